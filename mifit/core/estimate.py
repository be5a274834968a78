"""What each stage hands to the next: frozen records of plain arrays.

Lengths are in the capture's units, colours linear Rec. 709. World space is the capture's; object space is the
morphable model's: ``world = scale * rotation @ object + translation``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.diagnostics import Diagnostic
from mifit.core.files import Document
from mifit.core.photometry import Photometry

if TYPE_CHECKING:
    from mifit.appearance.illumination import DistantLight, Illumination
    from mifit.appearance.lobe import Lobe


@dataclass(frozen=True)
class Report:
    """How a stage ended.

    ``outcome`` is a value of ``optim.Outcome``, or ``"inconsistent"`` where the images contradict one another or the
    capture has a named fault; ``energies`` per term over the iterations (same length each); ``seconds`` of wall time;
    ``details`` are further figures for people, JSON values only.
    """

    outcome: str
    energies: dict[str, list[float]] = field(default_factory=dict)
    seconds: float = 0.0
    warnings: tuple[Diagnostic, ...] = ()
    details: Document = field(default_factory=dict)

    def noting(self, **details: object) -> Report:
        """The report with further details; those of the same names are replaced."""
        return replace(self, details={**self.details, **details})

    def after(self, seconds: float, phase: Document, warnings: Sequence[Diagnostic] = ()) -> Report:
        """The report with one more phase."""
        more = replace(self, seconds=self.seconds + seconds, warnings=(*self.warnings, *warnings))
        return more.noting(phases=[*self.details.get("phases", []), phase])

    def document(self) -> Document:
        """As it stands in ``result.json``."""
        return {
            "status": self.outcome,
            "seconds": self.seconds,
            "energies": self.energies,
            "warnings": [found.document() for found in self.warnings],
            "details": self.details,
        }

    def phase(self, name: str) -> Document:
        """What the last phase of a name told; empty where there is none."""
        found = [phase for phase in self.details.get("phases", []) if phase["name"] == name]
        return found[-1] if found else {}

    def detail(self, name: str) -> Document:
        """A group of details; empty where there is none."""
        return self.details.get(name) or {}


@dataclass(frozen=True)
class GeometryEstimate:
    """Stage 1: morphable-model fit.

    Coefficients ``identity`` (Ki,) and ``albedo`` (Ka,), which timesteps share, and ``expression`` (T, Ke) are in
    standard deviations. ``rotation`` (T, 3, 3), ``translation`` (T, 3) and ``scale`` take object to world space, in
    which the ``vertices`` (T, V, 3) are. ``vertex_albedo`` (V, 3) is the fitted model's linear reflectance; ``shading``
    (9, 3) the paper's l_k in I_d = C_d * sum l_k phi_k(n): SH coefficients in world axes, basis of ``core.sh``;
    ``ambient`` the paper's I_a, in linear image units. ``photometry`` are gains of cameras and exposures of images,
    which are divided out when a capture is read for this fit. ``displacement`` (V, 3) is the neutral surface beyond the
    model's span, object space: ``model.mean`` plus this is what coefficients add to; None where the surface is the
    model's. ``landmark_noise`` is the standard deviation of a landmark coordinate, pixels: of the detector as set, or
    of residuals where that is more. ``lights`` are the compact lights that shading showed, without colour; None where
    it wasn't looked at.
    """

    timesteps: tuple[int, ...]
    identity: NDArray
    albedo: NDArray
    expression: NDArray
    rotation: NDArray
    translation: NDArray
    scale: float
    vertices: NDArray
    vertex_albedo: NDArray
    shading: NDArray
    ambient: float
    report: Report
    photometry: Photometry = field(default_factory=Photometry)
    displacement: NDArray | None = None
    landmark_noise: float = 0.0
    lights: tuple[DistantLight, ...] | None = None

    def index(self, timestep: int) -> int:
        """Position of a timestep in the per-timestep arrays; KeyError when it was not fitted."""
        if timestep not in self.timesteps:
            raise KeyError(timestep)
        return self.timesteps.index(timestep)

    def at(self, timesteps: Sequence[int]) -> GeometryEstimate:
        """The fit of some of its timesteps, in the given order; KeyError as in `index`."""
        rows = [self.index(t) for t in timesteps]
        return replace(
            self,
            timesteps=tuple(timesteps),
            expression=self.expression[rows],
            rotation=self.rotation[rows],
            translation=self.translation[rows],
            vertices=self.vertices[rows],
        )


@dataclass(frozen=True)
class ReflectanceEstimate:
    """Stage 2: maps shared by all timesteps, and lighting.

    ``diffuse`` (S, S, 3) and ``specular`` (S, S) are albedo, the paper's C_d + delta C_d and C_s, 0..1; ``confidence``
    (S, S) is 0 where never seen, 1 where seen often and well, and ``specular_confidence`` (S, S) 0 as well where a
    texel was seen but told nothing of its specular albedo. ``shading_model``, a name of ``appearance.models``, says how
    maps, ``lobe`` and ``illumination`` (smooth radiance, compact lights, ambient) make an image. ``labels`` (H, W) are
    what images of the fit show (`core.estimate.Label`), each of the camera and timestep in ``labelled``; empty where
    that wasn't looked for. ``residual_shading`` (S, S, 3) is the factor of the diffuse light of the capture that mesh
    and lighting don't explain: relief finer than the mesh, edges of shadows. It is None where nothing was parted from
    the albedo, and under any other light. ``hair`` is the colour of the hair that is painted on the scalp; None where
    images show none.
    """

    diffuse: NDArray
    specular: NDArray
    confidence: NDArray
    illumination: Illumination
    lobe: Lobe
    shading_model: str
    report: Report
    labels: tuple[NDArray, ...] = ()
    labelled: tuple[tuple[str, int], ...] = ()
    residual_shading: NDArray | None = None
    specular_confidence: NDArray | None = None
    hair: tuple[float, ...] | None = None

    @property
    def lit_diffuse(self) -> NDArray:
        """(S, S, 3) what the diffuse light of this illumination is multiplied by: albedo times residual shading."""
        return self.diffuse if self.residual_shading is None else self.diffuse * self.residual_shading

    def label(self, camera: str, timestep: int) -> NDArray | None:
        """The labels of one image; None where there are none."""
        key = (camera, timestep)
        return self.labels[self.labelled.index(key)] if key in self.labelled else None


@dataclass(frozen=True)
class NormalsEstimate:
    """Stage 3: refined normals per timestep.

    ``normal_object`` (T, S, S, 3) are unit normals in object space, (0, 0, 0) outside the covered texels. ``tracked``
    has the timesteps that were tracked after the fit, each with the digest of the images that it was tracked in.
    """

    timesteps: tuple[int, ...]
    normal_object: NDArray
    report: Report
    tracked: Mapping[int, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ResidualEstimate:
    """What the images of fitted timesteps show beyond reflectance and light (`stages.find_residual`).

    ``radiance`` (T, S, S, 3) is linear, added to what the model shows of a texel, alike towards all sides; either
    sign, 0 where nothing is seen.
    """

    timesteps: tuple[int, ...]
    radiance: NDArray
    report: Report

    def at(self, timestep: int) -> NDArray | None:
        """(S, S, 3) of one timestep; None for one that has none."""
        return self.radiance[self.timesteps.index(timestep)] if timestep in self.timesteps else None


@dataclass(frozen=True)
class MeshEstimate:
    """Meshes with the refined normals as shape: ``vertices`` (T, V, 3) are world space."""

    timesteps: tuple[int, ...]
    vertices: NDArray
    report: Report


class Label(IntEnum):
    """Grey value of each kind of pixel in a mask's file; those above mid-grey are used, as in ``mask_path``."""

    BACKGROUND = 0
    OCCLUDER = 32
    MOUTH = 160
    EYES = 208
    SKIN = 255


def hidden(labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels (H, W) at which something hides the face."""
    return np.asarray(labels == Label.OCCLUDER)
