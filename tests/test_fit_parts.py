"""The bench that times a fit part by part looks for the parts where they are."""

import importlib.util
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from scans import problem

PATH = Path(__file__).parent / "bench" / "fit_parts.py"
spec = importlib.util.spec_from_file_location("fit_parts", PATH)
fit_parts = importlib.util.module_from_spec(spec)
spec.loader.exec_module(fit_parts)


@pytest.mark.parametrize("place", [place for places in fit_parts.PARTS.values() for place in places])
def test_every_part_is_there(place):
    original, _ = patch(place).get_original()
    assert callable(original)


def test_every_part_is_timed_and_the_fit_is_what_it_is_without():
    clock = fit_parts.Clock()
    with clock.watching():
        timed = problem().fit(max_sweeps=1)
    assert set(clock.calls) == set(fit_parts.PARTS) and all(seconds > 0 for seconds in clock.seconds.values())
    np.testing.assert_array_equal(timed.control.vertices, problem().fit(max_sweeps=1).control.vertices)
