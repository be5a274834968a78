"""Each calibration convention round-trips through all the others on the same points."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.capture.lens import opencv_matrix, undistort_points, undistortion
from mifit.capture.stereo import read_stereo, write_stereo
from mifit.capture.transforms import Shot, View, read_transforms, write_transforms
from mifit.core.camera import Camera
from mifit.errors import InputError
from mifit.extras.colmap import read_colmap
from tests.extras.photogrammetry import write_colmap

POINTS = np.random.default_rng(1).uniform(-9, 9, (60, 3))
LENSES = [
    (),
    (-0.21, 0.08, 0.001, -0.002),
    (-0.21, 0.08, 0.001, -0.002, 0.03),
    (0.1, 0.2, 0.001, 0, 0.1, 0.3, 0.1, 0.02),
]


def project_distorted(camera: Camera, points: np.ndarray) -> np.ndarray:
    """World points (N, 3) -> pixel coordinates (N, 2) in the image as stored, distortion included."""
    rotation, _ = cv2.Rodrigues(np.asarray(camera.rotation, dtype=np.float64))
    coefficients = np.array(camera.distortion or (0.0,) * 4, dtype=np.float64)
    pixels, _ = cv2.projectPoints(
        np.asarray(points, dtype=np.float64).reshape(-1, 1, 3),
        rotation,
        np.asarray(camera.translation, dtype=np.float64),
        opencv_matrix(camera),
        coefficients,
    )
    return np.asarray(pixels.reshape(-1, 2) + 0.5, dtype=np.float64)


def make_camera(name: str, degrees: float, lens: tuple[float, ...] = ()) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("yxz", [degrees, 3.0, -1.0], degrees=True).as_matrix() @ np.diag([1.0, -1, -1])
    pose[:3, 3] = (0.4, -0.7, 72.0)
    return Camera(name, 340, 240, 701.25, 699.5, 171.3, 118.9, pose, lens)


def through_transforms(cameras: list[Camera], folder: Path) -> list[Camera]:
    shots = [Shot(camera.name, 0, folder / f"{camera.name}.png") for camera in cameras]
    write_transforms(folder / "transforms.json", [View.of(camera) for camera in cameras], shots, "cm")
    return [view.camera() for view in read_transforms(folder / "transforms.json").views]


def through_colmap(cameras: list[Camera], folder: Path) -> list[Camera]:
    write_colmap(folder, [(camera, f"{camera.name}/0000.png") for camera in cameras])
    return [image.view.camera() for image in read_colmap(folder)]


def through_stereo(cameras: list[Camera], folder: Path) -> list[Camera]:
    """The pair in the original world: stereo files keep relative poses only."""
    write_stereo(folder / "stereo.yml", *cameras)
    names, sizes = [c.name for c in cameras], [(c.width, c.height) for c in cameras]
    read = [view.camera() for view in read_stereo(folder / "stereo.yml", names, sizes)]
    gauge = np.linalg.inv(read[0].world_to_camera) @ cameras[0].world_to_camera
    return [
        Camera(c.name, c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.world_to_camera @ gauge, c.distortion) for c in read
    ]


ROUTES = {"transforms": through_transforms, "colmap": through_colmap, "stereo": through_stereo}


@pytest.mark.parametrize("lens", LENSES, ids=len)
@pytest.mark.parametrize("second", ROUTES)
@pytest.mark.parametrize("first", ROUTES)
def test_round_trips(tmp_path: Path, first: str, second: str, lens: tuple[float, ...]) -> None:
    cameras = [make_camera("left", -20.0, lens), make_camera("right", 20.0, lens)]
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    there = ROUTES[second](ROUTES[first](cameras, tmp_path / "a"), tmp_path / "b")
    for camera, back in zip(cameras, there, strict=True):
        assert (back.name, back.width, back.height) == (camera.name, 340, 240)
        expected = project_distorted(camera, POINTS)
        assert np.abs(project_distorted(back, POINTS) - expected).max() < 1e-3
        assert np.ptp(expected, axis=0).min() > 100  # the points do cover the image


def test_stereo_files_hold_opencv_pixels(tmp_path: Path) -> None:
    write_stereo(tmp_path / "s.yml", make_camera("a", -20.0), make_camera("b", 20.0))
    text = (tmp_path / "s.yml").read_text()
    assert "170.80" in text  # 171.3 with the first pixel's centre at 0.5 is 170.8 with it at 0
    left, _ = read_stereo(tmp_path / "s.yml", ("a", "b"), [(340, 240)] * 2)
    assert left.intrinsics == pytest.approx((701.25, 699.5, 171.3, 118.9))


@pytest.mark.parametrize("first_line", ["%YAML:1.0", "%YAML 1.0", "%YAML 1.1", "%YAML 1.2"])
def test_stereo_files_of_every_opencv_are_read(tmp_path: Path, first_line: str) -> None:
    """OpenCV 2 to 4 begin them with %YAML:1.0, OpenCV 5 with %YAML 1.2."""
    path = tmp_path / "s.yml"
    write_stereo(path, make_camera("a", -20.0), make_camera("b", 20.0))
    _, rest = path.read_text().split("\n", 1)
    path.write_text(f"{first_line}\n{rest}")
    left, _ = read_stereo(path, ("a", "b"), [(340, 240)] * 2)
    assert left.intrinsics == pytest.approx((701.25, 699.5, 171.3, 118.9))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("M2:", "X2:", r"expected M2 3 x 3"),
        ("rows: 3", "rows: 9", r"M1: found 9 values for 9 x 3 of type d"),
        ("701.25", "-701.25", r"M1: found focal lengths -701.25"),
        ("701.25", ".NaN", r"M1: found a NaN"),
        ("image_width: 340", "image_width: 640", r"calibrated for 640 x 240 pixels, but the images have 340 x 240"),
        ("%YAML", "garbage", r"not a readable OpenCV YAML"),
    ],
)
def test_bad_stereo_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "s.yml"
    write_stereo(path, make_camera("a", -20.0), make_camera("b", 20.0))
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        read_stereo(path, ("a", "b"), [(340, 240)] * 2)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("factor", "message"), [(0.0, "singular rotation"), (-1.0, "left-handed rotation")])
def test_bad_stereo_rotation(tmp_path: Path, factor: float, message: str) -> None:
    import cv2

    first = make_camera("a", -20.0)
    write_stereo(tmp_path / "s.yml", first, first)
    file = cv2.FileStorage(str(tmp_path / "s.yml"), cv2.FILE_STORAGE_APPEND)
    file.release()
    text = (tmp_path / "s.yml").read_text()
    rotation = text[text.index("R: !!") : text.index("T: !!")]
    data = rotation[rotation.index("[") : rotation.index("]") + 1]
    bad = np.diag([factor, 1.0, 1.0]).ravel().tolist()
    (tmp_path / "s.yml").write_text(text.replace(data, str(bad)))
    with pytest.raises(InputError, match=f"R: found a {message}"):
        read_stereo(tmp_path / "s.yml", ("a", "b"), [(340, 240)] * 2)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        (
            "cameras.txt",
            "1 FISHEYE 340 240 1 2 3 4",
            r"line 1: found camera model 'FISHEYE', expected one",
        ),
        ("cameras.txt", "1 PINHOLE 340 240 700 700 170", r"line 1: found 3 parameters, expected 4 of PINHOLE"),
        ("cameras.txt", "1 PINHOLE 340 240 -700 700 170 120", r"found focal length -700"),
        (
            "cameras.txt",
            "1 PINHOLE 340 240 nan 700 170 120",
            r"line 1: found '340 240 nan 700 170 120', expected 6 finite numbers",
        ),
        ("images.txt", "1 1 0 0 0 0 0 0 9 a.png\n\n", r"line 1: camera 9 is not in cameras.txt"),
        ("images.txt", "1 2 0 0 0 0 0 0 1 a.png\n\n", r"found a quaternion of length 2, expected 1"),
        ("images.txt", "1 1 0 0\n\n", r"line 1: found 4 fields"),
        ("images.txt", "1 1 0 0 x 0 0 0 1 a.png\n\n", r"line 1: found '1 0 0 x 0 0 0', expected 7 finite numbers"),
        ("images.txt", "", r"found no image"),
    ],
)
def test_bad_colmap_models(tmp_path: Path, file: str, text: str, message: str) -> None:
    write_colmap(tmp_path, [(make_camera("a", 0.0), "a.png")])
    (tmp_path / file).write_text(text)
    with pytest.raises(InputError, match=message):
        read_colmap(tmp_path)
    (tmp_path / file).unlink()
    with pytest.raises(InputError, match=r"no such file; expected a COLMAP text model"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("lens", LENSES[1:], ids=len)
def test_undistorted_points_project_like_a_pinhole(lens: tuple[float, ...]) -> None:
    camera = make_camera("a", 10.0, lens)
    np.testing.assert_allclose(
        undistort_points(camera, project_distorted(camera, POINTS)), camera.project(POINTS), atol=1e-3
    )


def test_undistorted_images_show_points_where_the_pinhole_puts_them() -> None:
    camera = make_camera("a", 10.0, LENSES[1])
    centre = camera.pixel_centres()
    image = np.zeros((240, 340), dtype=np.float32)
    points = POINTS[:12]
    for x, y in project_distorted(camera, points):
        image += np.exp(-0.5 * ((centre[..., 0] - x) ** 2 + (centre[..., 1] - y) ** 2) / 1.5**2).astype(np.float32)
    lens = undistortion(camera)
    straight = lens.apply(image)
    assert lens.valid.mean() > 0.9
    for x, y in camera.project(points):
        near = np.hypot(centre[..., 0] - x, centre[..., 1] - y) < 5
        weight = straight * near
        found = (centre * weight[..., None]).sum((0, 1)) / weight.sum()
        others = np.hypot(*(camera.project(points) - (x, y)).T)
        if np.sort(others)[1] > 12:
            assert np.hypot(*(found - (x, y))) < 0.1


def test_a_lens_polynomial_that_folds_over_is_invalid_there() -> None:
    camera = Camera("a", 200, 200, 100.0, 100.0, 100.0, 100.0, np.eye(4), (-0.6, 0.0, 0.0, 0.0))
    valid = undistortion(camera).valid
    assert valid[100, 100]
    assert valid[100, 150]
    assert not valid[2, 2]  # radius 1.4: the derivative 1 - 1.8 r^2 is negative from r = 0.75 on
    assert not valid[100, 190]


@pytest.mark.parametrize("fy", [700.0, 693.0, 490.0])
def test_a_rendered_point_lands_where_the_camera_projects_it(variant: str, fy: float) -> None:
    import mitsuba as mi

    from mifit.render.scene import make_sensor

    pose = make_camera("a", 12.0).world_to_camera
    camera = Camera("a", 340, 240, 700.0, fy, 240.3, 72.9, pose)  # the centre is off by 70 and 47 pixels
    for point in ((0.0, 0.0, 0.0), (-5.0, 2.0, 1.0), (-12.0, -8.0, 3.0)):
        ball = {"type": "sphere", "center": list(point), "radius": 0.25, "light": {"type": "area"}}
        scene = mi.load_dict({"type": "scene", "ball": ball})
        direct = mi.load_dict({"type": "direct"})
        image = np.array(mi.render(scene, sensor=make_sensor(camera), integrator=direct, spp=64))
        weight = image[..., 0].astype(np.float64)
        found = (camera.pixel_centres() * weight[..., None]).sum((0, 1)) / weight.sum()
        assert np.hypot(*(found - camera.project(np.array(point)))) < 0.05


def test_the_sensor_refuses_a_lens(variant: str) -> None:
    from mifit.render.scene import make_sensor

    with pytest.raises(InputError, match="lens distortion"):
        make_sensor(make_camera("a", 0.0, LENSES[1]))
