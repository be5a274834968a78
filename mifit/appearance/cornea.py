"""The surface of an eye: a film of tears, smooth as glass, over iris and sclera.

What lies beneath it is the diffuse map's; the film reflects by Fresnel's equations for its index of refraction, in
Schlick's approximation (1994, within 0.025 up to 70 degrees), through a lobe about as sharp as pictures of heads show.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.lobe import Lobe

if TYPE_CHECKING:
    from mifit.appearance.formation import Appearance
    from mifit.appearance.occlusion import Occlusion

INDEX = 1.376
"""Index of refraction of the cornea."""
REFLECTANCE = ((INDEX - 1.0) / (INDEX + 1.0)) ** 2
"""Of light that falls along the normal: the specular albedo of an eye."""
EXPONENT = 2000.0
"""A reflected point is blurred by 2.6 degrees: what a quarter of a millimetre on an eyeball turns a reflection by."""
CORNEA = Lobe(EXPONENT, (1.0 - REFLECTANCE) / REFLECTANCE)
"""All light is reflected at grazing angles."""


def shade_eyes(
    appearance: Appearance,
    eye: NDArray[np.bool_],
    normals: NDArray,
    base: NDArray,
    view: NDArray,
    occlusion: Occlusion,
    points: NDArray,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`Appearance.shade_bent` of a surface that is an eye's at some of its points: there the lobe is the cornea's."""
    diffuse, specular = appearance.shade_bent(normals, base, view, occlusion, points)
    rows = np.flatnonzero(eye)
    if len(rows):
        film = replace(appearance, lobe=CORNEA)
        _, mirrored = film.shade_bent(normals[rows], base[rows], view[rows], occlusion.take(rows), points[rows])
        specular[rows] = mirrored
    return diffuse, specular


def reflects(lobe: Lobe) -> bool:
    """Whether eyes have a cornea beside skin with this lobe: the paper's plain lobe is in units of its own."""
    return lobe.fresnel is not None and lobe.normalized
