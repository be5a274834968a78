"""The lobe convolved with the lighting: no light direction is needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mifit.appearance.kernels import PreparedLobe, diffuse_transfer, specular_transfer
from mifit.appearance.models.base import ShadingModel, Transfer

FRESNEL = 8.0
"""Fresnel factor of skin's lobe. Schlick's for skin is 24 times the value at normal incidence, of which shadowing and
masking between microfacets take a part; fits of path-traced skin change by about 0.1 dB from 8 to 24."""


class PrefilteredModel(ShadingModel):
    """SH irradiance, and the lobe prefiltered about its mean direction (``appearance.lobe``); no shadows."""

    name = "prefiltered"
    fresnel = FRESNEL

    def transfer(
        self, n: Any, v: Any, lobe: PreparedLobe, coefficients: Sequence[Any], shadowed: Sequence[Any] | None = None
    ) -> Transfer:
        """Closed form; it doesn't depend on the lighting."""
        return Transfer(diffuse_transfer(n, lobe.order), specular_transfer(n, v, lobe))
