"""COLMAP text models, COLMAP's own or of other programs: a known capture comes back, bad files are refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mifit.capture import Capture
from mifit.cli import main
from mifit.core.camera import Camera
from mifit.errors import InputError
from mifit.extras.colmap import import_colmap, read_colmap
from tests.extras import photogrammetry as write
from tests.refused import refused

SIZE = (64, 48)


LENSES = [(), (-0.21, 0.08, 0.001, -0.002), (-0.21, 0.08, 0.001, -0.002, 0.03)]


def make_cameras(lens: tuple[float, ...] = ()) -> list[Camera]:
    cameras = []
    for i, (yaw, pitch) in enumerate(((-20.0, 4.0), (18.0, -3.0), (95.0, 20.0))):
        pose = np.eye(4)
        pose[:3, :3] = np.diag([1.0, -1, -1]) @ Rotation.from_euler("yxz", [yaw, pitch, 2.0], degrees=True).as_matrix()
        pose[:3, 3] = (0.4, -0.7 + i, 72.0)
        cameras.append(Camera(f"c{i}", *SIZE, 141.25, 139.5, 31.3, 25.9, pose, lens))
    return cameras


def make_photos(folder: Path, cameras: list[Camera], suffix: str = ".png") -> list[tuple[Camera, str]]:
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{camera.name}{suffix}" for camera in cameras]
    for i, name in enumerate(names):
        Image.new("RGB", SIZE, (10 * i, 0, 0)).save(folder / name)
    return list(zip(cameras, names, strict=True))


def assert_same_cameras(found: list[Camera], expected: list[Camera], unit: float = 1.0) -> None:
    by_name = {camera.name: camera for camera in found}
    assert sorted(by_name) == sorted(camera.name for camera in expected)
    for camera in expected:
        ours = by_name[camera.name]
        pose = camera.world_to_camera.copy()
        pose[:3, 3] *= unit
        np.testing.assert_allclose(ours.world_to_camera, pose, atol=1e-6)
        np.testing.assert_allclose(ours.matrix, camera.matrix, atol=1e-6)
        length = max(len(ours.distortion), len(camera.distortion))
        padded = [(*lens, *(0.0,) * 8)[:length] for lens in (ours.distortion, camera.distortion)]
        np.testing.assert_allclose(*padded, atol=1e-6)


def stored(capture: Capture) -> list[Camera]:
    return [capture.stored_camera(name) for name in capture.cameras]


@pytest.mark.parametrize("lens", LENSES, ids=len)
def test_a_known_capture_comes_back(tmp_path: Path, lens: tuple[float, ...]) -> None:
    cameras = make_cameras(lens)
    model = write.write_colmap(tmp_path / "in" / "sparse" / "0", make_photos(tmp_path / "in", cameras))
    capture = Capture.load(import_colmap(model, tmp_path / "out"))
    assert_same_cameras(stored(capture), cameras)
    assert (capture.units, capture.timesteps) == ("cm", (0,))
    red = [np.asarray(Image.open(capture.shots[name, 0].image))[0, 0, 0] for name in ("c0", "c1", "c2")]
    assert red == [0, 10, 20]  # each camera has its own photograph


def test_a_moving_camera_is_many_cameras_and_a_fixed_one_keeps_its_timesteps(tmp_path: Path) -> None:
    cameras = make_cameras()
    (tmp_path / "images" / "phone").mkdir(parents=True)
    (tmp_path / "images" / "left").mkdir()
    for name in ("phone/a.png", "phone/b.png", "left/0.png", "left/1.png"):
        Image.new("RGB", SIZE).save(tmp_path / "images" / name)
    moving = [(cameras[0], "phone/a.png"), (cameras[1], "phone/b.png")]
    fixed = [(cameras[2], "left/0.png"), (cameras[2], "left/1.png")]
    for chosen, names, steps in ((moving, ("a", "b"), (0,)), (fixed, ("left",), (0, 1))):
        model = write.write_colmap(tmp_path / "sparse", chosen)
        out = tmp_path / "-".join(names)
        capture = Capture.load(import_colmap(model, out))
        assert (capture.cameras, capture.timesteps) == (names, steps)
    assert_same_cameras(stored(capture), [Camera("left", *SIZE, 141.25, 139.5, 31.3, 25.9, cameras[2].world_to_camera)])


def test_videos_with_a_photogrammetric_calibration(tmp_path: Path) -> None:
    """The first frames were registered; the videos are called as they were."""
    cameras = make_cameras()[:2]
    for camera in cameras:
        make_photos(tmp_path / camera.name, [Camera(str(t), *SIZE, 1, 1, 0, 0, np.eye(4)) for t in range(3)])
    model = write.write_colmap(tmp_path / "m", [(camera, f"{camera.name}.png") for camera in cameras])
    out = import_colmap(model, tmp_path / "out", images=[tmp_path / camera.name for camera in cameras], units="mm")
    capture = Capture.load(out)
    assert (capture.units, capture.timesteps) == ("mm", (0, 1, 2))
    assert_same_cameras(stored(capture), cameras)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = make_cameras()
    model = write.write_colmap(tmp_path / "m", make_photos(tmp_path / "photos", cameras))
    arguments = ["import", "--colmap", str(model), "--photos", str(tmp_path / "photos"), "--out"]
    assert main([*arguments, str(tmp_path / "out")]) == 0
    assert_same_cameras(stored(Capture.load(tmp_path / "out")), cameras)
    capsys.readouterr()
    assert main([*arguments, str(tmp_path / "b"), "--transforms", str(tmp_path)]) == 2
    assert "found more than one of transforms, colmap" in capsys.readouterr().err
    images = ["--images", str(tmp_path / "photos"), "--photos", str(tmp_path), "--out", str(tmp_path / "b")]
    assert main(["import", *images]) == 2
    assert "--photos: found without a model" in capsys.readouterr().err


# -- what is refused ------------------------------------------------------------------------------------------------


def test_binary_and_empty_models(tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes(b"")
    refused(read_colmap, tmp_path, match=r"cameras\.txt: no such file; .* model_converter --output_type TXT")
    write.write_colmap(tmp_path, [])
    refused(read_colmap, tmp_path, match=r"images\.txt: found no image with a pose")


def test_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    """Bytes change at random: whatever comes of it, nothing but a calibration or one line."""
    cameras = [(camera, f"{camera.name}.png") for camera in make_cameras(LENSES[1])]
    files = {
        write.write_colmap(tmp_path, cameras) / "images.txt": lambda: read_colmap(tmp_path),
        tmp_path / "cameras.txt": lambda: read_colmap(tmp_path),
    }
    rng = np.random.default_rng(3)
    for path, read in files.items():
        whole, passed = path.read_bytes(), 0
        for _ in range(150):
            data = bytearray(whole)
            for place in rng.integers(0, len(data), rng.integers(1, 4)):
                data[place] = rng.integers(0, 256)
            path.write_bytes(bytes(data))
            try:
                photos = read()
            except InputError as error:
                assert "\n" not in str(error)
                continue
            passed += 1
            for photo in photos:
                assert np.isfinite(photo.view.world_to_camera).all() and np.isfinite(photo.view.intrinsics).all()
        path.write_bytes(whole)
        assert passed < 150, path


def test_photographs_that_are_missing_or_alike(tmp_path: Path) -> None:
    cameras = make_cameras()
    model = write.write_colmap(tmp_path / "m", [(c, f"{c.name}.png") for c in cameras])
    with pytest.raises(InputError, match=r"c0\.png: no such image; expected it there or in 'images'"):
        import_colmap(model, tmp_path / "out", photos=tmp_path / "none")
    for folder in ("a", "b"):
        make_photos(tmp_path / "m" / folder, cameras)
    names = ("a/c0.png", "a/c1.png", "b/c0.png", "b/c1.png")
    write.write_colmap(model, zip([*cameras, cameras[0]], names, strict=True))
    with pytest.raises(InputError, match="another one is called 'c0' too"):
        import_colmap(model, tmp_path / "out")
    shutil.rmtree(tmp_path / "m" / "b")
    write.write_colmap(model, [(cameras[0], "../../etc/a/c0.png"), (cameras[1], "/etc/c1.png")])
    Image.new("RGB", SIZE).save(tmp_path / "m" / "c0.png")
    Image.new("RGB", SIZE).save(tmp_path / "m" / "c1.png")
    capture = Capture.load(import_colmap(model, tmp_path / "out"))  # found by name, never outside the folders
    assert set(capture.cameras) == {"a", "etc"}
