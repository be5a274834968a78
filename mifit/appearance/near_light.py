"""A compact light at a place: its direction and strength change over a face, and its shadows spread."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.limits import MAX_NUMBER
from mifit.core.sh import basis
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.render.gbuffer import SurfaceScene

RAYS = 16
"""Points that stand for the extent of a compact light."""


@dataclass(frozen=True)
class NearLight:
    """A small ball of even radiance, such as a flash or a bare bulb, at a place in the world.

    A surface at the distance d that faces it receives ``intensity / d**2``. The colour is what surfaces at ``centre``
    receive, so that equations for it have the scale of those for a distant light, which this becomes as it moves away
    in one direction with the colour held.

    Attributes
    ----------
    position : (3,) float64
        World position of its middle.
    radius : float
        Of the ball, in units of the world; 0 for a point.
    colour : (3,) float64
        Irradiance at ``centre`` of a surface that faces it, linear Rec. 709.
    centre : (3,) float64
        A point of the world near what is lit, such as the middle of the head.

    Raises
    ------
    InputError
        The position is that of the centre.
    """

    position: NDArray[np.float64]
    radius: float
    colour: NDArray[np.float64]
    centre: NDArray[np.float64]

    def __post_init__(self) -> None:
        if not self.distance > 0:
            raise InputError(f"near light: found its position {self.position} in the centre, expected it beside it")

    @property
    def distance(self) -> float:
        """Of its middle from the centre, in units of the world."""
        return float(np.linalg.norm(self.position - self.centre))

    @property
    def direction(self) -> NDArray[np.float64]:
        """(3,) unit vector from the centre towards it."""
        return (self.position - self.centre) / self.distance

    @property
    def intensity(self) -> NDArray[np.float64]:
        """(3,) radiant intensity: irradiance at the distance of one unit of the world."""
        return self.colour * self.distance**2

    def samples(self, count: int = RAYS) -> NDArray[np.float64]:
        """(count, 3) points that evenly cover the disc that the centre sees of it, on a sunflower's pattern."""
        frame = np.linalg.svd(self.direction[None])[2]
        i = np.arange(count) + 0.5
        angle = i * math.pi * (3.0 - math.sqrt(5.0))
        across = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ frame[1:]
        return self.position + self.radius * np.sqrt(i / count)[:, None] * across

    def with_colour(self, colour: ArrayLike) -> NearLight:
        """The same light in another colour."""
        return replace(self, colour=np.asarray(colour, dtype=np.float64))

    def rotated(self, rotation: ArrayLike, about: ArrayLike = (0.0, 0.0, 0.0)) -> NearLight:
        """The light carried around a point of world space by a rotation R (3, 3), and its centre with it."""
        turn, pivot = np.asarray(rotation, dtype=np.float64), np.asarray(about, dtype=np.float64)
        return replace(self, **{n: pivot + turn @ (getattr(self, n) - pivot) for n in ("position", "centre")})

    def coefficients(self, order: int) -> NDArray[np.float64]:
        """(B*B, 3) SH coefficients of what the centre receives of it; other points receive something else."""
        towards = self.samples() - self.centre
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        return np.outer(basis(towards, order).mean(0), self.colour)

    def document(self) -> dict[str, Any]:
        """JSON values from which `illumination.light_from` makes it again."""
        return {
            "position": self.position.tolist(),
            "radius": self.radius,
            "intensity": self.intensity.tolist(),
            "centre": self.centre.tolist(),
        }

    @classmethod
    def of(cls, document: dict[str, Any]) -> NearLight:
        """The light of `document`; raises as `illumination.light_from`."""
        position, intensity, centre = (
            np.array(document[name], dtype=np.float64) for name in ("position", "intensity", "centre")
        )
        radius = float(document["radius"])
        shapes = {position.shape, intensity.shape, centre.shape}
        if shapes != {(3,)} or not (np.abs([*position, *intensity, *centre, radius]) <= MAX_NUMBER).all():
            raise ValueError(
                f"near light: found {document}, expected three finite numbers for position, intensity and centre"
            )
        light = cls(position, radius, intensity, centre)
        if not (radius >= 0.0 and light.distance > 0.0):
            raise ValueError(f"near light: found {document}, expected a radius from 0 and a place beside its centre")
        return light.with_colour(intensity / light.distance**2)

    def emitter(self) -> dict[str, Any]:
        """A point, whatever its radius."""
        return {
            "type": "point",
            "position": [float(x) for x in self.position],
            "intensity": {"type": "rgb", "value": [float(x) for x in self.intensity]},
        }

    def describe(self, unit_mm: float | None = None) -> str:
        """Where it is, seen from the centre, and how large."""
        x, y, z = self.position
        far = f"{self.distance:.4g} units" + ("" if unit_mm is None else f" ({self.distance * unit_mm:.0f} mm)")
        return f"at ({x:.4g}, {y:.4g}, {z:.4g}), {far} from the head's middle, with a radius of {self.radius:.2g}"

    def visible(self, scene: SurfaceScene, points: NDArray, normals: NDArray) -> NDArray[np.uint32]:
        """(N,) which of its samples the points (N, 3) of a mesh see, a bit each."""
        return scene.open_to(points, normals, self.samples())

    def incident(self, points: Any) -> tuple[list[Any], Any]:
        """Directions from points (Point3f) towards the samples, and the square of how much nearer than the centre.

        Raises
        ------
        InputError
            No points.
        """
        import drjit as dr
        import mitsuba as mi

        if points is None:
            raise InputError("near light: found no points, expected the world positions of what is shaded")
        samples = [mi.Point3f(*map(float, s)) for s in self.samples()]
        position, reach = mi.Point3f(*map(float, self.position)), mi.Float(self.distance**2)
        dr.make_opaque(samples, position, reach)
        return [dr.normalize(s - points) for s in samples], reach / dr.squared_norm(position - points)
