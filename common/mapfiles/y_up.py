"""The rotations from the map frame (z up) to the frames of splat files."""

import numpy as np

# glTF and SPZ: y up.
# x stays x, z (up) becomes y, y (left) becomes -z. The determinant is +1: nothing is mirrored.
R_yup_map = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
QUAT_XYZW = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # the same rotation: -90 degrees about x

# SOG and compressed PLY: y down. PlayCanvas and SuperSplat turn them by 180 degrees about z, as they do with
# the files of 3DGS training; then they have the orientation of the glTF and SPZ files.
R_ydown_map = np.diag([-1.0, -1.0, 1.0]) @ R_yup_map
