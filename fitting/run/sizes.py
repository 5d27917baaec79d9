"""Sizes that a fit can compute with."""

from typing import Any

import numpy as np

import jaxsubdiv as js

from ..scan.scan import Scan, ScanError

# In mm. Products of four lengths, and of their reciprocals, are far from the ends of single precision.
_LEAST, _MOST = 1e-6, 1e8


def check_sizes(scan: Scan, mesh: js.ControlMesh | js.Control | None) -> None:
    """See that coordinates are neither too small nor too large to compute with.

    Raises:
        ScanError: those of the scan are.
        ValueError: those of the control mesh are.
    """
    given: list[tuple[str, Any, type[ValueError]]] = [("scan", scan.points, ScanError)]
    if mesh is not None:
        given.append(("control mesh", mesh.vertices, ValueError))
    for name, rows, error in given:
        rows = np.asarray(rows, np.float64)
        size, most = float(np.ptp(rows, axis=0).max()), float(np.abs(rows).max())
        if 0 < size < _LEAST or most > _MOST:
            raise error(
                f"the {name} measures {size:.3g} across, with coordinates up to {most:.3g}: a fit takes sizes from "
                f"{_LEAST:g} to {_MOST:g}, in mm. Read the file with `scale=` (1000 for metres)."
            )
