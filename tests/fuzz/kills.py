"""Kill `jaxsubdiv-fit` at random moments, go on, and see that nothing is lost, mixed or left over.

    JAX_COMPILATION_CACHE_DIR=/tmp/cache python tests/fuzz/kills.py [KILLS] [SEED]

Not one of the tests: 200 kills take about twenty minutes. Every episode begins with an empty folder, or with the whole
results of other options; the command is killed again and again until one run gets to its end. After every kill each
folder holds one whole fit, of the options before or after, or a checkpoint as its mark; in the end it holds the very
bytes of a run that was not disturbed.
"""

import csv
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import meshes

import jaxsubdiv as js
from fitting.__main__ import main  # loaded once: the runs are forks, which begin at once

SCANS = ("p1/scan.xyz", "p2/scan.xyz")
COMMAND = [*SCANS, "--control", "control.obj", "--levels", "1", "--max-sweeps", "3"]
OPTIONS = {"a": [], "b": ["--h", "1.1"]}


def write_inputs(rng: np.random.Generator) -> None:
    """Two noisy ellipsoids, and a rough one as the template."""
    vertices, faces = meshes.mixed_closed()
    js.write_mesh("control.obj", js.ControlMesh(vertices * (24, 18, 15), sorted(faces, key=len)))
    for i, name in enumerate(SCANS):
        Path(name).parent.mkdir(exist_ok=True)
        points = rng.normal(size=(300, 3))
        points *= (25 + i, 19, 16) / np.linalg.norm(points, axis=1, keepdims=True)
        np.savetxt(name, points + rng.normal(scale=0.2, size=points.shape))


def start(options: str, out: str, *more: str) -> int:
    """A run in a process of its own; its number."""
    process = os.fork()
    if process == 0:
        with open("log.txt", "a") as log:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        os._exit(main([*COMMAND, *OPTIONS[options], "-o", out, *more]))
    return process


def killed(process: int, after: float) -> bool:
    """Whether the run was still working after so many seconds, and was killed; it must end well otherwise."""
    end = time.monotonic() + after
    while time.monotonic() < end:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            assert os.waitstatus_to_exitcode(status) in (0, 1), f"exit status {status}; see {Path('log.txt').resolve()}"
            return False
        time.sleep(0.002)
    os.kill(process, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) == -signal.SIGKILL


def contents(folder: Path) -> dict[str, bytes]:
    """Every file by its path; of the summary all but the seconds."""
    files = {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
    if "summary.csv" in files:
        rows = csv.DictReader(files["summary.csv"].decode().splitlines())
        files["summary.csv"] = repr([row | {"seconds": ""} for row in rows]).encode()
    return files


def check_after_kill(out: Path, whole: dict[str, dict[str, bytes]]) -> str:
    """See that every folder holds one whole fit or is marked; returns how many of each."""
    told = {"whole": 0, "marked": 0, "empty": 0}
    for folder in out.iterdir() if out.exists() else ():
        if not folder.is_dir() or folder.name.startswith(".unfinished-"):
            continue
        found = {name: data for name, data in contents(folder).items() if not name.startswith(".unfinished-")}
        if "checkpoint_start.npz" in found:
            told["marked"] += 1
        elif set(found) <= {"checkpoint.npz"}:
            told["empty"] += 1
        else:
            found.pop("checkpoint.npz", None)
            of = [{n.split("/")[1]: d for n, d in w.items() if n.startswith(folder.name + "/")} for w in whole.values()]
            assert found in of, f"{folder} holds no whole fit: {sorted(found)}"
            told["whole"] += 1
    return ", ".join(f"{count} {name}" for name, count in told.items())


def run_episodes(kills: int, seed: int) -> None:
    rng, whole, seconds = np.random.default_rng(seed), {}, 0.0
    write_inputs(rng)
    for options in [*OPTIONS, *OPTIONS]:  # the second time with compiled programs
        shutil.rmtree(f"whole_{options}", ignore_errors=True)
        began = time.monotonic()
        assert not killed(start(options, f"whole_{options}"), 600.0)
        seconds = time.monotonic() - began
        whole.setdefault(options, contents(Path(f"whole_{options}")))
        assert contents(Path(f"whole_{options}")) == whole[options], "two undisturbed runs differ"
    print(f"an undisturbed run takes {seconds:.1f} s", flush=True)
    n = episode = 0
    while n < kills:
        episode += 1
        out, over = Path("out"), bool(rng.integers(2))
        shutil.rmtree(out, ignore_errors=True)
        if over:
            shutil.copytree("whole_a", out)
        more = () if over else ("--resume",)
        while killed(start("b", str(out), *more), rng.uniform(0, 1.5 * seconds)):
            n += 1
            print(f"kill {n}: {check_after_kill(out, whole)}", flush=True)
        found = contents(out)
        assert sorted(found) == sorted(whole["b"]), f"lost or left over: {sorted(set(found) ^ set(whole['b']))}"
        others = [name for name in found if found[name] != whole["b"][name]]
        assert not others, f"differ from an undisturbed run: {others}"
        print(f"episode {episode}, {'over other results' if over else 'resumed'}: as an undisturbed run", flush=True)
    print(f"{n} kills in {episode} episodes: nothing lost, mixed or left over")


if __name__ == "__main__":
    folder = tempfile.mkdtemp(prefix="kills-")
    os.chdir(folder)
    print(f"in {folder}")
    run_episodes(*(int(word) for word in (sys.argv[1:] + ["200", "0"][len(sys.argv) - 1 :])))
    shutil.rmtree(folder)
