"""Calibration from a board: the cameras come back, and frames that would spoil them are left out by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.capture import import_capture
from mifit.capture.sources import ImageFiles
from mifit.capture.stereo import read_stereo
from mifit.cli import main
from mifit.core.image import encode_png
from mifit.errors import InputError
from mifit.extras.board_calibration import BoardCalibration, calibrate_boards, write_calibration
from mifit.extras.boards import Board
from tests.extras.board_video import Studio, pair, poses

CHARUCO = "charuco:9x6:30:22:DICT_5X5_250"


def write(folder: Path, images: list[np.ndarray]) -> ImageFiles:
    folder.mkdir(parents=True)
    for i, image in enumerate(images):
        (folder / f"{i:04d}.png").write_bytes(encode_png(image))
    return ImageFiles.folder(folder, folder.name)


@pytest.fixture(scope="module")
def charuco(tmp_path_factory: pytest.TempPathFactory) -> tuple[ImageFiles, ImageFiles]:
    """Two folders of 28 synchronous pictures of a ChArUco board."""
    folder, board = tmp_path_factory.mktemp("charuco"), Board.parse(CHARUCO)
    places, studios = poses(28, board, 470.0), [Studio(board, camera) for camera in pair()]
    a, b = (
        write(folder / studio.camera.name, [studio.render(p, 100 * k + i) for i, p in enumerate(places)])
        for k, studio in enumerate(studios)
    )
    return a, b


@pytest.fixture(scope="module")
def calibrated(charuco: tuple[ImageFiles, ImageFiles]) -> BoardCalibration:
    """The cameras that those pictures give."""
    return calibrate_boards(charuco, Board.parse(CHARUCO))


def check_cameras(found, tolerance: float = 0.002, degrees: float = 0.1, part: float = 0.005) -> None:
    """Intrinsics, relative pose and distortion (where it acts) against the truth."""
    for camera, truth in zip(found, pair(), strict=True):
        for key in ("fx", "fy", "cx", "cy"):
            limit = tolerance * (truth.fx if key in ("fx", "fy") else truth.width)
            assert abs(getattr(camera, key) - getattr(truth, key)) < limit, key
    a, b = found
    relative = b.world_to_camera @ np.linalg.inv(a.world_to_camera)
    truth = pair()[1].world_to_camera
    turn = Rotation.from_matrix(relative[:3, :3] @ truth[:3, :3].T).magnitude()
    shift = 10 * relative[:3, 3]  # millimetres
    assert np.degrees(turn) < degrees
    assert np.linalg.norm(shift - truth[:3, 3]) < part * np.linalg.norm(truth[:3, 3])


@pytest.mark.slow
def test_charuco_pictures_give_the_cameras(calibrated, tmp_path: Path) -> None:
    found = calibrated
    check_cameras(found.cameras)
    assert all(seen.error < 0.3 and len(seen.used) >= 15 for seen in found.watched)
    write_calibration(found, tmp_path, "cm")
    views = read_stereo(tmp_path / "stereo.yml", ["a", "b"], [(640, 480)] * 2)
    check_cameras([view.camera() for view in views])
    document = json.loads((tmp_path / "calibration.json").read_text())
    assert len(document["cameras"]["a"]["frames"]) == len(found.watched[0].used)
    assert document["cameras"]["a"]["coverage"] > 0.4


@pytest.mark.slow
def test_the_capture_calibration_is_taken_by_an_import(charuco, calibrated, tmp_path: Path) -> None:
    write_calibration(calibrated, tmp_path / "calibration", "cm")
    out = import_capture(
        tmp_path / "capture",
        images=[source.paths[0].parent for source in charuco],
        transforms=tmp_path / "calibration" / "transforms.json",
        count=1,
    )
    from mifit.capture import Capture

    capture = Capture.load(out)
    assert capture.calibrated and len(capture.timesteps) == 1
    check_cameras([capture.stored_camera(name) for name in ("a", "b")])


@pytest.mark.slow
def test_videos_by_the_command(charuco, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for source in charuco:
        writer = cv2.VideoWriter(
            str(tmp_path / f"{source.name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (640, 480)
        )
        writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
        for path in source.paths:
            writer.write(cv2.imread(str(path)))
        writer.release()
    videos = [word for name in "ab" for word in ("--video", str(tmp_path / f"{name}.avi"))]
    assert main(["calibrate", *videos, "--board", CHARUCO, "--out", str(tmp_path / "out")]) == 0
    assert "a: fx 8" in capsys.readouterr().out
    views = read_stereo(tmp_path / "out" / "stereo.yml", ["a", "b"], [(640, 480)] * 2)
    check_cameras([view.camera() for view in views])


@pytest.mark.slow
def test_spoilt_frames_are_left_out_by_name(charuco, tmp_path: Path) -> None:
    """Two each are blurred, mirrored, half covered and empty; the cameras come out nearly as without them."""
    board, (a, b) = Board.parse(CHARUCO), charuco
    spoilt = []
    for source in (a, b):
        images = [cv2.imread(str(p)) for p in source.paths]
        for i in (1, 9):
            images[i] = cv2.GaussianBlur(images[i], (0, 0), 3.0)
        for i in (4, 12):
            images[i] = images[i][:, ::-1]
        for i in (6, 14):
            found = board.find(cv2.cvtColor(images[i], cv2.COLOR_BGR2GRAY)).pixels
            images[i] = images[i].copy()
            images[i][:, : int(np.percentile(found[:, 0], 75))] = 90
        for i in (7, 15):
            images[i] = np.full_like(images[i], 90)
        spoilt.append(write(tmp_path / source.name, images))
    found = calibrate_boards(spoilt, board)
    check_cameras(found.cameras)
    for seen in found.watched:
        for frames, reason in (
            ((4, 12), "mirrored"),
            ((6, 14), "partly seen|no board"),
            ((7, 15), "no board found"),
            ((1, 9), "blurred|partly|no board"),
        ):
            for i in frames:
                assert any(seen.left_out[i].startswith(word) for word in reason.split("|")), (i, seen.left_out[i])


@pytest.mark.slow
def test_a_mirrored_camera_is_refused_by_name(charuco, tmp_path: Path) -> None:
    mirrored = write(tmp_path / "m", [cv2.imread(str(p))[:, ::-1] for p in charuco[0].paths[:10]])
    with pytest.raises(InputError, match=r"m: found 0 frames that can be used of 10 \(\d+ mirrored"):
        calibrate_boards([mirrored], Board.parse(CHARUCO))


@pytest.mark.slow
def test_blurred_pictures_are_refused_by_name(charuco, tmp_path: Path) -> None:
    sharp = [cv2.imread(str(p)) for p in charuco[0].paths[:10]]
    blurred = write(tmp_path / "m", [cv2.GaussianBlur(image, (0, 0), 6.0) for image in sharp])
    with pytest.raises(
        InputError, match=r"m: found \d frames that can be used of 10 .*(blurred|no board found|partly)"
    ):
        calibrate_boards([blurred], Board.parse(CHARUCO))


def test_boards_that_are_all_alike_are_refused_or_warned_of(tmp_path: Path) -> None:
    """Parallel to the image, a board tells nothing of the focal length."""
    board, (camera, _) = Board.parse(CHARUCO), pair()
    flat = []
    for i in range(8):
        pose = np.eye(4)
        pose[:3, 3] = (-135 + 6 * i, -90 + 3 * i, 600.0)
        flat.append(pose)
    studio = Studio(board, camera)
    source = write(tmp_path / "a", [studio.render(p, i) for i, p in enumerate(flat)])
    try:
        found = calibrate_boards([source], board)
    except InputError as error:
        assert "focal length known to" in str(error) or "allow no calibration" in str(error)
    else:
        assert any("focal length is known to" in text for text in found.warnings)


@pytest.mark.slow
def test_cameras_that_never_see_it_together(charuco, tmp_path: Path) -> None:
    a, b = charuco
    images = [cv2.imread(str(p)) for p in (*a.paths[:12], *b.paths[12:])]
    empty = np.full_like(images[0], 90)
    first = write(tmp_path / "a", [*images[:12], *[empty] * 16])
    second = write(tmp_path / "b", [*[empty] * 12, *images[12:]])
    with pytest.raises(InputError, match="b: sees the board together with a in 0 frames"):
        calibrate_boards([first, second], Board.parse(CHARUCO))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected charuco:"), ("charuco:9x6", "expected charuco:"), ("charuco:9:30:22", "expected charuco:"),
        ("charuco:9x6:22:30", "a marker smaller than its square"), ("charuco:99x99:30:22", "3 to 50 columns"),
        ("charuco:9x6:nan:22", "3 to 50 columns"), ("chessboard:10x7:25", "expected charuco:"),
        ("charuco:9x6:30:22:DICT_NONE", "found dictionary"), ("charuco:9x6:30:22:__class__", "found dictionary"),
        ("charuco:50x50:30:22:DICT_4X4_50", "needs more markers"), ("dots:3x3:1", "expected charuco:"),
    ],
)  # fmt: skip
def test_boards_that_are_none(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Board.parse(text)


def test_boards_are_printed_in_true_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image as Pillow

    assert main(["calibrate", "--board", CHARUCO, "--out", str(tmp_path)]) == 0
    with Pillow.open(tmp_path / "board.png") as page:
        assert page.info["dpi"][0] == pytest.approx(300, abs=0.1)
        assert page.size[0] / 300 * 25.4 == pytest.approx(9 * 30 + 20, abs=0.2)
        grey = np.asarray(page)
    assert len(Board.parse(CHARUCO).find(cv2.resize(grey, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA))) == 40
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    assert "100 per cent" in capsys.readouterr().out


@pytest.mark.slow
def test_frames_of_one_camera_only_are_not_mixed_up(charuco) -> None:
    one = calibrate_boards(charuco[:1], Board.parse(CHARUCO))
    assert len(one.cameras) == 1 and abs(one.cameras[0].fx - pair()[0].fx) < 0.002 * pair()[0].fx
    twin = replace(charuco[1], name="a")
    with pytest.raises(InputError, match="cameras of one name"):
        calibrate_boards([charuco[0], twin], Board.parse(CHARUCO))
