"""A capture made in memory: a painted head, shaded by harmonics, seen through the G-buffer. No file is needed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mifit.capture import Frame
from mifit.core.camera import Camera
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.sh import basis
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.geometry.parameters import exponential

SHADING = np.array([4.0, 0.0, 0.8, -0.7, 0.0, 0.0, 0.3, 0.0, 0.0])  # the same for every channel


def rotation_angle(a, b):
    """Angle between two rotations, in degrees."""
    return np.degrees(Rotation.from_matrix(a.T @ b).magnitude())


@dataclass
class MemoryCapture:
    """Offers what stage 1 uses of `mifit.Capture`, and the truth."""

    cameras_by_name: dict
    frames: dict
    vertices: np.ndarray
    rotation: np.ndarray
    identity: np.ndarray
    unit_mm: float = 10.0

    def camera(self, name):
        return self.cameras_by_name[name]

    def frame(self, name, timestep):
        return self.frames[name, timestep]

    def changed(self, change):
        """The same capture with ``change(name, timestep, frame)`` applied to every frame."""
        frames = {key: change(*key, frame) for key, frame in self.frames.items()}
        return replace(self, frames=frames)


def look_at_head(name, degrees, width, height, distance=70.0):
    """A camera at an angle about the vertical, looking at the origin."""
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn
    pose[:3, 3] = (0, 0, distance)
    f = 2.0 * width
    return Camera(name, width, height, f, f, width / 2, height / 2, pose)


def paint(points, rng):
    """Albedo factor at points (N, 3) in object space: blotches from 4 cm down to 2 mm."""
    value = np.zeros(len(points))
    for wavelength in np.geomspace(4.0, 0.4, 14):
        direction = rng.normal(size=(3, 3))
        direction *= 2 * np.pi / wavelength / np.linalg.norm(direction, axis=1, keepdims=True)
        value += np.prod(np.sin(points @ direction.T + rng.uniform(0, 6, 3)), axis=1)
    return np.exp(0.12 * value)


def make_capture(
    model,
    angles=((0.0, 0.0, 0.0),),
    views=(-20.0, 20.0),
    width=340,
    height=240,
    noise=0.4,
    seed=0,
    identity=0.6,
    painted=True,
    frown=0.4,
    shift=0.3,
):
    """Paint, pose and photograph a random face of the model.

    Parameters
    ----------
    angles : sequence of (3,)
        Rotation vector of each timestep, degrees.
    frown, shift : float
        Deviations of the expression's coefficients and of the position, cm, at each timestep.
    """
    rng = np.random.default_rng(seed)
    x_id = identity * rng.normal(size=model.n_identity)
    names = ("left", "right") if len(views) == 2 else tuple(f"c{i}" for i in range(len(views)))
    cameras = {n: look_at_head(n, v, width, height) for n, v in zip(names, views, strict=True)}
    frames, world, rotations = {}, [], []
    for t, angle in enumerate(angles):
        low, high = model.expression_bounds.T
        x_ex = np.clip(frown * rng.normal(size=model.n_expression) * (t > 0), low, high)
        rotation = exponential(np.radians(np.asarray(angle)))
        objects = model.shape(x_id, x_ex).astype(np.float64)
        vertices = objects @ rotation.T + rng.normal(size=3) * shift
        scene = SurfaceScene(vertices, model.faces)
        normals = vertex_normals(vertices, model.faces)
        spots = model.mean.astype(np.float64)
        for name, camera in cameras.items():
            g = scene.gbuffer(camera)
            hit = g.face >= 0
            face, weights = g.face[hit], g.weights[hit]
            n = normalize(interpolate(normals, model.faces, face, weights))
            albedo = interpolate(model.mean_albedo, model.faces, face, weights)
            if painted:
                albedo = (
                    albedo * paint(interpolate(spots, model.faces, face, weights), np.random.default_rng(7))[:, None]
                )
            image = np.zeros((height, width, 3), np.float32)
            image[hit] = albedo * (basis(n, 3) @ SHADING)[:, None] * 0.8
            image = np.maximum(image + 0.002 * rng.normal(size=image.shape), 0).astype(np.float32)
            marks = vertices[model.landmarks]
            facing = ((camera.position - marks) * normals[model.landmarks]).sum(1) > 0
            visible = facing & scene.visible_from(marks, camera.position)
            pixels = camera.project(marks) + noise * rng.normal(size=(68, 2))
            frames[name, t] = Frame(image, np.ones(hit.shape, bool), image.max(2) >= 1.0, pixels, visible)
        world.append(vertices)
        rotations.append(rotation)
    return MemoryCapture(cameras, frames, np.stack(world), np.stack(rotations), x_id)
