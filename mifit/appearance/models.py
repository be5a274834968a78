"""Shading models: how smooth lighting on a surface point becomes radiance towards the eye; one registry.

Adding one: derive from `ShadingModel`, name it, say what a point sends to the eye (`transfer`), and `register_model` an
instance. Fits, renders, relighting and the ``shdirect`` plugin then know it by its name.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mifit.appearance.arrays import Jit, dr, mi
from mifit.appearance.kernels import (
    PreparedLobe,
    SmoothLight,
    diffuse_transfer,
    dominant_direction,
    lobe_axis,
    lobe_factors,
    lobe_transfer,
    radiance,
    specular_transfer,
    unoccluded,
)
from mifit.config import SHADINGS
from mifit.core.sh import cosine_coefficients
from mifit.errors import InputError

Shade = Callable[[Jit, Jit], tuple[Jit, Jit]]
"""Unit normal and direction towards the viewer -> diffuse and specular radiance at unit albedo (Color3f)."""


@dataclass(frozen=True)
class Transfer:
    """What a point sends to the eye per unit of albedo and of each SH coefficient.

    ``diffuse`` and ``specular`` are B*B Floats each, ``gain`` (Float) is a factor on all of ``specular``.
    """

    diffuse: Sequence[Jit]
    specular: Sequence[Jit]
    gain: Jit = 1.0

    def shade(self, coefficients: Sequence[Jit]) -> tuple[Jit, Jit]:
        """Diffuse and specular radiance under SH coefficients (B*B colours)."""
        diffuse = radiance(self.diffuse, coefficients)
        same = self.specular is self.diffuse
        return diffuse, (diffuse if same else radiance(self.specular, coefficients)) * self.gain


class ShadingModel(ABC):
    """A shading model; `transfer` is all that one must have.

    Attributes
    ----------
    name : str
        By which settings, results and plugins know it.
    needs_shadows : bool
        Whether it reads shadowed diffuse transfer vectors, which are traced (``occlusion.trace_transfer``).
    turns : bool
        Whether the transfer changes with the lighting; a solver then linearises anew as the lighting changes.
    bands : int or None
        Bands of the lighting that it is fitted with; None for as many as the settings ask for.
    exponent : float or None
        Exponent where none is given; None for that of skin.
    fresnel : float or None
        Fresnel factor of the lobe that it is fitted with, see ``lobe.Lobe``.
    normalized : bool
        Kind of lobe that it has.
    has_ambient : bool
        Whether the ambient term is an unknown of the fit.
    """

    name: str
    needs_shadows: bool = False
    turns: bool = False
    bands: int | None = None
    exponent: float | None = None
    fresnel: float | None = None
    normalized: bool = True
    has_ambient: bool = False

    @abstractmethod
    def transfer(
        self, n: Jit, v: Jit, lobe: PreparedLobe, coefficients: Sequence[Jit], shadowed: Sequence[Jit] | None = None
    ) -> Transfer:
        """Transfer of points with unit normals ``n`` and unit directions ``v`` towards the viewer (Vector3f).

        ``coefficients`` (B*B colours) are radiance. A model whose transfer depends on it says so by `turns`; its
        gradient is wanted all the same. ``shadowed`` (B*B Floats) is traced diffuse transfer, given where
        `needs_shadows`.
        """

    def shade(
        self, n: Jit, v: Jit, lobe: PreparedLobe, coefficients: Sequence[Jit], shadowed: Sequence[Jit] | None = None
    ) -> tuple[Jit, Jit]:
        """Diffuse and specular radiance (Color3f) at unit albedo; parameters as in `transfer`."""
        return self.transfer(n, v, lobe, coefficients, shadowed).shade(coefficients)

    def about(
        self, base: Jit, v: Jit, lobe: PreparedLobe, light: SmoothLight, shadowed: Sequence[Jit] | None = None
    ) -> Shade:
        """Shading of normals bent away from those of the mesh, ``base`` (Vector3f), for which shadows were traced.

        What doesn't change with the normal is computed here, once. All else is as in `transfer`.
        """
        return lambda n, toward: self.shade(n, toward, lobe, light.coefficients, shadowed)


# The package's models ----------------------------------------------------------------------------------------------


class PaperModel(ShadingModel):
    """Ambient, SH irradiance, and the plain lobe ``(n . h)^m`` under a light in the dominant direction d.

    Its strength is the local irradiance undone of its cosine, ``L(p) = shading(n) / (n . d)``, as in the paper
    (section 5), with the quotient replaced by ``shading * c / (c^2 + guard^2)`` with ``c = max(n . d, 0)`` and a
    ``guard`` of 0.1: equal to within 4 % where n . d > 0.5, zero at the terminator instead of infinite, with a
    derivative below ``1 / guard^2``. The lobe is always the plain one, without a Fresnel factor.
    """

    name = "paper"
    guard = 0.1
    turns = True
    bands = 3
    exponent = 5.0
    normalized = False
    has_ambient = True

    def transfer(
        self, n: Jit, v: Jit, lobe: PreparedLobe, coefficients: Sequence[Jit], shadowed: Sequence[Jit] | None = None
    ) -> Transfer:
        """Both parts have the diffuse transfer; the specular one times `paper_specular`."""
        diffuse = diffuse_transfer(n, lobe.order)
        return Transfer(
            diffuse, diffuse, paper_specular(n, v, dominant_direction(coefficients), lobe.exponent, self.guard)
        )


class PrintedModel(PaperModel):
    """The paper's shading as it is printed: the guard is as small as single precision bears."""

    name = "printed"
    guard = 1e-3


def paper_specular(n: Jit, v: Jit, direction: Jit, exponent: Jit, guard: float) -> Jit:
    """Factor by which the paper's specular term scales the shading: ``(n . h)^m / (n . d)``, guarded."""
    c = dr.maximum(dr.dot(n, direction), 0.0)
    h = v + direction
    cos_h = dr.dot(n, h * dr.rsqrt(dr.maximum(dr.squared_norm(h), 1e-8)))
    # The power of a floor instead of zero: its logarithm, and so the derivative by the exponent, stays finite.
    power = dr.select(cos_h > 0.0, dr.power(dr.clip(cos_h, 1e-4, 1.0), exponent), 0.0)
    return power * c / (dr.square(c) + guard * guard)


FRESNEL = 8.0
"""Fresnel factor of skin's lobe. Schlick's for skin is 24 times the value at normal incidence, of which shadowing and
masking between microfacets take a part; fits of path-traced skin change by about 0.1 dB from 8 to 24."""


class PrefilteredModel(ShadingModel):
    """SH irradiance, and the lobe prefiltered about its mean direction (``appearance.lobe``); no shadows."""

    name = "prefiltered"
    fresnel = FRESNEL

    def transfer(
        self, n: Jit, v: Jit, lobe: PreparedLobe, coefficients: Sequence[Jit], shadowed: Sequence[Jit] | None = None
    ) -> Transfer:
        """Closed form; it doesn't depend on the lighting."""
        return Transfer(diffuse_transfer(n, lobe.order), specular_transfer(n, v, lobe))


class ShadowedModel(ShadingModel):
    """Traced diffuse transfer, and the prefiltered lobe dimmed by how much of the light about its axis gets through."""

    name = "shadowed"
    needs_shadows = True
    fresnel = FRESNEL

    def transfer(
        self, n: Jit, v: Jit, lobe: PreparedLobe, coefficients: Sequence[Jit], shadowed: Sequence[Jit] | None = None
    ) -> Transfer:
        """The traced vector, and the prefiltered lobe's."""
        shadowed = self._traced(shadowed)
        axis, moments = lobe_axis(n, v, lobe)
        return Transfer(shadowed, lobe_transfer(lobe, axis, moments), unoccluded(n, axis, shadowed, lobe.order))

    def about(
        self, base: Jit, v: Jit, lobe: PreparedLobe, light: SmoothLight, shadowed: Sequence[Jit] | None = None
    ) -> Shade:
        """Shadows are those of the base normal.

        For a bent one the unshadowed change is added, dimmed by the part of the light that reaches the point, and the
        lobe keeps its dimming.
        """
        shadowed, lambertian = self._traced(shadowed), (cosine_coefficients(lobe.order) / np.pi).tolist()
        blocked, open_sky = radiance(shadowed, light.coefficients), light.convolved(base, lambertian)
        passed = dr.clip(mi.luminance(blocked) / dr.maximum(mi.luminance(open_sky), 1e-6), 0.0, 1.0)
        specular_passed = unoccluded(base, lobe_axis(base, v, lobe)[0], shadowed, lobe.order)
        rest = blocked - passed * open_sky
        dr.eval(rest, passed, specular_passed)

        def shade(n: Jit, toward: Jit) -> tuple[Jit, Jit]:
            axis, moments = lobe_axis(n, toward, lobe)
            specular = light.convolved(axis, lobe_factors(lobe, moments))
            return rest + passed * light.convolved(n, lambertian), specular_passed * specular

        return shade

    def _traced(self, shadowed: Sequence[Jit] | None) -> Sequence[Jit]:
        if shadowed is None:
            raise InputError("shading model 'shadowed': found no transfer vectors, expected those of trace_transfer")
        return shadowed


# Registry ------------------------------------------------------------------------------------------------------------

_MODELS: dict[str, ShadingModel] = {}


def register_model(model: ShadingModel) -> None:
    """Make a shading model known by its name; one of the same name is replaced."""
    _MODELS[model.name] = model
    if model.name not in SHADINGS:
        SHADINGS.append(model.name)


def get(name: str | ShadingModel) -> ShadingModel:
    """The model of a name; InputError lists those that there are."""
    if isinstance(name, ShadingModel):
        return name
    if name not in _MODELS:
        raise InputError(f"shading model: found {name!r}, expected one of {', '.join(_MODELS)}")
    return _MODELS[name]


for _model in (PaperModel(), PrintedModel(), PrefilteredModel(), ShadowedModel()):
    register_model(_model)
