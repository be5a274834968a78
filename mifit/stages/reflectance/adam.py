"""The paper's own optimisation of stage 2: Adam over bounded variables, by differentiating the shading models.

One iteration updates, in the paper's order, lighting and ambient, then the specular map, then the diffuse offset,
each by one step of Mitsuba's Adam along the gradient of the whole objective at the values of that moment.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import aligned, on_device
from mifit.appearance.formation import Appearance, form_image
from mifit.appearance.illumination import Illumination
from mifit.appearance.kernels import prepare
from mifit.errors import InputError

HISTORY = ("data", "difference", "smoothness")


@dataclass(frozen=True)
class Samples:
    """M weighted observations of N texels on an S x S map.

    Attributes
    ----------
    normal, view, colour, weight : (M, 3) float32
        Unit normal and view vector, observed colour, weight per channel.
    texel : (M,) int
        Texel of each observation, 0 .. N - 1.
    first, second : (P,) int
        Rows of the same texel and timestep in two views: their difference is specular.
    index : (N,) int
        Flat position of each texel in the map.
    size : int
    albedo : (N, 3) float32
        Diffuse albedo C_d of the morphable model.
    traced : (M, K) float32 or None
        Shadowed transfer vectors, for models that need them.
    """

    normal: NDArray[np.float32]
    view: NDArray[np.float32]
    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    texel: NDArray[np.int64]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    index: NDArray[np.int64]
    size: int
    albedo: NDArray[np.float32]
    traced: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class AdamResult:
    """Where Adam ended: illumination, diffuse (N, 3), specular (N,), and the energies on the way."""

    illumination: Illumination
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    history: dict[str, list[float]] = field(default_factory=dict)


def minimize_by_adam(
    samples: Samples,
    appearance: Appearance,
    difference_weight: float,
    smoothness: tuple[float, float],
    iterations: int,
    specular: NDArray | None = None,
    rates: tuple[float, float, float] = (0.01, 0.005, 0.005),
    on_iteration: Callable[[int], None] | None = None,
) -> AdamResult:
    """Minimise E_O + lambda_S E_S + lambda_H E_H (paper, section 5) from zero specular albedo.

    Parameters
    ----------
    samples : Samples
    appearance : Appearance
        Model and lobe, and the smooth illumination to start from.
    difference_weight : float
        lambda_S.
    smoothness : (float, float)
        lambda_H of the diffuse offset and of the specular map.
    iterations : int
    specular : (N,), optional
        Specular map to start from; zero by default, as in the paper.
    rates : (float, float, float)
        Step lengths of lighting (relative to its largest coefficient), specular map and diffuse offset.
    on_iteration : callable, optional
        Called with the number of iterations done.

    Raises
    ------
    InputError
        No observation.
    """
    import drjit as dr
    import mitsuba as mi

    if not len(samples.colour):
        raise InputError("found 0 observations, expected some: no image shows the face")
    problem = _Objective(samples, appearance, difference_weight, smoothness)
    radiance, ambient = appearance.illumination.radiance, appearance.illumination.ambient
    k, n = len(radiance), len(samples.albedo)
    scale = max(float(np.abs(radiance).max()), 1e-6)
    # One vector for lighting and ambient, relative to the lighting's size, so that one step length fits any exposure.
    start = np.concatenate([np.asarray(radiance, dtype=np.float64).ravel() / scale, [ambient / scale]])
    low, high = np.full(3 * k + 1, -np.inf), np.full(3 * k + 1, np.inf)
    low[-1] = 0.0
    if not appearance.model.has_ambient:
        high[-1] = 0.0
    base = mi.Float(aligned(samples.albedo).ravel())
    begin = np.zeros(n, np.float32) if specular is None else np.asarray(specular, dtype=np.float32)
    # Optimisers of their own: each variable steps at the values that the ones before it have just taken.
    light = _Bounded(mi.Float(aligned(start)), rates[0], mi.Float(aligned(low)), mi.Float(aligned(high)))
    specular_albedo = _Bounded(mi.Float(aligned(begin)), rates[1], 0.0, 1.0)
    offset = _Bounded(dr.zeros(mi.Float, 3 * n), rates[2], -base, 1.0 - base)
    history: dict[str, list[float]] = {name: [] for name in HISTORY}

    def unpack(x: Any) -> tuple[list[Any], Any]:
        values = [mi.Color3f(*(scale * dr.gather(mi.Float, x, 3 * i + c) for c in range(3))) for i in range(k)]
        return values, scale * dr.gather(mi.Float, x, 3 * k)

    for iteration in range(iterations):
        light.step(lambda x: problem.total(problem.shade(*unpack(x)), specular_albedo.value, base, offset.value))
        shaded = problem.shade(*unpack(light.value))
        dr.eval(shaded)
        shown = partial(problem.total, shaded)
        specular_albedo.step(lambda x: shown(x, base, offset.value))  # noqa: B023, called at once
        offset.step(lambda x: shown(specular_albedo.value, base, x))  # noqa: B023
        for name, value in zip(HISTORY, problem.terms(shaded, specular_albedo.value, base, offset.value), strict=True):
            history[name].append(float(value[0]))
        if on_iteration is not None:
            on_iteration(iteration + 1)
    final = np.array(light.value, dtype=np.float64) * scale
    diffuse = np.array(base + offset.value, dtype=np.float32).reshape(n, 3)
    illumination = Illumination(final[:-1].reshape(k, 3), ambient=float(final[-1]))
    return AdamResult(illumination, diffuse, np.array(specular_albedo.value, dtype=np.float32), history)


class _Bounded:
    """A variable with a box that each of its Adam steps ends in."""

    def __init__(self, value: Any, rate: float, low: Any, high: Any) -> None:
        import mitsuba as mi

        self._optimizer = mi.ad.Adam(lr=rate, params={"x": value})
        self._low, self._high = low, high

    @property
    def value(self) -> Any:
        """The variable, detached."""
        import drjit as dr

        return dr.detach(self._optimizer["x"])

    def step(self, energy: Callable[[Any], Any]) -> None:
        """Differentiate an energy at the current value and take one step."""
        import drjit as dr

        dr.backward(energy(self._optimizer["x"]))
        self._optimizer.step()
        self._optimizer["x"] = dr.clip(self.value, self._low, self._high)
        dr.eval(self._optimizer["x"])


class _Objective:
    """The paper's objective over one set of observations."""

    def __init__(
        self,
        samples: Samples,
        appearance: Appearance,
        difference: float,
        smoothness: tuple[float, float],
    ) -> None:
        import mitsuba as mi

        self.model, self.lobe = appearance.model, prepare(appearance.lobe, appearance.order)
        self.difference, self.smoothness = difference, smoothness
        self.normal, self.view = on_device(mi.Vector3f, samples.normal), on_device(mi.Vector3f, samples.view)
        self.colour, self.weight = on_device(mi.Color3f, samples.colour), on_device(mi.Color3f, samples.weight)
        self.texel = mi.UInt(aligned(samples.texel, np.uint32))
        self.first, self.second = (mi.UInt(aligned(x, np.uint32)) for x in (samples.first, samples.second))
        self.traced = None
        if samples.traced is not None:
            self.traced = [mi.Float(aligned(column)) for column in samples.traced.T]
        self.neighbours = _neighbours(samples.index, samples.size)

    def shade(self, coefficients: list[Any], ambient: Any) -> tuple[Any, Any, Any]:
        """Diffuse and specular reflection at unit albedo, and ambient."""
        import drjit as dr

        if not dr.grad_enabled(coefficients):
            dr.make_opaque(coefficients)
        d, s = self.model.shade(self.normal, self.view, self.lobe, coefficients, self.traced)
        return d, s, ambient

    def terms(self, shaded: tuple[Any, Any, Any], specular_albedo: Any, base: Any, offset: Any) -> tuple[Any, Any, Any]:
        """Data, specular difference and smoothness terms, weighted."""
        import drjit as dr
        import mitsuba as mi

        d, s, ambient = shaded
        y = dr.gather(mi.Float, specular_albedo, self.texel)
        x = mi.Color3f(*(dr.gather(mi.Float, base + offset, 3 * self.texel + c) for c in range(3)))
        residual = self.colour - form_image(ambient, x, d, y, s)
        data = dr.sum(_total(self.weight * dr.square(residual)))
        pair = mi.Float(0.0)
        if self.difference > 0 and len(self.first):
            observed = _at(self.colour, self.first) - _at(self.colour, self.second)
            shown = _at(s, self.first) - _at(s, self.second)
            both = dr.minimum(_at(self.weight, self.first), _at(self.weight, self.second))
            at = dr.gather(mi.Float, y, self.first)
            pair = self.difference * dr.sum(_total(both * dr.square(observed - at * shown)))
        rough = mi.Float(0.0)
        for values, stride, shift, weight in [(specular_albedo, 1, 0, self.smoothness[1])] + [
            (offset, 3, c, self.smoothness[0]) for c in range(3)
        ]:
            if weight > 0:
                centre, *around = (dr.gather(mi.Float, values, stride * i + shift) for i in self.neighbours)
                rough += weight * dr.sum(dr.abs(sum(around) - 4.0 * centre))
        return data, pair, rough

    def total(self, shaded: tuple[Any, Any, Any], specular_albedo: Any, base: Any, offset: Any) -> Any:
        """The whole objective."""
        data, pair, rough = self.terms(shaded, specular_albedo, base, offset)
        return data + pair + rough


def _neighbours(index: NDArray, size: int) -> list[Any]:
    """Texel numbers of each texel and of its four neighbours; itself where there is none."""
    import mitsuba as mi

    own = np.full((size + 2, size + 2), -1, dtype=np.int64)
    row, column = index // size + 1, index % size + 1
    own[row, column] = np.arange(len(index))
    out = [np.arange(len(index))]
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        other = own[row + dy, column + dx]
        out.append(np.where(other < 0, np.arange(len(index)), other))
    return [mi.UInt(aligned(x, np.uint32)) for x in out]


def _at(colour: Any, index: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    return mi.Color3f(*(dr.gather(mi.Float, channel, index) for channel in (colour.x, colour.y, colour.z)))


def _total(colour: Any) -> Any:
    return colour.x + colour.y + colour.z
