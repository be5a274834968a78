"""``mifit.refine``: all frames of a video make the surface, the maps and the normals of a result sharper.

The surface comes first (`resurfacing`), since what is kept of a frame is tied to it. Then every frame is added to
sums of a fixed size per texel (`stages.absorb`) and forgotten: memory doesn't grow with the number of frames, and their
order doesn't matter.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

import numpy as np
from numpy.typing import NDArray

from mifit import cache
from mifit.config import GeometryConfig, ReflectanceConfig, ResidualConfig, from_mapping
from mifit.core.bend import bend, texel_neighbours
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate, Report, ResidualEstimate
from mifit.core.mesh import interpolate, normalize
from mifit.core.rows import Rows
from mifit.core.threads import one_blas_thread
from mifit.core.uv import TexelMap
from mifit.errors import ConvergenceError, InputError
from mifit.extras.absorb.frame import Absorber, FrameFit, carried_offsets
from mifit.extras.absorb.information import Information
from mifit.extras.absorb.solve_sums import Solved, solve_sums
from mifit.extras.resurface import resurfaced
from mifit.progress import Progress, silent
from mifit.result.record import R, Result
from mifit.stages.find_residual import find_residual
from mifit.stages.normals.carried import CarriedTangents
from mifit.stages.observations import Surface
from mifit.stages.reflectance.fill import blend_unseen
from mifit.stages.reflectance.maps import Smoothness
from mifit.stages.reflectance.relief import part_relief
from mifit.stages.track import Follower
from mifit.tracking import mesh_refiner

if TYPE_CHECKING:
    from mifit.capture import Capture

POSE = ("expression", "rotation", "translation", "vertices")
EVERY = 8
"""Frames between two checkpoints."""
DISAGREES, COVERED, LEAST_COVERED, BLURRED = 3.0, 2.0, 0.1, 0.7
"""Of a frame that is left out, relative to the median of the fitted ones: residual above; outliers above, and at least
this part of the face; contrast of the detail below."""


@one_blas_thread()
def refine(
    result: R,
    capture: Capture,
    timesteps: Sequence[int] | None = None,
    seed: int = 0,
    progress: Progress = silent,
    checkpoints: str | Path | None = None,
) -> R:
    """Add what further frames show to the surface, the maps and the normals of a result.

    Parameters
    ----------
    result : Reconstruction
        With reflectance. The timesteps that it has geometry for enter as well.
    capture : Capture
        The one that was fitted.
    timesteps : sequence of int, optional
        Frames to add; default: all of the capture. Those that the result has no geometry for are followed from frame to
        frame and not kept.
    seed : int
        As in `track`.
    progress : Progress
        ``done`` counts frames.
    checkpoints : path, optional
        Folder in which the surface and the sums are kept while frames are added: a run that was stopped goes on from
        there.

    Returns
    -------
    Reconstruction
        With the timesteps of ``result``. ``reflectance.frames`` tells how many frames showed each texel,
        ``normals.report.details["refined"]`` which frames were added and which were left out, and why. Where six
        frames or more come to those that were fitted, on a surface beyond the model's span, the surface has been swept
        with up to sixteen of them and is kept where views of others predict one another better; the last of
        ``geometry.report.details["phases"]`` says so.

    Raises
    ------
    InputError
        A result without reflectance, or a timestep that the capture lacks.

    Notes
    -----
    Maps and normals are linearised about the result, and the weights of the observations are those that it gives them;
    neither depends on the frames added before.
    """
    wanted = sorted({*result.timesteps, *(capture.timesteps if timesteps is None else timesteps)})
    for timestep in wanted:
        if timestep not in capture.timesteps:
            known = ", ".join(map(str, capture.timesteps))
            raise InputError(f"timestep {timestep}: not in the capture; it has {known}")
    check_reflectance(result)
    folder, key = None if checkpoints is None else Path(checkpoints), ""
    if folder is not None:
        names = [camera.name for camera in result.cameras]
        key = cache.digest([_digest(result), capture.digest(names, wanted), wanted, seed])
    seen = result.seen(capture)
    result = resurfaced(result, seen, fitted_jointly(result), wanted, seed, progress, folder, key)
    refinement = Refinement(result, capture, seed)
    if folder is not None:
        refinement.restore(folder, key)
    order = [*refinement.fitted, *(t for t in wanted if t not in refinement.fitted)]
    for done, timestep in enumerate(order):
        progress("refine", done, len(order))
        if timestep not in refinement.fits:
            refinement.add(timestep)
            if folder is not None and (done + 1) % EVERY == 0:
                refinement.keep(folder, key)
    progress("refine", len(order), len(order))
    return refinement.refined()


@dataclass(frozen=True)
class _Kept:
    """What a checkpoint holds: the sums, how each frame agreed, and where the last one that was followed ended."""

    sums: tuple[NDArray, ...]
    fits: tuple[Any, ...]
    pose: tuple[NDArray, ...]


class Refinement(Generic[R]):
    """A refinement frame by frame: `add` frames, those of the fit first, and ask for the `refined` result at any time.

    Parameters
    ----------
    result, capture, seed
        As in `refine`.

    Attributes
    ----------
    fitted : list of int
        Timesteps that were fitted jointly. They say how well a frame has to agree, so they come first.
    fits : dict of int to FrameFit
        How each frame that was looked at agreed.
    left_out : dict of int to str
        Those that were not added, and why.

    Raises
    ------
    InputError
        A result without reflectance.
    """

    def __init__(self, result: R, capture: Capture, seed: int = 0) -> None:
        check_reflectance(result)
        assert result.reflectance is not None
        self._began = time.perf_counter()
        self._result, self._seed = result, seed
        self._capture = result.seen(capture)
        names = [camera.name for camera in result.cameras]
        size, model = len(result.reflectance.diffuse), result.model
        surface = Surface(self._capture, model, result.geometry.at(result.timesteps[:1]), names, size, whole=True)
        carried = CarriedTangents(model, surface.texels)
        offsets = carried_offsets(carried, result.geometry, result.normals, size, surface.texels.index)
        offsets[~surface.facial] = 0.0
        self._absorber = Absorber(self._capture, model, result.reflectance, offsets, names, surface, seed)
        self._information = Information.nothing(len(surface))
        self._last = result.geometry.at(result.timesteps[-1:])
        self._follower: Follower | None = None
        self.fitted = fitted_jointly(result)
        self.fits: dict[int, FrameFit] = {}
        self.left_out: dict[int, str] = {}

    def add(self, timestep: int) -> FrameFit:
        """Add a frame, or leave it out where it disagrees with what was known before."""

        def disagrees(fit: FrameFit) -> str:
            return "" if timestep in self.fitted else _disagreement(fit, [self.fits[t] for t in self.fitted])

        try:
            fit = self._absorber.absorb(self._information, self._geometry(timestep), disagrees)
            why = disagrees(fit)
        except ConvergenceError:
            fit, why = FrameFit(np.inf, 1.0, 0.0, 0.0), "lost the face"
        if why:
            self.left_out[timestep] = why
        self.fits[timestep] = fit
        return fit

    def refined(self) -> R:
        """The result with what the frames so far say."""
        images = (len(self.fits) - len(self.left_out)) * len(self._result.cameras)
        found = _solved(self._result, self._absorber, self._information, images)
        return self._with(found)

    def keep(self, folder: Path, key: str) -> None:
        """Write the sums so far, to be found again by the same key."""
        pose = tuple(getattr(self._last, name) for name in POSE)
        rows = tuple((t, *astuple(fit), self.left_out.get(t, "")) for t, fit in self.fits.items())
        sums = tuple(getattr(self._information, f.name) for f in fields(self._information))
        cache.save(folder, "refine", _Kept(sums, rows, pose), key)

    def restore(self, folder: Path, key: str) -> None:
        """Go on from the sums that `keep` wrote, where there are any of this key."""
        kept = cache.load(folder, "refine", _Kept, key)
        if kept is None:
            return
        self._information = Information(*(np.array(part) for part in kept.sums))
        self.fits = {int(t): FrameFit(*values) for t, *values, _ in kept.fits}
        self.left_out = {int(row[0]): row[-1] for row in kept.fits if row[-1]}
        expression, rotation, translation, vertices = kept.pose
        self._last = replace(
            self._last, expression=expression, rotation=rotation, translation=translation, vertices=vertices
        )

    def _geometry(self, timestep: int) -> GeometryEstimate:
        """That of the result, or the face followed from the frame before."""
        result = self._result
        if timestep in result.timesteps:
            return result.geometry.at((timestep,))
        if self._follower is None:
            names = [camera.name for camera in result.cameras]
            self._follower = Follower(
                self._capture,
                result.model,
                result.geometry.at(self.fitted),
                names,
                GeometryConfig(),
                None,
                self._seed,
                self._last,
            )
        self._last, _, _ = self._follower.next(timestep)
        return self._last

    def _residual(self, reflectance: ReflectanceEstimate, normals: NormalsEstimate) -> ResidualEstimate | None:
        """What the new maps leave unexplained, for the timesteps that had a residual before."""
        result = self._result
        if result.residual is None:
            return None
        geometry = result.geometry.at(result.residual.timesteps)
        settings = from_mapping(ResidualConfig, result.config.get("residual", {}), "result.json: config: residual")
        names = [camera.name for camera in result.cameras]
        given = self._capture, result.model, geometry, reflectance, normals, names
        return find_residual(*given, settings, self._seed)

    def _with(self, found: Solved) -> R:
        """The result with what was found."""
        result, absorber, information = self._result, self._absorber, self._information
        assert result.reflectance is not None
        texels, model = absorber.texels, result.model
        added = [t for t in self.fits if t not in self.left_out]
        images = len(added) * len(result.cameras)
        quality = np.minimum(information.quality / max(1.0, 0.35 * images), 1.0)
        albedo = interpolate(result.geometry.vertex_albedo, model.faces, texels.face, texels.weights)
        filled = blend_unseen(model, texels, albedo, found.maps, quality, found.told)
        parts = result.reflectance.relief is not None
        parted = part_relief(model, texels, filled.diffuse, filled.confidence) if parts else None
        diffuse, lit_eyes = filled.diffuse if parted is None else parted.skin, result.reflectance.lit_eyes
        if lit_eyes is not None:
            # Beneath the film eyes stay as the fit has them: sums don't tell which view was how bright.
            eye = lit_eyes.any(axis=-1, keepdims=True)
            lit_eyes = np.where(eye, filled.diffuse, np.float32(0.0))
            diffuse = np.where(eye, result.reflectance.diffuse, diffuse)
        reflectance = replace(
            result.reflectance,
            diffuse=diffuse,
            lit_eyes=lit_eyes,
            relief=None if parted is None else parted.relief,
            specular=filled.specular,
            confidence=filled.confidence,
            specular_confidence=filled.specular_confidence,
            frames=texels.to_map(information.frames.astype(np.float32)),
        )
        facial = np.where(absorber.facial[:, None], 1.0, 0.0)
        shown = Rows(len(result.timesteps), filled.diffuse.shape, np.float32)
        for timestep in result.timesteps:
            normals = normalize(bend(*absorber.carried.frame(result.geometry.at((timestep,))), found.offsets))
            shown.add(texels.to_map((normals * facial).astype(np.float32)))
        before = Report(found.outcome.value) if result.normals is None else result.normals.report
        details = {
            **before.details,
            "refined": {
                "timesteps": sorted(added),
                "left_out": {str(t): why for t, why in self.left_out.items()},
                "residual": found.sigma,
                "seconds": time.perf_counter() - self._began,
            },
        }
        lines = tuple(f"timestep {t}: left out of the refinement, {why}" for t, why in self.left_out.items())
        report = replace(before, outcome=found.outcome.value, warnings=(*before.warnings, *lines), details=details)
        normals_estimate = NormalsEstimate(result.timesteps, shown.all, report)
        refined = replace(
            result,
            reflectance=reflectance,
            normals=normals_estimate,
            residual=self._residual(reflectance, normals_estimate),
        )
        return replace(refined, mesh=_mesh(refined)) if result.mesh is not None else refined


def _disagreement(fit: FrameFit, fitted: Sequence[FrameFit]) -> str:
    """Why a frame is left out, beside the fitted ones; empty where it isn't."""
    if not fitted:
        return ""
    residual, outliers, detail = (
        float(np.median([getattr(f, name) for f in fitted])) for name in ("residual", "outliers", "detail")
    )
    if fit.residual > DISAGREES * residual:
        times = fit.residual / residual
        return f"differs {times:.1f} times as much from what was expected as the fitted frames: its light?"
    if fit.outliers > max(COVERED * outliers, LEAST_COVERED):
        return f"{fit.outliers:.0%} of the face is not what was expected there: something before it?"
    if fit.detail < BLURRED * detail:
        return f"blurred: {fit.detail / detail:.0%} of the fitted frames' detail"
    return ""


def check_reflectance(result: Result) -> None:
    """Refuse a result that has no maps to refine."""
    if result.reflectance is None:
        raise InputError("refine: found a result without reflectance, expected one of 'mifit fit' with all stages")


def fitted_jointly(result: Result) -> list[int]:
    """Timesteps that were fitted jointly, not tracked."""
    tracked = [] if result.normals is None else result.normals.report.details.get("tracked", [])
    return [t for t in result.timesteps if t not in tracked]


def _solved(result: Result, absorber: Absorber, information: Information, images: int) -> Solved:
    """Maps and normals from the sums, by the settings of the fit."""
    assert result.reflectance is not None
    settings = from_mapping(ReflectanceConfig, result.config.get("reflectance", {}), "result.json: config: reflectance")
    texels, model = absorber.texels, result.model
    albedo = interpolate(result.geometry.vertex_albedo, model.faces, texels.face, texels.weights)
    maps = np.concatenate([result.reflectance.lit_diffuse, result.reflectance.specular[..., None]], axis=2)
    seen = (information.frames > 0) & absorber.facial
    prior = np.zeros((texels.size**2, 4), np.float32)
    prior[texels.index, :3] = np.clip(np.nan_to_num(albedo, nan=0.3), 0.01, 1.0)
    prior[:, 3] = float(np.median(absorber.specular[seen])) if seen.any() else 0.0
    rows = np.flatnonzero(absorber.facial)
    patch = TexelMap(texels.size, texels.index[rows], texels.face[rows], texels.weights[rows])
    smoothness = Smoothness(settings.smoothness_weight, settings.smoothness_weight * settings.specular_smoothness)
    return solve_sums(
        information,
        texels,
        absorber.facial,
        texel_neighbours(patch),
        prior.reshape(texels.size, texels.size, 4),
        smoothness,
        maps,
        absorber.offsets,
        images,
    )


def _mesh(result: Result) -> Any:
    """The refined meshes anew, from new normals."""
    assert result.mesh is not None and result.normals is not None
    refiner, count = mesh_refiner(result), len(result.timesteps)
    vertices, displacement = (
        Rows(count, array.shape[1:], array.dtype) for array in (result.mesh.vertices, result.mesh.displacement)
    )
    for timestep, normals in zip(result.timesteps, result.normals.normal_object, strict=True):
        mesh, height, _ = refiner.refine(result.geometry, timestep, normals)
        vertices.add(mesh)
        displacement.add(height)
    return replace(result.mesh, timesteps=result.timesteps, vertices=vertices.all, displacement=displacement.all)


def _digest(result: Result) -> str:
    """Of all that the sums depend on besides images."""
    import hashlib

    assert result.reflectance is not None
    state = hashlib.sha256(repr((result.timesteps, result.cameras, result.reflectance.illumination)).encode())
    arrays = [result.reflectance.diffuse, result.reflectance.specular, result.geometry.vertices]
    arrays += [] if result.normals is None else [result.normals.normal_object]
    for array in arrays:
        state.update(np.ascontiguousarray(array).tobytes())
    return state.hexdigest()
