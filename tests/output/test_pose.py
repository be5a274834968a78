"""A moment that was not fitted: the head placed by landmarks alone, and judged there."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mifit.core.image import to_8_bit
from mifit.errors import InputError
from mifit.output.evaluate import compare, evaluate, held_out
from mifit.output.placement import pose_head
from mifit.render.image_based import image_based
from tests.output.conftest import ball_camera
from tests.output.test_render_evaluate import FakeCapture

ONE = ball_camera("left", 0)
TURN, SHIFT = Rotation.from_euler("yx", (-14, 5), degrees=True).as_matrix(), np.array([-0.6, 0.4, 1.0])
LATER = 7


@pytest.fixture(scope="module")
def later(ball):
    """What one fixed camera saw: the ball at its fitted poses, and as at timestep 3 in a third one."""
    still = replace(ball, cameras=(ONE,), residual=None)
    g = ball.geometry
    head = (g.vertices[1] - g.translation[1]) @ g.rotation[1]
    geometry = replace(
        g.at((3,)), timesteps=(LATER,), rotation=TURN[None], translation=SHIFT[None],
        vertices=(head @ TURN.T + SHIFT)[None].astype(np.float32),
    )  # fmt: skip
    normals = replace(ball.normals, timesteps=(LATER,), normal_object=ball.normals.normal_object[1:])
    return still, replace(still, geometry=geometry, normals=normals, mesh=None)


@dataclass(frozen=True)
class Turning(FakeCapture):
    """A fixed camera's photographs and landmarks of a head that turns."""

    timesteps: tuple = (0, 3, LATER)
    marks: dict = field(default_factory=dict)

    def landmarks(self, name, timestep):
        return self.marks.get(timestep)


def turning(fitted, moved, noise=0.0, visible=68):
    """The capture: renders of the fits as its photographs."""
    shown = {0: fitted, 3: fitted, LATER: moved}
    images = {t: np.ascontiguousarray(r.render(ONE, t)[..., :3]) for t, r in shown.items()}
    points = ONE.project(moved.geometry.vertices[0][moved.model.landmarks].astype(float))
    points += noise * np.random.default_rng(0).standard_normal(points.shape)
    marks = {LATER: SimpleNamespace(points=points, visible=np.arange(68) < visible)}
    return Turning((ONE,), lambda camera, t: images[t], marks=marks)


def test_landmarks_place_the_head_of_the_nearest_expression(later, variant):
    fitted, moved = later
    placed, off = pose_head(fitted, turning(fitted, moved), LATER)
    assert off < 1e-3 and placed.timesteps == (LATER,) and placed.mesh is None
    assert np.abs(placed.geometry.vertices - moved.geometry.vertices).max() < 1e-3
    np.testing.assert_array_equal(placed.geometry.expression, fitted.geometry.expression[1:])
    np.testing.assert_array_equal(placed.normals.normal_object, fitted.normals.normal_object[1:])


def test_noise_of_landmarks_moves_the_head_little(later, variant):
    fitted, moved = later
    placed, off = pose_head(fitted, turning(fitted, moved, noise=0.3), LATER)
    assert 0.2 < off < 0.8
    turned = Rotation.from_matrix(placed.geometry.rotation[0] @ TURN.T).magnitude()
    assert np.degrees(turned) < 1.0


def test_a_moment_that_was_not_fitted_is_judged_as_it_would_be_with_its_pose(later, variant):
    fitted, moved = later
    capture = turning(fitted, moved)
    found = evaluate(fitted, capture, "left", timesteps=[LATER], baseline=True)
    assert found["posed"][str(LATER)]["landmark_pixels"] < 1e-3
    assert found["methods"]["full"]["psnr"] > 50  # photographs are renders
    assert held_out(fitted, found)
    known = evaluate(fitted, capture, "left", timesteps=[0])
    assert "posed" not in known and not held_out(fitted, known)
    # The images show light that stays while the head turns, which image-based rendering takes along.
    assert found["baseline"]["methods"]["image_based"]["psnr"] < 40
    json_safe = [type(v) for v in found["posed"][str(LATER)].values()]
    assert json_safe == [float]


def test_image_based_rendering_takes_all_fitted_moments_where_the_mesh_was_then(later, variant):
    """A pattern that is fixed to the surface comes out where the surface has gone."""
    fitted, moved = later
    painted = {}
    model = fitted.model
    for result in (fitted, moved):
        plain = replace(result, normals=None)
        for t in result.timesteps:
            flat = replace(plain.geometry, shading=np.eye(9, 3)[:, :1] * np.ones(3) * np.sqrt(4 * np.pi), ambient=0.0)
            painted[t] = np.ascontiguousarray(replace(plain, geometry=flat).render(ONE, t, "pca")[..., :3])
    capture = Turning((ONE,), lambda camera, t: painted[t], marks=turning(fitted, moved).marks)
    moments = dict(zip(fitted.timesteps, fitted.geometry.vertices, strict=True))
    there = moved.geometry.vertices[0]
    base = image_based(capture, (ONE,), ONE, LATER, there, model.faces, moments=moments)
    inside = compare(fitted, capture, "left", LATER).region & base.seen
    assert inside.sum() > 200

    def off(image):
        return float(np.abs(to_8_bit(image).astype(float) - to_8_bit(painted[LATER]))[inside].mean())

    stuck = image_based(capture, (ONE,), ONE, 0, fitted.geometry.vertices[0], model.faces)
    assert off(base.colour) < 4 < 0.5 * off(stuck.colour)


def test_too_few_landmarks_are_refused(later, variant):
    fitted, moved = later
    with pytest.raises(InputError, match="timestep 7 was not fitted, and no fitted camera has 6 visible landmarks"):
        evaluate(fitted, turning(fitted, moved, visible=5), "left", timesteps=[LATER])
    with pytest.raises(InputError, match="timestep 9 is not in the capture; it has 0, 3, 7"):
        evaluate(fitted, turning(fitted, moved), "left", timesteps=[9])
