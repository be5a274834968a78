"""Shading of plain arrays by name of the model, for tests."""

from __future__ import annotations

import numpy as np

from mifit.appearance import models
from mifit.appearance.formation import Appearance
from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.appearance.occlusion import Occlusion


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
    diffuse_transfer=None,
    normalized=True,
    fresnel=None,
):
    """Diffuse part, ambient included, and specular part (N, 3) of points with albedos (N, 3) and (N,)."""
    look = appearance(radiance, exponent, model, normalized, fresnel, ambient)
    d, s = look.shade(normals, view, Occlusion(diffuse_transfer))
    return (np.float32(ambient) + diffuse * d).astype(np.float32), (np.asarray(specular)[:, None] * s).astype(
        np.float32
    )


def specular_matrix(normals, view, radiance, exponent, model, diffuse_transfer=None, normalized=True, fresnel=None):
    """(N, B*B) transfer of points with unit specular albedo."""
    look = appearance(radiance, exponent, model, normalized, fresnel)
    return look.transfers(normals, view, Occlusion(diffuse_transfer))[1]


def light_columns(normals, view, visible, light, exponent, fresnel=None):
    """Diffuse and specular radiance (N,) at unit albedo per unit of a light's colour."""
    look = appearance(np.zeros((1, 3)), exponent, "prefiltered", True, fresnel, lights=(light,))
    diffuse, specular = look.transfers(normals, view, Occlusion(visible=(np.asarray(visible),)))
    return diffuse[:, -1], specular[:, -1]
