"""A Gaussian map from images with depth and poses, on arrays; rendered from a new view and written as PLY.

python examples/gaussian_map.py [OUT.ply]
"""

import sys
from pathlib import Path

import numpy as np

from beamsplat import Mapper, MapperSettings, RasterCamera, Rasterizer, RgbdKeyframe, write_gaussian_ply

CAMERA = RasterCamera(fx_px=180.0, fy_px=180.0, cx_px=119.5, cy_px=89.5, width_px=240, height_px=180)
WALL_Z_M = 3.0


def view_from(x_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (image uint8, optical z float32, T_map_camera) of a textured wall seen from x on a rail."""
    v, u = np.mgrid[0 : CAMERA.height_px, 0 : CAMERA.width_px]
    x = x_m + (u - CAMERA.cx_px) / CAMERA.fx_px * WALL_Z_M  # where each pixel meets the wall, metres
    y = (v - CAMERA.cy_px) / CAMERA.fy_px * WALL_Z_M
    tiles = (np.floor(x / 0.4) + np.floor(y / 0.4)) % 2
    rgb = np.stack([90 + 110 * tiles, 120 + 60 * np.sin(2.0 * x), 140 + 50 * np.cos(3.0 * y)], axis=-1)
    T_map_camera = np.eye(4)
    T_map_camera[0, 3] = x_m
    return rgb.astype(np.uint8), np.full(u.shape, WALL_Z_M, np.float32), T_map_camera


def main(out: Path) -> float:
    """Map five views and return the PSNR in dB of a view between them that the mapper never saw."""
    mapper = Mapper(MapperSettings(), seed=0)
    for id, x_m in enumerate((0.0, 0.2, 0.4, 0.6, 0.8)):
        rgb, depth_m, T_map_camera = view_from(x_m)
        sigma_m = np.full(depth_m.shape, 0.02, np.float32)
        keyframe = RgbdKeyframe(id, rgb, CAMERA, T_map_camera, depth_m, sigma_m)
        result = mapper.add(keyframe, T_map_anchor=np.eye(4))  # one anchor: the map frame itself
        if not result.ok:
            raise SystemExit(f"keyframe {id} was rejected: {result.status}")
        mapper.optimise()
    mapper.refine(100)
    rgb, _, T_map_camera = view_from(0.5)
    rasterizer, gaussians = Rasterizer(), mapper.store
    render = rasterizer.render(gaussians.params, gaussians.count, CAMERA, np.linalg.inv(T_map_camera))
    error = np.clip(render.image[:3].transpose(1, 2, 0), 0.0, 1.0) - rgb / 255.0
    rasterizer.release(render)
    psnr_db = float(-10.0 * np.log10(np.mean(error**2)))
    write_gaussian_ply(out, gaussians.params[:, : gaussians.count])
    print(f"{gaussians.count} Gaussians, {psnr_db:.1f} dB at an unseen view, written to {out}")
    return psnr_db


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "wall.ply"))
