"""Shading of plain arrays by name of the model, for tests."""

from __future__ import annotations

import numpy as np

from mifit.appearance import models
from mifit.appearance.arrays import on_device, stored
from mifit.appearance.formation import Appearance
from mifit.appearance.illumination import Illumination
from mifit.appearance.kernels import diffuse_transfer
from mifit.appearance.lobe import Lobe
from mifit.appearance.occlusion import Occlusion, VertexTransfer


def diffuse_matrix(normals, order):
    """(N, B*B) unshadowed transfer: radiance of a white Lambertian point = matrix @ coefficients."""
    import mitsuba as mi

    return stored(diffuse_transfer(on_device(mi.Vector3f, normals), order), len(normals))


def shadows(transfer) -> Occlusion:
    """Shadows of points by their own transfer (N, B*B), as if each were a vertex."""
    if transfer is None:
        return Occlusion()
    corners = np.tile(np.arange(len(transfer))[:, None], (1, 3))
    first = np.tile(np.float32((1, 0, 0)), (len(transfer), 1))
    return Occlusion(VertexTransfer(np.asarray(transfer, np.float32), corners, first))


def appearance(radiance, exponent, model, normalized=True, fresnel=None, ambient=0.0, lights=()) -> Appearance:
    """An appearance from plain values."""
    return Appearance(models.get(model), Illumination(radiance, lights, ambient), Lobe(exponent, fresnel, normalized))


def shade_points(
    normals,
    view,
    diffuse,
    specular,
    radiance,
    ambient,
    exponent,
    model,
    traced=None,
    normalized=True,
    fresnel=None,
):
    """Diffuse part, ambient included, and specular part (N, 3) of points with albedos (N, 3) and (N,)."""
    look = appearance(radiance, exponent, model, normalized, fresnel, ambient)
    d, s = look.shade(normals, view, shadows(traced))
    return (np.float32(ambient) + diffuse * d).astype(np.float32), (np.asarray(specular)[:, None] * s).astype(
        np.float32
    )


def specular_matrix(normals, view, radiance, exponent, model, traced=None, normalized=True, fresnel=None):
    """(N, B*B) transfer of points with unit specular albedo."""
    look = appearance(radiance, exponent, model, normalized, fresnel)
    return look.transfers(normals, view, shadows(traced))[1]


def light_columns(normals, view, visible, light, exponent, fresnel=None):
    """Diffuse and specular radiance (N,) at unit albedo per unit of a light's colour."""
    look = appearance(np.zeros((1, 3)), exponent, "prefiltered", True, fresnel, lights=(light,))
    diffuse, specular = look.transfers(normals, view, Occlusion(visible=(np.asarray(visible),)))
    return diffuse[:, -1], specular[:, -1]
