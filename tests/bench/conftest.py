"""After the timings of `bench_refine.py`: the ratios that `docs/measurements.md` quotes."""

RATIOS = (
    ("vertices, over C++", "jaxsubdiv, vertices", "C++, vertices"),
    ("with normals, over C++", "jaxsubdiv, normals", "C++, normals"),
    ("libigl's Loop matrix over ours", "libigl, Loop matrix", "jaxsubdiv, vertices"),
    ("OpenSubdiv's stencils over ours", "OpenSubdiv, stencils", "jaxsubdiv, vertices"),
    ("OpenSubdiv's levels over ours", "OpenSubdiv, levels", "jaxsubdiv, vertices"),
    ("trimesh's Loop over ours with tables", "trimesh, Loop with its tables", "tables"),
    ("vertices, over the floor", "jaxsubdiv, vertices", "floor"),
    ("value and gradient over vertices", "jaxsubdiv, gradient", "jaxsubdiv, vertices"),
    ("directional derivative over vertices", "jaxsubdiv, jvp", "jaxsubdiv, vertices"),
)


def pytest_terminal_summary(terminalreporter, config):
    session = getattr(config, "_benchmarksession", None)
    if session is None or not session.benchmarks:
        return
    medians = {(bench.group, bench.name): bench.stats.median for bench in session.benchmarks if bench.stats.rounds}
    write = terminalreporter.write_line
    write("\n| ratio of medians | mesh | |\n|---|---|---|")
    for name, above, below in RATIOS:
        for group in dict.fromkeys(group for group, _ in medians):
            if (group, above) in medians and (group, below) in medians:
                write(f"| {name} | {group} | {medians[group, above] / medians[group, below]:.2f} |")
    work = "jaxsubdiv, vertices"
    if all((kind, work) in medians for kind in ("triangles", "quads", "mixed", "shuffled")):
        triangles, quads = medians["triangles", work], medians["quads", work]
        write(f"| shuffled over ordered, vertices | triangles | {medians['shuffled', work] / triangles:.2f} |")
        # Half of the quads, and as many triangles as there are quads: 6,144 of the 5,120 timed alone.
        parts = quads / 2 + triangles * 6144 / 5120
        write(f"| mixed over the sum of its parts, vertices | mixed | {medians['mixed', work] / parts:.2f} |")
    for bench in session.benchmarks:
        for name, value in bench.extra_info.items():
            write(f"| {name} | {bench.group} | {value} |")
