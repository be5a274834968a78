"""A small capture with a known normal map: a dome seen by two cameras, shaded by the project's own model."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.capture.capture import Frame
from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate, ReflectanceEstimate, Report
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import rasterize_uv, sample_map
from mifit.morphable import MorphableModel
from mifit.render.gbuffer import SurfaceScene
from tests.shaded import shade_points

SIZE = 96
DONE = Report("converged")


def dome_model(n: int = 33) -> MorphableModel:
    """A shallow dome over a square, facing +z, with one identity and one expression mode."""
    y, x = np.mgrid[-1 : 1 : n * 1j, -1 : 1 : n * 1j]
    height = 0.8 - 0.35 * (x**2 + y**2)
    mean = np.stack([x.ravel(), y.ravel(), height.ravel()], axis=1).astype(np.float32)
    uv = np.stack([0.05 + 0.45 * (x.ravel() + 1), 0.05 + 0.45 * (y.ravel() + 1)], axis=1).astype(np.float32)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 1], 1), np.stack([i, i + n + 1, i + n], 1)]).astype(np.int32)
    mode = np.zeros((n * n, 3, 1), np.float32)
    mode[:, 2, 0] = 0.1 * np.exp(-4 * (x**2 + y**2)).ravel()
    albedo = np.full((n * n, 3), 0.5, np.float32)
    return MorphableModel(
        name="dome",
        mean=mean,
        faces=faces,
        identity=mode,
        expression=0.5 * mode,
        mean_albedo=albedo,
        albedo_modes=np.zeros((n * n, 3, 1), np.float32),
        uv=uv,
        faces_uv=faces,
        landmarks=np.linspace(0, n * n - 1, 68).astype(np.int32),
        face_mask=np.ones(len(faces), bool),
    )


def camera(name: str, angle: float, pixels: int = 160) -> Camera:
    """A camera five units from the dome, turned about y."""
    c, s = np.cos(angle), np.sin(angle)
    position = 5.0 * np.array([s, 0.0, c]) + [0.0, 0.0, 0.4]
    rotation = np.array([[c, 0.0, -s], [0.0, -1.0, 0.0], [-s, 0.0, -c]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return Camera(name, pixels, pixels, 2.0 * pixels, 2.0 * pixels, pixels / 2, pixels / 2, matrix)


@dataclass
class Scene:
    """What the tests share; a stand-in for a Capture with ``camera`` and ``frame``."""

    model: MorphableModel
    geometry: GeometryEstimate
    reflectance: ReflectanceEstimate
    normal_map: np.ndarray
    frames: dict[tuple[str, int], Frame]
    cameras: dict[str, Camera]
    requested: set[str] = field(default_factory=set)
    timesteps: tuple[int, ...] = ()

    def camera(self, name: str) -> Camera:
        return self.cameras[name]

    def with_fitted(self, cameras: object) -> Scene:
        return self

    def digest(self, cameras: Sequence[str], timesteps: Sequence[int]) -> str:
        images = [self.frames[name, t].image for name in cameras for t in timesteps]
        return hashlib.sha256(b"".join(np.ascontiguousarray(image).tobytes() for image in images)).hexdigest()

    def frame(self, name: str, timestep: int) -> Frame:
        self.requested.add(name)
        return self.frames[name, timestep]


def build(model_name: str = "prefiltered", noise: float = 0.0, timesteps: int = 1, tilt: float = 0.12) -> Scene:
    """Images of the dome with a bumpy normal map under coloured SH lighting."""
    model = dome_model()
    rng = np.random.default_rng(0)
    radiance = rng.normal(size=(9, 3)) * 0.25
    radiance[0] = 3.0
    radiance[1:4] += [[0.1, -0.5, 0.2], [0.9, 0.6, 0.7], [-0.5, 0.2, 0.6]]
    texels = rasterize_uv(model.uv, model.faces_uv, SIZE, model.face_mask)
    vertices = np.stack([model.mean] * timesteps).astype(np.float32)
    base = normalize(interpolate(vertex_normals(model.mean, model.faces), model.faces, texels.face, texels.weights))
    uv = interpolate(model.uv, model.faces_uv, texels.face, texels.weights)
    bump = tilt * np.stack([np.sin(25 * uv[:, 0]) * np.cos(19 * uv[:, 1]), np.cos(21 * uv[:, 0] + 17 * uv[:, 1])], 1)
    true = normalize(base + np.column_stack([bump, np.zeros(len(bump))]))
    diffuse = np.full((SIZE, SIZE, 3), (0.55, 0.4, 0.32), np.float32)
    row, column = np.mgrid[0:SIZE, 0:SIZE] / SIZE
    diffuse *= (1 + 0.2 * np.sin(9 * row + 4 * column))[..., None].astype(np.float32)
    specular = np.full((SIZE, SIZE), 0.1, np.float32)
    reflectance = ReflectanceEstimate(
        diffuse,
        specular,
        texels.mask.astype(np.float32),
        Illumination(radiance, ambient=0.01),
        Lobe(8.0),
        model_name,
        DONE,
    )
    geometry = GeometryEstimate(
        tuple(range(timesteps)),
        np.zeros(1),
        np.zeros(1),
        np.zeros((timesteps, 1)),
        np.stack([np.eye(3)] * timesteps),
        np.zeros((timesteps, 3)),
        1.0,
        vertices,
        model.mean_albedo,
        np.zeros((9, 3)),
        0.0,
        DONE,
    )
    cameras = {c.name: c for c in (camera("left", -0.35), camera("right", 0.35), camera("third", 0.0))}
    normal_map = texels.to_map(true.astype(np.float32))
    frames = {}
    for name, view in cameras.items():
        buffer = SurfaceScene(model.mean, model.faces).gbuffer(view)
        hit = buffer.face.ravel() >= 0
        face, weights = buffer.face.ravel()[hit], buffer.weights.reshape(-1, 3)[hit]
        at = interpolate(model.uv, model.faces_uv, face, weights)
        toward = normalize(view.position - interpolate(model.mean, model.faces, face, weights))
        body, glint = shade_points(
            normalize(sample_map(normal_map, at)),
            toward,
            sample_map(diffuse, at),
            sample_map(specular, at),
            radiance,
            0.01,
            8.0,
            model_name,
        )
        for t in range(timesteps):
            image = np.zeros((view.height * view.width, 3), np.float32)
            image[hit] = body + glint + noise * rng.normal(size=body.shape)
            shape = (view.height, view.width)
            frames[name, t] = Frame(
                image.reshape(*shape, 3), np.ones(shape, bool), np.zeros(shape, bool), None, np.zeros(68, bool)
            )
    return Scene(model, geometry, reflectance, normal_map, frames, cameras)
