"""Captures: what `frame` delivers, what is read when, and how much is kept."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from mifit.capture import Capture
from mifit.capture import capture as capture_module
from mifit.capture.landmark_files import read_landmarks
from mifit.core.image import read_image, write_image
from mifit.errors import InputError


def test_names_timesteps_and_units(folder: Path) -> None:
    capture = Capture.load(folder)
    assert capture.cameras == ("left", "right")
    assert capture.timesteps == (0, 1)
    assert (capture.units, capture.unit_mm, capture.calibrated) == ("cm", 10.0, True)
    assert Capture.load(folder / "transforms.json").cameras == capture.cameras


def test_a_frame_is_the_file_in_linear_colour_with_its_landmarks(folder: Path) -> None:
    frame = Capture.load(folder).frame("right", 1)
    np.testing.assert_array_equal(frame.image, read_image(folder / "images/right/0001.png"))
    stored = read_landmarks(folder / "landmarks/right/0001.json")
    assert frame.landmarks is not None
    np.testing.assert_array_equal(frame.landmarks, stored.points)
    np.testing.assert_array_equal(frame.visible, np.arange(68) % 5 > 0)
    assert frame.valid.all()
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0, 0] = 1.0


def test_only_the_named_camera_is_ever_read(folder: Path) -> None:
    shutil.rmtree(folder / "images" / "right")
    shutil.rmtree(folder / "landmarks" / "right")
    capture = Capture.load(folder)
    capture.frame("left", 0)
    assert len(capture.digest(["left"], [0, 1])) == 64
    with pytest.raises(InputError, match=r"right.0000.png: no such image file"):
        capture.frame("right", 0)
    with pytest.raises(InputError, match=r"no such file"):
        capture.digest()


def test_digest_changes_with_pixels_and_calibration_of_what_is_named(folder: Path, document) -> None:
    before = Capture.load(folder).digest(["left"], [0])
    write_image(folder / "images/right/0000.png", np.zeros((32, 48, 3)))
    assert Capture.load(folder).digest(["left"], [0]) == before
    write_image(folder / "images/left/0000.png", np.zeros((32, 48, 3)))
    changed = Capture.load(folder).digest(["left"], [0])
    assert changed != before
    for frame in document.frames:
        frame["fl_x"] += 0.01
    document.save()
    assert Capture.load(folder).digest(["left"], [0]) != changed


def test_memory_stays_bounded_over_600_frames(
    tmp_path: Path, make_capture: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_capture(tmp_path / "c", timesteps=300, size=(24, 16))
    capture = Capture.load(tmp_path / "c", cache_bytes=50_000)
    decoded = []
    monkeypatch.setattr(
        capture_module, "load_image", lambda path, load=capture_module.load_image: decoded.append(path) or load(path)
    )
    size = capture.frame("left", 0).nbytes
    for t in capture.timesteps:
        for camera in capture.cameras:
            capture.frame(camera, t)
            assert capture._cache.used <= 50_000
    assert len(decoded) == 600
    assert len(capture._cache) == 50_000 // size
    capture.frame("right", 299)  # the latest is still there, the first is not
    assert len(decoded) == 600
    capture.frame("left", 0)
    assert len(decoded) == 601


def test_mask_alpha_and_non_finite_pixels_make_pixels_invalid(folder: Path, document) -> None:
    mask = np.ones((32, 48), dtype=np.float32)
    mask[:5] = 0
    write_image(folder / "mask.png", mask)
    rgba = np.full((32, 48, 4), 0.5, dtype=np.float32)
    rgba[:, :7, 3] = 0
    write_image(folder / "images/left/0000.exr", rgba)
    rgba[..., 3] = 1
    rgba[10, 20, 1], rgba[12, 22, 0], rgba[14, 24, 2] = np.nan, 1e30, -np.inf
    rgba[16, 26], rgba[18, 28, 1], rgba[20, 30, 1] = (1e5, 1e5, 1e5, 1), -1, -0.01
    write_image(folder / "images/left/0001.exr", rgba)
    for frame in document.frames:
        frame["mask_path"] = "mask.png"
        if frame["camera_id"] == "left":
            frame["file_path"] = frame["file_path"].replace(".png", ".exr")
    document.save()
    capture = Capture.load(folder)
    first, second = capture.frame("left", 0), capture.frame("left", 1)
    assert not first.valid[:5].any()
    assert not first.valid[:, :7].any()
    assert first.valid[5:, 7:].all()
    assert np.argwhere(~second.valid[5:]).tolist() == [
        [5, 20],
        [7, 22],
        [9, 24],
        [13, 28],
    ]  # 1e5 may be a sky, -0.01 noise
    assert np.isfinite(second.image).all()
    assert (first.image[~first.valid] == 0).all()


def test_gain_multiplies_the_linear_image(folder: Path, document) -> None:
    plain = Capture.load(folder).frame("left", 0).image
    for frame in document.frames:
        frame["gain"] = [2.0, 1.0, 0.5] if frame["camera_id"] == "left" else 1.0
    document.save()
    capture = Capture.load(folder)
    np.testing.assert_allclose(capture.frame("left", 0).image, plain * np.float32([2, 1, 0.5]), rtol=1e-6)
    assert capture.views["right"].gain == (1.0, 1.0, 1.0)


def test_clipped_pixels_are_marked(folder: Path) -> None:
    codes = np.full((32, 48, 3), 100, dtype=np.uint8)
    codes[4, 9, 2] = 255
    Pillow.fromarray(codes).save(folder / "images/left/0000.png")
    assert np.argwhere(Capture.load(folder).frame("left", 0).clipped).tolist() == [[4, 9]]


def test_grey_images_are_taken(folder: Path) -> None:
    Pillow.new("L", (48, 32), 188).save(folder / "images/left/0000.png")
    np.testing.assert_allclose(Capture.load(folder).frame("left", 0).image, 0.50289, atol=1e-5)


def test_invisible_landmarks_stay_finite(folder: Path) -> None:
    points = [[4 + i, 5] for i in range(66)]
    (folder / "landmarks/left/0000.json").write_text(json.dumps({"points": [None, [math.nan, 3], *points]}))
    frame = Capture.load(folder).frame("left", 0)
    assert frame.landmarks is not None
    assert np.isfinite(frame.landmarks).all()
    assert frame.visible.tolist() == [False, False] + [True] * 66


def test_a_capture_without_landmarks_says_so(folder: Path, document) -> None:
    for frame in document.frames:
        del frame["landmark_path"]
    document.save()
    frame = Capture.load(folder).frame("left", 0)
    assert frame.landmarks is None
    assert not frame.visible.any()


def test_unknown_names_list_the_known_ones(folder: Path) -> None:
    capture = Capture.load(folder)
    with pytest.raises(InputError, match=r"camera 'top': not in .*; it has left, right"):
        capture.camera("top")
    with pytest.raises(InputError, match=r"timestep 9: not in .*; it has 0 to 1"):
        capture.frame("left", 9)


def test_damaged_images_are_named(folder: Path) -> None:
    path = folder / "images/left/0000.png"
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError, match=r"left.0000.png: damaged or truncated image"):
        Capture.load(folder).frame("left", 0)
    write_image(path, np.zeros((32, 40, 3)))
    with pytest.raises(InputError, match=r"0000.png: found 40 x 32 pixels, expected 48 x 32 \(w, h of camera 'left'\)"):
        Capture.load(folder).frame("left", 0)
    write_image(path, np.zeros((1, 1, 3)))
    with pytest.raises(InputError, match=r"found 1 x 1 pixels"):
        Capture.load(folder).frame("left", 0)


def test_the_shared_captures_agree_with_their_ground_truth(shared: Path, ict_path: Path) -> None:
    landmarks = np.load(ict_path)["landmarks_ibug68"]
    for name in ("soft", "hard", "gloss"):
        capture = Capture.load(shared / "captures" / name)
        truth = np.load(shared / "captures" / name / "truth/0001.npz")["vertices"][landmarks]
        for camera in ("left", "right"):
            found = capture.landmarks(camera, 1)
            assert found is not None
            error = np.linalg.norm(found.points - capture.camera(camera).project(truth), axis=1)
            assert np.median(error[found.visible]) < 1.3  # detector noise of 0.8 px a coordinate


def test_a_capture_is_pickled_and_copied(folder: Path) -> None:
    import copy
    import pickle

    capture = Capture.load(folder)
    name, timestep = capture.cameras[0], capture.timesteps[0]
    image = capture.frame(name, timestep).image
    for other in (pickle.loads(pickle.dumps(capture)), copy.deepcopy(capture), copy.copy(capture)):
        assert other.digest() == capture.digest()
        np.testing.assert_array_equal(other.frame(name, timestep).image, image)
