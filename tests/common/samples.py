"""Sample messages: one of each type."""

import numpy as np

from beamsplat.common.geometry.frames import camera_mount, lidar_mount
from beamsplat.common.geometry.transforms import se2_to_se3
from beamsplat.common.mapfiles.grid_tiles import pack_tile
from beamsplat.common.messages import (
    Anchors,
    Answer,
    CameraModel,
    Cloud,
    Correction,
    DepthEstimate,
    ExternalPose,
    FusedDepth,
    Grid,
    GridTile,
    Health,
    HealthBundle,
    Image,
    InputHealth,
    Keyframe,
    KeyframeAck,
    KeyframeCandidate,
    KeyframeDecision,
    LidarModel,
    MapAnchors,
    MapChunk,
    MapPoses,
    MapPreview,
    MapRender,
    MapState,
    MapStatus,
    Message,
    MovingBeams,
    NodeFigure,
    Odometry,
    OutputHealth,
    Rejected,
    Rig,
    Scan,
    Tick,
    WheelOdometry,
)  # fmt: skip


def sample_messages() -> list[Message]:
    """Return one message of each type, with no field at its default value."""
    rng = np.random.default_rng(7)
    T = se2_to_se3(np.array([[1.0, -2.0, 0.3], [0.5, 4.0, -3.0]]))
    camera = CameraModel(
        width_px=640, height_px=480, fx_px=530.0, fy_px=531.0, cx_px=319.5, cy_px=239.5,
        distortion_model="plumb_bob", distortion=(0.1, -0.2, 0.001, 0.002, 0.03),
        T_body_camera=camera_mount(0.1, 0.0, 0.45, pitch_down_rad=0.035),
    )  # fmt: skip
    return [
        Rig(
            stamp_ns=11, camera=camera, lidar=LidarModel(T_body_lidar=lidar_mount(0.0, 0.0, 0.18)),
            assumed=("camera height: assumed 0.45 m",), source="rig.toml",
        ),
        Image(
            stamp_ns=12, width_px=4, height_px=2, encoding="rgb8", step_bytes=12,
            data=rng.integers(0, 255, 24).astype(np.uint8),
        ),
        Scan(
            stamp_ns=13, angle_min_rad=-3.1, angle_increment_rad=0.01, time_increment_s=1e-4, scan_time_s=0.1,
            range_min_m=0.12, range_max_m=12.0,
            ranges_m=np.array([1.0, np.inf, np.nan, -1.0], np.float32), intensities=np.ones(4, np.float32),
        ),
        WheelOdometry(
            stamp_ns=14, T_odom_body=T[0], velocity_m_s=np.array([0.3, 0.0, 0.0]),
            angular_velocity_rad_s=np.array([0.0, 0.0, 0.1]),
        ),
        ExternalPose(stamp_ns=15, T_map_body=T[1]),
        Odometry(
            stamp_ns=16, T_odom_body=T[0], covariance=np.diag([1e-4, 1e-4, 1e-6]), status="lost",
            detail="no returns", quality=0.25, quality_reason="few surfaces",
        ),
        Correction(stamp_ns=17, T_map_odom=T[1], optimisation=3),
        Anchors(stamp_ns=18, anchor_ids=np.array([0, 7]), T_map_anchor=T, optimisation=3),
        MovingBeams(stamp_ns=22, moving=np.array([True, False, True])),
        Grid(
            stamp_ns=19, resolution_m=0.05, origin_m=np.array([-1.0, 2.0]),
            occupancy=np.array([[-1, 0, 100]], np.int8), changed=(0, 1, 1, 3),
        ),
        GridTile(
            stamp_ns=19, resolution_m=0.05, size=2, row=-3, column=4, remaining=1, map_uuid="m", since_ns=7,
            packed=np.frombuffer(pack_tile(np.array([[-1, 0], [100, 7]], np.int8)), np.uint8),
        ),
        DepthEstimate(
            stamp_ns=23, source="fastdepth", kind="relative", status="the network returned nothing above zero",
            values=np.array([[1.0, np.nan]], np.float32),
        ),
        FusedDepth.of(
            stamp_ns=24, depth_m=np.array([[1.0, np.nan]], np.float32), sigma_m=np.array([[0.1, np.nan]], np.float32),
            status="no beams in view", keyframe=True, scale=1.2, scale_sigma=0.01, inlier_share=0.9, residual_m=0.02,
            pairs=120, beams_age_ns=-5, T_odom_body=T[1],
        ),
        Cloud(
            stamp_ns=25, points_odom_m=np.ones((2, 3), np.float32), colours=np.full((2, 3), 9, np.uint8),
        ),
        Keyframe(
            stamp_ns=26, id=26, encoding="jpeg", picture=np.arange(5, dtype=np.uint8), camera=camera, anchor_id=7,
            T_anchor_body=T[0], T_map_anchor=T[1], optimisation=3, depth=np.arange(3, dtype=np.uint8),
            sigma=np.arange(4, dtype=np.uint8), mask=np.arange(2, dtype=np.uint8),
            beams=np.array([[320.0, 240.0, 2.0, 0.01]], np.float32), why="moved",
        ),
        KeyframeCandidate(stamp_ns=26, T_odom_body=T[1], sharpness=0.7),
        KeyframeDecision(stamp_ns=26, keyframe=True, reason="moved"),
        KeyframeAck(stamp_ns=26, id=26, status="no pixel has a depth"),
        MapChunk(
            stamp_ns=27, anchor_id=7, revision=4, T_map_anchor=T[1], count=2, packed=np.arange(9, dtype=np.uint8),
            pose_revision=3,
        ),
        MapAnchors(stamp_ns=27, pose_revision=3, anchor_ids=np.array([0, 7]), T_map_anchor=T),
        MapState(stamp_ns=27, first=4, total=9, data=np.arange(5, dtype=np.uint8)),
        MapPoses(
            stamp_ns=28, keyframe_ids=np.array([26, 30]), stamps_ns=np.array([26, 30]), T_map_body=T,
        ),
        MapRender(
            stamp_ns=0, render=np.arange(6, dtype=np.uint8), T_map_camera=T[0], left_out=12,
            camera=CameraModel(
                width_px=320, height_px=240, fx_px=250.5, fy_px=251.0, cx_px=159.25, cy_px=119.5,
                T_body_camera=np.eye(4),
            ),
        ),
        MapPreview(
            stamp_ns=26, keyframe_id=26, render=np.arange(6, dtype=np.uint8), T_map_camera=T[0],
            camera=CameraModel(
                width_px=320, height_px=240, fx_px=250.5, fy_px=251.0, cx_px=159.25, cy_px=119.5, T_body_camera=T[1],
            ),
        ),
        MapStatus(
            stamp_ns=26, status="the mask leaves no pixel to use", keyframes=3, refused=1, gaussians=9000, steps=40,
            loss=0.1, foretold_share=0.5, foretold_psnr_db=19.0, psnr_db=27.0, depth_error_m=0.02,
        ),
        Tick(stamp_ns=20, count=5),
        Health(
            stamp_ns=21, node="depth", instance="00ff", epoch=2, state="active",
            inputs=(InputHealth(topic="rig", received=1, dropped=2, lost=3, undecodable=4, stale=5, age_ms=6.0, late=7, refused=8),),
            outputs=(OutputHealth(topic="rig", sent=1, bytes=2, refused=3),),
            step_p50_ms=1.0, step_p95_ms=2.0, rss_mb=3.0, cpu_percent=4.0, detail="warm",
            rejected=(Rejected(topic="fusion/depth", reason="N beams", count=9),), pid=10, status="lost: no match",
            figures=(NodeFigure(name="link_up", value=1.0),), clock_id=2**64 - 1,
        ),
        HealthBundle(stamp_ns=32, packed=np.arange(90, dtype=np.uint8)),
        Answer(stamp_ns=31, text="depth was told to end, and starts again"),
    ]  # fmt: skip


def assert_equal(a: object, b: object) -> None:
    """Assert deep equality, with NaN equal to NaN; arrays by value, shape and dtype."""
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif hasattr(a, "model_fields_set"):
        for name in type(a).model_fields:
            assert_equal(getattr(a, name), getattr(b, name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b):
            assert_equal(x, y)
    else:
        assert a == b
