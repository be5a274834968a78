"""Stage 1's terms on a small synthetic head in float64: analytic Jacobians against finite differences, and more."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from mifit.core.camera import Camera
from mifit.core.mesh import normalize
from mifit.core.sh import basis
from mifit.stages.geometry.appearance import AppearanceProblem, fit_appearance
from mifit.stages.geometry.images import PixelView, SmoothImage
from mifit.stages.geometry.initial import align, best_pose, triangulate
from mifit.stages.geometry.landmarks import LandmarkProblem, LandmarkTerm, LandmarkView
from mifit.stages.geometry.parameters import Frames, Layout, exponential, left_jacobian
from mifit.stages.geometry.points import PointBasis
from mifit.stages.geometry.rendering import RenderingProblem
from tests.stages.memory_capture import rotation_angle


def head(rng, n=9, identity=4, expression=3, albedo=2):
    """A bumpy cap towards +z with random smooth modes; arrays are float64, which MorphableModel wouldn't keep."""
    v, u = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n), indexing="ij")
    mean = np.stack([7 * u, 9 * v, 8 - 4 * u**2 - 3 * v**2 + 0.5 * np.sin(4 * u) * np.cos(3 * v)], -1).reshape(-1, 3)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])

    def modes(count, size):
        wave = rng.normal(size=(count, 2)) * 2
        phase = rng.uniform(0, 6, (count, 3))
        uv = np.stack([u.ravel(), v.ravel()], 1) @ wave.T
        return size * np.sin(uv[:, None, :] + phase.T[None])

    return SimpleNamespace(
        mean=mean,
        faces=faces,
        identity=modes(identity, 0.4),
        expression=modes(expression, 0.3),
        mean_albedo=np.full((n * n, 3), 0.4) + 0.1 * np.sin(mean / 3),
        albedo_modes=modes(albedo, 0.05),
    )


def camera(name, degrees, size=96):
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    rotation = np.diag([1.0, -1.0, -1.0]) @ rotation
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ (rotation.T @ np.array([0, 0, -70.0]))
    return Camera(name, size, size, 3.2 * size, 3.2 * size, size / 2, size / 2, pose)


def smooth_image(rng, size=96, channels=3):
    raw = rng.uniform(0.1, 0.6, (size, size, channels))
    return SmoothImage(cv2.GaussianBlur(raw, (0, 0), 4.0), np.ones((size, size)))


def random_points(rng, model, count):
    weights = rng.dirichlet(np.ones(3), count)
    return rng.integers(0, len(model.faces), count), weights


def basis_on(model, face, weights):
    """PointBasis in float64 (the stage's own is float32)."""
    corners = model.faces[face]

    def at(values):
        return np.einsum("nk,nkc...->nc...", weights, values[corners]).reshape(3 * len(face), *values.shape[2:])

    return PointBasis(at(model.mean), at(model.identity), at(model.expression))


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    model = head(rng)
    layout = Layout(2, 4, 3, albedo=2, shading=27, ambient=1, log_scale=1)
    rotation = np.stack([exponential(rng.normal(size=3) * 0.1) for _ in range(2)])
    x = 0.3 * rng.normal(size=layout.size)
    for k in range(2):
        x[layout.at("rotation", k)] *= 0.3
        x[layout.at("translation", k)] = rng.normal(size=3) * 0.5
    x[layout.at("log_scale")] = 0.02
    x[layout.at("ambient")] = 0.03
    x[layout.at("shading").start] = 3.0
    cameras = [camera("left", -20), camera("right", 20)]
    return SimpleNamespace(rng=rng, model=model, layout=layout, frames=Frames(rotation, 1.0), x=x, cameras=cameras)


def landmark_views(scene, count=12):
    views = []
    for step in range(2):
        for cam in scene.cameras:
            vertices = scene.rng.choice(len(scene.model.mean), count, replace=False)
            face = np.array([np.flatnonzero(scene.model.faces == v)[0] for v in vertices])
            corner = np.argmax(scene.model.faces[face // 3] == vertices[:, None], axis=1)
            at_vertices = basis_on(scene.model, face // 3, np.eye(3)[corner])
            pixels = scene.rng.uniform(30, 66, (count, 2))
            views.append(LandmarkView(step, cam, np.arange(count), vertices, pixels, 0.7, at_vertices))
    return tuple(views)


def check_gradient(problem, x, tolerance, step=1e-6, columns=None):
    """The system's gradient against central differences of the energy, relative to the largest entry."""
    gradient = 2.0 * problem.linearize(x).gradient
    columns = range(len(x)) if columns is None else columns
    numeric = np.zeros(len(x))
    for i in columns:
        d = np.zeros(len(x))
        d[i] = step
        numeric[i] = (sum(problem.energies(x + d).values()) - sum(problem.energies(x - d).values())) / (2 * step)
    columns = np.array(list(columns))
    assert np.abs(numeric[columns]).min() > 0
    np.testing.assert_allclose(
        gradient[columns], numeric[columns], rtol=tolerance, atol=tolerance * np.abs(numeric).max() * 1e-2
    )


def test_left_jacobian_moves_the_rotation():
    rng = np.random.default_rng(5)
    for scale in (1e-7, 0.3, 2.0):
        v, d = scale * rng.normal(size=3), 1e-6 * rng.normal(size=3)
        np.testing.assert_allclose(exponential(v + d), exponential(left_jacobian(v) @ d) @ exponential(v), atol=1e-11)


def test_spline_gradient_is_exact_and_reproduces_a_ramp():
    rng = np.random.default_rng(1)
    y, x = np.mgrid[0:20, 0:30] + 0.5
    ramp = SmoothImage(np.stack([x, y, x + 2 * y], -1), np.ones((20, 30)))
    pixels = rng.uniform(3, 17, (50, 2))
    values, slope, inside = ramp.sample(pixels)
    assert inside.all()
    np.testing.assert_allclose(values[:, 0], pixels[:, 0], atol=1e-12)  # pixel centres at half-integers
    np.testing.assert_allclose(values[:, 1], pixels[:, 1], atol=1e-12)
    np.testing.assert_allclose(slope[:, 2], np.tile([1.0, 2.0], (50, 1)), atol=1e-12)
    image = SmoothImage(rng.random((20, 30, 2)), np.ones((20, 30)))
    _, slope, _ = image.sample(pixels)
    for axis in range(2):
        d = np.zeros(2)
        d[axis] = 1e-6
        numeric = (image.sample(pixels + d)[0] - image.sample(pixels - d)[0]) / 2e-6
        np.testing.assert_allclose(slope[:, :, axis], numeric, rtol=1e-6, atol=1e-7)


def test_samples_at_the_border_or_on_invalid_pixels_are_refused():
    valid = np.ones((20, 30))
    valid[10, 12] = 0
    image = SmoothImage(np.ones((20, 30, 1)), valid)
    pixels = np.array([[15.0, 5.0], [0.6, 5.0], [29.5, 5.0], [-5.0, 3.0], [np.nan, 2.0], [12.5, 10.5], [40.0, 50.0]])
    assert image.sample(pixels)[2].tolist() == [True, False, False, False, False, False, False]


def test_landmark_jacobian(scene):
    layout = replace(scene.layout, albedo=0, shading=0, ambient=0)
    x = np.concatenate([scene.x[scene.layout.at("identity")], scene.x[scene.layout.at("log_scale")]])
    x = np.concatenate([x, *(scene.x[scene.layout.local(k)] for k in range(2))])
    problem = LandmarkProblem(
        layout,
        scene.frames,
        LandmarkTerm(landmark_views(scene), 30.0),
        {"identity": 0.5, "expression": 0.8, "log_scale": 2.0},
    )
    check_gradient(problem, x, 1e-6)


def test_rendering_jacobian(scene):
    """Projection through the image's gradient, normals through the one-ring, albedo, lighting, ambient, pose, scale."""
    views = []
    for step in range(2):
        for cam in scene.cameras:
            face, weights = random_points(scene.rng, scene.model, 60)
            views.append(PixelView(step, cam, smooth_image(scene.rng), face, weights))
    priors = {"identity": 0.3, "albedo": 0.2, "expression": 0.4, "ambient": 10.0}
    problem = RenderingProblem(
        scene.model, scene.layout, scene.frames, tuple(views), LandmarkTerm(landmark_views(scene), 50.0), priors
    )
    check_gradient(problem, scene.x, 1e-4)


def test_rendering_normals_matter(scene):
    """With a constant image the data term reaches the shape only through the normals; its gradient must not vanish."""
    face, weights = random_points(scene.rng, scene.model, 60)
    flat = SmoothImage(np.full((96, 96, 3), 0.3), np.ones((96, 96)))
    view = PixelView(0, scene.cameras[0], flat, face, weights)
    problem = RenderingProblem(
        scene.model, scene.layout, scene.frames, (view,), LandmarkTerm((), np.inf), {"ambient": 1.0}
    )
    shape = [*range(*scene.layout.at("identity").indices(99)), *range(*scene.layout.at("expression", 0).indices(99))]
    check_gradient(problem, scene.x, 1e-4, columns=shape)


def test_appearance_recovers_albedo_and_lighting():
    rng = np.random.default_rng(3)
    n, modes = 2000, rng.normal(size=(2000, 3, 5)).astype(np.float32) * 0.05
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    harmonics = basis(normals, 3).astype(np.float32)
    shading = 0.3 * rng.normal(size=(9, 3))
    shading[0] = 3.0
    albedo, mean = rng.normal(size=5), rng.uniform(0.2, 0.6, (n, 3)).astype(np.float32)
    observed = ((mean + modes @ albedo) * (harmonics @ shading) + 0.02).astype(np.float32)
    observed[:100] = 1.0  # a highlight
    untold = np.zeros((3, 5))
    problem = AppearanceProblem(mean, modes, harmonics, observed, np.full(n, 1.0 / n), 30.0, untold)
    solution = fit_appearance(problem, 50)
    assert solution.usable
    np.testing.assert_allclose(solution.value[:5], albedo, atol=0.02)
    np.testing.assert_allclose(solution.value[5:-1].reshape(9, 3), shading, atol=0.02)
    np.testing.assert_allclose(solution.value[-1], 0.02, atol=0.005)


@pytest.mark.parametrize("tint", [(1.0, 1.0, 1.0), (0.1, 0.1, 0.1), (1.0, 0.4, 0.05)], ids=["white", "dark", "orange"])
def test_the_level_of_the_albedo_is_held_whatever_the_light(tint):
    """A mode that darkens the whole face makes the contrasts of all others cheap, and the images show a lot of them."""
    rng = np.random.default_rng(4)
    n, whole = 2000, np.array([0.45, 0.27, 0.2])
    painted = rng.normal(size=(n, 6))
    painted -= painted.mean(axis=0)
    mean = np.tile(whole, (n, 1)).astype(np.float32)
    relative = np.concatenate([np.full((n, 1), 0.3), 0.02 * painted], axis=1)
    modes = (whole[:, None] * relative[:, None]).astype(np.float32)
    normals = normalize(rng.normal(size=(n, 3)))
    harmonics = basis(normals, 3).astype(np.float32)
    shading = np.zeros((9, 3))
    shading[0] = 3.0 * np.array(tint)
    paint = np.array([0.0, 4.0, -4.0, 3.0, -5.0, 4.0, -3.0])
    observed = ((mean + modes @ paint) * (harmonics @ shading)).astype(np.float32)
    level = modes.mean(axis=0) / whole[:, None]

    def levels(problem: AppearanceProblem) -> np.ndarray:
        solution = fit_appearance(problem, 50)
        assert solution.usable
        return (mean + modes @ solution.value[:7]).mean(axis=0) / whole

    weight = np.full(n, 1.0 / n)
    held = AppearanceProblem(mean, modes, harmonics, observed, weight, 30.0, level)
    np.testing.assert_allclose(levels(held), 1.0, atol=2e-3)
    assert (levels(replace(held, level=np.zeros_like(level))) < 0.95).all()  # what it is held against


def test_triangulation_and_pose_are_exact_without_noise():
    rng = np.random.default_rng(6)
    points = rng.normal(size=(30, 3)) * [7, 9, 4]
    rotation, translation = exponential(np.array([0.2, -0.7, 0.1])), np.array([1.0, 2.0, -3.0])
    world = 0.1 * (10 * points) @ rotation.T + translation
    cameras = [camera("left", -20, 480), camera("right", 20, 480)]
    pixels = [cam.project(world) for cam in cameras]
    pixels[0][:5] = np.nan
    found = triangulate(cameras, pixels)
    assert np.isnan(found[:5]).all()
    np.testing.assert_allclose(found[5:], world[5:], atol=1e-8)
    r, t = align(10 * points[5:], found[5:], 0.1)
    np.testing.assert_allclose(r, rotation, atol=1e-9)
    np.testing.assert_allclose(t, translation, atol=1e-8)
    for cams, pix in ((cameras, pixels), (cameras[1:], pixels[1:])):
        best = best_pose(cams, 10 * points, pix, 0.1, 50.0)
        assert rotation_angle(best[0], rotation) < 1e-3 and np.abs(best[1] - translation).max() < 1e-3
