"""The rotation from the map frame (z up) to the frame of glTF and SPZ files (y up)."""

import numpy as np

# x stays x, z (up) becomes y, y (left) becomes -z. The determinant is +1: nothing is mirrored.
R_yup_map = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
QUAT_XYZW = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # the same rotation: -90 degrees about x
