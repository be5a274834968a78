"""A small capture with known albedo and lighting: a dome turning before two cameras, shaded by our own models."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from stages.normal_scene import camera, dome_model

from mifit.appearance.occlusion import OccludingMesh
from mifit.capture.capture import Frame
from mifit.core.estimate import GeometryEstimate, Report
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import sample_map
from mifit.render.gbuffer import SurfaceScene
from tests.shaded import shade_points

SIZE = 48
EXPONENT = 60.0
VIEWS = {"left": -0.35, "right": 0.35, "third": 0.05}


@dataclass
class TurningDome:
    """Stands in for a Capture with ``camera`` and ``frame``; holds the truth."""

    model: object
    geometry: GeometryEstimate
    radiance: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    shading: str
    fresnel: float | None
    frames: dict = field(default_factory=dict)

    def camera(self, name):
        return camera(name, VIEWS[name])

    def frame(self, name, timestep):
        return self.frames[name, timestep]

    def changed(self, change):
        """The same capture with ``change(frame)`` applied to every frame."""
        return replace(self, frames={key: change(f) for key, f in self.frames.items()})


def lighting(order=4, seed=3):
    """Bright from above and one side, positive everywhere that matters."""
    from mifit.core.sh import bands

    rng = np.random.default_rng(seed)
    out = rng.normal(size=(order * order, 3)) * (0.35 / (1 + bands(order)[:, None]))
    out[0] = (3.0, 2.7, 2.4)
    out[1:4] += np.array([[-0.8], [0.9], [-0.6]])
    return out


def albedos(size=SIZE, gloss=0.12):
    """Smooth blotches: diffuse about 0.4, specular about ``gloss``."""
    y, x = np.mgrid[0 : 1 : size * 1j, 0 : 1 : size * 1j]
    wave = np.sin(9 * x + 3 * y) * np.cos(7 * y)
    diffuse = np.stack([0.5 + 0.12 * wave, 0.38 + 0.1 * np.cos(8 * x), 0.32 + 0.06 * wave], axis=-1)
    specular = gloss * (1 + 0.6 * np.sin(6 * x) * np.cos(5 * y))
    return diffuse.astype(np.float32), specular.astype(np.float32)


def turning_dome(shading="prefiltered", fresnel=8.0, gloss=0.12, radiance=None, exponent=EXPONENT, steps=4, depth=1.0,
                 swing=1.0):  # fmt: skip
    """Render the capture without noise; ``depth`` stretches the dome to the cameras, ``swing`` scales its turns."""
    model = dome_model()
    stretched = model.mean * [1.0, 1.0, depth] - [0.0, 0.0, 0.6 * (depth - 1.0)]
    radiance = lighting(3 if shading == "paper" else 4) if radiance is None else radiance
    diffuse, specular = albedos(gloss=gloss)
    level = np.full((len(model.mean), 3), diffuse.mean((0, 1)), np.float32)
    model = replace(model, mean=stretched.astype(np.float32), mean_albedo=level)
    turns = [(0.0, 0.0), (0.35, 0.1), (-0.3, 0.2), (0.1, -0.35)][:steps]
    vertices, rotations = [], []
    centre = np.array([0.0, 0.0, 0.6])
    for yaw, pitch in turns:
        yaw, pitch = swing * yaw, swing * pitch
        cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
        turn = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        rotations.append(turn)
        vertices.append(((model.mean - centre) @ turn.T + centre).astype(np.float32))
    count = len(turns)
    geometry = GeometryEstimate(
        tuple(range(count)),
        np.zeros(1),
        np.zeros(1),
        np.zeros((count, 1)),
        np.stack(rotations),
        np.zeros((count, 3)),
        1.0,
        np.stack(vertices),
        level,
        np.zeros((9, 3)),
        0.0,
        Report("converged"),
    )
    scene = TurningDome(model, geometry, radiance, diffuse, specular, shading, fresnel)
    for name in VIEWS:
        for t in range(count):
            colour, mask = render(scene, name, t, diffuse, specular, radiance, exponent, shading, fresnel)
            scene.frames[name, t] = Frame(colour, mask, np.zeros(mask.shape, bool), None, np.zeros(68, bool))
    return scene


def render(scene, name, t, diffuse, specular, radiance, exponent, shading, fresnel, ambient=0.0):
    """Shade one view through the G-buffer: image and coverage."""
    model, view, vertices = scene.model, camera(name, VIEWS[name]), scene.geometry.vertices[t]
    buffer = SurfaceScene(vertices, model.faces).gbuffer(view)
    mask = buffer.mask
    face, weights = buffer.face[mask], buffer.weights[mask]
    point = interpolate(vertices, model.faces, face, weights)
    normal = normalize(interpolate(vertex_normals(vertices, model.faces), model.faces, face, weights))
    uv = interpolate(model.uv, model.faces_uv, face, weights)
    x, y = sample_map(diffuse, uv), sample_map(specular, uv)
    toward = normalize(view.position - point)
    traced = None
    if shading == "shadowed":
        traced = OccludingMesh(SurfaceScene(vertices, model.faces)).transfer(round(len(radiance) ** 0.5))
        traced = interpolate(traced, model.faces, face, weights)
    d, s = shade_points(normal, toward, x, y, radiance, ambient, exponent, shading, traced, fresnel=fresnel)
    image = np.zeros((*mask.shape, 3), np.float32)
    image[mask] = d + s
    return image, mask
