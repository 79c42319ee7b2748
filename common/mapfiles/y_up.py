"""Our maps have z up; glTF and SPZ have y up. Both get the same turn, so that they look alike."""

import numpy as np

# x stays, z (up) becomes y, y (left) becomes -z: proper, so nothing is mirrored.
R_yup_map = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
QUAT_XYZW = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # the same turn: -90 degrees about x
