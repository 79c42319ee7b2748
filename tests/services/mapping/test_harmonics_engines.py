"""Colours that depend on the direction, in both engines: images, gradients, moves, maps, sessions and PLY files."""

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData

from beamsplat.common.engines.cpu import CpuSplatEngine
from beamsplat.common.engines.cuda import CudaSplatEngine
from beamsplat.common.geometry.transforms import inverse, make_transform, se3_exp, so3_exp
from beamsplat.common.harmonics.basis import coefficients
from beamsplat.common.mapfiles.ply import write_gaussian_ply
from beamsplat.common.mapfiles.state import store_of
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.services.mapping.engines.cpu import CpuEngine
from beamsplat.services.mapping.engines.cuda import CudaEngine
from beamsplat.services.mapping.keyframe import RgbdKeyframe
from beamsplat.services.mapping.mapper import HALF, Mapper
from beamsplat.services.mapping.session.state import arrays_of, restore
from beamsplat.services.mapping.settings import LearningRates
from beamsplat.tools.bench.raster import synthetic_room
from tests.common.raster.cuda.shim import needs_compiler, shim_kernels
from tests.services.mapping.test_cuda_engine import SETTINGS

CAMERA = RasterCamera(44.0, 44.0, 31.5, 23.5, 64, 48)
COUNT = 3000


@pytest.fixture(scope="module")
def room():
    params, T_camera_map = synthetic_room(COUNT)
    params[3:5] += 1.0
    return params[:, :COUNT], T_camera_map


def filled(engine, room, degree):
    rng = np.random.default_rng(degree)
    engine.store.add(room[0], 0)
    state = engine.store.state()
    state["harmonics"] = rng.normal(scale=0.1, size=(3 * coefficients(degree), COUNT)).astype(np.float32)
    engine.store.restore(state)
    return engine


def engines(room, degree):
    made = CpuSplatEngine(degree=degree), CudaSplatEngine(shim_kernels(), degree=degree)
    return [filled(engine, room, degree) for engine in made]


def towards_grey(image, gradient):
    gradient[:] = 0.0
    gradient[:3] = (image[:3] - 0.5) / image[:3].size
    return float(0.5 * np.mean((image[:3] - 0.5) ** 2))


@needs_compiler
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_both_engines_show_the_same_and_have_the_same_gradients(room, degree):
    T, (cpu, cuda) = room[1], engines(room, degree)
    plain = CpuSplatEngine()
    plain.store.add(room[0], 0)
    image = cpu.render(CAMERA, T)
    assert np.abs(image - plain.render(CAMERA, T)).max() > 0.02
    np.testing.assert_allclose(cuda.render(CAMERA, T), image, atol=3e-4)
    (a, pose_a), (b, pose_b) = (one.fit(CAMERA, T, towards_grey) for one in (cpu, cuda))
    assert b == pytest.approx(a, rel=1e-4)
    np.testing.assert_allclose(pose_b, pose_a, atol=2e-3 * np.abs(pose_a).max())
    # What the harmonics add to it: finite differences of the rest are disturbed by splats that appear.
    numeric = numeric_pose_gradient(cpu, T) - numeric_pose_gradient(plain, T)
    added = pose_a - plain.fit(CAMERA, T, towards_grey)[1]
    np.testing.assert_allclose(added, numeric, atol=0.2 * np.abs(added).max())


def numeric_pose_gradient(engine, T_camera_map):
    losses = [
        [engine.fit(CAMERA, se3_exp(sign * 1e-3 * xi) @ T_camera_map, towards_grey)[0] for sign in (1, -1)]
        for xi in np.eye(6)
    ]
    return np.array([(higher - lower) / 2e-3 for higher, lower in losses])


@needs_compiler
def test_a_map_that_is_turned_looks_the_same_from_a_camera_that_is_turned_with_it(room):
    T_new_old = make_transform(so3_exp([0.4, -0.9, 1.3]), np.array([2.0, -1.0, 0.5]))
    for engine in engines(room, 3):
        before = engine.render(CAMERA, room[1])
        engine.store.move(0, T_new_old)
        after = engine.render(CAMERA, room[1] @ inverse(T_new_old))
        np.testing.assert_allclose(after, before, atol=2e-3)


RATES = replace(LearningRates(), harmonics=2e-2, colour=2e-2)
GLOSSY = replace(SETTINGS, half_iterations=0, full_iterations=0, rates=RATES, max_colour_error=1.0)


def wall(number):
    """A wall 2 m away that is bright from one side (number 0) and dark from the other one."""
    T_map_camera = [np.eye(4), make_transform(so3_exp([0.0, np.pi, 0.0]), np.array([0.0, 0.0, 4.0]))][number]
    rgb = np.full((48, 64, 3), (200, 60)[number], np.uint8)
    depth = np.full((48, 64), 2.0, np.float32)
    return RgbdKeyframe(number, rgb, CAMERA, T_map_camera, depth, np.full_like(depth, 0.01))


def glossy_map(engine):
    """Return the map of the wall, and its loss."""
    mapper = Mapper(GLOSSY, seed=1, engine=engine)
    for number in range(2):
        assert mapper.add(wall(number), np.eye(4)).ok
    mapper.refine(50, HALF)
    return mapper, float(np.mean([mapper.step(keyframe, HALF) for keyframe in mapper.keyframes.values()]))


@needs_compiler
def test_maps_with_harmonics_are_learnt_saved_and_exported_alike(room, tmp_path):
    (cpu, loss), (cuda, loss_cuda) = (
        glossy_map(engine) for engine in (CpuEngine(1, 1), CudaEngine(shim_kernels(), degree=1))
    )
    assert loss < 0.5 * glossy_map(CpuEngine())[1]  # without harmonics
    assert loss_cuda == pytest.approx(loss, rel=0.1)
    assert np.abs(cpu.store.state()["harmonics"]).max() > 0.02

    # Saved by one engine, opened by the other; with a higher degree, and with none.
    for saved, engine in ((cpu, CudaEngine(shim_kernels(), degree=2)), (cuda, CpuEngine(1, 0))):
        arrays = arrays_of(saved, {})
        opened = Mapper(GLOSSY, engine=engine)
        assert restore(opened, arrays, lambda id: lambda: wall(id)) == []
        state = opened.store.state()
        np.testing.assert_array_equal(state["params"], arrays["store_params"])
        if engine.store.degree:
            own = state["harmonics"].reshape(3, 8, -1)
            np.testing.assert_array_equal(own[:, :3], arrays["store_harmonics"].reshape(3, 3, -1))
            assert not own[:, 3:].any()
        else:
            assert "harmonics" not in state

    store = store_of(arrays_of(cuda, {}))
    assert store.degree == 1
    write_gaussian_ply(tmp_path / "map.ply", store.with_harmonics())
    vertices = PlyData.read(tmp_path / "map.ply")["vertex"]
    assert [p.name for p in vertices.properties][8:11] == ["f_dc_2", "f_rest_0", "f_rest_1"]
    for row in (0, 4, 8):
        np.testing.assert_array_equal(vertices[f"f_rest_{row}"], store.harmonics[row, : store.count])
    np.testing.assert_allclose(vertices["opacity"], store.params[10, : store.count])
