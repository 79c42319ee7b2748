"""Metric depth of one image and one scan: the beams and the floor explain the image of a simulated corridor.

python examples/depth.py
"""

import numpy as np

from beamsplat import (
    Beams,
    DepthInput,
    Fusion,
    FusionInput,
    Pinhole,
    camera_mount,
    lidar_mount,
    make_source,
    scan_points,
)

CAMERA = Pinhole(fx_px=300.0, fy_px=300.0, cx_px=159.5, cy_px=119.5, width_px=320, height_px=240)
T_BODY_CAMERA = camera_mount(0.1, 0.0, 0.40)  # 40 cm above the floor, looking forward
T_BODY_LIDAR = lidar_mount(0.0, 0.0, 0.20)
HALF_WIDTH_M, END_M = 1.2, 6.0  # walls at y = +-1.2 m, and one across at x = 6 m


def scan() -> tuple[np.ndarray, float, float]:
    """Return ranges float32 [720], angle of the first beam and increment: what the lidar measures."""
    increment_rad = 2 * np.pi / 720
    angle = -np.pi + np.arange(720) * increment_rad
    with np.errstate(divide="ignore"):
        side = np.where(np.sin(angle) == 0.0, np.inf, HALF_WIDTH_M / np.abs(np.sin(angle)))
        end = np.where(np.cos(angle) > 0.0, END_M / np.cos(angle), np.inf)
    return np.minimum(side, end).astype(np.float32), -np.pi, increment_rad


def true_depth() -> np.ndarray:
    """Return the optical z float64 [240, 320] of floor and walls; the ceiling is out of reach."""
    rays = CAMERA.ray_grid() @ T_BODY_CAMERA[:3, :3].T  # body frame, per metre of optical z
    x0, y0, z0 = T_BODY_CAMERA[:3, 3]
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 2] < 0, -z0 / rays[..., 2], np.inf)
        side = np.where(
            rays[..., 1] == 0, np.inf, (HALF_WIDTH_M - y0 * np.sign(rays[..., 1])) / np.abs(rays[..., 1])
        )
        end = (END_M - x0) / rays[..., 0]
    return np.minimum(np.minimum(floor, side), end)


def main() -> float:
    """Estimate depth and return the median error in metres over the pixels that were answered."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (CAMERA.height_px, CAMERA.width_px, 3), dtype=np.uint8)
    ranges, angle_min_rad, increment_rad = scan()
    points_lidar, index = scan_points(ranges, angle_min_rad, increment_rad, range_min_m=0.1, range_max_m=12.0)
    points_body = points_lidar @ T_BODY_LIDAR[:3, :3].T + T_BODY_LIDAR[:3, 3]
    beams = Beams(points_body, index, np.full(len(index), 0.01))
    # 1. A depth source guesses dense depth: here from beams and floor alone, elsewhere a network.
    estimate = make_source("stixel").estimate(
        DepthInput(0, image, CAMERA, T_BODY_CAMERA, beams, floor_known=True)
    )
    # 2. Fusion makes it metric and states a standard deviation for every pixel.
    fusion = Fusion(CAMERA, T_BODY_CAMERA, floor_known=True, planar=True)
    frame = FusionInput(0, image, np.eye(4), beams, estimate.values, estimate.kind)
    result = fusion.fuse(frame, keyframe=True)
    known = np.isfinite(result.depth_m)
    error_m = float(np.median(np.abs(result.depth_m - true_depth())[known]))
    print(f"{result.status}: {known.mean():.0%} of the pixels answered, median error {error_m:.3f} m, "
          f"median sigma {np.median(result.sigma_m[known]):.3f} m")  # fmt: skip
    return error_m


if __name__ == "__main__":
    main()
