"""Normal equations of the lighting beside the maps: sums over the observations, priors, elimination of the texels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SPECULAR_SPREAD = 0.15
"""Standard deviation of the specular albedo over a face, relative to its median."""
SPECULAR_LIMIT = 0.03
"""Specular albedo expected of skin where the images are too few to tell: at the most what it reflects at normal
incidence (index of refraction 1.4)."""
FEW_IMAGES = 4
"""Images of a texel from which its four albedos are told by the images."""


@dataclass(frozen=True)
class LightingProblem:
    """n texels seen in J images, K lighting coefficients.

    Attributes
    ----------
    colour : (n, J, 3)
        Observed linear colour.
    weight : (n, J, 3)
        Weight of each observation; 0 where there is none.
    clipped : (n, J) bool
        Observations that are lower bounds only.
    diffuse : (n, J, K)
        Transfer vectors of the diffuse reflection at unit albedo.
    specular : (n, J, K)
        Transfer vectors of the specular reflection at unit albedo.
    albedo : (n, 3)
        Diffuse albedo expected by the morphable model.
    order : int
        Bands B of the smooth light: the first B*B of the K; the others are the compact lights.
    """

    colour: NDArray[np.float32]
    weight: NDArray[np.float32]
    clipped: NDArray[np.bool_]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    albedo: NDArray[np.float32]
    order: int


def specular_pull(expected: float, sigma: float) -> float:
    """Weight that ties a texel's specular albedo to the expected one, beside squared residuals of deviation `sigma`."""
    return (sigma / (SPECULAR_SPREAD * max(expected, 1e-3))) ** 2


def expected_specular(specular: NDArray, seen: NDArray) -> float:
    """Specular albedo to expect of a texel, given those of others (n,) and which images see them (n, J).

    Two or three images of a still head leave it open how much of the broad reflection is specular.
    """
    found = float(np.median(specular))
    images = float(np.median(seen.sum(axis=1)))
    return min(found, SPECULAR_LIMIT) if images < FEW_IMAGES else found


@dataclass(frozen=True)
class LightingPriors:
    """Weights of what is assumed where the images are silent, relative to the data's own scale.

    Attributes
    ----------
    roughness : float
        Penalty on (l (l + 1))^2 times the squared coefficients of band l.
    negative : float
        Penalty on squared negative radiance.
    albedo : float
        Pull of the diffuse albedo to the morphable model's: fixes the gauge between albedo and lighting.
    specular : float
        Pull of each texel's specular albedo to the expected one, at the least; see `SPECULAR_SPREAD`.
    """

    roughness: float = 1e-7
    negative: float = 0.5
    albedo: float = 1e-2
    specular: float = 2e-2


PRIORS = LightingPriors()
"""The usual weights."""


@dataclass(frozen=True)
class LightingStep:
    """A step of lighting (K, 3), ambient, diffuse (n, 3) and specular albedo (n,)."""

    light: NDArray[np.float64]
    ambient: float
    diffuse: NDArray[np.float32]
    specular_albedo: NDArray[np.float32]


@dataclass
class LightingEquations:
    """Normal equations: lighting (3K) and ambient (1) against the texels' own blocks of four."""

    system: NDArray[np.float64]  # (3K + 1, 3K + 1)
    right: NDArray[np.float64]
    own: NDArray[np.float32]  # (n, 4, 4)
    own_right: NDArray[np.float32]
    cross: NDArray[np.float32]  # (n, 4, 3K + 1)

    @classmethod
    def accumulate(
        cls,
        problem: LightingProblem,
        diffuse: NDArray,
        specular_albedo: NDArray,
        diffuse_light: NDArray,
        specular_light: NDArray,
        residual: NDArray,
        weight: NDArray,
    ) -> LightingEquations:
        """Sums over the observations (n, J, 3) of a problem, linearised about maps and shading."""
        n, _, k = problem.specular.shape
        system, right = np.zeros((3 * k + 1, 3 * k + 1)), np.zeros(3 * k + 1)
        own, own_right = np.zeros((n, 4, 4), np.float32), np.zeros((n, 4), np.float32)
        cross = np.zeros((n, 4, 3 * k + 1), np.float32)
        for c in range(3):
            block = slice(c * k, (c + 1) * k)
            rows = diffuse[:, None, None, c] * problem.diffuse + specular_albedo[:, None, None] * problem.specular
            w, r = weight[..., c], residual[..., c]
            jd, js = diffuse_light[..., c], specular_light[..., c]
            weighted = rows * w[..., None]
            flat = weighted.reshape(-1, k)
            system[block, block] = flat.T @ rows.reshape(-1, k)
            system[block, -1] = system[-1, block] = flat.sum(0)
            system[-1, -1] += w.sum()
            right[block] = flat.T @ r.ravel()
            right[-1] += (w * r).sum()
            own[:, c, c] = (w * jd * jd).sum(1)
            own[:, c, 3] = own[:, 3, c] = (w * jd * js).sum(1)
            own[:, 3, 3] += (w * js * js).sum(1)
            own_right[:, c] = (w * jd * r).sum(1)
            own_right[:, 3] += (w * js * r).sum(1)
            cross[:, c, block] = np.matmul(jd[:, None], weighted)[:, 0]
            cross[:, 3, block] = np.matmul(js[:, None], weighted)[:, 0]
            cross[:, c, -1] = (w * jd).sum(1)
            cross[:, 3, -1] += (w * js).sum(1)
        return cls(system, right, own, own_right, cross)

    def add_priors(
        self,
        priors: LightingPriors,
        light: NDArray,
        diffuse: NDArray,
        specular_albedo: NDArray,
        albedo: NDArray,
        stiffness: NDArray,
        sphere_basis: NDArray,
        sigma: float,
        expected: float,
    ) -> None:
        """Add the quadratic penalties of `LightingPriors` beside residuals of standard deviation `sigma`.

        `expected` is the specular albedo that texels are pulled to.
        """
        k = len(stiffness)
        scale = float(np.trace(self.system[:-1, :-1])) / (3 * k)
        for c in range(3):
            pull = priors.albedo * float(np.median(self.own[:, c, c]))
            self.own[:, c, c] += pull
            self.own_right[:, c] += pull * (albedo[:, c] - diffuse[:, c])
        pull = max(priors.specular * float(np.median(self.own[:, 3, 3])), specular_pull(expected, sigma))
        self.own[:, 3, 3] += pull
        self.own_right[:, 3] += pull * (expected - specular_albedo)
        radiance = sphere_basis @ light
        for c in range(3):
            block = slice(c * k, (c + 1) * k)
            negative = radiance[:, c] < 0
            rows = sphere_basis[negative]
            pull = priors.negative * scale * 4.0 * np.pi / len(sphere_basis)
            smooth = priors.roughness * scale * stiffness
            self.system[block, block] += pull * rows.T @ rows + np.diag(smooth)
            self.right[block] -= pull * rows.T @ radiance[negative, c] + smooth * light[:, c]

    def eliminate(self, count: int, damping: float) -> tuple[NDArray, NDArray, NDArray]:
        """Inverse blocks of the texels (n, 4, 4), and what remains for the first ``count`` lights."""
        diagonal = np.einsum("nii->ni", self.own)
        floor = 1e-6 * float(np.median(diagonal)) + 1e-12
        damped = self.own + np.eye(4, dtype=np.float32) * (damping * diagonal + floor)[:, :, None]
        inverse = np.linalg.inv(damped)
        cross = self.cross[:, :, :count]
        eliminated = np.matmul(inverse, cross)
        own_diagonal = np.diag(self.system)[:count]
        reduced = self.system[:count, :count] - cross.reshape(-1, count).T @ eliminated.reshape(-1, count)
        reduced += np.diag(damping * own_diagonal + 1e-8 * own_diagonal.mean())
        return inverse, reduced, self.right[:count] - np.einsum("nak,na->k", eliminated, self.own_right)

    def solve(self, with_ambient: bool, damping: float) -> LightingStep:
        """Eliminate the texels, solve for lighting and ambient, and substitute back."""
        size = len(self.right)
        count = size if with_ambient else size - 1
        inverse, reduced, right = self.eliminate(count, damping)
        move = np.linalg.solve(reduced, right)
        left = self.own_right - self.cross[:, :, :count] @ move.astype(np.float32)
        own_move = np.einsum("nab,nb->na", inverse, left)
        light = move[: size - 1].reshape(3, -1).T
        return LightingStep(light, float(move[-1]) if with_ambient else 0.0, own_move[:, :3], own_move[:, 3])
