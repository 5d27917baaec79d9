"""Keeping freed memory: what it says is what glibc does."""

import platform
import subprocess
import sys

import pytest

# In a process of its own: the setting stays. The share of page faults that a second array of 100 MB causes tells.
_FAULTS = """
import resource, sys, numpy as np, jaxsubdiv as js
if sys.argv[1] == "keep":
    assert js.keep_freed_memory()
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(100_000_000 // 8)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the setting is glibc's")
def test_a_large_array_is_not_mapped_anew():
    def faults(how: str) -> list[int]:
        command = [sys.executable, "-c", _FAULTS, how]
        return [int(n) for n in subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()]

    first, second = faults("keep")
    assert second < first / 20
    first, second = faults("leave")
    assert second > first / 2
