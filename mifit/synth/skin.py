"""Painted skin: albedo, oil, roughness and relief as functions of position on the mean face.

The features follow the 68 landmarks, so any morphable model can be painted; none of them lies in the span of its
modes: moles, freckles, brows, lips, stubble, pores, wrinkles, oily regions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from mifit.core.mesh import interpolate, normalize
from mifit.core.uv import TexelMap
from mifit.morphable.pigment import polyline_distance
from mifit.synth.procedural import smooth_noise

FAIR = np.array([0.58, 0.385, 0.30])
DEEP = np.array([0.16, 0.088, 0.058])
"""Linear reflectance of the ends of the range of skin tones that subjects are drawn from."""


@dataclass(frozen=True)
class SkinMaps:
    """Maps of one piece of surface, row 0 at v = 1.

    ``albedo`` (S, S, 3) is linear reflectance, ``specular`` (S, S) the weight of the oily lobe against the dry one,
    0..1, ``roughness`` (S, S) that of the dry lobe (square root of the microfacet width), ``bump`` (S, S) relief along
    the normal in millimetres. Texels outside ``cover`` (S, S) repeat their nearest neighbour.
    """

    albedo: NDArray[np.float32]
    specular: NDArray[np.float32]
    roughness: NDArray[np.float32]
    bump: NDArray[np.float32]
    cover: NDArray[np.bool_]


@dataclass(frozen=True)
class SkinStyle:
    """What is particular to a subject, drawn once and used for all pieces of surface."""

    seed: int
    tone: NDArray[np.float64]
    hair: NDArray[np.float64]
    stubble: float
    wrinkles: float
    oil: float
    freckles: int
    moles: int
    brows: tuple[float, float] = (0.5, 6.0)
    """How uneven they are, and half their width in millimetres."""

    @classmethod
    def draw(cls, seed: int, tone: float | None = None) -> SkinStyle:
        """Draw a subject's style; the same seed gives the same one. `tone` from 0 (fair) to 1 (deep)."""
        rng = np.random.default_rng([seed, 1])
        drawn = rng.uniform(0.0, 0.75)
        t = drawn if tone is None else tone
        return cls(
            seed=seed,
            tone=np.exp((1 - t) * np.log(FAIR) + t * np.log(DEEP)) * rng.uniform(0.97, 1.03, 3),
            hair=np.array([0.05, 0.032, 0.022]) * rng.uniform(0.5, 2.0),
            stubble=float(rng.choice([0.0, rng.uniform(0.3, 1.0)])),
            wrinkles=float(rng.uniform(0.3, 1.0)),
            oil=float(rng.uniform(0.5, 1.0)),
            freckles=int(rng.integers(20, 140)),
            moles=int(rng.integers(5, 14)),
        )

    def portrait(self) -> SkinStyle:
        """The same skin without moles, with less oil and stubble, and with finer brows."""
        return replace(self, oil=0.5 * self.oil, moles=0, stubble=0.5 * self.stubble, brows=(0.15, 4.5))


@dataclass(frozen=True)
class Anatomy:
    """Positions on the mean face, in millimetres, that features are placed by."""

    landmarks: NDArray[np.float64]
    lips: NDArray[np.float32]
    origin: NDArray[np.float64]

    _STEP = 0.25
    """Millimetres per cell of `lips`."""

    @classmethod
    def of(cls, landmarks: NDArray) -> Anatomy:
        """Prepare the 68 landmarks (68, 3), millimetres, y up, nose along +z."""
        points = np.asarray(landmarks, dtype=np.float64)
        outline = points[48:60, :2]
        origin = outline.min(axis=0) - 10.0
        cells = np.ceil((outline.max(axis=0) + 10.0 - origin) / cls._STEP).astype(int)
        image = np.zeros((cells[1], cells[0]), dtype=np.float32)
        cv2.fillPoly(image, [np.round((outline - origin) / cls._STEP).astype(np.int32)], 1.0)
        return cls(points, gaussian_filter(image, 0.8 / cls._STEP), origin)

    def lip_weight(self, p: NDArray, normals: NDArray) -> NDArray[np.float32]:
        """1 on the lips, 0 elsewhere, soft over about a millimetre."""
        at = (p[:, 1::-1] - self.origin[::-1]) / self._STEP
        inside = map_coordinates(self.lips, at.T, order=1, cval=0.0)
        near = np.abs(p[:, 2] - self.landmarks[48:60, 2].mean()) < 22.0
        return np.asarray(inside * near * (normals[:, 2] > 0.0), dtype=np.float32)

    def line_distance(self, p: NDArray, indices: list[int]) -> NDArray[np.float32]:
        """Distance in millimetres to the polyline through some landmarks."""
        return polyline_distance(p, self.landmarks[indices]).astype(np.float32)


def paint(
    texels: TexelMap, mean_mm: NDArray, normals: NDArray, faces: NDArray, landmarks: NDArray, style: SkinStyle
) -> SkinMaps:
    """Paint the maps of a piece of surface with ``faces`` (F, 3), which ``texels`` are of.

    ``mean_mm`` and ``normals`` (V, 3) are the whole mean face in millimetres; ``landmarks`` (68,) its iBUG points.
    """
    p = interpolate(mean_mm, faces, texels.face, texels.weights).astype(np.float32)
    n = normalize(interpolate(normals, faces, texels.face, texels.weights))
    anatomy = Anatomy.of(mean_mm[landmarks])
    front = np.clip(n[:, 2] * 2.0, 0.0, 1.0).astype(np.float32)
    albedo, lips, brows = _paint_colour(p, n, front, anatomy, style)
    spots, raised = _paint_spots(p, front, mean_mm, anatomy, style)
    albedo *= spots
    beard = _beard(p, front, anatomy) * style.stubble * (1 - lips)
    rng = np.random.default_rng([style.seed, 3])
    dots = np.clip(smooth_noise(p, 1.1, rng) * 1.2 - 0.9, 0.0, 1.0) * beard
    albedo *= 1.0 - 0.25 * beard[:, None] * np.array([1.0, 0.85, 0.7], np.float32)
    albedo = albedo * (1 - 0.8 * dots[:, None]) + 0.8 * dots[:, None] * style.hair.astype(np.float32)
    oil = _oil(p, front, anatomy, style, lips, rng)
    roughness = 0.52 - 0.14 * oil + 0.05 * smooth_noise(p, 12.0, rng) + 0.1 * brows
    bump = _relief(p, front, anatomy, style, lips, rng) + 0.25 * raised + 0.12 * brows * smooth_noise(p, 1.6, rng)
    return SkinMaps(
        albedo=_fill(texels, np.clip(albedo, 0.005, 0.9)),
        specular=_fill(texels, np.clip(oil, 0.02, 0.98)),
        roughness=_fill(texels, np.clip(roughness, 0.25, 0.75)),
        bump=_fill(texels, bump),
        cover=texels.mask,
    )


def _paint_colour(
    p: NDArray, n: NDArray, front: NDArray, anatomy: Anatomy, style: SkinStyle
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Base tone with blotches, blush, lips and brows -> albedo, lip weight, brow weight."""
    rng = np.random.default_rng([style.seed, 2])
    blotches = 0.05 * smooth_noise(p, 35.0, rng, octaves=4)
    albedo = style.tone.astype(np.float32) * (1.0 + blotches[:, None] * np.array([0.6, 1.0, 1.1], np.float32))
    marks = anatomy.landmarks
    for side in (2, 14):  # jaw points below the ears; the blush sits between them and the nose
        centre = 0.45 * marks[side] + 0.55 * marks[33] + (0.0, 8.0, 0.0)
        blush = front * np.exp(-0.5 * np.sum((p - centre) ** 2, axis=1) / 18.0**2)
        albedo *= 1.0 - blush[:, None] * np.array([0.02, 0.20, 0.16], np.float32)
    lips = anatomy.lip_weight(p, n)
    pores = 0.1 * smooth_noise(p, 2.5, rng)
    lip_tone = style.tone * (0.82, 0.55, 0.60)
    albedo += lips[:, None] * (lip_tone.astype(np.float32) * (1 + pores[:, None]) - albedo)
    brows = np.zeros(len(p), dtype=np.float32)
    rough, wide = style.brows
    strokes = np.clip(0.75 + rough * smooth_noise(p * (0.5, 1.0, 0.5), 1.8, rng), 0.0, 1.0)
    for line in ([17, 18, 19, 20, 21], [22, 23, 24, 25, 26]):
        near = anatomy.line_distance(p - np.array([0.0, -2.0, 0.0]), line)
        brows = np.maximum(brows, np.clip((wide - near) / 3.0, 0.0, 1.0) * strokes * front)
    albedo += brows[:, None] * (style.hair.astype(np.float32) - albedo) * 0.85
    return albedo.astype(np.float32), lips, brows


def _paint_spots(
    p: NDArray, front: NDArray, mean_mm: NDArray, anatomy: Anatomy, style: SkinStyle
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Moles and freckles -> factors on the albedo (N, 3) and relief of the moles, 0..1."""
    rng = np.random.default_rng([style.seed, 4])
    marks = anatomy.landmarks
    centre = marks[27:36].mean(axis=0)
    skin = mean_mm[(np.linalg.norm(mean_mm - centre, axis=1) < 85.0) & (mean_mm[:, 2] > marks[[0, 16], 2].mean())]
    moles = skin[rng.integers(len(skin), size=style.moles)]
    cheeks = skin[np.linalg.norm((skin - centre) * (0.6, 1.2, 0.6), axis=1) < 30.0]
    freckles = cheeks[rng.integers(len(cheeks), size=style.freckles)] + rng.normal(0.0, 2.0, (style.freckles, 3))
    centres = np.concatenate([moles, freckles])
    radius = np.concatenate([rng.uniform(0.9, 2.4, len(moles)), rng.uniform(0.5, 1.3, len(freckles))])
    depth = np.concatenate([rng.uniform(0.5, 0.85, len(moles)), rng.uniform(0.1, 0.35, len(freckles))])
    distance, which = cKDTree(centres).query(p, distance_upper_bound=4.0)
    hit = np.isfinite(distance)
    which = np.where(hit, which, 0)
    profile = np.where(hit, np.clip(1.6 - distance / radius[which], 0.0, 1.0), 0.0) * front
    darkening = (profile * depth[which])[:, None] * np.array([0.8, 1.0, 1.0])
    return (1.0 - darkening).astype(np.float32), (profile * (which < len(moles))).astype(np.float32)


def _beard(p: NDArray, front: NDArray, anatomy: Anatomy) -> NDArray[np.float32]:
    """Where stubble grows: below the nose and between the jaw lines."""
    marks = anatomy.landmarks
    below = np.clip((marks[33, 1] - 3.0 - p[:, 1]) / 8.0, 0.0, 1.0)
    above = np.clip((p[:, 1] - marks[8, 1] + 25.0) / 15.0, 0.0, 1.0)
    cheek = np.clip((anatomy.line_distance(p, [33, 8]) - 62.0) / -12.0, 0.0, 1.0)
    return (below * above * cheek * np.sqrt(front)).astype(np.float32)


def _oil(
    p: NDArray, front: NDArray, anatomy: Anatomy, style: SkinStyle, lips: NDArray, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Weight of the glossy lobe: forehead, nose, chin and lips shine."""
    marks = anatomy.landmarks
    forehead = marks[[21, 22]].mean(axis=0) + np.array([0.0, 28.0, -6.0])
    zone = 0.15 + 0.45 * np.exp(-0.5 * np.sum(((p - forehead) * (0.6, 1.0, 0.6)) ** 2, axis=1) / 18.0**2)
    zone += 0.6 * np.exp(-0.5 * (anatomy.line_distance(p, [27, 30, 33]) / 10.0) ** 2)
    zone += 0.3 * np.exp(-0.5 * np.sum((p - marks[8] - (0.0, 14.0, 0.0)) ** 2, axis=1) / 12.0**2)
    zone *= style.oil * (0.3 + 0.7 * front) * (1.0 + 0.25 * smooth_noise(p, 9.0, rng, octaves=3))
    return (zone + lips * (0.75 - zone)).astype(np.float32)


def _relief(
    p: NDArray, front: NDArray, anatomy: Anatomy, style: SkinStyle, lips: NDArray, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Millimetres of pores, fine wrinkles, forehead lines and nasolabial folds."""
    marks = anatomy.landmarks
    relief = -0.035 * np.clip(smooth_noise(p, 1.6, rng), 0.0, 2.0) + 0.02 * smooth_noise(p, 4.0, rng, octaves=2)
    phase = 2 * np.pi * p[:, 1] / 9.0 + 0.9 * smooth_noise(p, 30.0, rng)
    rise = p[:, 1] - marks[[19, 24], 1].mean()
    band = np.clip((rise - 6.0) / 10.0, 0.0, 1.0) * np.clip((60.0 - rise) / 15.0, 0.0, 1.0) * front
    relief -= 0.16 * style.wrinkles * band * np.maximum(np.sin(phase), 0.0) ** 4
    for fold in ([31, 48], [35, 54]):
        outward = np.sign(marks[fold[0], 0]) * np.array([5.0, 0.0, 0.0])
        near = anatomy.line_distance(p - outward, fold)
        relief -= 0.25 * style.wrinkles * np.exp(-0.5 * (near / 1.5) ** 2) * front
    creases = np.sin(2 * np.pi * p[:, 0] / 2.2 + smooth_noise(p, 8.0, rng))
    return (relief * (1 - lips) - 0.05 * lips * np.maximum(creases, 0.0)).astype(np.float32)


def _fill(texels: TexelMap, values: NDArray) -> NDArray[np.float32]:
    """Texel values -> map; uncovered texels repeat the nearest covered one, so that filtering meets no border."""
    image = texels.to_map(np.asarray(values, dtype=np.float32))
    rows, columns = distance_transform_edt(~texels.mask, return_distances=False, return_indices=True)
    return np.ascontiguousarray(image[rows, columns])
