"""What is known of skin before any image: level and colour of its albedo, reflectance at normal incidence, gloss.

Images show albedo times light. What of the two is whose, they tell through highlights alone, and weakly, so it falls
back to what has been measured of skin and not to whatever a fit without highlights happened to leave.

Reflectance at normal incidence follows from skin's index of refraction, 1.4: ((1.4 - 1) / (1.4 + 1))^2 = 0.028. The
lobe beforehand has a Beckmann roughness a = 0.3, as skin is usually rendered; that is about as wide as the exponent
2 / a^2 - 2 = 20. It is an assumption, and gives way where images that are left out are better predicted by another.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NORMAL_REFLECTANCE = 0.028
"""Specular albedo of skin at normal incidence."""
EXPONENT = 20.0
"""Exponent of a roughness of 0.3: where none is given, and the images left out aren't predicted better by another."""


FAINTEST = 0.2
"""Part of the mean face's level, in its darkest channel, down to which a fitted albedo's contrasts are believed."""


def levelled(albedo: NDArray, mean: NDArray, face: NDArray, mean_face: NDArray) -> NDArray:
    """Albedo with the level and colour of the morphable model's mean face.

    Stage 1 finds albedo beside light that is free, which says nothing of their product's split; its priors then decide,
    and they made skin half as bright and four times as yellow as it was on path-traced heads, and in light far from
    white drove a channel below nothing. Differences between places are told by images, so those stay, up to where they
    would be magnified beyond belief.

    Parameters
    ----------
    albedo, mean : (N, 3)
        Of the fitted model and of its mean at the points wanted.
    face, mean_face : (V, 3)
        The same at the vertices of the face, whose averages are the levels.
    """
    wanted = np.maximum(np.asarray(mean_face, dtype=np.float64).mean(axis=0), 1e-3)
    found = np.asarray(face, dtype=np.float64).mean(axis=0)
    # The largest part of the way from the mean face to the fitted one that leaves every channel some light.
    way = float(np.min((1.0 - FAINTEST) * wanted / np.maximum(wanted - found, (1.0 - FAINTEST) * wanted)))
    return (mean + way * (albedo - mean)) * (wanted / (wanted + way * (found - wanted)))
