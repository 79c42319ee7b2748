"""The engines of CPU and GPU behind one interface: the same images, gradients and stores (the GPU by its CPU build)."""

from functools import lru_cache

import numpy as np
import pytest

from beamsplat.common.engines.choice import make_splat_engine
from beamsplat.common.engines.cpu import CpuSplatEngine
from beamsplat.common.engines.cuda import CudaSplatEngine
from beamsplat.common.engines.device_store import DeviceStore
from beamsplat.common.engines.protocol import EngineIdentity, identity_in
from beamsplat.common.geometry.transforms import se3_exp
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.layout import MEAN, SCALE
from beamsplat.common.raster.optimiser import learning_rates
from beamsplat.tools.bench.raster import synthetic_room
from tests.common.raster.cuda.shim import needs_compiler, shim_kernels

CAMERA = RasterCamera(44.0, 44.0, 31.5, 23.5, 64, 48)
RATES = learning_rates(1e-3, 1e-3, 1e-3, 1e-2, 1e-2)


@lru_cache(maxsize=1)
def room():
    params, T_camera_map = synthetic_room(3000)
    params[3:5] += 1.0
    return params[:, :3000], T_camera_map


def filled(engine):
    engine.store.add(room()[0], 0)
    return engine


def engines():
    return [filled(CpuSplatEngine()), filled(CudaSplatEngine(shim_kernels()))]


def towards_grey(image, gradient):
    """Half the squared distance of the colours to grey."""
    gradient[:] = 0.0
    gradient[:3] = (image[:3] - 0.5) / image[:3].size
    return float(0.5 * np.mean((image[:3] - 0.5) ** 2))


@needs_compiler
def test_both_engines_show_and_optimise_the_same():
    T = room()[1]
    cpu, cuda = engines()
    for one in (cpu, cuda):
        image, index = one.view(CAMERA, T)
        assert np.array_equal(one.render(CAMERA, T), image)
        assert np.all(np.diff(index) > 0)
        only_seen = CpuSplatEngine()  # nothing else contributes to the image
        only_seen.store.add(one.store.selected(index), 0)
        np.testing.assert_allclose(only_seen.render(CAMERA, T), image, atol=2e-4)
    np.testing.assert_allclose(cuda.render(CAMERA, T), cpu.render(CAMERA, T), atol=2e-4)
    (a, pose_a), (b, pose_b) = (one.fit(CAMERA, T, towards_grey) for one in (cpu, cuda))
    assert b == pytest.approx(a, rel=1e-4)
    np.testing.assert_allclose(pose_b, pose_a, atol=1e-3 * np.abs(pose_a).max())
    np.testing.assert_array_equal(cuda.store.params[:, :3000], room()[0])  # without rates nothing is changed
    for _ in range(5):
        losses = [one.fit(CAMERA, T, towards_grey, RATES)[0] for one in (cpu, cuda)]
    assert losses[0] < 0.95 * a
    assert losses[1] == pytest.approx(losses[0], rel=0.01)


def test_the_gradient_of_the_pose_is_that_of_finite_differences():
    T, engine = room()[1], filled(CpuSplatEngine())
    _, pose = engine.fit(CAMERA, T, towards_grey)
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = 1e-3
        higher, lower = (engine.fit(CAMERA, se3_exp(sign * xi) @ T, towards_grey)[0] for sign in (1, -1))
        assert pose[axis] == pytest.approx((higher - lower) / 2e-3, abs=0.1 * np.abs(pose).max())


@needs_compiler
def test_further_gaussians_are_rendered_and_forgotten():
    T = room()[1]
    larger = RasterCamera(88.0, 88.0, 63.5, 47.5, 128, 96)
    more = [np.ascontiguousarray(room()[0][:, 2000:2500]), np.ascontiguousarray(room()[0][:, 2500:])]
    for engine in (CpuSplatEngine(), CudaSplatEngine(shim_kernels())):
        engine.store.add(room()[0][:, :2000], 0)
        before = engine.render(CAMERA, T)
        used = None if engine.device_memory is None else engine.device_memory.fixed_bytes
        image = engine.render_with(larger, T, more)
        np.testing.assert_allclose(image, filled(CpuSplatEngine()).render(larger, T), atol=2e-4)
        assert np.array_equal(engine.render(CAMERA, T), before)
        assert engine.store.count == 2000
        if used is not None:  # but for a growth of the buffers of pairs
            assert engine.device_memory.fixed_bytes <= used + 64 * engine._map.buffers.pairs


@needs_compiler
def test_a_store_on_a_device_answers_as_one_in_host_memory():
    rng = np.random.default_rng(5)
    stores = [GaussianStore(), DeviceStore(DeviceGaussians(shim_kernels()))]
    for store in stores:
        store.add(room()[0][:, :1000], 3)
        store.add(room()[0][:, 1000:], 7)
    host, device = stores
    group = np.sort(rng.choice(3000, 50, replace=False))
    at = np.array([0.3, -0.2, 0.5])
    np.testing.assert_array_equal(device.rows(MEAN, SCALE), host.rows(MEAN, SCALE))
    np.testing.assert_array_equal(device.selected(group), host.selected(group))
    np.testing.assert_array_equal(device.chunk(7), host.chunk(7))
    assert device.nearest_m(3, at) == pytest.approx(host.nearest_m(3, at), abs=1e-9)
    assert device.nearest_m(99, at) == host.nearest_m(99, at) == np.inf
    centres = room()[0][:3, :1000].astype(float)
    assert host.nearest_m(3, at) == pytest.approx(np.linalg.norm(centres - at[:, None], axis=0).min())
    np.testing.assert_array_equal(device.survivors(2, 0.0), host.survivors(2, 0.0))
    assert 0 < host.survivors(2, 0.0).sum() <= 3000
    assert not device._copies  # nothing was copied as a whole
    assert device.bytes_each == 8
    assert device.copied_bytes_each == host.copied_bytes_each == host.bytes_each


@needs_compiler
def test_growth_ends_at_the_limit_of_a_budget():
    gaussians = DeviceGaussians(shim_kernels(), 256)
    gaussians.limit = 1000
    gaussians.append(np.zeros((14, 700), np.float32))
    assert gaussians.capacity == 768
    gaussians.append(np.zeros((14, 100), np.float32))
    assert gaussians.capacity == 1024  # without the limit: 1280
    gaussians.append(np.zeros((14, 400), np.float32))
    assert gaussians.capacity == 1280  # what is needed is always there


def test_the_engine_of_a_session_is_read_from_its_manifest():
    identity = filled(CpuSplatEngine()).identity
    assert identity.name == "cpu"
    assert "numba" in identity.version
    assert identity_in({"engine": {"name": "cpu", "device": "x", "version": "1"}}) == EngineIdentity(
        "cpu", "x", "1"
    )
    for damaged in ({}, {"engine": None}, {"engine": {"name": "cpu"}}, {"engine": {"name": 1, "more": 2}}):
        assert identity_in(damaged) is None


def test_the_cpu_is_an_engine_without_memory_of_its_own():
    engine = make_splat_engine("cpu", "localization.engine")
    assert engine.device_memory is None
    assert engine.description == "CPU, 1 thread"
