"""Calibrated cameras that matches adjust: what images determine is undone, the rest stays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mifit
from mifit.capture import Capture
from mifit.cli import main
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate, Report
from mifit.extras import bundle
from mifit.extras.refine_cameras import RefinedCameras, calibration_precision, refine_cameras
from mifit.morphable import MorphableModel
from mifit.optim import minimize
from tests.capture.conftest import write_capture
from tests.stages.memory_capture import MemoryCapture, make_capture

BOTH = ("left", "right")
TURNS = [(0, 0, 0), (-8, 14, 3), (9, -12, -4)]


@dataclass
class Calibrated(MemoryCapture):
    """A capture in memory whose calibration may be off; ``frames`` are those of the true cameras."""

    calibrated: bool = True

    def with_camera(self, camera: Camera) -> Calibrated:
        return replace(self, cameras_by_name={**self.cameras_by_name, camera.name: camera})


@pytest.fixture(scope="module")
def model(variant) -> MorphableModel:
    return MorphableModel.load("builtin:coarse").subset(identity=30, expression=20, albedo=10)


def captured(model: MorphableModel, **options) -> Calibrated:
    return Calibrated(**vars(make_capture(model, seed=3, **options)))


@pytest.fixture(scope="module")
def true(model) -> Calibrated:
    """A head that turns, painted, seen by exact cameras."""
    return captured(model, angles=TURNS)


def fit_of(capture: Calibrated, model: MorphableModel, steps: int) -> GeometryEstimate:
    """The true head, as a fit would give it but for a millimetre."""
    vertices = capture.vertices[:steps] + 0.1 * np.sin(capture.vertices[:steps])
    return GeometryEstimate(
        tuple(range(steps)), np.zeros(30), np.zeros(10), np.zeros((steps, 20)), capture.rotation[:steps],
        np.zeros((steps, 3)), 1.0, vertices, model.mean_albedo, np.zeros((9, 3)), 0.0, Report("converged"),
    )  # fmt: skip


def off(camera: Camera, degrees=(0.0, 0.0, 0.0), focal: float = 1.0) -> Camera:
    """A camera that has turned about its own axes, its place as it was."""
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = Rotation.from_rotvec(degrees, degrees=True).as_matrix() @ pose[:3, :3]
    pose[:3, 3] = -pose[:3, :3] @ camera.position
    return replace(camera, world_to_camera=pose, fx=focal * camera.fx, fy=focal * camera.fy)


def miss(capture: Calibrated, cameras) -> float:
    """Pixels by which what the true cameras show of the head lies off these cameras' epipolar lines, root mean square.

    Half a distance to each view, as a point between the lines shares it.
    """
    a, b = cameras
    truth = [capture.camera(name) for name in BOTH]
    points = capture.vertices.reshape(-1, 3)
    rays = [c.pixel_rays(t.project(points)) for c, t in zip(cameras, truth, strict=True)]
    normal = np.cross(b.position - a.position, rays[0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return float(np.sqrt(np.mean((0.5 * b.fx * np.sum(normal * rays[1], axis=1)) ** 2)))


@pytest.mark.parametrize("steps", [1, 3])
def test_what_matches_see_of_a_wrong_camera_is_undone(model, true, steps: int) -> None:
    """Roll, pitch and focal length of one camera, from three timesteps or one."""
    wrong = true.with_camera(off(true.camera("right"), (0.3, 0.0, 0.3), 1.005))
    found = refine_cameras(wrong, model, fit_of(true, model, steps), BOTH)
    assert tuple(camera.name for camera in found.cameras) == BOTH and not found.doubtful
    assert found.finding.startswith("the calibration is off: dense matches are ")
    before, after = miss(true, [wrong.camera(name) for name in BOTH]), miss(true, found.cameras)
    assert before > 1.5 and after < 0.1 * before
    told = found.figures
    for key in ("residual_pixels", "residual_left_out_pixels"):
        assert told[key][0] > 1.0 and told[key][1] < 0.2
    assert 0.5 < max(told["moved"][name]["at_head_mm"] for name in BOTH) < 6.0


def test_a_right_calibration_stays(model, true) -> None:
    found = refine_cameras(true, model, fit_of(true, model, 3), BOTH)
    assert found.cameras == () and not found.doubtful
    assert "matches that were left out are 0.0" in found.finding
    assert max(found.figures["deviations"]) < 0.1


def test_matches_do_not_tell_how_far_views_converge(model, true) -> None:
    """A turn along the baseline moves matches along their epipolar lines: depth explains it as well."""
    wrong = true.with_camera(off(true.camera("right"), (0.0, 0.3, 0.0)))
    found = refine_cameras(wrong, model, fit_of(true, model, 3), BOTH)
    assert found.cameras == ()
    for moved in found.figures["moved"].values():
        assert moved["degrees"] < 0.05 and moved["position_mm"] < 0.5


@pytest.mark.parametrize("options", [{"focal": 1.06}, {"degrees": (0.0, 0.0, 4.0)}])
def test_another_calibration_is_not_adjusted(model, true, options) -> None:
    wrong = true.with_camera(off(true.camera("right"), **options))
    found = refine_cameras(wrong, model, fit_of(true, model, 1), BOTH)
    assert found.cameras == () and found.doubtful
    assert "of the deviations that a calibration is taken to have, expected at most 3" in found.finding


def test_what_cameras_do_not_explain_is_said(model, true) -> None:
    """Waves in one camera's images, of 2 pixels."""
    x, y = np.moveaxis(true.camera("right").pixel_centres().astype(np.float32) - 0.5, 2, 0)

    def bent(name, t, frame):
        image = cv2.remap(frame.image, x, y + 2.0 * np.sin(y / 12.0), cv2.INTER_LINEAR)
        return replace(frame, image=image) if name == "right" else frame

    found = refine_cameras(true.changed(bent), model, fit_of(true, model, 1), BOTH)
    assert found.cameras == () and found.doubtful
    assert found.finding.endswith("the cameras may be out of step, or their lenses distort otherwise")


def test_an_adjustment_that_does_not_settle_is_dropped(model, true, monkeypatch) -> None:
    wrong = true.with_camera(off(true.camera("right"), (0.3, 0.0, 0.3), 1.005))
    monkeypatch.setattr(bundle, "minimize", partial(minimize, max_iterations=1))
    found = refine_cameras(wrong, model, fit_of(true, model, 1), BOTH)
    assert found.cameras == () and found.doubtful and found.finding.endswith("hasn't settled")


def test_captures_that_cannot_be_matched_are_left_alone(model, true) -> None:
    fit = fit_of(true, model, 1)
    flat = true.changed(lambda name, t, frame: replace(frame, image=np.full_like(frame.image, 0.5)))
    for capture, cameras, why in (
        (replace(true, calibrated=False), BOTH, "the capture is uncalibrated"),
        (true, BOTH[:1], "one camera has nothing to be matched with"),
        (flat, BOTH, "0 points of the face are matched between them, expected at least 400"),
    ):
        found = refine_cameras(capture, model, fit, cameras)
        assert found.cameras == () and found.doubtful and why in found.finding


@pytest.mark.parametrize(
    ("turn", "centre"), [((0.5, 0, 0), (0, 0, 0)), ((0, 0, 0.5), (0, 0, 0)), ((0, 0, 0), (0, 0.35, 0))]
)
def test_a_deviation_of_the_prior_is_what_is_documented(turn, centre) -> None:
    """0.5 degrees about the centre, or 0.5 % of the distance."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("yx", (5, 5), degrees=True).as_matrix()
    pose[:3, 3] = (1.0, -2.0, 70.0)
    rotation = Rotation.from_rotvec(turn, degrees=True)
    shift = rotation.apply(pose[:3, 3] - np.array(centre)) - pose[:3, 3]
    way = np.concatenate([rotation.as_rotvec(), shift])
    precision = calibration_precision(pose[None], np.array([70.0]))
    assert precision[0, 0] == pytest.approx(0.005**-2) and not precision[0, 1:].any()
    assert way @ precision[1:, 1:] @ way == pytest.approx(1.0, rel=0.02)


@pytest.fixture
def command(tmp_path, monkeypatch, variant):
    """A calibrated capture on disk, and what the command finds of it."""
    folder = write_capture(tmp_path / "capture")
    capture = Capture.load(folder)
    moved = tuple(replace(capture.camera(name), fx=1.01 * capture.camera(name).fx) for name in BOTH)
    found = [RefinedCameras(moved, "the calibration is off", False, {})]
    monkeypatch.setattr(mifit, "fit", lambda *_, until, **__: SimpleNamespace(geometry=until))
    monkeypatch.setattr("mifit.extras.refine_cameras.refine_cameras", lambda *_: found[0])
    return folder, found


def test_the_command_writes_cameras_and_keeps_the_calibration_as_it_was(command, capsys) -> None:
    folder, _ = command
    before = (folder / "transforms.json").read_bytes()
    calibrated = Capture.load(folder)
    assert main(["calibrate", str(folder), "--refine", "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("The calibration is off\nCapture: ")
    after = Capture.load(folder)
    for name in BOTH:
        assert after.camera(name).fx == pytest.approx(1.01 * calibrated.camera(name).fx)
        assert after.landmarks(name, 0) is not None
    assert (folder / "transforms_before.json").read_bytes() == before
    assert main(["calibrate", str(folder), "--refine", "--quiet"]) == 2  # it would overwrite what it kept
    assert "move it away first" in capsys.readouterr().err


def test_the_command_leaves_a_calibration_that_stays(command, capsys) -> None:
    folder, found = command
    found[0] = RefinedCameras((), "the cameras stay", False, {})
    before = (folder / "transforms.json").read_bytes()
    assert main(["calibrate", str(folder), "--refine", "--quiet"]) == 0
    assert (folder / "transforms.json").read_bytes() == before and not (folder / "transforms_before.json").exists()
    assert main(["calibrate", str(folder), "--quiet"]) == 2
    assert "calibrated already; --refine adjusts it" in capsys.readouterr().err
