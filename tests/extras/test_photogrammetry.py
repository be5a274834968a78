"""Cameras of other programs and data sets: a known capture comes back, bad files are refused."""

from __future__ import annotations

import json
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
from mifit.extras.colmap import read_colmap
from mifit.extras.importers import KINDS, import_from
from mifit.extras.metashape import read_metashape
from mifit.extras.nersemble import read_nersemble
from mifit.extras.realitycapture import read_realitycapture
from tests.capture.conftest import write_capture
from tests.extras import photogrammetry as write
from tests.refused import refused

SIZE = (64, 48)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "capture")


def imported(out: Path, **options) -> Path:
    """`import_from` with its source as an option called after its kind."""
    (kind,) = (name for name in options if name in KINDS)
    return import_from(kind, options.pop(kind), out, **options)


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
@pytest.mark.parametrize("program", ["metashape", "realitycapture", "colmap"])
def test_a_known_capture_comes_back(tmp_path: Path, program: str, lens: tuple[float, ...]) -> None:
    cameras = make_cameras(lens)
    photos = make_photos(tmp_path / "in", cameras, ".jpg" if program == "metashape" else ".png")
    if program == "metashape":
        labels = [(camera, name.removesuffix(".jpg")) for camera, name in photos]
        options = {"metashape": write.write_metashape(tmp_path / "in" / "cameras.xml", labels)}
    elif program == "realitycapture":
        options = {"realitycapture": write.write_xmp(tmp_path / "in", photos)}
    else:
        options = {"colmap": write.write_colmap(tmp_path / "in" / "sparse" / "0", photos)}
    capture = Capture.load(imported(tmp_path / "out", **options))
    assert_same_cameras(stored(capture), cameras)
    assert capture.units == ("cm" if program == "colmap" else "m")
    assert capture.timesteps == (0,)
    red = [np.asarray(Image.open(capture.shots[name, 0].image))[0, 0, 0] for name in ("c0", "c1", "c2")]
    np.testing.assert_allclose(red, [0, 10, 20], atol=2)  # each camera has its own photograph


def test_the_chunk_of_metashape_has_scale_and_place(tmp_path: Path) -> None:
    cameras = make_cameras()
    similarity = np.eye(4)
    similarity[:3, :3] = 0.037 * Rotation.from_euler("xyz", [10, 50, -160], degrees=True).as_matrix()
    similarity[:3, 3] = (5.0, -3.0, 0.25)
    path = write.write_metashape(tmp_path / "c.xml", [(c, c.name) for c in cameras], similarity)
    assert_same_cameras([photo.view.camera() for photo in read_metashape(path)], cameras)


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
        capture = Capture.load(imported(out, colmap=model))
        assert (capture.cameras, capture.timesteps) == (names, steps)
    assert_same_cameras(stored(capture), [Camera("left", *SIZE, 141.25, 139.5, 31.3, 25.9, cameras[2].world_to_camera)])


def test_vhap(tmp_path: Path, folder: Path) -> None:
    original = Capture.load(folder)
    capture = Capture.load(imported(tmp_path / "out", vhap=write.write_vhap(tmp_path / "v", folder)))
    assert (capture.units, capture.cameras, capture.timesteps) == ("m", original.cameras, original.timesteps)
    assert_same_cameras(stored(capture), stored(original))
    ours, theirs = capture.frame("right", 1), original.frame("right", 1)
    third = ours.image.shape[1] // 3
    np.testing.assert_array_equal(ours.image[:, third:], theirs.image[:, third:])
    assert not ours.valid[:, :third].any() and ours.valid[:, third:].all()  # its masks come along


@pytest.mark.parametrize("layout", ["released", "folders"])
def test_nersemble(tmp_path: Path, layout: str) -> None:
    cameras = [Camera(f"2222{c.name[1:]}", *SIZE, 141.25, 139.5, 31.3, 25.9, c.world_to_camera) for c in make_cameras()]
    person = tmp_path / "074"
    sequence, parameters = person / "sequences" / "EMO-1", person / "calibration"
    parameters.mkdir(parents=True)
    (parameters / "camera_params.json").write_text(json.dumps(write.nersemble_parameters(cameras, 2.0)))
    (sequence / "images").mkdir(parents=True)
    for camera in cameras:
        for t in (9, 12):
            if layout == "folders":
                (sequence / "images" / f"cam_{camera.name}").mkdir(exist_ok=True)
                image = Image.new("RGB", SIZE, (20 * t, 0, 0))
                image.save(sequence / "images" / f"cam_{camera.name}" / f"frame_{t:05d}.png")
        if layout == "released":
            import cv2

            file = sequence / "images" / f"cam_{camera.name}.avi"
            writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 73.0, SIZE)
            for _ in range(2):
                writer.write(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
            writer.release()
    capture = Capture.load(imported(tmp_path / "out", nersemble=sequence))
    assert (capture.units, capture.timesteps) == ("m", (0, 1))
    assert_same_cameras(stored(capture), cameras)


def test_videos_with_a_photogrammetric_calibration(tmp_path: Path) -> None:
    """The first frames were registered; the videos are called as they were."""
    cameras = make_cameras()[:2]
    for camera in cameras:
        make_photos(tmp_path / camera.name, [Camera(str(t), *SIZE, 1, 1, 0, 0, np.eye(4)) for t in range(3)])
    model = write.write_metashape(tmp_path / "c.xml", [(camera, f"{camera.name}.png") for camera in cameras])
    out = imported(tmp_path / "out", images=[tmp_path / camera.name for camera in cameras], metashape=model, units="cm")
    capture = Capture.load(out)
    assert (capture.units, capture.timesteps) == ("cm", (0, 1, 2))
    assert_same_cameras(stored(capture), cameras)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = make_cameras()
    model = write.write_metashape(tmp_path / "c.xml", make_photos(tmp_path / "photos", cameras))
    arguments = ["import", "--metashape", str(model), "--photos", str(tmp_path / "photos"), "--out"]
    assert main([*arguments, str(tmp_path / "out")]) == 0
    assert_same_cameras(stored(Capture.load(tmp_path / "out")), cameras)
    capsys.readouterr()
    assert main([*arguments, str(tmp_path / "b"), "--colmap", str(tmp_path)]) == 2
    assert "found more than one of colmap, metashape" in capsys.readouterr().err


# -- what is refused ------------------------------------------------------------------------------------------------


BOMB = '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]>'
OTHER_FILE = '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<document", BOMB + "<document", "a document type, which is refused"),
        ("<document", OTHER_FILE + "<document", "a document type, which is refused"),
        ("</document>", "", "not a readable Metashape XML file"),
        ("document", "cameras", "found no chunk of a document"),
        ('type="frame" class="adjusted"', 'type="fisheye" class="adjusted"', "found camera type 'fisheye'"),
        ("<f>139.5</f>", "<f>-139.5</f>", "found focal length -139.5"),
        ("<f>139.5</f>", "<f>nan</f>", "found 'nan', expected 1 finite numbers"),
        ("<f>139.5</f>", "<f>139.5</f><k4>90</k4>", "k4 moves points by up to"),
        ("<f>139.5</f>", "<f>139.5</f><b2>9</b2>", "b2 moves points by up to 1.55 pixels"),
        ("<transform>", "<transform>1 ", "expected 16 finite numbers"),
        ('width="64"', 'width="99999999"', "found resolution 99999999 x 48"),
        ('width="64"', 'width="²"', "found resolution ² x 48"),
        ('label="c1"', "", "has no label"),
        ("<scale>1.0</scale>", "<scale>0</scale>", "found scale 0, expected a positive one"),
        ('sensor_id="1"', 'sensor_id="77"', "its sensor 77 has no calibration"),
        ("<transform>", "<gone>", "not a readable"),
    ],
)
def test_bad_metashape_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write.write_metashape(tmp_path / "c.xml", [(camera, camera.name) for camera in make_cameras()])
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    refused(read_metashape, path, match=message)


def test_metashape_without_poses_or_on_the_globe(tmp_path: Path) -> None:
    path = write.write_metashape(tmp_path / "c.xml", [(camera, camera.name) for camera in make_cameras()])
    text = path.read_text(encoding="utf-8")
    import re

    path.write_text(re.sub("<camera (.*?)><transform>.*?</transform>", r"<camera \1>", text), encoding="utf-8")
    refused(read_metashape, path, match="found no image with a pose")
    far = re.sub("<translation>.*?</translation>", "<translation>4.2e6 6.1e5 4.7e6</translation>", text)
    path.write_text(far, encoding="utf-8")
    refused(read_metashape, path, match="expected local coordinates")


@pytest.mark.parametrize("text", ["<a>" * 200_000, "<a>" * 200_000 + "</a>" * 200_000, "<a " + "b" * 10**6 + "=''/>"])
def test_deep_and_long_xml(tmp_path: Path, text: str) -> None:
    path = tmp_path / "c.xml"
    path.write_text(text)
    refused(read_metashape, path, match=r"c\.xml: ")


def test_large_and_odd_files(tmp_path: Path) -> None:
    path = tmp_path / "c.xml"
    with path.open("wb") as stream:
        stream.truncate(1 << 40)
    refused(read_metashape, path, match="expected a XML file of at most 8388608")
    (tmp_path / "cameras.bin").write_bytes(b"")
    refused(read_colmap, tmp_path, match=r"cameras\.txt: no such file; .* model_converter --output_type TXT")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<x:xmpmeta", BOMB + "<x:xmpmeta", "a document type, which is refused"),
        ("brown3t2", "division", "DistortionModel: found 'division', expected one of perspective, brown3"),
        ('FocalLength35mm="', 'FocalLength35mm="-', "found focal length -"),
        ('Skew="0"', 'Skew="0.5"', "the skew moves points"),
        ("<xcr:Rotation>", "<xcr:Rotation>1 ", "Rotation: found .*, expected 9 finite numbers"),
        ("<xcr:Rotation>", "<xcr:Rotation>7", "expected an orthonormal one"),
        ("<xcr:Position>", "<xcr:Position>inf ", "Position: found"),
        ("xcr:Rotation", "xcr:Turn", "found no image with a pose"),
        ("</x:xmpmeta>", "", "not a readable XMP file"),
    ],
)
def test_bad_xmp_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    write.write_xmp(tmp_path, make_photos(tmp_path, make_cameras()[:1]))
    path = tmp_path / "c0.xmp"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    refused(read_realitycapture, tmp_path, lambda name: SIZE, match=message)


def test_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    """Bytes change at random: whatever comes of it, nothing but a calibration or one line."""
    cameras = [(camera, f"{camera.name}.png") for camera in make_cameras(LENSES[1])]
    files = {
        write.write_metashape(tmp_path / "c.xml", cameras): lambda: read_metashape(tmp_path / "c.xml"),
        write.write_xmp(tmp_path, cameras) / "c1.xmp": lambda: read_realitycapture(tmp_path, lambda n: SIZE),
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


def test_bad_data_sets(tmp_path: Path, folder: Path) -> None:
    refused(read_nersemble, tmp_path, match="images: no such folder")
    (tmp_path / "images").mkdir()
    refused(read_nersemble, tmp_path, match="found no cam_SERIAL")
    (tmp_path / "images" / "cam_1").mkdir()
    Image.new("RGB", SIZE).save(tmp_path / "images" / "cam_1" / "0.png")
    refused(read_nersemble, tmp_path, match="found no camera_params.json")
    good = write.nersemble_parameters(make_cameras(), 1.0)
    for change, message in (
        ({"world_2_cam": []}, "found no object world_2_cam"),
        ({"world_2_cam": {"2": np.eye(4).tolist()}}, "has cameras 2, expected one called '1'"),
        ({"world_2_cam": {"1": np.diag([1.0, 1, -1, 1]).tolist()}}, "left-handed"),
        ({"world_2_cam": {"1": [[1]]}}, "expected 4 x 4 finite numbers"),
        ({"intrinsics": np.zeros((3, 3)).tolist()}, "found focal lengths 0, 0"),
        ({"width": 10}, "calibrated for 10 x 48 pixels, but camera '1' has 64 x 48"),
        ({"width": "a"}, "expected pixels"),
    ):
        document = {**good, "world_2_cam": {"1": np.eye(4).tolist()}, **change}
        (tmp_path / "camera_params.json").write_text(json.dumps(document))
        refused(read_nersemble, tmp_path, match=message)
    out = tmp_path / "out"
    vhap = write.write_vhap(tmp_path / "v", folder)
    for options, message in (
        ({"vhap": vhap, "images": [vhap / "images"]}, "vhap: brings its own images"),
        ({"vhap": vhap, "photos": vhap}, "photos: found without a model"),
    ):
        with pytest.raises(InputError, match=message):
            imported(out, **options)
        assert not out.exists()


def test_photographs_that_are_missing_or_alike(tmp_path: Path) -> None:
    cameras = make_cameras()
    model = write.write_colmap(tmp_path / "m", [(c, f"{c.name}.png") for c in cameras])
    with pytest.raises(InputError, match=r"c0\.png: no such image; expected it there or in 'images'"):
        imported(tmp_path / "out", colmap=model, photos=tmp_path / "none")
    for folder in ("a", "b"):
        make_photos(tmp_path / "m" / folder, cameras)
    names = ("a/c0.png", "a/c1.png", "b/c0.png", "b/c1.png")
    write.write_colmap(model, zip([*cameras, cameras[0]], names, strict=True))
    with pytest.raises(InputError, match="another one is called 'c0' too"):
        imported(tmp_path / "out", colmap=model)
    shutil.rmtree(tmp_path / "m" / "b")
    write.write_colmap(model, [(cameras[0], "../../etc/a/c0.png"), (cameras[1], "/etc/c1.png")])
    Image.new("RGB", SIZE).save(tmp_path / "m" / "c0.png")
    Image.new("RGB", SIZE).save(tmp_path / "m" / "c1.png")
    capture = Capture.load(imported(tmp_path / "out", colmap=model))  # found by name, never outside the folders
    assert set(capture.cameras) == {"a", "etc"}
