"""What is known of skin before any image: level and colour of its albedo, reflectance at normal incidence, gloss.

Images show albedo times light. What of the two is whose, they tell through highlights alone, and weakly, so it falls
back to what has been measured of skin and not to whatever a fit without highlights happened to leave.

Sources
-------
- Reflectance at normal incidence 0.028 (index of refraction 1.4): d'Eon and Luebke, GPU Gems 3 (2007), chapter 14.
- Beckmann roughness of facial regions 0.2 to 0.4: Weyrich et al., "Analysis of human faces using a measurement-based
  skin reflectance model" (SIGGRAPH 2006), and 0.3 as the mean that d'Eon and Luebke take from it. A roughness a is
  about as wide as the exponent 2 / a^2 - 2: 48 to 11.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NORMAL_REFLECTANCE = 0.028
"""Specular albedo of skin at normal incidence."""
EXPONENT = 40.0
"""Exponent where none is given: within the measured range, towards its smooth end, where highlights show most."""


def levelled(albedo: NDArray, fitted: NDArray, mean: NDArray) -> NDArray:
    """Albedo with the level and colour of the morphable model's mean face.

    Stage 1 finds albedo beside light that is free, which says nothing of their product's split; its priors then decide,
    and they made skin half as bright and four times as yellow as it was on path-traced heads. Differences between
    places are told by images, so those stay.

    Parameters
    ----------
    albedo : (N, 3)
        Of the fitted model.
    fitted, mean : (V, 3)
        Albedo of the fitted model and of its mean at the vertices of the face.
    """
    wanted = np.maximum(np.asarray(mean, dtype=np.float64).mean(axis=0), 1e-3)
    found = np.maximum(np.asarray(fitted, dtype=np.float64).mean(axis=0), 1e-3)
    return albedo * (wanted / found)
