"""Photo-consistency without a model of albedo: one surface point has one texture, whichever view and time sees it.

The paper's term compares each image with a rendering whose albedo lies in the morphable model, so that a mole, a
brow or a shadow that the model can't paint pulls on the geometry. Here every surface point i carries a free value
a_i (variable projection): with y_iv the log-texture of image v at the point's projection,

    E = sum_i min over a_i of sum_v w_iv |y_iv - a_i|^2,

which is the spread of what the images show of one point. Eliminating a_i couples all images that see the point, so
the normal equations are dense in the timesteps' parameters; they are a few hundred.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.process import on_all_cores
from mifit.optim import geman_mcclure
from mifit.optim.systems import DenseSystem
from mifit.stages.geometry.images import SmoothImage
from mifit.stages.geometry.landmarks import LandmarkTerm
from mifit.stages.geometry.normal import NormalEquations, prior_energy, square
from mifit.stages.geometry.parameters import Frames, Layout
from mifit.stages.geometry.points import PointBasis, geometry_columns, project


@dataclass(frozen=True)
class TextureView:
    """One image and the surface points that it sees.

    Attributes
    ----------
    step : int
    camera : Camera
    image : SmoothImage
        Log-texture.
    points : (n,) int
        Indices of the seen points, ascending.
    weight : (n,) float
        How much each counts: the cosine of the view angle, 0..1.
    basis : PointBasis
        Of the seen points.
    """

    step: int
    camera: Camera
    image: SmoothImage
    points: NDArray
    weight: NDArray
    basis: PointBasis


@dataclass(frozen=True)
class ConsistencyProblem:
    """Spread of the log-texture of surface points over images, landmarks, priors.

    Attributes
    ----------
    count : int
        Number of surface points N.
    noise : float
        Standard deviation of the log-texture between images.
    robust : float
        Residual, in units of ``noise``, where Geman and McClure's penalty turns: highlights, hair, occlusion.
    independence : float
        Neighbouring points share pixels; each point's squared residual counts this much.
    known : (N, C) values and (N,) weights, optional
        What other images, not in ``views``, have shown of the points: one more, constant view.
    """

    layout: Layout
    frames: Frames
    count: int
    views: tuple[TextureView, ...]
    noise: float
    robust: float
    independence: float
    landmarks: LandmarkTerm
    priors: dict[str, float]
    known: tuple[NDArray, NDArray] | None = None
    _last: dict[bytes, list] = field(default_factory=dict, init=False, repr=False, compare=False)

    def _observe(self, x: NDArray) -> list:
        """Per view: projection, values, gradients and weights (0 where the image has no valid pixel).

        The last ones are kept: where a step's energy is accepted its equations are wanted next.
        """
        key = x.tobytes()
        if key not in self._last:
            self._last.clear()
            self._last[key] = self._look(x)
        return self._last[key]

    def _look(self, x: NDArray) -> list:
        """`_observe`, where it isn't known yet."""

        def observe(view: TextureView) -> tuple:
            points = view.basis.evaluate(x[self.layout.at("identity")], x[self.layout.at("expression", view.step)])
            projection = project(view.camera, self.frames.pose(self.layout, x, view.step), points)
            values, slope, inside = view.image.sample(projection.pixels)
            weight = np.where(inside & (projection.depth > 0), view.weight, 0.0)
            return view, projection, values.astype(np.float64), slope, weight

        return on_all_cores(observe, self.views)

    def _reweighted(self, observed: list) -> tuple[NDArray, NDArray, list[NDArray], float]:
        """Robust mean of each point over its views by three rounds of reweighting, started at the median view.

        Returns
        -------
        mean (N, C), total weight (N,), weights per view, energy
        """
        channels = observed[0][2].shape[1] if observed else 3
        mean = np.zeros((self.count, channels))
        total = np.zeros(self.count)
        weights = [weight for *_, weight in observed]
        energy = 0.0
        for _ in range(4):
            mean[:], total[:] = self._known_sum(channels)
            for (view, _, values, _, _), weight in zip(observed, weights, strict=True):
                total[view.points] += weight
                mean[view.points] += weight[:, None] * values
            mean /= np.maximum(total, 1e-12)[:, None]
            energy, weights = 0.0, []
            if self.known is not None:
                energy = float((self.known[1] * ((self.known[0] - mean) ** 2).sum(1)).sum())
            for view, _, values, _, base in observed:
                squared = ((values - mean[view.points]) ** 2).sum(1)
                rho, robust = geman_mcclure(squared, self.robust * self.noise * np.sqrt(channels))
                energy += float((base * rho).sum())
                weights.append(base * robust)
        total[:] = self._known_sum(channels)[1]
        for (view, *_), weight in zip(observed, weights, strict=True):
            total[view.points] += weight
        return mean, total, weights, energy * self.independence / self.noise**2

    def _known_sum(self, channels: int) -> tuple[NDArray, NDArray]:
        """Weighted sum and weight of what is known of each point beforehand."""
        if self.known is None:
            return np.zeros((self.count, channels)), np.zeros(self.count)
        return self.known[1][:, None] * self.known[0], self.known[1]

    def texture(self, x: NDArray) -> tuple[NDArray, NDArray]:
        """The eliminated values a (N, C) at x and the weight (N,) behind each."""
        mean, total, *_ = self._reweighted(self._observe(x))
        return mean, total

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        return {
            "consistency": self._reweighted(self._observe(x))[3],
            "landmarks": self.landmarks.energy(self.layout, self.frames, x),
            "prior": prior_energy(self.layout, x, self.priors),
        }

    def linearize(self, x: NDArray) -> DenseSystem:
        """Normal equations with the free values eliminated."""
        layout = self.layout
        observed = self._observe(x)
        mean, total, weights, _ = self._reweighted(observed)
        factor = self.independence / self.noise**2
        equations = NormalEquations(layout)
        channels = mean.shape[1]
        s = layout.shared_size
        # rows of the eliminated unknowns: sum over views of w J, in all columns
        pooled = np.zeros((self.count, channels, layout.size), dtype=np.float32)

        def columns(number: int) -> tuple[NDArray, NDArray, NDArray]:
            """Products of a view's rows, and its part of the pooled ones."""
            view, projection, values, slope, _ = observed[number]
            shared, local = geometry_columns(layout, view.basis, projection, slope)
            row_weight = np.repeat(weights[number], channels)
            residual = (values - mean[view.points]).reshape(-1)
            products = square(shared, local, residual, factor * row_weight)
            w = row_weight.astype(np.float32)[:, None]
            n = len(view.points)
            return products, (w * shared).reshape(n, channels, s), (w * local).reshape(n, channels, local.shape[-1])

        for view, found in zip(self.views, on_all_cores(columns, range(len(self.views))), strict=True):
            products, shared, local = found
            equations.add_square(view.step, products)
            pooled[view.points, :, :s] += shared
            pooled[view.points, :, layout.local(view.step)] += local
        self.landmarks.accumulate(equations, layout, self.frames, x)
        equations.add_priors(x, self.priors)
        system = equations.system()
        used = total > 1e-9
        rows = pooled[used]
        rows *= np.sqrt(factor / total[used]).astype(np.float32)[:, None, None]
        rows = rows.reshape(-1, layout.size)
        return DenseSystem(system.dense() - rows.T @ rows, system.gradient)

    def spread(self, x: NDArray) -> float:
        """Robust standard deviation of the log-texture between images at x: the noise level."""
        observed = self._observe(x)
        mean, *_ = self._reweighted(observed)
        residual = [(values - mean[view.points])[weight > 0] for view, _, values, _, weight in observed]
        together = np.abs(np.concatenate(residual)) if residual else np.zeros(0)
        return max(1.4826 * float(np.median(together)), 1e-3) if together.size else 1.0
