"""Sums of a fixed size per texel that hold all that any number of frames said about it.

About the maps m0 and normals n0 that a result starts from, the image of a texel is nearly linear in what is unknown:

    I_c - ambient = a_c D_c + s S_c + (a0_c dD_c + s0 dS_c) . x

with the diffuse and specular radiance D, S at unit albedo under the known light, their derivatives by the two
tangent-plane offsets x of the normal (`core.bend`), the diffuse albedo a and the specular one s. The normal equations
of these six unknowns are added up over frames and cameras; sums don't know in which order frames came.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Information:
    """Normal equations of N texels: half the gradient of the squared residuals is ``H u - h``.

    Attributes
    ----------
    dd, ds, dr : (N, 3)
        Per channel: D^2, D S and D times the observed radiance, each times the observation's weight and summed.
    ss, sr : (N,)
        S^2, and S times the observed radiance, over all channels.
    dx : (N, 3, 2), sx : (N, 2)
        Between albedos and normal.
    xx : (N, 3), xr : (N, 2)
        Of the normal: entries 00, 01, 11; and with the observed radiance.
    square : (N,)
        Observed radiance squared: what remains of it is the residual.
    weight : (N,)
        Observations, as far as they count.
    quality : (N,)
        Sum of the cosines at which images measured the texel.
    frames : (N,)
        Number of frames that measured the texel.
    """

    dd: NDArray[np.float64]
    ds: NDArray[np.float64]
    dr: NDArray[np.float64]
    ss: NDArray[np.float64]
    sr: NDArray[np.float64]
    dx: NDArray[np.float64]
    sx: NDArray[np.float64]
    xx: NDArray[np.float64]
    xr: NDArray[np.float64]
    square: NDArray[np.float64]
    weight: NDArray[np.float64]
    quality: NDArray[np.float64]
    frames: NDArray[np.float64]

    @classmethod
    def nothing(cls, count: int) -> Information:
        """Of texels that no frame has shown yet."""
        shapes = {"dd": (3,), "ds": (3,), "dr": (3,), "dx": (3, 2), "sx": (2,), "xx": (3,), "xr": (2,)}
        return cls(**{f.name: np.zeros((count, *shapes.get(f.name, ()))) for f in fields(cls)})

    def add(
        self,
        rows: NDArray,
        target: NDArray,
        weight: NDArray,
        diffuse: NDArray,
        specular: NDArray,
        slope: NDArray,
        cosine: NDArray,
    ) -> None:
        """Add one image of n of the texels, in place.

        Parameters
        ----------
        rows : (n,) int
            Which texels; none twice.
        target, weight : (n, 3)
            Observed radiance without ambient, and the weight of its squared residual; 0 where nothing is measured.
        diffuse, specular : (n, 3)
            Radiance at unit albedo.
        slope : (n, 3, 2)
            Derivative of the image by the normal's offsets.
        cosine : (n,)
            Of the angle to the camera times the trust in the observation; 0 where nothing is measured.
        """
        wd, ws, wt = weight * diffuse, weight * specular, weight * target
        self.dd[rows] += wd * diffuse
        self.ds[rows] += wd * specular
        self.dr[rows] += wd * target
        self.ss[rows] += (ws * specular).sum(1)
        self.sr[rows] += (ws * target).sum(1)
        self.dx[rows] += wd[..., None] * slope
        self.sx[rows] += (ws[..., None] * slope).sum(1)
        for k, (i, j) in enumerate(((0, 0), (0, 1), (1, 1))):
            self.xx[rows, k] += (weight * slope[..., i] * slope[..., j]).sum(1)
        self.xr[rows] += (wt[..., None] * slope).sum(1)
        self.square[rows] += (wt * target).sum(1)
        self.weight[rows] += weight.mean(1)
        self.quality[rows] += cosine

    def residual(self, diffuse: NDArray, specular: NDArray, offsets: NDArray) -> NDArray[np.float64]:
        """(N,) sum of weighted squared residuals at albedos (N, 3), (N,) and offsets (N, 2)."""
        a, s, x = diffuse, specular, offsets
        square = self.square + (self.dd * a * a - 2 * self.dr * a).sum(1) + self.ss * s * s - 2 * self.sr * s
        square += 2 * s * (self.ds * a).sum(1)
        square += 2 * np.einsum("nc,nci,ni->n", a, self.dx, x) + 2 * s * (self.sx * x).sum(1)
        square += self.xx[:, 0] * x[:, 0] ** 2 + 2 * self.xx[:, 1] * x[:, 0] * x[:, 1] + self.xx[:, 2] * x[:, 1] ** 2
        return np.maximum(square - 2 * (self.xr * x).sum(1), 0.0)
