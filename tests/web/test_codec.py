"""The numbers of the 3D viewer (web/src), run by Node: its own tests, and its decoder against ours."""

import numpy as np
from scipy.spatial.transform import Rotation

from beamsplat.common.geometry.transforms import make_transform
from beamsplat.common.messages.splat_codec import pack, unpack
from beamsplat.common.raster.layout import COLOUR, MEAN, OPACITY, QUAT, SCALE
from tests.web.node import WEB, run_node


def test_the_viewers_own_tests_pass():
    run_node("--test", *sorted((WEB / "test").glob("*.test.mjs")))


def test_the_viewer_decodes_what_the_mapper_packs(tmp_path):
    rng = np.random.default_rng(11)
    params = rng.normal(size=(14, 500)).astype(np.float32)
    params[SCALE:QUAT] = rng.uniform(np.log(1e-3), np.log(0.3), (3, 500))
    params[COLOUR:] = rng.uniform(size=(3, 500))
    packed = pack(params)
    T_map_anchor = make_transform(Rotation.random(random_state=12).as_matrix(), np.array([3.0, -4.0, 0.5]))
    (tmp_path / "chunk").write_bytes(packed.tobytes())
    run_node("test/place_file.mjs", tmp_path / "chunk", tmp_path / "records", *T_map_anchor.ravel())
    records = np.fromfile(tmp_path / "records", np.uint32).reshape(500, 12)
    floats = records.view(np.float32)
    want = unpack(packed).astype(np.float64)
    assert (
        np.abs(floats[:, :3] - (T_map_anchor[:3, :3] @ want[MEAN:SCALE] + T_map_anchor[:3, 3:]).T).max()
        < 1e-5
    )
    R = T_map_anchor[:3, :3] @ Rotation.from_quat(np.roll(want[QUAT:OPACITY], -1, axis=0).T).as_matrix()
    scale = np.exp(want[SCALE:QUAT]).T
    covariance = np.einsum("nij,nj,nkj->nik", R, scale**2, R)
    upper = covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    largest = scale.max(axis=1)
    assert (np.abs(floats[:, 4:10] - upper) / largest[:, None] ** 2).max() < 1e-5
    assert np.abs(floats[:, 10] / largest - 1.0).max() < 1e-5
    rgba = records[:, 3].copy().view(np.uint8).reshape(500, 4) / 255.0
    assert np.abs(rgba[:, :3].T - want[COLOUR:]).max() < 1e-6
    opacity = np.clip(rgba[:, 3], 1e-3, 1.0 - 1e-3)  # the shader's limits
    assert np.abs(opacity - 1.0 / (1.0 + np.exp(-want[OPACITY]))).max() < 1e-6
