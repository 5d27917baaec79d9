"""How many threads the command solves in."""

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from fitting.command.programs import calculate_in_one_thread


def count_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.mark.parametrize(("given", "expected"), [(None, {1}), ("2", {2})])
def test_command_solves_in_one_thread_unless_the_environment_says(given, expected, monkeypatch):
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    with threadpool_limits(2, "blas"):
        calculate_in_one_thread()
        assert count_threads() == expected
