"""A small head made of a sphere, with every stage's result made up, for tests that need no fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance import models
from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.config import MeshConfig
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate, Report
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.result import Reconstruction
from mifit.stages.normals.refine_mesh import refine_mesh

RADIUS = 9.0


def mean_geometry(model: MorphableModel) -> GeometryEstimate:
    """The mean head of a built-in model where it was made, at one timestep."""
    identity, albedo, expression = (np.zeros(n) for n in (100, 100, len(model.expression_names)))
    return GeometryEstimate(
        (0,), identity, albedo, expression[None], np.eye(3)[None], np.zeros((1, 3)), 1.0,
        model.mean[None].astype(np.float32), model.mean_albedo, np.zeros((9, 3)), 0.0, Report("converged"),
    )  # fmt: skip


def ball_model(rows: int = 16, columns: int = 24) -> MorphableModel:
    """A sphere with a seam: poles on the y axis, face area in front (z > 0), other faces outside the map."""
    theta = np.linspace(0.02, np.pi - 0.02, rows + 1)
    phi = np.arange(columns) / columns * 2 * np.pi  # 0 is the back, pi the front
    t, p = np.meshgrid(theta, phi, indexing="ij")
    mean = RADIUS * np.stack([-np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], -1).reshape(-1, 3)
    u, v = np.meshgrid(np.arange(columns + 1) / columns, 1 - np.arange(rows + 1) / rows)
    faces, faces_uv = [], []
    for i in range(rows):
        for j in range(columns):
            a, b = i * columns + j, i * columns + (j + 1) % columns
            c, d = a + columns, b + columns
            faces += [(a, c, b), (b, c, d)]
            e = i * (columns + 1) + j
            faces_uv += [(e, e + columns + 1, e + 1), (e + 1, e + columns + 1, e + columns + 2)]
    faces, faces_uv = np.array(faces), np.array(faces_uv)
    outward = np.einsum("fc,fc->f", vertex_normals(mean, faces)[faces[:, 0]], mean[faces[:, 0]])
    if outward.sum() < 0:
        faces, faces_uv = faces[:, ::-1], faces_uv[:, ::-1]
    mask = mean[faces].mean(1)[:, 2] > 0.2 * RADIUS
    rng = np.random.default_rng(1)
    modes = mean / RADIUS
    front = np.flatnonzero(mean[:, 2] > 0.5 * RADIUS)
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return MorphableModel(
        name="ball",
        mean=mean.astype(np.float32),
        faces=faces.astype(np.int32),
        identity=(0.2 * modes)[..., None].astype(np.float32),
        expression=(0.3 * modes * (mean[:, 1:2] < 0))[..., None].astype(np.float32),
        mean_albedo=rng.uniform(0.4, 0.6, mean.shape).astype(np.float32),
        albedo_modes=np.full((*mean.shape, 1), 0.05, np.float32),
        uv=uv.astype(np.float32),
        faces_uv=faces_uv.astype(np.int32),
        landmarks=rng.choice(front, 68).astype(np.int32),
        face_mask=mask,
        expression_names=("jawOpen",),
    )


def ball_camera(name: str = "left", angle: float = 15.0, size: int = 64) -> Camera:
    """A camera 70 units away that looks at the origin from an angle about the vertical (degrees)."""
    a = np.radians(angle)
    position = 70 * np.array([np.sin(a), 0.0, np.cos(a)])
    z = -position / 70
    x = np.cross(z, (0.0, 1.0, 0.0)) / np.linalg.norm(np.cross(z, (0.0, 1.0, 0.0)))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ position
    return Camera(name, size, size, 3.4 * size, 3.4 * size, size / 2, size / 2, pose)


def ball_result(size: int = 32, shading_model: str = "prefiltered") -> Reconstruction:
    model = ball_model()
    rng = np.random.default_rng(0)
    expression = np.array([[0.0], [0.7]])
    angle = np.radians([0.0, 10.0])
    rotation = np.stack([[[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]] for a in angle])
    translation = np.array([[0.0, 0.0, 0.0], [0.5, -0.2, 0.1]])
    identity, albedo, scale = np.array([0.3]), np.array([-0.4]), 1.02
    vertices = np.stack(
        [scale * model.shape(identity, e) @ r.T + t for e, r, t in zip(expression, rotation, translation, strict=True)]
    )
    radiance = np.zeros((9, 3))
    radiance[0] = (3.0, 2.8, 2.6)
    radiance[2] = 0.8
    radiance[1] = -0.5
    shading = radiance * np.repeat([1.0, 2 / 3, 1 / 4], [1, 3, 5])[:, None]
    curve = {"data": [3.0, 1.0, 0.5], "prior": [0.1, 0.2, 0.2]}
    hidden = Diagnostic("landmark-hidden", "one landmark is hidden", camera="left")
    report = Report("converged", curve, 1.5, (hidden,), {"points": 68})
    geometry = GeometryEstimate(
        (0, 3), identity, albedo, expression, rotation, translation, scale, vertices.astype(np.float32),
        model.albedo(albedo), shading, 0.01, report,
    )  # fmt: skip
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    diffuse = texels.to_map(rng.uniform(0.3, 0.6, (len(texels.index), 3)).astype(np.float32))
    specular = texels.to_map(np.full(len(texels.index), 0.15, np.float32))
    confidence = texels.to_map(np.ones(len(texels.index), np.float32))
    reflectance = ReflectanceEstimate(
        diffuse,
        specular,
        confidence,
        Illumination(radiance, ambient=0.02),
        Lobe(12.0, normalized=models.get(shading_model).normalized),
        shading_model,
        Report("max_iterations", curve, 2.0),
    )
    normals = []
    for v, r in zip(vertices, rotation, strict=True):
        base = interpolate(vertex_normals(v, model.faces) @ r, model.faces, texels.face, texels.weights)
        bent = normalize(base + 0.1 * rng.standard_normal(base.shape))
        normals.append(texels.to_map(bent.astype(np.float32)))
    refined = NormalsEstimate((0, 3), np.stack(normals), Report("converged", curve, 0.7))
    return Reconstruction(
        model=model,
        geometry=geometry,
        reflectance=reflectance,
        normals=refined,
        mesh=refine_mesh(model, geometry, refined, MeshConfig(detail=3.0)),
        config={"seed": 0, "reflectance": {"exponent": 12.0}},
        cameras=(ball_camera("left", -20), ball_camera("right", 20)),
        capture_digest="0123",
        seconds=4.2,
        peak_memory=123456789,
    )


@pytest.fixture(scope="session")
def ball() -> Reconstruction:
    return ball_result()


@pytest.fixture(scope="session")
def stage_1_ball(ball) -> Reconstruction:
    return replace(ball, reflectance=None, normals=None, mesh=None)
