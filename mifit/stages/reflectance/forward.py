"""The image-formation model of stage 2 at observed surface points: what maps and lighting make of a texel."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.keylight import KeyLight
from mifit.core.mesh import interpolate
from mifit.stages.observations import Observations

if TYPE_CHECKING:
    from mifit.render.gbuffer import SurfaceScene

CHUNK = 1 << 19
"""Points shaded at a time: bounds the memory of the basis functions."""


@dataclass(frozen=True)
class Forward:
    """A shading model with its settings; the shading itself is `render.shading`.

    Attributes
    ----------
    model : str
        ``"paper"``, ``"prefiltered"`` or ``"shadowed"``.
    order : int
        Bands of the lighting.
    exponent : float
        Blinn-Phong exponent.
    fresnel : float or None
        Rise of the lobe towards grazing views; None for plain Blinn-Phong.
    traced : tuple of (V, B*B) float32
        Shadowed diffuse transfer per timestep, at the vertices; empty unless ``shadowed``.
    faces : (F, 3) int
    key : KeyLight, optional
        A compact light; its irradiance is the last row of the lighting, not what it holds itself.
    scenes : tuple of SurfaceScene
        Meshes of the timesteps, for the key light's shadows.
    """

    model: str
    order: int
    exponent: float
    fresnel: float | None = None
    traced: tuple[NDArray[np.float32], ...] = field(default=(), repr=False)
    faces: NDArray[np.int32] | None = field(default=None, repr=False)
    key: KeyLight | None = None
    scenes: tuple[SurfaceScene, ...] = field(default=(), repr=False)

    @property
    def lights(self) -> int:
        """Number K of lighting unknowns per channel: coefficients, and the key light's irradiance."""
        return self.order**2 + (self.key is not None)

    def transfers(self, seen: Observations, radiance: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse (N, J, K) and specular (N, J, K) transfer vectors of observations at unit albedo.

        With a key light its transfer is the last of the K.

        ``radiance`` matters to the paper's model alone: its dominant direction is held fixed.
        """
        from mifit.render.local import diffuse_matrix, specular_matrix

        n, j = seen.weight.shape
        steps = seen.normal.shape[1]
        traced = self.traced_at(seen)
        if traced is None:
            diffuse = diffuse_matrix(seen.normal.reshape(-1, 3), self.order).reshape(n, steps, -1)
        else:
            diffuse = traced
        diffuse = diffuse[:, seen.step]
        rows = diffuse.reshape(n * j, -1) if traced is not None else None
        specular = specular_matrix(
            seen.image_normal.reshape(-1, 3),
            seen.view.reshape(-1, 3),
            radiance[: self.order**2],
            self.exponent,
            self.model,
            rows,
            fresnel=self.fresnel,
        )
        specular = specular.reshape(n, j, -1)
        if self.key is None:
            return diffuse, specular
        matt, glossy = self.key_columns(seen)
        return np.append(diffuse, matt[..., None], axis=2), np.append(specular, glossy[..., None], axis=2)

    def shade(self, seen: Observations, radiance: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular reflection (N, J, 3) at unit albedo, without ambient."""
        from mifit.render.local import shade_points

        n, j = seen.weight.shape
        shade, glint = np.empty((n, j, 3), np.float32), np.empty((n, j, 3), np.float32)
        step = max(1, CHUNK // j)
        for start in range(0, n, step):
            part = seen.take(slice(start, start + step))
            normal, view = part.image_normal.reshape(-1, 3), part.view.reshape(-1, 3)
            traced = self.traced_at(part)
            ones = np.ones((len(normal), 3), np.float32)
            d, s = shade_points(
                normal,
                view,
                ones,
                ones[:, 0],
                radiance[: self.order**2],
                0.0,
                self.exponent,
                self.model,
                None if traced is None else traced[:, part.step].reshape(len(normal), -1),
                fresnel=self.fresnel,
            )
            d, s = d.reshape(-1, j, 3), s.reshape(-1, j, 3)
            if self.key is not None:
                matt, glossy = self.key_columns(part)
                irradiance = radiance[-1].astype(np.float32)
                d, s = d + matt[..., None] * irradiance, s + glossy[..., None] * irradiance
            shade[start : start + step], glint[start : start + step] = d, s
        return shade, glint

    def open_towards(self, seen: Observations, directions: NDArray) -> NDArray[np.uint32]:
        """(N, T) which of some directions the texels see, a bit each."""
        steps = [s.open_towards(seen.point[:, t], seen.normal[:, t], directions) for t, s in enumerate(self.scenes)]
        return np.stack(steps, axis=1)

    def key_columns(
        self, seen: Observations, open_sky: NDArray[np.uint32] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular reflection (N, J) at unit albedo per unit of the key light's irradiance.

        Shadows are traced unless (N, T) bits tell which of the light's directions the texels see.
        """
        from mifit.render.local import key_columns

        assert self.key is not None
        directions = self.key.samples()
        if open_sky is None:
            open_sky = self.open_towards(seen, directions)
        n, j = seen.weight.shape
        matt, glossy = key_columns(
            seen.image_normal.reshape(-1, 3),
            seen.view.reshape(-1, 3),
            open_sky[:, seen.step].ravel(),
            directions,
            self.exponent,
            self.fresnel,
        )
        return matt.reshape(n, j), glossy.reshape(n, j)

    def traced_at(self, seen: Observations) -> NDArray[np.float32] | None:
        """(N, T, K) traced transfer vectors at the texels, or None."""
        if self.model != "shadowed":
            return None
        assert self.faces is not None
        return np.stack([interpolate(t, self.faces, seen.face, seen.barycentric) for t in self.traced], axis=1)
