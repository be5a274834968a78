"""Image formation at observed surface points: what maps and lighting make of a texel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.formation import Appearance
from mifit.appearance.illumination import DistantLight, Illumination
from mifit.appearance.lobe import Lobe
from mifit.appearance.models import ShadingModel
from mifit.appearance.occlusion import MeshPoints, OccludingMesh, Occlusion, VertexTransfer
from mifit.core.process import blocks
from mifit.sampling.observations import Observations


@dataclass(frozen=True)
class Forward:
    """An appearance on the meshes of the timesteps.

    Attributes
    ----------
    appearance : Appearance
        Model and lobe; its illumination says how many bands and which compact lights there are, not how bright.
    meshes : tuple of OccludingMesh
        One per timestep.
    gloss : float
        The most that is expected of the specular albedo; 0 without specular reflection.
    """

    appearance: Appearance
    meshes: tuple[OccludingMesh, ...] = field(default=(), repr=False)
    gloss: float = 1.0

    @classmethod
    def of(cls, model: ShadingModel, order: int, lobe: Lobe, meshes: tuple[OccludingMesh, ...] = ()) -> Forward:
        """A model under smooth light of some bands."""
        return cls(Appearance(model, Illumination.dark(order), lobe), meshes)

    @property
    def model(self) -> ShadingModel:
        """The shading model."""
        return self.appearance.model

    @property
    def order(self) -> int:
        """Bands of the smooth light."""
        return self.appearance.order

    @property
    def lobe(self) -> Lobe:
        """The specular lobe."""
        return self.appearance.lobe

    @property
    def lights(self) -> tuple[DistantLight, ...]:
        """The compact lights."""
        return self.appearance.illumination.lights

    @property
    def unknowns(self) -> int:
        """Number K of lighting unknowns per channel: coefficients, and a colour per compact light."""
        return self.order**2 + len(self.lights)

    @property
    def dark(self) -> NDArray[np.float64]:
        """(K, 3) no light."""
        return np.zeros((self.unknowns, 3))

    def under(self, light: NDArray, ambient: float = 0.0) -> Appearance:
        """The appearance under lighting unknowns (K, 3)."""
        illumination = self.appearance.illumination.with_unknowns(light, ambient)
        return replace(self.appearance, illumination=illumination)

    def with_lobe(self, lobe: Lobe) -> Forward:
        """The same with another lobe."""
        return replace(self, appearance=replace(self.appearance, lobe=lobe))

    def with_lights(self, lights: tuple[DistantLight, ...]) -> Forward:
        """The same with other compact lights."""
        return replace(self, appearance=replace(self.appearance, illumination=Illumination.dark(self.order, lights)))

    def transfers(self, seen: Observations, light: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular transfer vectors (M, K), at unit albedo, of the observations that count.

        ``light`` (K, 3) matters to models that turn with the lighting alone.
        """
        diffuse, specular = self.under(light).transfers(*_flat(seen), self.occlusion(seen))
        return diffuse, self._gloss(specular)

    def shade(self, seen: Observations, light: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular radiance (N, J, 3) at unit albedo, without ambient; 0 where observations don't count."""
        diffuse, specular = (np.zeros((*seen.weight.shape, 3), np.float32) for _ in range(2))
        appearance = self.under(light)
        for rows in blocks(*seen.weight.shape):
            part = seen.take(rows)
            d, s = appearance.shade(*_flat(part), self.occlusion(part))
            diffuse[rows], specular[rows] = part.spread(d), part.spread(s)
        return diffuse, self._gloss(specular)

    def _gloss(self, specular: NDArray[np.float32]) -> NDArray[np.float32]:
        return specular if self.gloss else np.zeros_like(specular)

    def occlusion(self, seen: Observations) -> Occlusion:
        """Shadows at the observations that count, image after image of each texel."""
        if not (self.model.needs_shadows or self.lights):
            return Occlusion()
        steps = [self.appearance.trace(mesh, surface_points(seen, t)) for t, mesh in enumerate(self.meshes)]
        transfer, there = None, seen.weight > 0
        if self.model.needs_shadows:
            every = VertexTransfer.joined([s.transfer for s in steps if s.transfer is not None], seen.step)
            transfer = every.take(there.ravel())
        visible = tuple(
            np.stack(bits, axis=1)[:, seen.step][there] for bits in zip(*(s.visible for s in steps), strict=True)
        )
        return Occlusion(transfer, visible)

    def columns(self, seen: Observations, directions: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Diffuse and specular radiance (M, D) of the observations that count, at unit albedo per unit of irradiance
        from single directions (D, 3).

        Shadows are traced, a ray each.
        """
        visible = np.empty((len(directions), len(seen.weight), len(self.meshes)), bool)
        for first in range(0, len(directions), 32):
            part = directions[first : first + 32]
            number = np.arange(len(part), dtype=np.uint32)[:, None]
            for t, mesh in enumerate(self.meshes):
                bits = mesh.scene.open_towards(seen.point[:, t], seen.normal[:, t], part)
                visible[first : first + 32, :, t] = (bits >> number) & 1
        shown = visible[..., seen.step][:, seen.weight > 0]
        diffuse, specular = self.appearance.light_transfer(*_flat(seen), directions, shown)
        return diffuse.T, specular.T


def _flat(seen: Observations) -> tuple[NDArray, NDArray]:
    """Normals and views (M, 3) of the observations that count."""
    there = seen.weight > 0
    return seen.image_normal[there], seen.view[there]


def surface_points(seen: Observations, step: int) -> MeshPoints:
    """The texels on the mesh of one timestep."""
    return MeshPoints(seen.point[:, step], seen.normal[:, step], seen.face, seen.barycentric)
