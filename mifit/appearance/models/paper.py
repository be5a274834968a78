"""The paper's shading: SH irradiance, and a highlight under one light in the dominant direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mifit.appearance.kernels import PreparedLobe, diffuse_transfer, dominant_direction
from mifit.appearance.models.base import ShadingModel, Transfer

GUARD = 0.1
"""Cosine between normal and dominant direction below which the paper's L(p) is faded out."""

SMALLEST = 1e-3
"""The same where nothing is to be added to the paper: as small as single precision bears."""


class PaperModel(ShadingModel):
    """Ambient, SH irradiance, and the plain lobe ``(n . h)^m`` under a light in the dominant direction d.

    Its strength is the local irradiance undone of its cosine, ``L(p) = shading(n) / (n . d)``, as in the paper
    (section 5), with the quotient replaced by ``shading * c / (c^2 + GUARD^2)`` with ``c = max(n . d, 0)``: equal to
    within 4 % where n . d > 0.5, zero at the terminator instead of infinite, with a derivative below
    ``1 / GUARD^2``. The lobe is always the plain one, without a Fresnel factor.
    """

    name = "paper"
    guard = GUARD
    turns = True
    bands = 3
    exponent = 5.0
    normalized = False
    has_ambient = True

    def transfer(
        self, n: Any, v: Any, lobe: PreparedLobe, coefficients: Sequence[Any], shadowed: Sequence[Any] | None = None
    ) -> Transfer:
        """Both parts have the diffuse transfer; the specular one times `paper_specular`."""
        diffuse = diffuse_transfer(n, lobe.order)
        return Transfer(
            diffuse, diffuse, paper_specular(n, v, dominant_direction(coefficients), lobe.exponent, self.guard)
        )


class PrintedModel(PaperModel):
    """The paper's shading as it is printed: ``L(p)`` is the quotient itself but for where its divisor vanishes."""

    name = "printed"
    guard = SMALLEST


def paper_specular(n: Any, v: Any, direction: Any, exponent: Any, guard: float = GUARD) -> Any:
    """Factor by which the paper's specular term scales the shading: ``(n . h)^m / (n . d)``, guarded."""
    import drjit as dr

    c = dr.maximum(dr.dot(n, direction), 0.0)
    h = v + direction
    cos_h = dr.dot(n, h * dr.rsqrt(dr.maximum(dr.squared_norm(h), 1e-8)))
    # The power of a floor instead of zero: its logarithm, and so the derivative by the exponent, stays finite.
    power = dr.select(cos_h > 0.0, dr.power(dr.clip(cos_h, 1e-4, 1.0), exponent), 0.0)
    return power * c / (dr.square(c) + guard * guard)
