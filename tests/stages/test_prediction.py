"""Images predicted by others: what is left out, that nothing of it is used, and that the error tells a lobe."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from stages.reflectance_scene import EXPONENT, turning_dome

from mifit.appearance import models
from mifit.appearance.lobe import Lobe
from mifit.config import ReflectanceConfig
from mifit.core.mesh import interpolate
from mifit.progress import silent
from mifit.stages.observations import Surface
from mifit.stages.reflectance import prediction, trials
from mifit.stages.reflectance.forward import Forward
from mifit.stages.reflectance.prediction import folds, predict
from mifit.stages.reflectance.trials import lighting_problem


@pytest.fixture(scope="module")
def scene(variant):
    dome = turning_dome()
    surface = Surface(dome, dome.model, dome.geometry, ("left", "right"), 24)
    seen = surface.observe(surface.sample(300, np.random.default_rng(0)))
    albedo = interpolate(dome.geometry.vertex_albedo, dome.model.faces, seen.face, seen.barycentric)

    def problem(exponent=EXPONENT, glossy=True):
        model = models.get("prefiltered")
        forward = replace(Forward.of(model, 4, Lobe(exponent, 8.0), surface.meshes), glossy=glossy)
        return lighting_problem(seen, forward, np.zeros((16, 3)), albedo, True)

    return seen, problem


def images(step, camera):
    return SimpleNamespace(step=np.array(step), camera=np.array(camera))


def test_timesteps_are_left_out_where_there_are_enough_and_cameras_otherwise():
    name, groups = folds(images([0, 0, 1, 1, 2, 2], [0, 1, 0, 1, 0, 1]))
    assert name == "timesteps" and [g.tolist() for g in groups] == [
        [True, True, False, False, False, False],
        [False, False, True, True, False, False],
        [False, False, False, False, True, True],
    ]
    name, groups = folds(images([0, 0, 1, 1], [0, 1, 0, 1]))
    assert name == "cameras" and [g.tolist() for g in groups] == [[True, False] * 2, [False, True] * 2]
    assert folds(images([0, 0], [0, 0]))[1] == []


def test_what_is_left_out_is_not_used(scene, monkeypatch):
    seen, problem = scene
    lights = {}

    def solve(part, **settings):
        (left_out,) = set(seen.step[(part.weight == 0).all(axis=(0, 2))].tolist())
        return lights.setdefault(left_out, real(part, **settings))

    real = prediction.solve_lighting
    monkeypatch.setattr(prediction, "solve_lighting", solve)
    predict(seen, problem(), 0.05)
    whole = dict(lights)
    lights.clear()
    first = seen.step == 0
    spoiled = replace(problem(), colour=np.where(first[:, None], np.float32(7.0), problem().colour))
    predict(seen, spoiled, 0.05)
    assert sorted(whole) == sorted(lights) == [0, 1, 2, 3]
    np.testing.assert_array_equal(lights[0].light, whole[0].light)
    assert not np.allclose(lights[1].light, whole[1].light)


def test_the_error_tells_the_lobe_and_that_there_is_one(scene):
    seen, problem = scene
    right = predict(seen, problem(), 0.05)
    assert right.left_out == "timesteps" and len(right.errors) == 4
    assert predict(seen, problem(EXPONENT / 8), 0.05).error > 1.03 * right.error
    sharper = predict(seen, problem(EXPONENT * 4), 0.05).error
    assert abs(sharper / right.error - 1.0) < 0.05  # four bands of light don't tell it from a sharper one
    assert predict(seen, problem(glossy=False), 0.0).error > 1.5 * right.error


def test_a_camera_that_sees_nothing_predicts_nothing(scene):
    seen, problem = scene
    still = replace(seen, step=np.zeros_like(seen.step))  # cameras are left out in turn
    blind = replace(problem(), weight=np.where((seen.camera == 1)[:, None], np.float32(0.0), problem().weight))
    assert predict(still, blind, 0.05) is None


def test_trials_are_fitted_to_all_images_only_where_that_is_asked_for(scene, monkeypatch):
    seen, problem = scene
    fitted = []
    real = trials.solve_held
    monkeypatch.setattr(trials, "solve_held", lambda *given: fitted.append(given) or real(*given))
    tried = trials.Trials(seen, problem().albedo, ReflectanceConfig(), silent)
    plain = Forward.of(models.get("prefiltered"), 4, Lobe(EXPONENT, 8.0))
    right = tried.add("right", plain)
    tried.add("right", plain.with_lobe(Lobe(EXPONENT / 8, 8.0)))
    assert not fitted and right.score < tried.done[1].score
    figures = tried.figures()
    assert len(fitted) == 1 and figures["residuals"] == {"right": right.found.unexplained}
    assert len(fitted) == 1 and len(figures["predicted"]) == 2
