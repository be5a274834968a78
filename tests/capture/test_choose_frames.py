"""The most informative frames: spread in pose, sharp, eyes open, views that agree."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from mifit.capture.capture import Frame
from mifit.capture.choose_frames import choose_frames
from mifit.core.camera import Camera
from mifit.errors import InputError

STEPS = 12
SIDE = 200


def view(name, angle):
    turn = Rotation.from_euler("y", angle, degrees=True).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn.T
    matrix[:3, 3] = [0.0, 0.0, 40.0]
    return Camera(name, SIDE, SIDE, 400.0, 400.0, SIDE / 2, SIDE / 2, matrix)


class Head:
    """68 points that turn, seen by two cameras, as a stand-in for a Capture."""

    calibrated, path = True, "head"

    def __init__(self, yaw, seed=0):
        rng = np.random.default_rng(seed)
        self.points = rng.uniform(-5.0, 5.0, (68, 3)) * [1.0, 1.0, 0.7]
        for eye, x in ((36, -3.0), (42, 3.0)):
            for k, (dx, dy) in enumerate(((-1, 0), (-0.4, 0.4), (0.4, 0.4), (1, 0), (0.4, -0.4), (-0.4, -0.4))):
                self.points[eye + k] = (x + dx, 2.0 + dy, 3.0)
        self.yaw = yaw
        self.timesteps = tuple(range(len(yaw)))
        self.cameras = ("left", "right")
        texture = rng.uniform(0.1, 0.9, (SIDE, SIDE, 1)).repeat(3, axis=2)
        self.images = {(c, t): texture for c in self.cameras for t in self.timesteps}
        self.closed, self.lost, self.read = set(), set(), set()

    def camera(self, name):
        return view(name, -20.0 if name == "left" else 20.0)

    def landmarks(self, name, timestep):
        if timestep in self.lost:
            return None
        yaw = np.interp(timestep, self.timesteps, self.yaw)
        points = self.points.copy()
        if timestep in self.closed:
            for eye in (36, 42):
                points[eye : eye + 6, 1] = points[eye, 1]
        turn = Rotation.from_euler("yx", [yaw, 0.5 * yaw], degrees=True).as_matrix()
        shift = [0.0, 0.08 * timestep, 0.0]
        return SimpleNamespace(points=self.camera(name).project(points @ turn.T + shift), visible=np.ones(68, bool))

    def frame(self, name, timestep):
        self.read.add(name)
        shape = (SIDE, SIDE)
        return Frame(self.images[name, timestep].astype(np.float32), np.ones(shape, bool), np.zeros(shape, bool), None,
                     np.zeros(68, bool))  # fmt: skip


def swing():
    return 20.0 * np.sin(np.arange(STEPS) * 2.0 * np.pi / STEPS)


def test_the_ends_and_the_middle_of_a_turn_are_chosen():
    head = Head(np.linspace(-30.0, 30.0, STEPS))
    found = choose_frames(head, head.cameras, 3)
    assert {0, STEPS - 1} < set(found.timesteps) and len(found.timesteps) == 3
    assert found.why.keys() == set(found.timesteps) and not found.left_out
    (middle,) = set(found.timesteps) - {0, STEPS - 1}
    assert middle in (5, 6) and found.why[middle].startswith("nearest to the middle")


def test_frames_that_tell_little_are_left_out_with_a_reason():
    head = Head(swing())
    head.images["right", 3] = gaussian_filter(head.images["right", 3], (3, 3, 0))
    head.closed, head.lost = {9}, {6}
    found = choose_frames(head, head.cameras, STEPS)
    assert set(found.timesteps) == set(range(STEPS)) - {3, 6, 9}
    assert found.left_out[3].startswith("blurred") and found.left_out[9].startswith("eyes closed")
    assert found.left_out[6] == "no landmarks"
    assert found.document()["left_out"]["6"] == "no landmarks"


def test_views_that_disagree_are_left_out():
    head = Head(swing())
    real = head.landmarks

    def landmarks(name, timestep):
        found = real(name, timestep)
        if (name, timestep) == ("right", 4):
            found.points += [0.0, 6.0]
        return found

    head.landmarks = landmarks
    found = choose_frames(head, head.cameras, STEPS)
    assert list(found.left_out) == [4] and "views disagree" in found.left_out[4]


def test_only_named_cameras_are_read():
    head = Head(swing())
    choose_frames(head, ("left",), 2)
    assert head.read == {"left"}


def test_nothing_to_choose_by_is_refused():
    head = Head(swing())
    head.lost = set(range(STEPS))
    with pytest.raises(InputError, match="no timestep has landmarks"):
        choose_frames(head, head.cameras, 2)
    with pytest.raises(InputError, match="no camera"):
        choose_frames(head, (), 2)


def test_further_frames_lie_far_from_those_taken_and_come_from_those_named():
    head = Head(np.linspace(-30.0, 30.0, STEPS))
    found = choose_frames(head, head.cameras, 2, timesteps=range(1, STEPS - 2), beside=(0, 1))
    assert set(found.timesteps) == {5, STEPS - 3} and found.why.keys() == set(found.timesteps)
    every = choose_frames(head, head.cameras, STEPS, beside=(0, 1))
    assert set(every.timesteps) == set(range(2, STEPS))
