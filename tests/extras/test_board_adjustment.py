"""Cameras and boards together: what few views in the middle of an image don't tell, and cameras out of step."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from mifit.extras.board_calibration import _together, adjust
from mifit.extras.board_camera import Watched
from mifit.extras.boards import Board, BoardPoints
from tests.extras.board_video import opencv_matrix, pair, poses

BOARD = Board.parse("charuco:10x7:25:18")
NOISE = 0.25


@dataclass(frozen=True)
class Seen:
    """What two cameras see of a board that stays in the middle of their images."""

    watched: list[Watched]
    poses: list[np.ndarray]


@pytest.fixture
def seen() -> Seen:
    rng = np.random.default_rng(3)
    watched, far = [], 900.0
    for camera in pair():
        used = {}
        for i, pose in enumerate(poses(14, BOARD, far, seed=5)):
            pose = pose.copy()
            pose[:2, 3] *= 0.3
            to_camera = camera.world_to_camera @ pose
            at, _ = cv2.projectPoints(
                BOARD.points,
                cv2.Rodrigues(to_camera[:3, :3])[0],
                to_camera[:3, 3],
                opencv_matrix(camera),
                np.array(camera.distortion),
            )
            used[i] = BoardPoints(
                np.arange(len(BOARD.points)), at[:, 0] + 0.5 + NOISE * rng.standard_normal((len(at), 2))
            )
        objects = [BOARD.points.astype(np.float32)] * len(used)
        images = [(found.pixels - 0.5).astype(np.float32) for found in used.values()]
        _, matrix, lens, *_ = cv2.calibrateCamera(objects, images, (camera.width, camera.height), None, None)
        errors = dict.fromkeys(used, NOISE * np.sqrt(2.0))
        size = camera.width, camera.height
        watched.append(Watched(camera.name, size, matrix, tuple(lens.ravel()[:5]), 0.0, used, errors, {}))
    return Seen(watched, [np.eye(4), pair()[1].world_to_camera])


def test_a_lens_stays_plain_where_the_board_was_not_seen(seen: Seen) -> None:
    watched = seen.watched
    assert max(abs(w.distortion[4]) for w in watched) > 1.0  # what it is when nothing holds it
    found, _ = adjust(watched, seen.poses, BOARD)
    corner = np.array([[[0.0, 0.0]], [[639.0, 479.0]], [[0.0, 479.0]]])

    def off(matrix: np.ndarray, lens: tuple[float, ...], camera) -> float:
        """Pixels by which a corner of the image looks elsewhere than it does."""
        rays = cv2.undistortPoints(corner, opencv_matrix(camera), np.array(camera.distortion))[:, 0]
        points = np.column_stack([rays, np.ones(len(rays))])
        seen_at = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(lens))[0] - corner
        return float(np.linalg.norm(seen_at, axis=-1).max())

    before = [off(w.matrix, w.distortion, c) for w, c in zip(watched, pair(), strict=True)]
    after = [off(w.matrix, w.distortion, c) for w, c in zip(found, pair(), strict=True)]
    assert max(after) < 0.5 * max(before)
    assert max(abs(lens[4]) for lens in (w.distortion for w in found)) < 0.5


def test_frames_in_which_the_cameras_are_out_of_step_are_left_out_by_name(seen: Seen) -> None:
    watched = seen.watched
    late = {
        i: BoardPoints(p.ids, p.pixels + np.array([6.0, 2.0])) if i in (4, 9) else p for i, p in watched[1].used.items()
    }
    watched[1] = Watched(**{**vars(watched[1]), "used": late})
    _, every = adjust(watched, seen.poses, BOARD)
    found, relative = _together(watched, seen.poses, BOARD)
    out = [reason for w in found for i, reason in w.left_out.items() if i in (4, 9)]
    assert len(out) >= 2 and all("contradicts the others" in reason for reason in out)
    assert all(i in (4, 9) for w in found for i in w.left_out)
    assert max(w.error for w in found) < 2.0 * NOISE
    truth = pair()[1].world_to_camera[:3, :3]
    turns = [np.degrees(np.arccos(0.5 * (np.trace(p[1][:3, :3] @ truth.T) - 1.0))) for p in (every, relative)]
    assert turns[1] < 0.5 * turns[0] and turns[1] < 0.4, turns
