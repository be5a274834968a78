"""More frames of a video than were fitted: which enter, which are left out by name, and what they are worth."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mifit.core.estimate import NormalsEstimate, Report
from mifit.core.photometry import Photometry
from mifit.errors import ConvergenceError, InputError
from mifit.extras import refine as module
from mifit.extras.refine import MOST, refine

CAMERAS = ("left", "right")
FRAMES = 6
CONFIG = {
    "reflectance": {"texture_size": 96, "shading": "prefiltered", "bands": 3, "exponent": 8.0, "segment": False},
    "residual": {"enabled": False},
    "photometry": {"enabled": False},
    "seed": 0,
}


@pytest.fixture(scope="module")
def scene(variant):
    """Six timesteps of one bumpy dome; the first two are fitted."""
    from tests.stages.normal_scene import build

    scene = build(timesteps=FRAMES, noise=0.02)
    scene.timesteps = tuple(range(FRAMES))
    return scene


class Follower:
    """Finds the true geometry of a timestep, and the face in none named in ``lost``."""

    lost: tuple[int, ...] = ()

    def __init__(self, capture, model, geometry, *rest):
        assert geometry.timesteps == (0, 1)
        self.scene = capture

    def next(self, timestep):
        if timestep in self.lost:
            raise ConvergenceError("lost")
        return self.scene.geometry.at((timestep,)), False, []


@pytest.fixture
def asked(monkeypatch):
    """Choices of frames: all that are offered, as many as are asked for."""
    asked = []

    def choose(capture, cameras, count, timesteps, beside):
        asked.append(count)
        assert tuple(cameras) == CAMERAS and not set(timesteps) & set(beside)
        clear = sorted(t for t in timesteps if t != 7)
        return SimpleNamespace(timesteps=tuple(clear[:count]), left_out={7: "blurred"})

    monkeypatch.setattr(module, "choose_frames", choose)
    monkeypatch.setattr(module, "Follower", Follower)
    return asked


@pytest.fixture
def result(scene, asked):
    """A fit of two timesteps whose normals are the mesh's."""
    from mifit.result import Reconstruction

    return Reconstruction(
        model=scene.model,
        geometry=scene.geometry.at((0, 1)),
        reflectance=scene.reflectance,
        config=CONFIG,
        cameras=tuple(scene.cameras[c] for c in CAMERAS),
    )


def entered(found):
    return found.reflectance.report.details["refined"]


def test_frames_of_the_video_mend_maps_and_lighting(scene, result):
    scene.requested.clear()
    wrong = result.with_albedo(np.clip(1.15 * scene.reflectance.diffuse, 0, 1))
    few, many = refine(wrong, scene, (0, 1)), refine(wrong, scene)
    assert scene.requested == set(CAMERAS)
    assert entered(few)["timesteps"] == [0, 1] and entered(many)["timesteps"] == list(range(FRAMES))
    assert many.timesteps == many.normals.timesteps == (0, 1)
    seen = scene.reflectance.confidence > 0

    def error(found):
        truth, diffuse = scene.reflectance.diffuse[seen], found.reflectance.diffuse[seen]
        return np.std(diffuse * (truth.mean(0) / diffuse.mean(0)) - truth)  # the level is a convention

    assert error(many) < error(few) and error(many) < 0.05


def test_a_frame_in_other_light_is_left_out_by_name(scene, result):
    frames = dict(scene.frames)
    for name in CAMERAS:
        frames[name, 4] = replace(frames[name, 4], image=frames[name, 4].image[:, ::-1] * 0.6)
    changed = replace(scene, frames=frames)
    found, without = refine(result, changed), refine(result, scene, (0, 1, 2, 3, 5))
    assert entered(found)["timesteps"] == [0, 1, 2, 3, 5] and list(entered(found)["left_out"]) == ["4"]
    assert "timestep 4: left out of the refinement, it differs" in found.reflectance.report.warnings[-1].text
    assert_array_equal(found.reflectance.diffuse, without.reflectance.diffuse)


@pytest.fixture
def quick(monkeypatch, scene):
    """Stages that answer at once, and the geometry that they were given."""
    given = {}

    def infer(capture, model, geometry, names, config, seed, progress):
        given["reflectance"], given["config"] = geometry, config
        return scene.reflectance

    def normals(capture, model, geometry, reflectance, names, config, seed, progress):
        given["normals"] = geometry
        return NormalsEstimate(geometry.timesteps, np.stack([scene.normal_map] * 2), Report("converged"))

    monkeypatch.setattr(module, "infer_reflectance", infer)
    monkeypatch.setattr(module, "refine_normals", normals)
    return given


def test_a_frame_without_a_face_is_left_out_by_name(scene, result, quick, monkeypatch):
    monkeypatch.setattr(Follower, "lost", (3,))
    found = refine(result, scene)
    assert entered(found) == {"timesteps": [0, 1, 2, 4, 5], "left_out": {"3": "the face isn't found in it"}}
    assert quick["reflectance"].timesteps == (0, 1, 2, 4, 5) and quick["normals"].timesteps == (0, 1)


def test_the_surface_is_found_from_all_frames_where_the_fit_has_one(scene, result, quick, monkeypatch):
    def find(capture, model, geometry, names, config, progress):
        assert geometry.timesteps == tuple(range(FRAMES)) and tuple(names) == CAMERAS
        return replace(geometry, displacement=geometry.displacement + np.float32(0.1))

    def shade(capture, model, geometry, names, config, seed, progress):
        assert geometry.timesteps == tuple(range(FRAMES)) and tuple(names) == CAMERAS
        return replace(geometry, displacement=2 * geometry.displacement)

    monkeypatch.setattr(module, "find_surface", find)
    monkeypatch.setattr(module, "refine_surface", shade)
    assert refine(result, scene).geometry.displacement is None
    beyond = replace(result.geometry, displacement=np.zeros_like(scene.model.mean))
    found = refine(replace(result, geometry=beyond), scene)
    assert (found.geometry.displacement == np.float32(0.2)).all() and found.timesteps == (0, 1)
    assert quick["reflectance"].displacement is quick["normals"].displacement is found.geometry.displacement


def test_exposures_are_those_of_all_frames(scene, result, quick, monkeypatch):
    found = Photometry(exposure={("left", 4): 2.0})
    seen = []

    def photometry(capture, model, geometry, names, config, seed, progress):
        assert geometry.timesteps == tuple(range(FRAMES))
        return found

    monkeypatch.setattr(module, "find_photometry", photometry)
    monkeypatch.setattr(type(scene), "with_photometry", lambda self, given: seen.append(given) or self, raising=False)
    refined = refine(replace(result, config={**CONFIG, "photometry": {"enabled": True}}), scene)
    assert seen == [found] and refined.geometry.photometry is quick["reflectance"].photometry is found


def test_the_choice_is_of_what_is_asked_for_and_says_what_it_left_out(scene, result, quick, asked, monkeypatch):
    monkeypatch.setattr(scene, "timesteps", tuple(range(9)))
    found = refine(result, scene, (7, 5, 2))
    assert asked[0] == MOST - 2 and entered(found)["left_out"] == {"7": "blurred"}
    assert entered(found)["timesteps"] == [0, 1, 2, 5]
    monkeypatch.setattr(module, "MOST", 4)
    assert entered(refine(result, scene))["timesteps"] == [0, 1, 2, 3]


def test_the_settings_are_those_of_the_fit_and_tracked_timesteps_are_left_to_be_tracked(scene, result, quick):
    longer = replace(
        result,
        geometry=scene.geometry.at((0, 1, 2)),
        normals=NormalsEstimate((0, 1, 2), np.stack([scene.normal_map] * 3), Report("converged"), {2: "digest"}),
    )
    found = refine(longer, scene)
    assert found.timesteps == (0, 1) and quick["config"].texture_size == 96 and quick["config"].bands == 3
    assert entered(found)["timesteps"] == list(range(FRAMES))


def test_what_cannot_be_refined_is_refused(scene, result):
    with pytest.raises(InputError, match="without reflectance"):
        refine(replace(result, reflectance=None), scene)
    with pytest.raises(InputError, match="timestep 9: not in the capture; it has 0, 1, 2"):
        refine(result, scene, (9,))
