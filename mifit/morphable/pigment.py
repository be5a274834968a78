"""Skin albedo for any face mesh: melanin and haemoglobin, with regions placed by landmarks.

Reflectance falls exponentially with pigment, so a small change of pigment changes albedo in proportion to the
albedo itself: d albedo = -albedo * (absorption_m * d melanin + absorption_h * d haemoglobin). Both pigments
vary as a whole, by region (lips, brows, cheeks, nose, beard, eye sockets) and as smooth random fields.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from mifit.morphable.gaussian_process import compress, field_modes
from mifit.morphable.topology import EYES_AND_MOUTH

SKIN = np.array([0.47, 0.285, 0.205])
"""Linear Rec. 709 reflectance of skin of medium pigmentation."""
SPREAD = 0.28
"""Standard deviation of the log luminance of skin over a face, brows and lips included."""
SPECULAR = 0.03
"""Specular reflectance of skin at normal incidence (index of refraction 1.4)."""

MELANIN = np.array([1.0, 1.2, 1.4])
HAEMOGLOBIN = np.array([0.12, 1.0, 0.72])
"""Absorption of the two pigments in the three channels, per unit of log reflectance."""

_FIELDS = ((35.0, 40, 0.07, 0.08), (14.0, 110, 0.045, 0.05))
"""Correlation length in mm, inducing points, deviation of melanin, deviation of haemoglobin."""

_REGIONS = {
    # region: (mean melanin, mean haemoglobin, deviation of melanin, deviation of haemoglobin)
    "whole": (0.0, 0.0, 0.27, 0.085),
    "lips": (0.12, 0.42, 0.10, 0.16),
    "brows": (0.75, 0.05, 0.22, 0.02),
    "cheeks": (0.0, 0.10, 0.03, 0.09),
    "nose": (0.0, 0.10, 0.02, 0.08),
    "beard": (0.05, -0.02, 0.09, 0.03),
    "sockets": (0.05, 0.06, 0.06, 0.05),
    "forehead": (0.0, -0.03, 0.05, 0.04),
}


def skin_model(
    mean: NDArray, faces_used: NDArray, landmarks: NDArray, unit_mm: float, count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean albedo (V, 3), linear reflectance, and albedo modes (V, 3, count) for a face surface.

    ``mean`` (V, 3) has y up and the nose along +z, in units of ``unit_mm`` millimetres; ``faces_used`` (F, 3) are those
    of the photometric region, where the random fields live; ``landmarks`` (68,) iBUG vertices. Modes are orthogonal,
    premultiplied by their standard deviations.
    """
    points = np.asarray(mean, dtype=np.float64) * unit_mm
    masks = region_masks(points, landmarks)
    melanin = sum(masks[r] * v[0] for r, v in _REGIONS.items())
    haemoglobin = sum(masks[r] * v[1] for r, v in _REGIONS.items())
    albedo = SKIN * np.exp(-np.multiply.outer(melanin, MELANIN) - np.multiply.outer(haemoglobin, HAEMOGLOBIN))

    n = len(points)
    used = np.zeros(n, dtype=bool)
    used[faces_used] = True
    fields_m: list[NDArray] = [masks[region][:, None] * v[2] for region, v in _REGIONS.items()]
    fields_h: list[NDArray] = [masks[region][:, None] * v[3] for region, v in _REGIONS.items()]
    for scale, inducing, sigma_m, sigma_h in _FIELDS:
        field = field_modes(points, scale, inducing, where=used)
        fields_m.append(field * sigma_m)
        fields_h.append(field * sigma_h)
    columns = np.concatenate(
        [
            np.einsum("vc,vk->vck", (-albedo * absorption).astype(np.float32), np.hstack(fields).astype(np.float32))
            for absorption, fields in ((MELANIN, fields_m), (HAEMOGLOBIN, fields_h))
        ],
        axis=2,
    )
    modes = compress(columns.reshape(3 * n, -1), count)
    return albedo.astype(np.float32), modes.reshape(n, 3, -1)


def region_masks(points: NDArray, landmarks: NDArray) -> dict[str, NDArray[np.float64]]:
    """Soft masks (V,) in 0..1 of the regions of a face, from vertices in mm and the 68 landmarks."""
    p = points[landmarks]
    eye = float(np.linalg.norm(p[36] - p[45])) / 90.0  # sizes below are for outer corners of eyes 90 mm apart
    lips = _inside(points[:, :2], p[48:60, :2], 1.2 * eye) * (1 - _inside(points[:, :2], p[60:68, :2], 0.3 * eye))
    depth = points[:, 2] - p[48:60, 2].min()
    masks = {"whole": np.ones(len(points)), "lips": lips * _step(depth, -12.0 * eye, 4.0 * eye)}

    brows = np.zeros(len(points))
    for first in (17, 22):
        brow = p[first : first + 5] - (0.0, 1.5 * eye, 0.0)  # detectors mark the brow's upper edge
        brows = np.maximum(brows, np.exp(-0.5 * (polyline_distance(points, brow) / (2.6 * eye)) ** 3))
    masks["brows"] = brows

    masks["cheeks"] = np.maximum(
        *(
            _bump(points, 0.3 * p[lower].mean(0) + 0.35 * p[wing] + 0.35 * p[jaw], 15 * eye)
            for lower, wing, jaw in (([40, 41], 31, 3), ([46, 47], 35, 13))
        )
    )
    masks["nose"] = np.maximum(_bump(points, p[30], 11 * eye), 0.8 * _bump(points, p[[31, 35]].mean(0), 12 * eye))
    sockets = np.zeros(len(points))
    for ring in EYES_AND_MOUTH[:2]:
        sockets = np.maximum(sockets, np.exp(-0.5 * (polyline_distance(points, p[[*ring, ring[0]]]) / (6 * eye)) ** 2))
    masks["sockets"] = sockets * (1 - brows)

    outline = np.concatenate([p[3:14, :2], p[[35, 33, 31], :2]])
    beard = _inside(points[:, :2], outline, 10 * eye) * _step(points[:, 2] - p[3, 2], -15 * eye, 20 * eye)
    masks["beard"] = beard * (1 - masks["lips"])
    above = p[19:25].mean(0)
    masks["forehead"] = _step(points[:, 1] - above[1], 5 * eye, 20 * eye) * _step(
        points[:, 2] - p[[0, 16], 2].mean(), 0.0, 30 * eye
    )
    return masks


def _step(x: NDArray, low: float, high: float) -> NDArray:
    """Smooth step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _bump(points: NDArray, centre: NDArray, radius: float) -> NDArray:
    return np.exp(-0.5 * ((points - centre) ** 2).sum(1) / radius**2)


def polyline_distance(points: NDArray, line: NDArray) -> NDArray:
    """Distance of points (N, D) from a polyline (M, D)."""
    best = np.full(len(points), np.inf)
    for a, b in itertools.pairwise(line):
        d = b - a
        t = np.clip((points - a) @ d / max(d @ d, 1e-12), 0.0, 1.0)
        best = np.minimum(best, ((points - a - t[:, None] * d) ** 2).sum(1))
    return np.sqrt(best)


def _inside(points: NDArray, polygon: NDArray, softness: float) -> NDArray:
    """Soft indicator (N,) of a polygon (M, 2): 1 inside, 0 beyond ``softness`` on either side of its border."""
    inside = np.zeros(len(points), dtype=bool)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (a[1] > points[:, 1]) != (b[1] > points[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            x = a[0] + (points[:, 1] - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
        inside ^= crosses & (points[:, 0] < x)
    distance = polyline_distance(points, np.vstack([polygon, polygon[:1]]))
    return _step(np.where(inside, distance, -distance), -softness, softness)
