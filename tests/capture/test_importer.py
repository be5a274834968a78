"""Imports: pixels and cameras arrive, and input that doesn't fit together is refused without leaving a trace."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from mifit.capture import Capture, import_capture
from mifit.capture.stereo import write_stereo
from mifit.core.image import read_image
from mifit.errors import InputError
from mifit.extras.colmap import import_colmap
from tests.extras.photogrammetry import write_colmap


def write_video(path: Path, frames: int = 6, size: tuple[int, int] = (64, 48), rate: float = 25.0) -> Path:
    """Every frame is one grey level, so that it can be told after lossy coding."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate, size)
    for i in range(frames):
        writer.write(np.full((size[1], size[0], 3), 20 + 20 * i, dtype=np.uint8))
    writer.release()
    return path


def levels(capture: Capture, camera: str) -> list[int]:
    """Frame numbers by grey level."""
    return [
        round((np.asarray(Pillow.open(capture.shots[camera, t].image)).mean() - 20) / 20) for t in capture.timesteps
    ]


@pytest.fixture
def pair(tmp_path: Path) -> list[Path]:
    return [write_video(tmp_path / "in put" / f"{name}.avi") for name in ("links", "rechts")]


def test_videos_become_an_uncalibrated_capture(tmp_path: Path, pair: list[Path]) -> None:
    seen = []
    out = import_capture(tmp_path / "ca p", videos=pair, progress=lambda *a: seen.append(a))
    capture = Capture.load(out)
    assert capture.cameras == ("links", "rechts")
    assert not capture.calibrated
    assert levels(capture, "rechts") == [0, 1, 2, 3, 4, 5]
    assert seen[-1] == ("Importing", 12, 12)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"every": 2}, [0, 2, 4]),
        ({"start": 3}, [3, 4, 5]),
        ({"start": 1, "every": 2, "count": 2}, [1, 3]),
        ({"count": 99}, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_frames_are_chosen(tmp_path: Path, pair: list[Path], options: dict, expected: list[int]) -> None:
    capture = Capture.load(import_capture(tmp_path / "out", videos=pair, **options))
    assert levels(capture, "links") == expected
    assert capture.timesteps == tuple(range(len(expected)))


def test_bad_videos(tmp_path: Path, pair: list[Path]) -> None:
    data = pair[1].read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(data[: int(0.6 * len(data))])
    text = tmp_path / "text.mp4"
    text.write_text("no video")
    for second, message in (
        (
            cut,
            r"cut.avi: (the header promises 6 frames but|not a readable video: truncated)",
        ),
        (text, r"text.mp4: not a readable video"),
        (tmp_path / "none.mp4", r"none.mp4: no such video file"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            import_capture(tmp_path / "out", videos=[pair[0], second])
        assert "\n" not in str(caught.value)
        assert not [p for p in tmp_path.iterdir() if p.is_dir() and p.name != "in put"]  # nothing is left behind


def test_videos_of_the_same_name_are_called_after_their_folders(tmp_path: Path) -> None:
    videos = [write_video(tmp_path / name / "video.avi", frames=1) for name in ("cam1", "cam2")]
    assert Capture.load(import_capture(tmp_path / "out", videos=videos)).cameras == ("cam1", "cam2")
    with pytest.raises(InputError, match="expected files or folders with different names"):
        import_capture(tmp_path / "again", videos=[videos[0], videos[0]])


def test_image_folders_with_a_stereo_file(tmp_path: Path, folder: Path) -> None:
    original = Capture.load(folder)
    write_stereo(tmp_path / "pair.yml", original.camera("left"), original.camera("right"))
    images = [folder / "images" / name for name in ("left", "right")]
    out = import_capture(tmp_path / "out", images=images, calibration=tmp_path / "pair.yml", units="mm")
    capture = Capture.load(out)
    assert (capture.calibrated, capture.units) == (True, "mm")
    np.testing.assert_array_equal(capture.frame("right", 1).image, original.frame("right", 1).image)
    gauge = np.linalg.inv(capture.camera("left").world_to_camera) @ original.camera("left").world_to_camera
    points = np.random.default_rng(0).normal(size=(20, 3)) * 5
    moved = points @ gauge[:3, :3].T + gauge[:3, 3]
    for name in original.cameras:
        np.testing.assert_allclose(
            capture.camera(name).project(moved), original.camera(name).project(points), atol=1e-3
        )


def test_numbers_in_names_give_the_order(tmp_path: Path) -> None:
    (tmp_path / "cam").mkdir()
    for i in (10, 9, 2):
        Pillow.new("RGB", (20, 20), (i, i, i)).save(tmp_path / "cam" / f"f{i}.png")
    capture = Capture.load(import_capture(tmp_path / "out", images=[tmp_path / "cam"]))
    shown = [np.asarray(Pillow.open(capture.shots["cam", t].image))[0, 0, 0] for t in capture.timesteps]
    assert shown == [2, 9, 10]


def test_colmap_model_with_its_images(tmp_path: Path, folder: Path) -> None:
    original = Capture.load(folder)
    write_colmap(folder / "sparse" / "0", [(original.camera(n), f"{n}/0000.png") for n in original.cameras])
    capture = Capture.load(import_colmap(folder / "sparse" / "0", tmp_path / "out"))
    assert (capture.cameras, capture.timesteps) == (("left", "right"), (0,))
    points = np.random.default_rng(0).normal(size=(20, 3)) * 5
    for name in original.cameras:
        np.testing.assert_allclose(
            capture.camera(name).project(points), original.camera(name).project(points), atol=1e-3
        )
    images = [folder / "images/left", folder / "images/right"]
    both = import_colmap(folder / "sparse" / "0", tmp_path / "b", images=images)
    assert Capture.load(both).timesteps == (0, 1)


def test_nerfstudio_scenes_keep_landmarks_and_masks(tmp_path: Path, folder: Path, document) -> None:
    Pillow.new("L", (48, 32), 255).save(folder / "m.png")
    for frame in document.frames:
        frame["mask_path"] = "m.png"
    document.save()
    original = Capture.load(folder)
    capture = Capture.load(import_capture(tmp_path / "out", transforms=document.path, start=1))
    assert capture.timesteps == (0,)
    assert capture.shots["left", 0].mask is not None
    ours, theirs = capture.frame("left", 0), original.frame("left", 1)
    np.testing.assert_array_equal(ours.image, theirs.image)
    np.testing.assert_allclose(ours.landmarks, theirs.landmarks, atol=1e-3)
    np.testing.assert_array_equal(ours.visible, theirs.visible)


def test_bad_imports(tmp_path: Path, folder: Path, pair: list[Path]) -> None:
    left, right = folder / "images/left", folder / "images/right"
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    original = Capture.load(folder)
    write_stereo(tmp_path / "pair.yml", original.camera("left"), original.camera("right"))
    for options, message in (
        ({}, "nothing to import"),
        ({"videos": pair, "images": [left]}, "found videos and folders of images"),
        ({"images": [left], "calibration": "a.yml", "transforms": "b"}, "found more than one of calibration"),
        ({"images": [left], "calibration": tmp_path / "pair.yml"}, "describes two cameras, but 1 are given"),
        ({"images": [left, right], "calibration": tmp_path / "none.yml"}, "none.yml: no such calibration file"),
        (
            {"videos": pair, "calibration": tmp_path / "pair.yml"},
            "calibrated for 48 x 32 pixels, but the im",
        ),
        ({"images": [tmp_path / "empty"]}, "empty: found no image"),
        ({"images": [tmp_path / "none"]}, "none: no such folder"),
        ({"images": [left], "start": 2}, "start: found 2, expected less than the 2 frames"),
        ({"images": [left], "every": 0}, "every 0"),
        ({"images": [left], "units": "inch"}, "units: found 'inch'"),
    ):
        with pytest.raises(InputError, match=message):
            import_capture(out, **options)
        assert not out.exists()
    write_colmap(tmp_path / "model", [(original.camera("left"), "left/0000.png")])
    other, gone = "has cameras left, expected one called 'right'", "left.0000.png: no such image"
    for images, message in (([left, right], other), ([], gone)):
        with pytest.raises(InputError, match=message):
            import_colmap(tmp_path / "model", out, images=images)
        assert not out.exists()
    with pytest.raises(InputError, match="is there already and not empty"):
        import_capture(folder, images=[left])


def test_damaged_images_stop_an_import(tmp_path: Path, folder: Path) -> None:
    first = folder / "images/left/0000.png"
    jpeg = folder / "images/left/0001.jpg"
    (folder / "images/left/0001.png").unlink()
    Pillow.open(first).save(jpeg)
    jpeg.write_bytes(jpeg.read_bytes()[:500])
    with pytest.raises(InputError, match=r"0001.jpg: damaged or truncated image"):
        import_capture(tmp_path / "out", images=[folder / "images/left"])
    Pillow.new("RGB", (1, 1)).save(jpeg)
    with pytest.raises(InputError, match=r"0001.jpg: found 1 x 1 pixels, expected 48 x 32"):
        import_capture(tmp_path / "out", images=[folder / "images/left"])
    shutil.copy(jpeg, first)
    with pytest.raises(InputError):
        import_capture(tmp_path / "out", images=[folder / "images/left"])


def test_the_hard_capture_from_its_videos_has_the_cameras_of_its_transforms(tmp_path: Path, shared: Path) -> None:
    source = shared / "captures" / "hard"
    out = import_capture(
        tmp_path / "hard", videos=[source / "left.mp4", source / "right.mp4"], calibration=source / "stereo.yml"
    )
    ours, reference = Capture.load(out), Capture.load(source)
    assert (ours.cameras, ours.timesteps, ours.calibrated) == (("left", "right"), reference.timesteps, True)
    gauge = np.linalg.inv(ours.camera("left").world_to_camera) @ reference.camera("left").world_to_camera
    truth = np.load(source / "truth" / "0000.npz")["vertices"][::50].astype(np.float64)
    moved = truth @ gauge[:3, :3].T + gauge[:3, 3]
    for name in ours.cameras:
        difference = ours.camera(name).project(moved) - reference.camera(name).project(truth)
        assert np.abs(difference).max() < 1e-3
        error = ours.frame(name, 3).image - read_image(source / "images" / name / "0003.png")
        assert np.abs(error).mean() < 0.02  # video coding is lossy
