"""What a change of `refine` gains: CPU seconds of two checkouts, taken by turns.

    git worktree add /tmp/before REVISION
    python tests/bench/refine_against.py /tmp/before

prints ratios of medians, this checkout over the other one. float32; 5,120 triangles on a sphere, 6,144 quads on a
torus; the batch has 16 meshes of 384 quads at 3 levels, and its figure is that of one mesh.
"""

import argparse
import functools
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]


def works() -> tuple[dict[str, Callable[[], object]], dict[str, float]]:
    """What is timed, and what is counted."""
    import jax
    import jax.numpy as jnp
    import meshes
    import trimesh

    import jaxsubdiv as js

    js.keep_freed_memory()
    ball, torus = trimesh.creation.icosphere(4), meshes.torus
    shapes = {
        "triangles": js.ControlMesh(ball.vertices, ball.faces),
        "quads": js.ControlMesh(*torus(96, 64)),
        "mixed": js.ControlMesh(*torus(96, 64, "mixed")),
    }
    schemes = {"": js.Interpolating(), "circle-preserving, ": js.CirclePreserving()}
    timed: dict[str, Callable[[], object]] = {}
    counted: dict[str, float] = {}

    def in_single(mesh: js.ControlMesh) -> js.Control:
        return jax.tree.map(lambda leaf: leaf.astype(jnp.float32), mesh.control())

    def add(name: str, function: Callable, *arguments: object) -> Any:
        compiled = jax.jit(function).lower(*arguments).compile()
        timed[name] = lambda: jax.block_until_ready(compiled(*arguments))
        return compiled

    def functions(scheme: js.AbstractScheme) -> dict[str, Callable]:
        def positions(topology, control):
            return js.refine(scheme, topology, control).vertices

        def with_normals(topology, control):
            surface = js.refine(scheme, topology, control)
            return surface.vertices, surface.normals

        def square(topology, control):
            x = positions(topology, control)
            return jnp.vdot(x, x)

        return {"positions": positions, "with normals": with_normals, "gradient": jax.value_and_grad(square, 1)}

    for of_scheme, scheme in schemes.items():
        kinds = shapes if not of_scheme else {"quads": shapes["quads"]}
        for kind, mesh in kinds.items():
            control = in_single(mesh)
            for levels in (1, 2, 4) if not of_scheme else (4,):
                topology = js.build_topology(mesh, scheme, levels)
                n = sum(leaf.nbytes for leaf in jax.tree.leaves(topology.levels))
                size = jax.eval_shape(js.refine, scheme, topology, control).vertices.size * 4
                counted[f"{of_scheme}{kind}, level {levels}: table bytes a vertex"] = 12 * n / size
                for work, function in functions(scheme).items():
                    name = f"{of_scheme}{kind}, level {levels}: {work}"
                    compiled = add(name, function, topology, control)
                    needs = compiled.memory_analysis().temp_size_in_bytes
                    counted[f"{name}, temporaries over positions"] = needs / size
                if levels == 4 and not of_scheme:
                    # Before `refine_vertices`, who wanted the vertices alone called `refine`.
                    alone = getattr(js, "refine_vertices", js.refine)
                    timed[f"{kind}, level 4: positions, not jitted"] = functools.partial(
                        lambda *arguments: jax.block_until_ready(arguments[0](*arguments[1:])),
                        alone,
                        scheme,
                        topology,
                        control,
                    )
    small = js.ControlMesh(*torus(24, 16))
    topology, control = js.build_topology(small, schemes[""], 3), in_single(small)
    controls = jax.tree.map(lambda leaf: jnp.stack([leaf] * 16), control)
    for work, function in functions(schemes[""]).items():
        add(f"batch of 16: {work}", jax.vmap(function, (None, 0)), topology, controls)
    if hasattr(js, "pad_topology"):
        counted["second mesh of a size class: programs compiled"] = compiled_for_second()
    return timed, counted


def compiled_for_second() -> int:
    """Programs compiled for a sheet of 17 x 15 cells, after a torus of 16 x 16 in the same class."""
    import jax
    import meshes

    import jaxsubdiv as js

    scheme, compiled = js.Interpolating(), []
    refine = jax.jit(js.refine)
    for mesh in (js.ControlMesh(*meshes.torus(16, 16)), js.ControlMesh(*meshes.grid(17, 15))):
        topology = js.pad_topology(js.build_topology(mesh, scheme, 2))
        refine(scheme, topology, js.pad_control(topology, mesh.control()))
        compiled.append(refine._cache_size())
    return compiled[1] - compiled[0]


def serve(repository: str) -> None:
    """Time what the lines of the standard input name."""
    sys.path[:0] = [repository, str(HERE / "tests")]
    timed, counted = works()
    print(json.dumps([list(timed), counted]), flush=True)
    for line in sys.stdin:
        function = timed[line.strip()]
        start = time.process_time()
        function()
        print(time.process_time() - start, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", help="checkout to compare with")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.other)
        return
    processes = [
        subprocess.Popen(
            [sys.executable, __file__, repository, "--serve"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=repository,
        )
        for repository in (str(HERE), options.other)
    ]

    def ask(process: subprocess.Popen, name: str) -> float:
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(name + "\n")
        process.stdin.flush()
        return float(process.stdout.readline())

    (names, ours), (_, theirs) = (json.loads(process.stdout.readline()) for process in processes if process.stdout)
    print("| | this | other | ratio |\n|---|---|---|---|")
    for name in names:
        for process in processes:
            ask(process, name)
        rounds = [[ask(process, name) for process in processes] for _ in range(options.rounds)]
        mine, other = (statistics.median(column) for column in zip(*rounds, strict=True))
        print(f"| {name}, CPU ms | {1e3 * mine:.2f} | {1e3 * other:.2f} | {mine / other:.2f} |", flush=True)
    for name, value in ours.items():
        before = theirs.get(name)
        of_other = "- | -" if before is None else f"{before:.2f} | {value / before if before else 1:.2f}"
        print(f"| {name} | {value:.2f} | {of_other} |")
    for process in processes:
        process.terminate()


if __name__ == "__main__":
    main()
