"""Checkpoints come back exactly, or not at all."""

import numpy as np
import pytest

from mifit import cache
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.appearance.lobe import Lobe
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import NormalsEstimate, ReflectanceEstimate, Report


@pytest.fixture
def estimate():
    rng = np.random.default_rng(0)
    warning = Diagnostic("code", "a warning", camera="left")
    report = Report("converged", {"data": [2.0, 1.0]}, 1.5, (warning,), {"figure": 3})
    return NormalsEstimate((0, 2), rng.random((2, 4, 4, 3), dtype=np.float32), report)


def test_round_trip(tmp_path, estimate):
    cache.save(tmp_path, "normals", estimate, "key")
    back = cache.load(tmp_path, "normals", NormalsEstimate, "key")
    assert back is not None
    assert back.timesteps == estimate.timesteps
    assert back.report == estimate.report
    np.testing.assert_array_equal(back.normal_object, estimate.normal_object)
    assert [p.name for p in tmp_path.iterdir()] == ["normals.npz"]


def test_other_key_missing_and_damaged(tmp_path, estimate):
    assert cache.load(tmp_path, "normals", NormalsEstimate, "key") is None
    cache.save(tmp_path, "normals", estimate, "key")
    assert cache.load(tmp_path, "normals", NormalsEstimate, "other") is None
    path = tmp_path / "normals.npz"
    path.write_bytes(path.read_bytes()[:200])
    assert cache.load(tmp_path, "normals", NormalsEstimate, "key") is None


def test_lighting_and_lobe_round_trip(tmp_path):
    rng = np.random.default_rng(1)
    lights = (DistantLight(np.array([0.0, 0.6, 0.8]), 0.1, np.array([1.0, 2.0, 1 / 3])),)
    maps = rng.random((4, 4, 3)), rng.random((4, 4)), rng.random((4, 4))
    lobe = Lobe(11.0, 3.0, True)
    light = Illumination(rng.standard_normal((9, 3)), lights, 0.1)
    estimate = ReflectanceEstimate(*maps, light, lobe, "shadowed", Report("converged", details={"tried": [[1, 2]]}))
    cache.save(tmp_path, "reflectance", estimate, "key")
    back = cache.load(tmp_path, "reflectance", ReflectanceEstimate, "key")
    assert back is not None and back.report == estimate.report and back.shading_model == "shadowed"
    np.testing.assert_array_equal(back.diffuse, estimate.diffuse)
    np.testing.assert_array_equal(back.illumination.unknowns, light.unknowns)
    assert back.lobe.exponent == 11.0
    assert back.illumination.ambient == 0.1 and back.lobe.fresnel == 3.0
    assert back.illumination.lights[0].document() == lights[0].document()


@pytest.mark.parametrize("damage", ["nan", "shape", "scalar"])
def test_changed_content_is_not_used(tmp_path, estimate, damage):
    cache.save(tmp_path, "normals", estimate, "key")
    path = tmp_path / "normals.npz"
    with np.load(path) as data:
        arrays = dict(data)
    if damage == "nan":
        arrays["normal_object"][0, 1, 2] = np.nan
    elif damage == "shape":
        arrays["normal_object"] = arrays["normal_object"][:1]
    else:
        arrays["_meta"] = np.frombuffer(bytes(arrays["_meta"]).replace(b"[0, 2]", b"[0, 7]"), np.uint8)
    np.savez(path, **arrays)
    assert cache.load(tmp_path, "normals", NormalsEstimate, "key") is None


def test_digest_follows_every_value():
    assert cache.digest({"a": 1, "b": [1, 2]}) == cache.digest({"b": [1, 2], "a": 1})
    assert cache.digest({"a": 1}) != cache.digest({"a": 2})


def test_lighting_and_lobe_come_back_to_the_last_bit(tmp_path):
    rng = np.random.default_rng(1)
    light = DistantLight(np.array([0.6, 0.0, 0.8]), 0.01, rng.random(3))
    estimate = ReflectanceEstimate(
        diffuse=rng.random((4, 4, 3), dtype=np.float32),
        specular=rng.random((4, 4), dtype=np.float32),
        confidence=rng.random((4, 4), dtype=np.float32),
        illumination=Illumination(rng.normal(size=(9, 3)), (light,), 0.1),
        lobe=Lobe(150.0, 8.0),
        shading_model="shadowed",
        report=Report("converged"),
    )
    cache.save(tmp_path, "reflectance", estimate, "key")
    back = cache.load(tmp_path, "reflectance", ReflectanceEstimate, "key")
    np.testing.assert_array_equal(back.illumination.unknowns, estimate.illumination.unknowns)
    np.testing.assert_array_equal(back.illumination.lights[0].direction, light.direction)
    assert back.illumination.lights[0].radius == light.radius and back.illumination.ambient == 0.1
    assert back.lobe == estimate.lobe and back.shading_model == "shadowed"
    np.testing.assert_array_equal(back.diffuse, estimate.diffuse)
