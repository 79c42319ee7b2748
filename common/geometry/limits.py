"""Limits of what a camera can be."""

from __future__ import annotations

# Of the focal length, as a multiple of the longer side of the image: less than a tenth of that of a fisheye
# lens, and 90 times that of a usual camera.
FOCAL_RATIO = (0.02, 100.0)
