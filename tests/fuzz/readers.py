"""Damaged files for every reader: each is read, or refused by an error that the reader documents.

    python tests/fuzz/readers.py --minutes 60          # counts, and what was found, at the end and meanwhile
    python tests/fuzz/readers.py --only .nrrd .dcm     # the files whose names end so
    python tests/fuzz/readers.py --case 1234           # reads that one again, and leaves its file in this folder

Files are read in a process of its own, which may end, hang or run out of memory: then the next one goes on.
"""

import argparse
import json
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))  # as pytest imports these files, too
from mutate import mutated
from seeds import Seed, seeds

_SECONDS = 20.0  # for one file; the slowest compiles a fit's programs
_STARTS = 120.0  # for the imports, and the first compilation
_BYTES = 2**32  # more address space than this process has when it starts
_GROWTH = 2**28  # resident memory that one small file may take
_OUTCOMES = ("read", "documented error", "undocumented error", "crash", "hang", "memory")


def main() -> int:
    """Run; the exit status is 1 where something was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--cases", type=int, default=sys.maxsize, help="stop after so many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", metavar="SUFFIX", default=[""], help="of the files: .nii.gz .nrrd")
    parser.add_argument("--case", type=int, help="only this one, with its error in full")
    parser.add_argument("--work", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case is not None:
        return _show(_known(options.only), options.seed, options.case)
    if options.work is not None:
        _work(_known(options.only), options.seed, options.work)
        return 0
    counts = _supervise(options.only, options.seed, time.monotonic() + 60 * options.minutes, options.cases)
    print(", ".join(f"{outcome}: {counts[outcome]}" for outcome in _OUTCOMES))
    return int(any(counts[outcome] for outcome in _OUTCOMES[2:]))


def _known(only: list[str]) -> list[Seed]:
    """The seeds whose names end so."""
    known = [one for one in seeds() if one.name.endswith(tuple(only))]
    if not known:
        sys.exit(f"no seed's name ends with {' or '.join(only)}")
    return known


def _supervise(only: list[str], seed: int, end: float, n_cases: int) -> Counter[str]:
    """Let processes read one case after the other; what happened to each of them."""
    counts: Counter[str] = Counter()
    case = 0
    while time.monotonic() < end and case < n_cases:
        command = [sys.executable, __file__, "--seed", str(seed), "--work", str(case), "--only", *only]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as worker:
            assert worker.stdout is not None
            limit, ended = _STARTS, False
            while case < n_cases and time.monotonic() < end:
                if not select.select([worker.stdout], [], [], limit)[0]:
                    ended = _note(counts, case, "hang", f"nothing for {limit:.0f} s")
                elif not (line := worker.stdout.readline()):
                    ended = _note(counts, case, "crash", f"exit status {worker.wait()}")
                else:
                    said = json.loads(line)
                    if said["outcome"] != "started":
                        _note(counts, case, said["outcome"], said["words"])
                        case += 1
                    limit = _SECONDS
                if ended:
                    case += 1
                    break
            worker.kill()
    return counts


def _note(counts: Counter[str], case: int, outcome: str, words: str) -> bool:
    counts[outcome] += 1
    if outcome not in _OUTCOMES[:2]:
        print(f"case {case}: {outcome}: {words}", flush=True)
    return True


def _work(known: list[Seed], seed: int, case: int) -> None:
    """Read cases from this one on, and say what happened, a line each."""
    said, sys.stdout = sys.stdout, sys.stderr  # what libraries print is not an answer
    here = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (here + _BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        outcome, words = _outcome(*_case(known, seed, case))
        print(json.dumps({"outcome": outcome, "words": words}), file=said, flush=True)
        case += 1


def _case(known: list[Seed], seed: int, case: int) -> tuple[Seed, bytes]:
    rng = np.random.default_rng([seed, case])
    share = np.array([one.share for one in known])
    one = known[int(rng.choice(len(known), p=share / share.sum()))]
    return one, mutated(one.data, rng)


def _outcome(seed: Seed, data: bytes) -> tuple[str, str]:
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", UserWarning)
        path = Path(folder, seed.name)
        path.write_bytes(data)
        before = _peak(reset=True)
        try:
            seed.read(path)
            outcome, words = "read", ""
        except MemoryError:
            outcome, words = "memory", seed.name
        except seed.errors as error:
            outcome, words = "documented error", ""
            if seed.name not in str(error):
                outcome, words = "undocumented error", f"{seed.name}: names no file: {error}"
        except Exception as error:
            at = traceback.extract_tb(error.__traceback__)[-1]
            words = f"{type(error).__name__}: {str(error)[:200]} ({Path(at.filename).name}:{at.lineno})"
            outcome, words = "undocumented error", f"{seed.name}: {words}"
        grown = _peak() - before
        return ("memory", f"{seed.name}: {grown / 2**20:.0f} MiB") if grown > _GROWTH else (outcome, words)


def _peak(reset: bool = False) -> int:
    """The largest resident memory since the last reset, in bytes."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    status: Any = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) * 1024


def _show(known: list[Seed], seed: int, case: int) -> int:
    one, data = _case(known, seed, case)
    path = Path(f"case_{case}_{one.name}")
    path.write_bytes(data)
    print(f"{os.fspath(path)}: {one.name}, {len(data)} bytes")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, one.name)
        copy.write_bytes(data)
        print(one.read(copy))
    return 0


if __name__ == "__main__":
    sys.exit(main())
