"""What is known of skin before any image: reflectance at normal incidence and gloss.

Images show albedo times light. What of the two is whose, they tell through highlights alone, and weakly, so it falls
back to what has been measured of skin. The level of the diffuse albedo is stage 1's (`geometry.appearance`).

Reflectance at normal incidence follows from skin's index of refraction, 1.4: ((1.4 - 1) / (1.4 + 1))^2 = 0.028. The
lobe beforehand has a Beckmann roughness a = 0.3, as skin is usually rendered; that is about as wide as the exponent
2 / a^2 - 2 = 20. It is an assumption, and gives way where images that are left out are better predicted by another.
"""

from __future__ import annotations

NORMAL_REFLECTANCE = 0.028
"""Specular albedo of skin at normal incidence."""
EXPONENT = 20.0
"""Exponent of a roughness of 0.3: where none is given, and the images left out aren't predicted better by another."""
