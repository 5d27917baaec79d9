"""Files as other programs write them, for tests."""

import numpy as np

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)


def table(*columns: np.ndarray, separator: str = " ") -> str:
    return "".join(separator.join(f"{value:g}" for value in row) + "\n" for row in np.column_stack(columns))


FIVE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (-1, 0.5, 0)]
LINES = "".join(f"{x} {y} {z}\n" for x, y, z in FIVE)
XML = '<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="5" NumberOfStrips="0" NumberOfPolys="1"><Points>'
XML += f'<DataArray type="Float32" NumberOfComponents="3" format="ascii">{LINES}</DataArray></Points><Polys><DataArray '
XML += 'type="Int32" Name="connectivity" format="ascii">0 1 2 3 4</DataArray><DataArray type="Int32" Name="offsets" '
XML += 'format="ascii">5</DataArray></Polys></Piece></PolyData></VTKFile>'
PLY = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
PLY += "property list uchar int vertex_indices\nend_header\n"
FREESURFER = "#!ascii version of lh.white\n4 2\n" + table(SQUARE, np.zeros(4)) + "0 1 2 0\n0 2 3 0\n"
