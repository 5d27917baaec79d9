"""Images and bodies in them, for tests."""

import numpy as np
from scipy.spatial.transform import Rotation

SHAPE, SPACING = (9, 8, 7), np.array([0.5, 1.25, 3.0])
TURN = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
