"""A shading model registered from outside is fitted, rendered, saved and traced like those of the package."""

from __future__ import annotations

import numpy as np
import pytest
from stages.reflectance_scene import SIZE, lighting, turning_dome
from stages.test_infer_reflectance import held_out

from mifit import NormalsConfig, ReflectanceConfig, infer_reflectance, refine_normals
from mifit.appearance import kernels, models
from mifit.appearance.models import ShadingModel, Transfer
from mifit.config import SHADINGS
from mifit.errors import InputError
from mifit.result import Reconstruction

SHEEN_MEAN = np.sqrt(1 / (4 * np.pi))
"""Mean radiance from all directions, as a factor on the constant coefficient."""


class SheenModel(ShadingModel):
    """Lambertian with a constant sheen: the specular albedo times the mean radiance, whatever normal and view."""

    name = "sheen"
    exponent = 10.0  # it has no lobe to estimate

    def transfer(self, n, v, lobe, coefficients, shadowed=None):
        """The lobe isn't looked at."""
        diffuse = kernels.diffuse_transfer(n, lobe.order)
        zero = 0.0 * diffuse[0]
        return Transfer(diffuse, [zero + float(SHEEN_MEAN), *[zero] * (len(diffuse) - 1)])


@pytest.fixture(scope="module")
def sheen():
    models.register_model(SheenModel())
    yield "sheen"
    models._MODELS.pop("sheen")
    SHADINGS.remove("sheen")


@pytest.fixture(scope="module")
def dome(variant, sheen):
    return turning_dome(sheen, None, gloss=0.03, depth=2.0)


@pytest.fixture(scope="module")
def found(dome, sheen):
    config = ReflectanceConfig(texture_size=SIZE, shading=sheen, bands=4, smoothness_weight=1e-5)
    return infer_reflectance(dome, dome.model, dome.geometry, ("left", "right"), config)


def test_it_is_fitted(dome, found):
    assert found.shading_model == "sheen" and found.report.outcome == "converged"
    assert found.report.details["shading"]["model"] == "sheen"
    assert found.lobe.exponent == SheenModel.exponent
    good = found.confidence > 0.8
    gauge = dome.diffuse[good].mean() / found.diffuse[good].mean()
    assert good.mean() > 0.5
    assert np.abs(gauge * found.diffuse - dome.diffuse)[good].mean() < 0.03
    assert held_out(dome, found) < 0.004  # as for the models of the package


def test_it_renders_what_it_was_fitted_to(dome, found, tmp_path):
    result = Reconstruction(model=dome.model, geometry=dome.geometry, reflectance=found)
    image = result.render(dome.camera("third"), 0)
    truth = dome.frame("third", 0)
    inside = (image[..., 3] == 1) & truth.valid
    assert inside.sum() > 1000
    assert np.sqrt(np.mean((image[..., :3] - truth.image)[inside] ** 2)) < 5e-3
    diffuse = result.render(dome.camera("third"), 0, "diffuse")
    sheen = (image - diffuse)[inside][:, :3]
    shining = sheen[sheen[:, 1] > 0.002]  # the specular map ends at zero in places
    assert len(shining) > 0.9 * len(sheen)
    colour = found.illumination.radiance[0] / found.illumination.radiance[0, 1]
    np.testing.assert_allclose(shining / shining[:, 1:2], np.tile(colour, (len(shining), 1)), atol=1e-3)
    result.save(tmp_path / "result")
    again = Reconstruction.load(tmp_path / "result", dome.model)
    assert again.reflectance.shading_model == "sheen"
    np.testing.assert_array_equal(again.render(dome.camera("third"), 0), image)


def test_normals_are_refined_with_it(dome, found):
    refined = refine_normals(dome, dome.model, dome.geometry.at((0,)), found, ("left", "right"), NormalsConfig())
    assert refined.report.energies["data 0"][-1] <= refined.report.energies["data 0"][0]
    assert np.isfinite(refined.normal_object).all()


def test_the_integrator_knows_it(variant, sheen):
    import mitsuba as mi

    import mifit

    mifit.register_plugins()
    radiance = lighting(3)[:1]  # positive everywhere, so that the emitter clamps nothing
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "shdirect", "model": sheen, "hide_emitters": True},
            "ball": {
                "type": "sphere",
                "bsdf": {"type": "blinnphong", "diffuse_reflectance": 0.0, "specular_reflectance": 0.2},
            },
            "light": {"type": "shenv", "coefficients": mi.TensorXf(radiance.astype(np.float32))},
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            },
        }
    )
    image = np.array(mi.render(scene, spp=1))
    middle = image[7:9, 7:9, :3].reshape(-1, 3)
    np.testing.assert_allclose(middle, np.tile(0.2 * SHEEN_MEAN * radiance[0], (4, 1)), rtol=1e-4)


def test_an_unknown_model_is_named(sheen):
    with pytest.raises(InputError, match=r"found 'phong', expected one of .*'sheen'"):
        ReflectanceConfig(shading="phong")
    with pytest.raises(InputError, match="found 'phong', expected one of paper, printed, prefiltered, shadowed, sheen"):
        models.get("phong")
