"""transforms.json: every kind of bad entry gives one line that names it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mifit.capture import Capture
from mifit.capture.transforms import read_transforms, write_transforms
from mifit.errors import InputError

EYE = np.eye(4).tolist()


def _scaled(row: int, factor: float) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[row] *= factor
    return matrix.tolist()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("fl_x", -3.0, r"frames\[1\]: fl_x: found -3.0, expected a positive number of pixels"),
        ("fl_x", 0, r"fl_x: found 0, expected a positive"),
        ("fl_x", "wide", r"fl_x: found 'wide', expected a positive"),
        ("fl_y", float("nan"), r"fl_y: found nan, expected a positive"),
        ("cx", 1e6, r"cx, cy: found 1e\+06"),
        ("k1", float("inf"), r"k1: found inf, expected a finite number"),
        ("w", 1, r"w, h: found 1 x 32 pixels, expected at least 16"),
        ("w", 10**7, r"w, h: found 10000000 x 32 pixels, expected at least 16 on each side and at most 67 megapixels"),
        ("timestep_index", -1, r"timestep_index: found -1, expected a whole number of at least 0"),
        ("timestep_index", 0.5, r"timestep_index: found 0.5"),
        ("camera_id", {}, r"camera_id: found \{\}, expected a non-empty string"),
        ("file_path", None, r"file_path: found nothing, expected a non-empty string"),
        ("file_path", "", r"file_path: found ''"),
        ("gain", [1, 2], r"gain: found \[1, 2\], expected a positive number or three"),
        ("gain", -1, r"gain: found -1"),
        ("transform_matrix", [[1, 2], [3]], r"transform_matrix: found .*expected 4 x 4 numbers"),
        ("transform_matrix", [[1, 2], [3, 4]], r"transform_matrix: found shape \(2, 2\)"),
        ("transform_matrix", _scaled(0, float("nan")), r"transform_matrix: found a NaN or infinite value"),
        ("transform_matrix", _scaled(1, 0.0), r"transform_matrix: found a singular rotation \(determinant 0\)"),
        ("transform_matrix", _scaled(2, -1.0), r"transform_matrix: found a left-handed rotation \(determinant -1\)"),
        ("transform_matrix", _scaled(0, 2.0), r"transform_matrix: found a scaled or sheared rotation"),
        ("transform_matrix", _scaled(3, 2.0), r"last row \[0.0, 0.0, 0.0, 2.0\]"),
    ],
)
def test_bad_entries(document, key: str, value: object, message: str) -> None:
    document.frames[1][key] = value
    document.save()
    with pytest.raises(InputError, match=message) as caught:
        Capture.load(document.path)
    assert "\n" not in str(caught.value)
    assert str(document.path) in str(caught.value)


@pytest.mark.parametrize(("key", "value"), [("w", 49), ("fl_x", 70.0), ("k1", 0.1), ("transform_matrix", EYE)])
def test_a_camera_that_changes_over_time_is_refused(document, key: str, value: object) -> None:
    assert document.frames[3]["camera_id"] == "right"
    document.frames[3][key] = value
    document.save()
    with pytest.raises(InputError, match=r"frames\[3\]: .*: differs from the first image of camera 'right'"):
        Capture.load(document.path)


def test_duplicate_and_missing_timesteps(document) -> None:
    document.frames[2]["timestep_index"] = 0
    document.save()
    with pytest.raises(InputError, match=r"frames\[2\]: timestep 0 of camera 'left' is there twice"):
        Capture.load(document.path)
    document.frames[2]["timestep_index"] = 7
    document.save()
    with pytest.raises(InputError, match=r"camera 'left' has no image of timestep 1, expected every camera"):
        Capture.load(document.path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not readable as JSON"),
        ("[1, 2]", r"found \[1, 2\], expected an object"),
        ("{}", "frames: found nothing, expected a list of at least one image"),
        ('{"frames": []}', "expected a list of at least one image"),
        ('{"frames": [3]}', r"frames\[0\]: found 3, expected an object"),
        ('{"frames": [{}], "units": "furlong"}', "units: found 'furlong', expected one of mm, cm"),
        ('{"frames": [{}], "camera_model": "OPENCV_FISHEYE"}', "camera_model: found 'OPENCV_FISHEYE'"),
        ("[" * 100000, "not readable as JSON"),
        ('{"frames": [{"file_path": "a\\u0000b"}]}', "file_path"),
    ],
)
def test_bad_documents(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(InputError, match=message):
        Capture.load(tmp_path)


def test_missing_folder_and_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no such folder"):
        Capture.load(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"transforms.json: no such file"):
        Capture.load(tmp_path)


def test_written_and_read_again_is_the_same(folder: Path) -> None:
    first = read_transforms(folder / "transforms.json")
    write_transforms(folder / "transforms.json", first.views, first.shots, "mm")
    second = read_transforms(folder / "transforms.json")
    assert second.units == "mm"
    assert second.shots == first.shots
    for a, b in zip(first.views, second.views, strict=True):
        assert a.intrinsics == b.intrinsics
        assert a.world_to_camera is not None
        assert b.world_to_camera is not None
        np.testing.assert_allclose(a.world_to_camera, b.world_to_camera, atol=1e-12)


def test_shared_keys_may_stand_at_the_top(document) -> None:
    before = Capture.load(document.path).camera("left")
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        document.content[key] = document.frames[0][key]
        for frame in document.frames:
            del frame[key]
    document.save()
    after = Capture.load(document.path).camera("left")
    assert (after.fx, after.cy, after.width) == (before.fx, before.cy, before.width)


def test_plain_nerfstudio_scenes_have_one_camera_per_image(document) -> None:
    document.content["frames"] = document.frames[:2]
    for frame in document.frames:
        del frame["camera_id"], frame["timestep_index"]
    document.frames[1]["file_path"] = "images/right/0001.png"
    document.save()
    capture = Capture.load(document.path)
    assert capture.cameras == ("0000", "0001")
    assert capture.timesteps == (0,)


def test_a_capture_without_calibration_loads_and_refuses_to_give_a_camera(document) -> None:
    for frame in document.frames:
        del frame["transform_matrix"]
    document.save()
    capture = Capture.load(document.path)
    assert not capture.calibrated
    assert capture.frame("left", 0).valid.all()
    with pytest.raises(InputError, match=r"camera 'left' has no pose \(transform_matrix\); estimate it"):
        capture.camera("left")


def test_rounded_matrices_are_made_orthonormal(document) -> None:
    for frame in document.frames:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()
    document.save()
    rotation = Capture.load(document.path).camera("left").rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_unicode_is_kept_in_the_file(folder: Path) -> None:
    assert json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["frames"]
