"""The prefiltered model with the surface's own shadows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mifit.appearance.kernels import (
    PreparedLobe,
    diffuse_transfer,
    lobe_axis,
    lobe_transfer,
    radiance,
    specular_transfer,
    unoccluded,
)
from mifit.appearance.models.base import Shade, ShadingModel, Transfer
from mifit.appearance.models.prefiltered import FRESNEL
from mifit.errors import InputError


class ShadowedModel(ShadingModel):
    """Traced diffuse transfer, and the prefiltered lobe dimmed by how much of the light about its axis gets through."""

    name = "shadowed"
    needs_shadows = True
    fresnel = FRESNEL

    def transfer(
        self, n: Any, v: Any, lobe: PreparedLobe, coefficients: Sequence[Any], shadowed: Sequence[Any] | None = None
    ) -> Transfer:
        """The traced vector, and the prefiltered lobe's."""
        shadowed = self._traced(shadowed)
        axis, moments = lobe_axis(n, v, lobe)
        return Transfer(shadowed, lobe_transfer(lobe, axis, moments), unoccluded(n, axis, shadowed, lobe.order))

    def about(
        self,
        base: Any,
        v: Any,
        lobe: PreparedLobe,
        coefficients: Sequence[Any],
        shadowed: Sequence[Any] | None = None,
    ) -> Shade:
        """Shadows are those of the base normal.

        For a bent one the unshadowed change is added, dimmed by the part of the light that reaches the point, and the
        lobe keeps its dimming.
        """
        import drjit as dr
        import mitsuba as mi

        shadowed = self._traced(shadowed)
        blocked = radiance(shadowed, coefficients)
        open_sky = radiance(diffuse_transfer(base, lobe.order), coefficients)
        passed = dr.clip(mi.luminance(blocked) / dr.maximum(mi.luminance(open_sky), 1e-6), 0.0, 1.0)
        axis, _ = lobe_axis(base, v, lobe)
        specular_passed = unoccluded(base, axis, shadowed, lobe.order)
        rest = blocked - passed * open_sky
        dr.eval(rest, passed, specular_passed)

        def shade(n: Any, toward: Any) -> tuple[Any, Any]:
            diffuse = radiance(diffuse_transfer(n, lobe.order), coefficients)
            specular = radiance(specular_transfer(n, toward, lobe), coefficients)
            return rest + passed * diffuse, specular_passed * specular

        return shade

    def _traced(self, shadowed: Sequence[Any] | None) -> Sequence[Any]:
        if shadowed is None:
            raise InputError("shading model 'shadowed': found no transfer vectors, expected those of trace_transfer")
        return shadowed
