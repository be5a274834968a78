"""A subject's head: shape outside the model's span, expressions and motion over time, eyeballs, split meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mifit.capture.landmark_files import COUNT, Landmarks
from mifit.core.camera import Camera
from mifit.core.mesh import SplitMesh, vertex_normals
from mifit.morphable import MorphableModel
from mifit.morphable.openings import RADIUS_MM
from mifit.render.gbuffer import SurfaceScene
from mifit.synth.procedural import smooth_noise

IRIS_COLOURS = np.array([[0.10, 0.045, 0.02], [0.16, 0.10, 0.04], [0.14, 0.20, 0.28], [0.12, 0.18, 0.12]])
"""Brown, hazel, blue, green; linear."""


@dataclass(frozen=True)
class HeadPose:
    """Head pose and expression at one timestep: world = scale * rotation @ object + translation."""

    expression: NDArray[np.float32]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]


OUTSIDE = 0.5
"""Millimetres by which a subject's surface leaves the model's span by default."""


def neutral_shape(model: MorphableModel, seed: int, outside: float = OUTSIDE) -> NDArray[np.float64]:
    """(V, 3) vertices of a subject without expression, object space.

    Identity coefficients are drawn from the model's prior at 0.7 standard deviations, then every vertex moves
    along its normal by smooth noise of ``outside`` millimetres, most of which no mode of the model spans.
    """
    rng = np.random.default_rng([seed, 11])
    identity = 0.7 * np.clip(rng.standard_normal(model.n_identity), -2.0, 2.0)
    shape = np.asarray(model.shape(identity), dtype=np.float64)
    noise = smooth_noise(model.mean * model.unit_mm, 28.0, rng, octaves=2)
    return shape + (outside / model.unit_mm) * noise[:, None] * vertex_normals(shape, model.faces)


def draw_motion(model: MorphableModel, timesteps: int, seed: int, scale: float, centre: NDArray) -> list[HeadPose]:
    """A pose and an expression per timestep, which differ as widely as in photographs; the first one is neutral.

    ``scale`` is in world units per model unit; ``centre`` (3,) the object-space point that the head turns about and
    that stays near the world's origin.
    """
    rng = np.random.default_rng([seed, 12])
    phase, speed = rng.uniform(0, 2 * np.pi, 6), rng.uniform(0.5, 1.1, 6)
    swing = np.array([9.0, 5.0, 3.0, 0.8, 0.5, 0.5])  # degrees of yaw, pitch, roll; centimetres
    bounds = np.asarray(model.expression_bounds, dtype=np.float64)
    free = np.isinf(bounds).max(axis=1)
    active = rng.permutation(model.n_expression)[:6]
    strength = np.where(free[active], rng.uniform(-0.9, 0.9, len(active)), rng.uniform(0.15, 0.55, len(active)))
    seconds = np.arange(timesteps)
    expression = np.zeros((timesteps, model.n_expression))
    wave = 0.5 - 0.5 * np.cos(0.9 * seconds[:, None] + np.arange(len(active)))
    expression[1:, active] = (strength * wave)[1:]  # the first timestep is neutral
    swing = swing * np.sin(phase + speed * seconds[:, None])
    rotations = Rotation.from_euler("yxz", swing[:, :3], degrees=True).as_matrix()
    return [
        HeadPose(weights.astype(np.float32), rotation, shift - scale * rotation @ centre)
        for weights, rotation, shift in zip(np.clip(expression, *bounds.T), rotations, swing[:, 3:], strict=True)
    ]


def wrap_uv(uv: NDArray, faces_uv: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Move every face by whole tiles so that its centre lies in the unit square -> (uv, faces_uv), unshared."""
    corners = uv[faces_uv]
    corners = corners - np.floor(corners.mean(axis=1, keepdims=True))
    return corners.reshape(-1, 2).astype(np.float32), np.arange(corners.size // 2, dtype=np.int32).reshape(-1, 3)


def split_eyeball(model: MorphableModel, chosen: NDArray[np.bool_]) -> SplitMesh:
    """The mesh of an eyeball with the UVs of `sphere`, found from directions about its centre."""
    source, faces = np.unique(model.faces[chosen], return_inverse=True)
    points = model.mean[source].astype(np.float64)
    # least squares sphere: |p|^2 = 2 p.c + (r^2 - |c|^2)
    system = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    centre = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0][:3]
    x, y, z = (points - centre).T
    uv = np.stack([np.arctan2(y, x) / (2 * np.pi) % 1.0, 1 - np.arctan2(np.hypot(x, y), z) / np.pi], axis=1)
    return SplitMesh(source.astype(np.int64), uv.astype(np.float32), faces.reshape(-1, 3).astype(np.int32))


def eye_centre(opening_mm: NDArray) -> NDArray[np.float64]:
    """Centre of an eyeball behind an opening (N, 3), millimetres: as far forward as the lids allow."""
    middle = opening_mm.mean(axis=0)
    across = np.linalg.norm(opening_mm[:, :2] - middle[:2], axis=1)
    depth = opening_mm[:, 2] - np.sqrt(np.maximum(RADIUS_MM**2 - across**2, 0.0))
    return np.array([middle[0], middle[1], depth.min()])


def paint_eye(seed: int, size: int = 256) -> NDArray[np.float32]:
    """Sclera, iris and pupil of an eye that looks along +z, for the UVs of `sphere`."""
    rng = np.random.default_rng([seed, 13])
    angle = np.degrees((np.arange(size) + 0.5) * np.pi / size)[:, None]  # from the pupil's centre
    streaks = 1.0 + 0.2 * rng.standard_normal((1, size))
    iris = rng.choice(IRIS_COLOURS) * rng.uniform(0.8, 1.25)
    image = np.broadcast_to(np.array([0.62, 0.56, 0.52]), (size, size, 3)).copy()
    image = np.where((angle < 29.0)[..., None], np.clip(iris * streaks[..., None], 0.01, 0.6), image)
    image = np.where((angle < 12.0)[..., None], 0.005, image)
    return np.broadcast_to(image, (size, size, 3)).astype(np.float32)


def sphere(segments: int = 32) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.int32]]:
    """Unit sphere about the z axis: vertices (V, 3), which are its normals, UVs with v = 1 at +z, and faces."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, segments + 1), np.linspace(0, 2 * np.pi, 2 * segments + 1))
    vertices = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    uv = np.stack([phi / (2 * np.pi), 1 - theta / np.pi], axis=-1)
    index = np.arange(theta.size).reshape(theta.shape)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), uv.reshape(-1, 2).astype(np.float32), faces.astype(np.int32)


# What a landmark detector makes of a head
# ----------------------------------------------------------------------------------------------------------------------

LANDMARK_NOISE = 0.8
"""Pixels of landmark error at a width of 680; proportional to the width."""


def draw_bias(seed: int, deviation: float) -> NDArray[np.float64]:
    """(68, 3) displacement of each landmark in object space, the same in all images of a head.

    Detectors put a landmark where annotators would, not where a model's vertex is: MediaPipe's points on renders of
    scanned heads lie about 5 pixels, at a width of 680, from the points that fit all views. ``deviation`` is the
    standard deviation of each coordinate; a frontal view shows 1.25 times it on average.
    """
    return deviation * np.random.default_rng([seed, 15]).standard_normal((COUNT, 3))


def mark(
    model: MorphableModel,
    world: NDArray,
    camera: Camera,
    scene: SurfaceScene,
    rng: np.random.Generator,
    bias: NDArray | None = None,
) -> Landmarks:
    """Landmarks of one image as a detector would find them, knowing which are hidden.

    ``world`` (V, 3) are vertices in world space and ``scene`` the head there; ``rng`` draws the noise, and ``bias``
    (68, 3) is a displacement in world space.
    """
    points = world[model.landmarks]
    normals = vertex_normals(world, model.faces)[model.landmarks]
    facing = np.einsum("nk,nk->n", normals, camera.position - points) > 0
    pixels = camera.project(points if bias is None else points + bias)
    inside = (pixels > 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
    noise = LANDMARK_NOISE * camera.width / 680 * rng.standard_normal(pixels.shape)
    return Landmarks(pixels + noise, facing & inside & scene.visible_from(points, camera.position))
