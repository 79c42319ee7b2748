"""USD files, read by Pixar's own library."""

import numpy as np
import pytest

from beamsplat.common.mapfiles.usd import write_usd

SH_C0 = 0.28209479177387814


@pytest.fixture(scope="module")
def params():
    """float32 [14, 500]: Gaussians with unnormalised rotations, up to 30 m from the origin."""
    rng = np.random.default_rng(3)
    out = np.zeros((14, 500), np.float32)
    out[0:3] = rng.uniform(-30.0, 30.0, (3, 500))
    out[3:6] = rng.uniform(-6.0, -1.0, (3, 500))
    out[6:10] = rng.normal(size=(4, 500)) * rng.uniform(0.3, 2.0, 500)
    out[10] = rng.uniform(-8.0, 8.0, 500)
    out[11:14] = rng.uniform(0.0, 1.0, (3, 500))
    return out


def test_values_as_openusd_reads_them(params, tmp_path):
    pxr = pytest.importorskip("pxr", reason="needs usd-core")
    from pxr import Usd, UsdGeom, UsdVol

    assert pxr
    write_usd(tmp_path / "map.usda", params)
    stage = Usd.Stage.Open(str(tmp_path / "map.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splats
    prim = splats.GetPrim()
    declared = set(prim.GetPrimDefinition().GetPropertyNames())
    assert {a.GetName() for a in prim.GetAuthoredAttributes()} <= declared

    def values(name):
        return np.array(prim.GetAttribute(name).Get())

    np.testing.assert_array_equal(values("positions"), params[0:3].T)
    np.testing.assert_allclose(np.log(values("scales")), params[3:6].T, atol=1e-5)
    turned = prim.GetAttribute("orientations").Get()
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in turned])
    np.testing.assert_allclose(quats, (params[6:10] / np.linalg.norm(params[6:10], axis=0)).T, atol=1e-6)
    opacity = 1.0 / (1.0 + np.exp(-params[10].astype(float)))
    np.testing.assert_allclose(values("opacities"), opacity, atol=1e-6)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 0
    colours = values("radiance:sphericalHarmonicsCoefficients") * SH_C0 + 0.5
    np.testing.assert_allclose(colours, params[11:14].T, atol=1e-6)
    low, high = values("extent")
    reach = 3.0 * np.exp(params[3:6].max(axis=0))
    np.testing.assert_allclose(low, (params[0:3] - reach).min(axis=1), atol=1e-4)
    np.testing.assert_allclose(high, (params[0:3] + reach).max(axis=1), atol=1e-4)


def test_the_same_map_gives_the_same_bytes_and_an_empty_one_is_refused(params, tmp_path):
    for name in ("a", "b"):
        write_usd(tmp_path / f"{name}.usda", params)
    assert (tmp_path / "a.usda").read_bytes() == (tmp_path / "b.usda").read_bytes()
    with pytest.raises(ValueError, match="no Gaussians"):
        write_usd(tmp_path / "c.usda", params[:, :0])
    assert not (tmp_path / "c.usda").exists()
