"""What lights a face: smooth distant light, compact lights beside it, and an ambient term.

NumPy only: a record that stages fit, results keep and shading reads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.calls import finite, whole
from mifit.core.files import Document
from mifit.core.limits import MAX_NUMBER
from mifit.core.sh import SHLighting, basis, check_order, order_of
from mifit.errors import InputError

RAYS = 16
"""Points that stand for the extent of a compact light."""


@dataclass(frozen=True)
class DistantLight:
    """A disc of even radiance, far away, such as the sun or a bare lamp: too compact for spherical harmonics.

    A surface point reflects ``colour * f(w, v) * (n . w)``, averaged over the directions w of the disc that it sees.

    Attributes
    ----------
    direction : (3,) float64
        Unit vector towards its centre, world axes.
    radius : float
        Angular radius in radians; 0 for a point.
    colour : (3,) float64
        Irradiance of a surface that faces it, linear Rec. 709: a white Lambertian point reflects 1 / pi of it.
    """

    direction: NDArray[np.float64]
    radius: float
    colour: NDArray[np.float64]

    def __post_init__(self) -> None:
        direction, colour = finite(self.direction, (3,), "direction"), finite(self.colour, (3,), "colour")
        if not direction.any() or not 0.0 <= self.radius <= np.pi:
            raise InputError(
                f"light: found direction {self.direction!r} and radius {self.radius!r}, expected a unit vector and "
                "0 to pi"
            )
        object.__setattr__(self, "direction", direction)
        object.__setattr__(self, "colour", colour)

    def samples(self, count: int = RAYS) -> NDArray[np.float64]:
        """(count, 3) directions that cover the disc evenly; one of a point."""
        return disc(self.direction, self.radius, whole(count, 1, "count") if self.radius > 0.0 else 1)

    def with_colour(self, colour: ArrayLike) -> DistantLight:
        """The same light in another colour."""
        return replace(self, colour=np.asarray(colour, dtype=np.float64))

    def rotated(self, rotation: ArrayLike) -> DistantLight:
        """The light turned by a rotation R (3, 3): what came from d comes from R d."""
        return replace(self, direction=np.asarray(rotation, dtype=np.float64) @ self.direction)

    def coefficients(self, order: int) -> NDArray[np.float64]:
        """(B*B, 3) SH coefficients of its radiance: what B bands can show of it."""
        return np.outer(basis(self.samples(), order).mean(0), self.colour)

    def document(self) -> Document:
        """JSON values from which `light_from` makes it again."""
        return {"direction": self.direction.tolist(), "radius": self.radius, "irradiance": self.colour.tolist()}

    def emitter(self) -> Document:
        """A point at infinity, whatever its radius."""
        return {
            "type": "directional",
            "direction": [-float(x) for x in self.direction],
            "irradiance": {"type": "rgb", "value": [float(x) for x in self.colour]},
        }

    def describe(self) -> str:
        """Where it is and how large it looks, for a report."""
        x, y, z = self.direction
        return f"towards ({x:.2f}, {y:.2f}, {z:.2f}), with an angular radius of {math.degrees(self.radius):.1f} degrees"


def light_from(document: Document) -> DistantLight:
    """The light of `DistantLight.document`.

    KeyError, TypeError or ValueError for a value that is missing, of the wrong kind or shape, or not finite.
    """
    direction, colour = (np.array(document[name], dtype=np.float64) for name in ("direction", "irradiance"))
    radius = float(document["radius"])
    if direction.shape != (3,) or colour.shape != (3,) or not (np.abs(colour) <= MAX_NUMBER).all():
        raise ValueError(f"compact light: found {document}, expected three finite numbers for direction and irradiance")
    if not (abs(np.linalg.norm(direction) - 1.0) < 1e-3 and 0.0 <= radius <= math.pi):
        raise ValueError(f"compact light: found {document}, expected a unit direction and a radius from 0 to pi")
    return DistantLight(direction, radius, colour)


def disc(direction: ArrayLike, radius: float, count: int = RAYS) -> NDArray[np.float64]:
    """Directions (count, 3) that cover a disc of an angular radius evenly, on a sunflower's pattern."""
    centre = np.asarray(direction, dtype=np.float64)
    frame = np.linalg.svd(centre[None])[2]  # the centre up to its sign, and two directions across
    i = np.arange(count) + 0.5
    # Even in solid angle: the cap between centre and angle a has the area 2 pi (1 - cos a).
    cosine = 1.0 - (1.0 - math.cos(radius)) * i / count
    angle = i * math.pi * (3.0 - math.sqrt(5.0))
    across = np.cos(angle)[:, None] * frame[1] + np.sin(angle)[:, None] * frame[2]
    return cosine[:, None] * centre + np.sqrt(np.maximum(1.0 - cosine**2, 0.0))[:, None] * across


@dataclass(frozen=True)
class Illumination:
    """Everything that lights a face, world axes, linear Rec. 709.

    Attributes
    ----------
    radiance : (B*B, 3) float64
        SH coefficients of the smooth incident radiance, conventions of ``core.sh``; compact lights are not in it.
    lights : tuple of DistantLight
        Compact lights beside it.
    ambient : float
        The paper's I_a, added to every point: light that the model leaves out.

    Raises
    ------
    InputError
        Radiance of another shape than (B*B, 3).
    """

    radiance: NDArray[np.float64]
    lights: tuple[DistantLight, ...] = field(default=())
    ambient: float = 0.0

    def __post_init__(self) -> None:
        radiance = np.asarray(self.radiance, dtype=np.float64)
        if radiance.ndim != 2 or radiance.shape[1] != 3:
            raise InputError(f"radiance: found shape {radiance.shape}, expected (B*B, 3)")
        order_of(radiance)
        object.__setattr__(self, "radiance", radiance)
        object.__setattr__(self, "lights", tuple(self.lights))

    @classmethod
    def dark(cls, order: int, lights: Sequence[DistantLight] = ()) -> Illumination:
        """No light from B bands, and compact lights of no colour: the shape of what is to be fitted."""
        check_order(order)
        return cls(np.zeros((order * order, 3)), tuple(light.with_colour(np.zeros(3)) for light in lights))

    @property
    def order(self) -> int:
        """Number of bands B."""
        return order_of(self.radiance)

    @property
    def unknowns(self) -> NDArray[np.float64]:
        """(K, 3) all that images are linear in, but for ambient: coefficients, then a colour per compact light."""
        return np.concatenate([self.radiance, *(light.colour[None] for light in self.lights)])

    def with_unknowns(self, values: NDArray, ambient: float | None = None) -> Illumination:
        """The same lights with other coefficients and colours (K, 3); inverse of `unknowns`.

        InputError for another shape.
        """
        count = len(self.radiance)
        if np.shape(values) != (count + len(self.lights), 3):
            raise InputError(f"lighting: found shape {np.shape(values)}, expected {(count + len(self.lights), 3)}")
        lights = tuple(light.with_colour(colour) for light, colour in zip(self.lights, values[count:], strict=True))
        return Illumination(values[:count], lights, self.ambient if ambient is None else ambient)

    def rotated(self, rotation: ArrayLike) -> Illumination:
        """Turned by a rotation R (3, 3): what came from d comes from R d."""
        turned = SHLighting(self.radiance).rotate(rotation).coefficients
        return replace(self, radiance=turned, lights=tuple(light.rotated(rotation) for light in self.lights))

    def scaled(self, factor: float) -> Illumination:
        """Everything brighter by a factor."""
        factor = float(finite(factor, (), "factor"))
        lights = tuple(light.with_colour(factor * light.colour) for light in self.lights)
        return Illumination(factor * self.radiance, lights, factor * self.ambient)

    def smooth(self) -> SHLighting:
        """All of it, without ambient, as far as the bands can show compact lights."""
        return SHLighting(self.radiance + sum((light.coefficients(self.order) for light in self.lights), np.zeros(1)))
