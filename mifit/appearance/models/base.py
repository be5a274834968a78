"""What a shading model is: how smooth lighting on a surface point becomes radiance towards the eye."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mifit.appearance.kernels import PreparedLobe, light_transfer, radiance

Shade = Callable[[Any, Any], tuple[Any, Any]]
"""Unit normal and direction towards the viewer -> diffuse and specular radiance at unit albedo (Color3f)."""


@dataclass(frozen=True)
class Transfer:
    """What a point sends to the eye per unit of albedo and of each SH coefficient.

    Attributes
    ----------
    diffuse, specular : list of B*B Floats
    gain : Float
        Factor on all of ``specular``.
    """

    diffuse: Sequence[Any]
    specular: Sequence[Any]
    gain: Any = 1.0

    def shade(self, coefficients: Sequence[Any]) -> tuple[Any, Any]:
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
        Exponent where none is given; None where it is to be estimated.
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
        self, n: Any, v: Any, lobe: PreparedLobe, coefficients: Sequence[Any], shadowed: Sequence[Any] | None = None
    ) -> Transfer:
        """Transfer of points.

        Parameters
        ----------
        n, v : Vector3f
            Unit normal, and unit direction towards the viewer.
        lobe : PreparedLobe
        coefficients : B*B colours
            Radiance. A model whose transfer depends on it says so by `turns`; its gradient is wanted all the same.
        shadowed : B*B Floats
            Traced diffuse transfer; given where `needs_shadows`.
        """

    def shade(
        self, n: Any, v: Any, lobe: PreparedLobe, coefficients: Sequence[Any], shadowed: Sequence[Any] | None = None
    ) -> tuple[Any, Any]:
        """Diffuse and specular radiance (Color3f) at unit albedo; parameters as in `transfer`."""
        return self.transfer(n, v, lobe, coefficients, shadowed).shade(coefficients)

    def about(
        self,
        base: Any,
        v: Any,
        lobe: PreparedLobe,
        coefficients: Sequence[Any],
        shadowed: Sequence[Any] | None = None,
    ) -> Shade:
        """Shading of normals that are bent away from those of the mesh, for which shadows were traced.

        What doesn't change with the normal is computed here, once.

        Parameters
        ----------
        base, v : Vector3f
            The mesh's normal, and direction towards the viewer.
        lobe, coefficients, shadowed
            As in `transfer`.
        """
        return lambda n, toward: self.shade(n, toward, lobe, coefficients, shadowed)

    def light(self, n: Any, v: Any, lobe: PreparedLobe, directions: Sequence[Any], visible: Any) -> tuple[Any, Any]:
        """Diffuse and specular radiance per unit of a compact light's colour, see ``kernels.light_transfer``."""
        return light_transfer(n, v, lobe, directions, visible)
