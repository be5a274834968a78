"""Tracking: frames one by one, priors that follow, lost faces, folders that survive a kill."""

from __future__ import annotations

import gc
import shutil
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mifit.config import MeshConfig, NormalsConfig
from mifit.core.estimate import NormalsEstimate, Report
from mifit.errors import ConvergenceError, InputError

CAMERAS = ("left", "right")
CONFIG = NormalsConfig(magnitude_weight=0.03)


def angles(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1)))


@pytest.fixture(scope="module")
def scene(variant):
    """Four timesteps of one dome; the first is fitted."""
    from normal_scene import build

    scene = build(timesteps=4, noise=0.004)
    scene.timesteps = (0, 1, 2, 3)
    return scene


@pytest.fixture
def fit_truth(monkeypatch, scene):
    """Stand in for stage 1: its answer is the truth, and it notes what it was started from."""
    from mifit import tracking as track

    starts = []

    class NoTexture:
        def __init__(self, *arguments):
            pass

        def aligned(self, geometry):
            return geometry

    def fit(capture, model, geometry, cameras, timestep, config):
        starts.append((timestep, geometry.timesteps[-1]))
        return scene.geometry.at((timestep,))

    monkeypatch.setattr(track, "fit_pose_expression", fit)
    monkeypatch.setattr(track, "KeptTexture", NoTexture)
    return starts


def first(scene):
    return scene.geometry.at((0,))


def run(scene, timesteps=(1, 2, 3), normals=None, **options):
    from mifit.result import Reconstruction
    from mifit.tracking import track

    cameras = tuple(scene.cameras[c] for c in CAMERAS)
    result = Reconstruction(scene.model, first(scene), scene.reflectance, normals, cameras=cameras)
    return track(scene, result, timesteps, CONFIG, **options)


def test_frames_come_one_at_a_time_from_the_last(scene, fit_truth):
    calls = []
    frames = run(scene, progress=lambda label, done, total: calls.append((done, total)))
    one = next(frames)
    assert one.timestep == 1
    assert fit_truth == [(1, 0)]
    rest = list(frames)
    assert [f.timestep for f in rest] == [2, 3]
    assert fit_truth == [(1, 0), (2, 1), (3, 2)]
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)]
    mask = np.linalg.norm(scene.normal_map, axis=-1) > 0
    for frame in (one, *rest):
        assert angles(frame.normal_object, scene.normal_map)[mask].mean() < 2.5
        assert not frame.refound


def test_the_prior_steadies_detail_over_frames(scene, fit_truth):
    mask = np.linalg.norm(scene.normal_map, axis=-1) > 0
    error = [angles(f.normal_object, scene.normal_map)[mask].mean() for f in run(scene)]
    assert error[1] < error[0]
    assert error[2] < error[0]


def test_the_prior_does_not_lag(scene, fit_truth):
    """Detail that turns around between two frames is followed at once."""
    from normal_scene import build

    turned = build(timesteps=4, tilt=-0.12)
    mixed = replace(scene, frames={k: (turned if k[1] == 3 else scene).frames[k] for k in scene.frames})
    mixed.timesteps = scene.timesteps
    mask = np.linalg.norm(scene.normal_map, axis=-1) > 0
    *_, last = run(mixed)
    assert angles(last.normal_object, turned.normal_map)[mask].mean() < 2.5
    assert angles(last.normal_object, scene.normal_map)[mask].mean() > 7.0


def test_where_nothing_is_measured_the_last_detail_stays(scene, fit_truth):
    blind = {k: replace(f, valid=np.zeros_like(f.valid)) if k[1] == 2 else f for k, f in scene.frames.items()}
    hidden = replace(scene, frames=blind)
    hidden.timesteps = scene.timesteps
    seen, unseen = run(hidden, timesteps=(1, 2))
    assert_allclose(unseen.normal_object, seen.normal_object, atol=1e-4)
    assert "no camera measures the face" in unseen.warnings[-1].text


def test_only_named_cameras_are_read(scene, fit_truth):
    scene.requested.clear()
    list(run(scene, timesteps=(1,)))
    assert scene.requested == set(CAMERAS)


@pytest.mark.parametrize(
    ("timesteps", "message"), [((9,), "timestep 9: not in the capture; it has 0, 1, 2, 3"), ((0,), "has it already")]
)
def test_impossible_timesteps_are_refused(scene, fit_truth, timesteps, message):
    with pytest.raises(InputError, match=message):
        next(run(scene, timesteps=timesteps))


class TestLostFaces:
    """`_follow` on errors that are given."""

    @staticmethod
    def follow(scene, errors):
        from mifit.tracking import _follow

        last, home = replace(first(scene), scale=2.0), replace(first(scene), scale=3.0)

        def fit(start):
            if errors[start.scale] is None:
                raise ConvergenceError(f"from {start.scale}")
            return start

        found, refound = _follow(fit, lambda g: errors[g.scale], last, home)
        return found.scale, refound

    def test_a_good_frame_is_kept(self, scene):
        assert self.follow(scene, {2.0: 1.0, 3.0: 0.5}) == (2.0, False)

    def test_a_lost_one_is_found_from_home(self, scene):
        assert self.follow(scene, {2.0: 50.0, 3.0: 1.0}) == (3.0, True)
        assert self.follow(scene, {2.0: None, 3.0: 1.0}) == (3.0, True)

    def test_the_better_of_two_bad_ones_is_kept(self, scene):
        assert self.follow(scene, {2.0: 20.0, 3.0: 30.0}) == (2.0, False)
        assert self.follow(scene, {2.0: 20.0, 3.0: None}) == (2.0, False)

    def test_no_fit_at_all_is_an_error(self, scene):
        with pytest.raises(ConvergenceError, match=r"from 2\.0"):
            self.follow(scene, {2.0: None, 3.0: None})


def test_landmark_error_is_in_pixels(scene):
    from mifit.tracking import landmark_error

    one = first(scene)
    frames = {}
    for (name, t), frame in scene.frames.items():
        exact = scene.camera(name).project(one.vertices[0][scene.model.landmarks])
        frames[name, t] = replace(frame, landmarks=exact + np.array([3.0, 4.0]), visible=np.ones(68, bool))
    marked = replace(scene, frames=frames)
    assert landmark_error(marked, scene.model, one, CAMERAS) == pytest.approx(5.0, abs=1e-3)
    assert landmark_error(scene, scene.model, one, CAMERAS) == 0.0


# Into a folder


@pytest.fixture
def saved(scene, tmp_path):
    """A result with timestep 0 in a folder, and its reload."""
    from mifit.result import Reconstruction
    from mifit.stages.normals.refine_mesh import refine_mesh

    scene.model.save(tmp_path / "dome.npz")
    mask = np.linalg.norm(scene.normal_map, axis=-1) > 0
    base = np.where(mask[..., None], [0.0, 0.0, 1.0], 0.0).astype(np.float32)
    normals = NormalsEstimate((0,), base[None], Report("converged"))
    config = MeshConfig(detail=20.0)
    result = Reconstruction(
        model=scene.model,
        geometry=first(scene),
        reflectance=scene.reflectance,
        normals=normals,
        mesh=refine_mesh(scene.model, first(scene), normals, config),
        config={"seed": 0, "mesh": {"detail": config.detail}},
        cameras=tuple(scene.cameras[c] for c in CAMERAS),
        model_source=str(tmp_path / "dome.npz"),
    )
    result.save(tmp_path / "result")
    return tmp_path / "result"


def reload(folder):
    from mifit.result import Reconstruction

    return Reconstruction.load(folder)


def test_each_frame_is_on_disk_when_it_is_done(scene, fit_truth, saved, monkeypatch):
    from mifit import tracking

    seen = []
    write = tracking.add_timestep

    def watch(result, folder, timestep):
        write(result, folder, timestep)
        seen.append(reload(folder).timesteps)

    monkeypatch.setattr(tracking, "add_timestep", watch)
    tracking.track_into(saved, reload(saved), scene, (1, 2), CONFIG)
    assert seen == [(0, 1), (0, 1, 2)]
    for t in (1, 2):
        assert (saved / "geometry" / f"{t:04d}.ply").is_file()
        assert (saved / "maps" / f"normal_tangent_{t:04d}.png").is_file()
        assert (saved / "refined" / f"{t:04d}.ply").is_file()


def test_meshes_of_tracked_frames_are_refined_as_those_of_the_fit(scene, fit_truth, saved):
    from mifit.stages.normals.refine_mesh import refine_mesh
    from mifit.tracking import track_into

    found = track_into(saved, reload(saved), scene, (1,), CONFIG)
    expected = refine_mesh(scene.model, found.geometry, found.normals, MeshConfig(detail=20.0))
    assert found.mesh.timesteps == (0, 1)
    assert np.abs(found.mesh.vertices[1] - found.geometry.vertices[1]).max() > 0
    for mesh in (found.mesh, reload(saved).mesh):
        assert_array_equal(mesh.vertices, expected.vertices)


@pytest.mark.slow
@pytest.mark.parametrize(("moment", "killed_after"), [("before", 0), ("between", 1)])
def test_a_killed_run_resumes_to_the_same_result(scene, fit_truth, saved, tmp_path, monkeypatch, killed_after, moment):
    from mifit import tracking
    from mifit.result import writing as folder_module

    whole = tmp_path / "whole"
    shutil.copytree(saved, whole)
    expected = tracking.track_into(whole, reload(whole), scene, (1, 2), CONFIG)

    class Killed(BaseException):
        pass

    count = [0]
    document, write = folder_module.write_json, tracking.add_timestep

    def die(*arguments, **options):
        if count[0] == killed_after:
            raise Killed
        count[0] += 1
        return (write if moment == "before" else document)(*arguments, **options)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        # before: no file of the frame; between: its maps are there, result.json doesn't name it yet
        if moment == "before":
            patch.setattr(tracking, "add_timestep", die)
        else:
            patch.setattr(folder_module, "write_json", die)
        tracking.track_into(saved, reload(saved), scene, (1, 2), CONFIG)
    assert len(reload(saved).timesteps) == 1 + killed_after
    tracking.track_into(saved, reload(saved), scene, (1, 2), CONFIG, resume=True)
    found = reload(saved)
    assert found.timesteps == expected.timesteps == (0, 1, 2)
    assert_array_equal(found.geometry.vertices, reload(whole).geometry.vertices)
    assert_array_equal(found.normals.normal_object, reload(whole).normals.normal_object)
    assert_array_equal(found.mesh.vertices, reload(whole).mesh.vertices)
    assert found.fitted == (0,) and list(found.tracked) == [1, 2]


def test_without_resume_frames_are_tracked_anew(scene, fit_truth, saved):
    from mifit.tracking import track_into

    track_into(saved, reload(saved), scene, (1,), CONFIG)
    assert len(fit_truth) == 1
    track_into(saved, reload(saved), scene, (1,), CONFIG, resume=True)
    assert len(fit_truth) == 1
    again = track_into(saved, reload(saved), scene, (1,), CONFIG)
    assert len(fit_truth) == 2
    assert again.timesteps == again.mesh.timesteps == (0, 1)


def test_frames_whose_images_changed_are_tracked_anew(scene, fit_truth, saved):
    from mifit.tracking import sequence_left, track_into

    track_into(saved, reload(saved), scene, (1, 2), CONFIG)
    assert len(fit_truth) == 2
    assert track_into(saved, reload(saved), scene, (1, 2), CONFIG, resume=True).timesteps == (0, 1, 2)
    assert len(fit_truth) == 2
    frames = dict(scene.frames)
    name = CAMERAS[0]
    frames[name, 2] = replace(frames[name, 2], image=0.9 * frames[name, 2].image)
    again = track_into(saved, reload(saved), replace(scene, frames=frames), (1, 2), CONFIG, resume=True)
    assert len(fit_truth) == 3 and again.timesteps == (0, 1, 2)
    # A frame starts from the one before: with the first, the second is tracked anew as well.
    frames[name, 1] = replace(frames[name, 1], image=0.9 * frames[name, 1].image)
    changed = replace(scene, frames=frames, timesteps=(0, 1, 2))
    assert sequence_left(reload(saved), changed, resume=False) == ()
    steps = sequence_left(reload(saved), changed, resume=True)
    assert steps == (1, 2)
    track_into(saved, reload(saved), changed, steps, CONFIG, resume=True)
    assert len(fit_truth) == 5


def test_memory_does_not_grow_with_tracked_frames(scene, fit_truth, saved, tmp_path, monkeypatch):
    """What frames leave behind in memory is their pose, not their maps and meshes."""
    from mifit.core import arrays as rows
    from mifit.tracking import track_into

    monkeypatch.setattr(rows, "IN_MEMORY", 0)  # as for a long video
    # Maps and meshes are NumPy's. Small Python objects come and go by some kB with what ran before.
    arrays = tracemalloc.DomainFilter(inclusive=True, domain=np.lib.tracemalloc_domain)
    left = []
    for k, steps in enumerate(((1, 2, 3), (1,), (1, 2, 3))):  # the first for kernels and caches
        folder = shutil.copytree(saved, tmp_path / str(k))
        tracemalloc.start()
        tracked = track_into(folder, reload(folder), scene, steps, CONFIG)
        gc.collect()
        held = tracemalloc.take_snapshot().filter_traces([arrays]).traces
        left.append(sum(trace.size for trace in held))
        tracemalloc.stop()
        assert tracked.timesteps == (0, *steps)
    frame = tracked.normals.normal_object[0].nbytes + tracked.mesh.vertices[0].nbytes
    assert left[1] > 0
    assert (left[2] - left[1]) / 2 < 0.01 * frame, (left, frame)


def test_a_result_without_reflectance_is_refused(scene, saved):
    from mifit.tracking import track_into

    with pytest.raises(InputError, match="without reflectance"):
        track_into(saved, replace(reload(saved), reflectance=None, normals=None), scene, (1,), CONFIG)
