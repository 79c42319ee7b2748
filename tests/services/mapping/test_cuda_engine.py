"""The CUDA engine under the mapper, on the CPU build of its kernels: the same maps as those of the CPU engine."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from beamsplat.common.engines.device_store import DeviceStore
from beamsplat.common.geometry.transforms import inverse, make_transform, se2_to_se3, se3_exp, so3_exp
from beamsplat.common.mapfiles.scores import psnr_db
from beamsplat.common.mapfiles.store import GaussianStore
from beamsplat.common.raster.camera import RasterCamera
from beamsplat.common.raster.cuda.gaussians import DeviceGaussians
from beamsplat.common.raster.rasterizer import Rasterizer
from beamsplat.services.mapping.engines.cpu import CpuEngine
from beamsplat.services.mapping.engines.cuda import CudaEngine
from beamsplat.services.mapping.keyframe import RgbdKeyframe
from beamsplat.services.mapping.mapper import HALF, Mapper
from beamsplat.services.mapping.session.state import arrays_of, restore
from beamsplat.services.mapping.settings import MapperSettings
from beamsplat.tools.bench.raster import synthetic_room
from tests.common.raster.cuda.shim import needs_compiler, shim_kernels

pytestmark = needs_compiler

CAMERA = RasterCamera(44.0, 44.0, 31.5, 23.5, 64, 48)
SETTINGS = MapperSettings(half_iterations=4, full_iterations=3, stride_px=3, fine_stride_px=2)


@lru_cache(maxsize=1)
def room():
    params, T_camera_map = synthetic_room(20_000)
    params[3:5] += 0.5
    params[10] = 3.0
    return params, inverse(T_camera_map)


def T_map_camera(number):
    return room()[1] @ make_transform(so3_exp([0.0, 0.03 * number, 0.0]), np.array([0.08 * number, 0.0, 0.0]))


@lru_cache(maxsize=32)
def shot(number):
    """rgb float [H, W, 3] in [0, 1], depth (m) [H, W]"""
    render = Rasterizer().render(room()[0], 20_000, CAMERA, inverse(T_map_camera(number)))
    depth = np.where(render.image[4] > 0.9, render.expected_depth(), np.nan).astype(np.float32)
    return np.clip(render.image[:3].transpose(1, 2, 0), 0.0, 1.0), depth


def keyframe(number, **change):
    rgb, depth = shot(number)
    beams = np.array([[u, 23.0, depth[23, u]] for u in range(4, 60, 8) if np.isfinite(depth[23, u])])
    frame = RgbdKeyframe(
        number, (rgb * 255.0 + 0.5).astype(np.uint8), CAMERA, T_map_camera(number), depth,
        np.full(depth.shape, 0.01, np.float32), beams_uvz=beams,
    )  # fmt: skip
    return replace(frame, **change)


def drive(engine, numbers, settings=SETTINGS, **change):
    mapper = Mapper(settings, seed=1, engine=engine)
    for number in numbers:
        assert mapper.add(keyframe(number, **change), np.eye(4)).ok
        mapper.optimise()
    return mapper


def quality_db(mapper, number):
    image = mapper.render(CAMERA, T_map_camera(number))
    return psnr_db(np.clip(image[:3].transpose(1, 2, 0), 0.0, 1.0), shot(number)[0])


def cuda_engine():
    return CudaEngine(shim_kernels())


def both(settings=SETTINGS, numbers=range(3), **change):
    return [drive(engine, numbers, settings, **change) for engine in (CpuEngine(), cuda_engine())]


@pytest.fixture(scope="module")
def mapped():
    return both()


def test_both_engines_make_the_same_map(mapped):
    cpu, cuda = mapped
    assert cuda.steps == cpu.steps == 3 * 7
    assert cuda.store.count == pytest.approx(cpu.store.count, rel=0.01)
    for number in (0, 1, 4):  # the last one is not among the keyframes
        assert quality_db(cuda, number) == pytest.approx(quality_db(cpu, number), abs=0.1)


def test_one_step_moves_gaussians_pose_and_exposure_alike():
    settings = replace(
        SETTINGS, half_iterations=0, full_iterations=0, refine_pose=True, refine_exposure=True, ssim_every=1
    )
    mask = np.ones((48, 64), bool)
    mask[10:30, 5:20] = False
    before = [drive(engine, range(2), settings, mask=mask) for engine in (CpuEngine(), cuda_engine())]
    start = before[0].store.params[:, : before[0].store.count].copy()
    for mapper in before:
        held = mapper.keyframes[1]
        held.delta = se3_exp(np.array([0.01, -0.005, 0.004, 0.004, -0.003, 0.002]))
        for size in (HALF, 0):
            mapper.step(held, size)
    cpu, cuda = before
    moved, same = (m.store.params[:, : cpu.store.count] - start for m in before)
    assert cuda.store.count == cpu.store.count
    seen = cpu.store.steps[: cpu.store.count] > 0
    np.testing.assert_array_equal(cpu.store.steps[: cpu.store.count], cuda.store.steps[: cpu.store.count])
    assert np.linalg.norm(same - moved) < 0.02 * np.linalg.norm(moved)
    assert np.abs(moved[:, seen]).max() > 1e-3
    a, b = cpu.keyframes[1], cuda.keyframes[1]
    assert (a.pose_steps, a.exposure_steps) == (b.pose_steps, b.exposure_steps) == (2, 2)
    np.testing.assert_allclose(b.delta, a.delta, atol=2e-5)
    np.testing.assert_allclose(b.exposure, a.exposure, atol=1e-4)
    assert b.exposure.dtype == np.float32


def test_the_same_drive_gives_the_same_bytes(mapped):
    again = drive(cuda_engine(), range(3))
    for name, array in mapped[1].store.state().items():
        np.testing.assert_array_equal(array, again.store.state()[name])


def test_a_map_of_one_engine_is_read_by_the_other(mapped):
    cpu, cuda = mapped
    for saved, engine in ((cpu, cuda_engine()), (cuda, CpuEngine())):
        opened = Mapper(SETTINGS, engine=engine)
        assert restore(opened, arrays_of(saved, {}), lambda id: lambda: keyframe(id)) == []
        for name, array in saved.store.state().items():
            if name != "events":
                np.testing.assert_array_equal(opened.store.state()[name], array)
        assert quality_db(opened, 4) == pytest.approx(quality_db(saved, 4), abs=0.01)
        before = quality_db(opened, 1)
        opened.refine(6, HALF)
        assert quality_db(opened, 1) > before - 0.3


def test_a_keyframe_with_other_images_is_optimised_on_them(mapped):
    mapper = drive(cuda_engine(), range(2))
    held = mapper.keyframes[0]
    first = mapper.step(held, HALF)
    level = replace(held.levels[HALF], rgb=255 - held.levels[HALF].rgb)
    held.levels = [held.levels[0], level]
    assert mapper.step(held, HALF) > 2.0 * first


def random_gaussians(rng, count):
    params = rng.normal(size=(14, count)).astype(np.float32)
    params[6:10] /= np.linalg.norm(params[6:10], axis=0)
    return params


def test_a_store_in_device_memory_is_the_same_as_one_of_arrays():
    rng = np.random.default_rng(3)
    stores = [GaussianStore(), DeviceStore(DeviceGaussians(shim_kernels()))]
    for round in range(6):
        new, anchor = random_gaussians(rng, int(rng.integers(1, 3000))), int(rng.integers(3))
        T = se2_to_se3(rng.normal(size=3))
        keep = rng.random(stores[0].count + new.shape[1]) < 0.8
        for store in stores:
            store.add(new, anchor)
            store.keep(keep)
            store.move(anchor, T)
        if round == 3:
            group = np.flatnonzero(stores[0].anchor[: stores[0].count] == anchor)[::2]
            for store in stores:
                arrays = store.columns(group)
                store.page_out([group])
                store.page_in(arrays, anchor)
        compare(*stores)
    saved = stores[0].state()
    for store in stores:
        store.restore(saved)
    compare(*stores)
    with pytest.raises(ValueError, match="read-only"):
        stores[1].params[0, 0] = 1.0


def compare(a, b):
    assert a.count == b.count
    assert a.versions() == b.versions()
    one, other = a.state(), b.state()
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_allclose(other[name], one[name], atol=2e-5)
    for anchor in a.versions():
        np.testing.assert_allclose(b.chunk(anchor), a.chunk(anchor), atol=2e-5)


@pytest.mark.slow
def test_a_drive_of_twenty_keyframes_is_within_a_tenth_of_a_decibel():
    settings = replace(SETTINGS, half_iterations=8, full_iterations=4, refine_pose=True, refine_exposure=True)
    cpu, cuda = both(settings, range(20))
    for mapper in (cpu, cuda):
        mapper.refine(20)
    views = [n + 0.5 for n in range(0, 19, 3)]
    cpu_db, cuda_db = (np.mean([quality_db(m, n) for n in views]) for m in (cpu, cuda))
    assert cpu_db > 20.0
    assert cuda_db == pytest.approx(cpu_db, abs=0.1)
