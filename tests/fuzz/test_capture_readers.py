"""Every reader of captures gives a valid object or a mifit error, whatever the file holds."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mifit.capture import Capture
from mifit.capture.landmark_files import read_landmarks
from mifit.capture.stereo import read_stereo, write_stereo
from mifit.core.camera import Camera
from mifit.core.image import MAX_PIXELS, encode_png, load_image, write_image
from mifit.extras.colmap import read_colmap
from tests.extras.photogrammetry import write_colmap
from tests.fuzz.conftest import NASTY, as_json, bounded, read_or_refuse, spoilt_bytes, spoilt_documents

POSE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 60.0], [0, 0, 0, 1]]
FRAME = {
    "file_path": "images/left/0000.png", "landmark_path": "landmarks/0.json", "mask_path": "mask.png",
    "camera_id": "left", "timestep_index": 0, "w": 40, "h": 30, "fl_x": 50.0, "fl_y": 50.0, "cx": 20.0, "cy": 15.0,
    "k1": 0.01, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0, "transform_matrix": POSE, "gain": [1.0, 1.1, 0.9],
}  # fmt: skip
DOCUMENT = {
    "camera_model": "OPENCV",
    "units": "cm",
    "frames": [{**FRAME, "camera_id": name, "timestep_index": t} for t in (0, 1) for name in ("left", "right")],
}
PLAIN = {  # as nerfstudio and Blender exporters write it
    "camera_angle_x": 0.7, "w": 40, "h": 30, "units": "m",
    "frames": [{"file_path": name, "transform_matrix": POSE} for name in ("images/left/0000", "./mask.png")],
}  # fmt: skip
POINTS = (np.arange(136).reshape(68, 2) * 0.2 + 1.0).round(2)
CAMERA = Camera("left", 40, 30, 50.0, 51.0, 20.0, 15.0, np.eye(4), distortion=(0.01, 0.0, 0.001, 0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture folder with all files that `DOCUMENT` names."""
    folder = tmp_path_factory.mktemp("capture")
    image = np.linspace(0, 1, 30 * 40 * 3).reshape(30, 40, 3)
    write_image(folder / "images" / "left" / "0000.png", image)
    write_image(folder / "mask.png", np.ones((30, 40)))
    (folder / "landmarks").mkdir()
    (folder / "landmarks" / "0.json").write_text(json.dumps({"points": POINTS.tolist(), "visible": [True] * 68}))
    return folder


def use(folder: Path) -> None:
    """Load a capture and use all of it; what it gives must be sound."""
    capture = Capture.load(folder)
    assert capture.unit_mm > 0 and capture.cameras and capture.timesteps
    for name in capture.cameras:
        if capture.calibrated:
            camera = capture.camera(name)
            assert np.isfinite(camera.world_to_camera).all() and min(camera.fx, camera.fy) > 0
            assert np.allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)
        frame = capture.frame(name, capture.timesteps[0])
        assert np.isfinite(frame.image).all() and frame.image.shape[:2] == frame.valid.shape
        assert frame.landmarks is None or np.isfinite(frame.landmarks).all()


@bounded(250)
@given(st.data())
def test_transforms(folder: Path, data: st.DataObject) -> None:
    document = data.draw(spoilt_documents(data.draw(st.sampled_from([DOCUMENT, PLAIN]))))
    (folder / "transforms.json").write_text(as_json(document))
    read_or_refuse(lambda: use(folder))


@bounded(60)
@given(st.data())
def test_transforms_as_text(folder: Path, data: st.DataObject) -> None:
    (folder / "transforms.json").write_bytes(data.draw(spoilt_bytes(json.dumps(DOCUMENT).encode())))
    read_or_refuse(lambda: use(folder))


@pytest.mark.parametrize("document", [DOCUMENT, PLAIN])
def test_the_undamaged_captures_are_read(folder: Path, document: dict) -> None:
    (folder / "transforms.json").write_text(json.dumps(document))
    use(folder)


@bounded(150)
@given(st.data())
def test_colmap(tmp_path: Path, data: st.DataObject) -> None:
    write_colmap(tmp_path, [(CAMERA, "left/0000.png"), (CAMERA, "right/0000.png")])
    for name in data.draw(st.sampled_from([["cameras.txt"], ["images.txt"], ["cameras.txt", "images.txt"]])):
        path = tmp_path / name
        if data.draw(st.booleans()):
            path.write_bytes(data.draw(spoilt_bytes(path.read_bytes())))
        else:  # one field becomes something else
            lines = path.read_text().splitlines()
            rows = [i for i, line in enumerate(lines) if line and not line.startswith("#")]
            row = data.draw(st.sampled_from(rows))
            words = lines[row].split()
            words[data.draw(st.integers(0, len(words) - 1))] = str(data.draw(NASTY))
            lines[row] = " ".join(words)
            path.write_text("\n".join(lines) + "\n", errors="replace")
    for image in read_or_refuse(lambda: read_colmap(tmp_path)) or ():
        assert image.view.calibrated and min(image.view.width, image.view.height) > 0
        assert np.isfinite(image.view.world_to_camera).all() and np.isfinite(image.view.intrinsics).all()


@bounded(150)
@given(st.data())
def test_stereo_calibration(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "stereo.yml"
    write_stereo(path, CAMERA, CAMERA)
    path.write_bytes(data.draw(spoilt_bytes(path.read_bytes())))
    found = read_or_refuse(lambda: read_stereo(path, ["a", "b"], [(40, 30), (40, 30)]))
    for view in found or ():
        camera = view.camera()
        assert min(camera.fx, camera.fy) > 0 and np.isfinite(camera.world_to_camera).all()
        assert np.isfinite([camera.cx, camera.cy, *camera.distortion]).all()


@bounded(200)
@given(st.data())
def test_landmarks(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "l.json"
    if data.draw(st.booleans()):
        whole = {"convention": "ibug68", "points": POINTS.tolist(), "visible": [True] * 68}
        path.write_text(as_json(data.draw(spoilt_documents(data.draw(st.sampled_from([whole, POINTS.tolist()]))))))
    else:
        path.write_text(json.dumps({"points": POINTS.tolist()}))
        path.write_bytes(data.draw(spoilt_bytes(path.read_bytes())))
    found = read_or_refuse(lambda: read_landmarks(path))
    if found is not None:
        assert found.points.shape == (68, 2) and np.isfinite(found.points).all()
        assert found.visible.shape == (68,) and found.visible.dtype == bool


def image_files() -> dict[str, bytes]:
    """One small file of every kind that is read."""
    codes = (np.random.default_rng(0).random((12, 17, 3)) * 255).astype(np.uint8)
    jpeg, tiff, png16 = (
        cv2.imencode(suffix, image)[1].tobytes()
        for suffix, image in ((".jpg", codes), (".tiff", codes), (".png", codes.astype(np.uint16) * 257))
    )
    hdr = cv2.imencode(".hdr", codes.astype(np.float32) / 255)[1].tobytes()
    return {"png": encode_png(codes), "png16": png16, "jpg": jpeg, "tiff": tiff, "hdr": hdr}


FILES = image_files()


def check_image(path: Path) -> None:
    found = read_or_refuse(lambda: load_image(path))
    if found is not None:
        height, width = found.pixels.shape[:2]
        assert found.pixels.shape == (height, width, 3) and 0 < height * width <= MAX_PIXELS
        assert found.pixels.dtype == np.float32 and found.clipped.shape == (height, width)
        if found.bits < 32:
            assert 0 <= found.pixels.min() and found.pixels.max() <= 1


@bounded(300)
@given(st.data())
def test_images(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "image"
    path.write_bytes(data.draw(spoilt_bytes(FILES[data.draw(st.sampled_from(sorted(FILES)))])))
    check_image(path)


@bounded(150)
@given(st.data())
def test_exr_images(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "image.exr"
    write_image(path, np.linspace(0, math.pi, 12 * 17 * 3).reshape(12, 17, 3))
    path.write_bytes(data.draw(spoilt_bytes(path.read_bytes())))
    check_image(path)


@bounded(60)
@given(
    st.binary(max_size=200),
    st.sampled_from([b"", b"#?RADIANCE\n", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"II*\0", b"v/1\x01"]),
)
def test_arbitrary_bytes_are_no_image(tmp_path: Path, content: bytes, start: bytes) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(start + content)
    check_image(path)
