"""The camera tracker on both engines: the GPU's by the CPU build of its kernels."""

import pytest

from beamsplat.common.engines.choice import cuda_obstacle
from beamsplat.common.engines.cuda import CudaSplatEngine
from beamsplat.common.errors import UserError
from beamsplat.services.localization.camera.depth import DepthPrior
from beamsplat.services.localization.camera.node import CameraLocalization, CameraLocalizationConfig
from beamsplat.services.localization.camera.settings import CameraTrackerSettings
from beamsplat.services.localization.camera.tracker import CameraTracker
from tests.common.raster.cuda.shim import needs_compiler, shim_kernels
from tests.services.localization.camera.box import CAMERA, T_BODY_CAMERA, drive, pose_error, render_view

SETTINGS = CameraTrackerSettings(width_px=80, first_steps=3, steps_per_image=1, rasterizer_steps=1)


def track(path, engine=None):
    tracker = CameraTracker(CAMERA, T_BODY_CAMERA, SETTINGS, engine)
    results = []
    for i, T in enumerate(path):
        rgb, z = render_view(T)
        results.append(tracker.track(i, rgb))
        tracker.add_depth(i, DepthPrior(z, 0.01, True))
    return tracker, results


@needs_compiler
def test_the_tracker_finds_the_same_poses_on_both_engines():
    path = drive(5)
    cpu, cuda = track(path), track(path, CudaSplatEngine(shim_kernels()))
    assert cuda[0].splats.count == pytest.approx(cpu[0].splats.count, rel=0.01)
    for T, a, b in zip(path[1:], cpu[1][1:], cuda[1][1:]):
        assert a.status == b.status == "ok"
        assert pose_error(T, b.T_map_body)[0] < 0.04
        assert pose_error(a.T_map_body, b.T_map_body)[0] < 0.004
    for tracker, _ in (cpu, cuda):
        tracker.splats.clear()
        assert tracker.splats.count == 0
        tracker.close()


@pytest.mark.skipif(cuda_obstacle() is None, reason="this machine has a GPU")
def test_a_tracker_that_is_to_use_a_gpu_says_what_is_missing_before_it_starts():
    with pytest.raises(
        UserError, match=r'localization.engine = "cuda": .+; or set localization.engine = "auto"'
    ):
        CameraLocalization(CameraLocalizationConfig(engine="cuda")).check_resources()
