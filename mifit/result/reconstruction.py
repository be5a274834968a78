"""The result of a fit: what was found, with the settings and the inputs that it was found from.

Methods that show a face import what does so when they are called.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.core.arrays import same
from mifit.core.calls import checked
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic, worst_first
from mifit.core.estimate import (
    GeometryEstimate,
    MeshEstimate,
    NormalsEstimate,
    ReflectanceEstimate,
    Report,
    ResidualEstimate,
)
from mifit.core.files import Document
from mifit.core.sh import SHLighting, radiance_of_shading
from mifit.errors import InputError
from mifit.morphable import MorphableModel

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.output.relight import Exposure, Lighting
    from mifit.output.scene import Skin

Method = Literal["full", "diffuse", "pca"]
METHODS: tuple[Method, ...] = ("pca", "diffuse", "full")


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction:
    """What ``mifit.fit`` returns: a face that can be rendered, relit, saved and read back.

    Attributes
    ----------
    model : MorphableModel
    geometry : GeometryEstimate
    reflectance : ReflectanceEstimate or None
        None when the fit ended after stage 1.
    normals : NormalsEstimate or None
        None when stage 3 did not run.
    mesh : MeshEstimate or None
        Meshes with the refined normals as shape; None when stage 3 did not run. Renders and relighting use the
        fitted mesh with the refined normals instead, as the fit did.
    residual : ResidualEstimate or None
        What the images of fitted timesteps show beyond the model; ``full`` renders add it. None where it wasn't looked
        for, and for a face that is edited, or in another light.
    config : dict
        Settings as used (``dataclasses.asdict`` of the FitConfig, and the seed).
    cameras : tuple of Camera
        Cameras that were fitted; the views that `relight` and turntables start from.
    capture_digest : str
        Digest of the images and calibration that were fitted.
    units : str
        Name of the unit of length, e.g. ``"cm"``.
    unit_mm : float
        Its length in millimetres.
    seconds : float
        Wall time of the fit.
    peak_memory : int
        Largest resident memory of the fitting process in bytes.
    model_source : str
        Path of the model's file, or ``"builtin"``: what `load` reads the model from again. Empty when it is not
        known; then `load` wants the model given.
    warnings : tuple of Diagnostic
        Things a person should know about the capture and the whole fit.
    environment : (H, W, 3) float32, optional
        Lat-long radiance that `relight` put in place of the recovered lighting; path tracing uses it whole. Not saved.
    environment_rotation : (3, 3), optional
        Its rotation: what the image shows at d comes from R d.
    """

    model: MorphableModel = field(repr=False)
    geometry: GeometryEstimate = field(repr=False)
    reflectance: ReflectanceEstimate | None = field(default=None, repr=False)
    normals: NormalsEstimate | None = field(default=None, repr=False)
    config: dict = field(default_factory=dict)
    cameras: tuple[Camera, ...] = ()
    capture_digest: str = ""
    units: str = "cm"
    unit_mm: float = 10.0
    seconds: float = 0.0
    peak_memory: int = 0
    model_source: str = ""
    warnings: tuple[Diagnostic, ...] = ()
    environment: NDArray[np.float32] | None = field(default=None, repr=False)
    mesh: MeshEstimate | None = field(default=None, repr=False)
    residual: ResidualEstimate | None = field(default=None, repr=False)
    environment_rotation: NDArray[np.float64] | None = field(default=None, repr=False)

    def __eq__(self, other: object) -> bool:
        """Whether two results are the same, to the last bit."""
        if not isinstance(other, Reconstruction):
            return NotImplemented
        names = [f.name for f in fields(self) if f.name != "model"]
        return self.model.digest == other.model.digest and all(
            same(getattr(self, name), getattr(other, name)) for name in names
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        steps = ", ".join(map(str, self.timesteps[:4])) + (", ..." if len(self.timesteps) > 4 else "")
        parts = [f"model {self.model.name}", f"timesteps {steps}"]
        parts.append("cameras " + (", ".join(camera.name for camera in self.cameras) or "none"))
        if self.reflectance is not None:
            size, lights = len(self.reflectance.diffuse), len(self.illumination.lights)
            parts.append(f"{size} x {size} maps")
            parts.append(f"{self.reflectance.shading_model} shading, {self.illumination.order} bands")
            parts += [f"{lights} compact light" + "s" * (lights > 1)] * bool(lights)
        parts += ["relit"] * (self.environment is not None)
        return f"Reconstruction({'; '.join(parts)})"

    def save(self, folder: str | Path, force: bool = False) -> None:
        """Write the result folder (docs/formats.md), or replace the result that is in it.

        A save that fails leaves the older result as it was. Files that mifit did not write, or that were changed
        since, are never deleted. InputError where the folder holds other files and no result, and ``force`` isn't
        given.
        """
        from mifit.output.scene import write_scene
        from mifit.result.writing import save

        save(self, Path(folder), lambda path: write_scene(self, path, self.timesteps[0]), force)

    @classmethod
    def load(cls, folder: str | Path, model: MorphableModel | None = None) -> Reconstruction:
        """Read a result folder; ``model`` is the one that was fitted, where its file is no longer where
        ``result.json`` says.

        InputError where the folder is no result, damaged, of another format version, or the model is another one.
        """
        from mifit.result.reading import load

        return load(Path(folder), model)

    @checked
    def render(
        self,
        camera: Camera,
        timestep: int = 0,
        method: Method = "full",
        integrator: Literal["local", "path"] = "local",
        samples: int | None = None,
        seed: int = 0,
    ) -> NDArray[np.float32]:
        """One view, (H, W, 4) float32: linear colour, not premultiplied, 0 where the model covers nothing, and its
        coverage.

        Parameters
        ----------
        camera : Camera
            Undistorted camera in the capture's world space.
        method : {"full", "diffuse", "pca"}
            ``pca`` is the stage-1 model (vertex albedo under its shading coefficients and ambient term), ``diffuse``
            the final geometry, normals and diffuse albedo without specular, ``full`` everything.
        integrator : {"local", "path"}
            ``local`` shades the visible surface as the fit did; ``path`` traces paths through a Mitsuba scene with
            shadows and interreflection, by ``seed``.
        samples : int, optional
            ``local``: samples along one side of a pixel (default 2); ``path``: samples per pixel (default 64).

        Raises
        ------
        InputError
            Timestep not fitted, unknown method or integrator, or a method whose stage did not run.
        """
        from mifit.output.scene import render_view

        return render_view(self, camera, timestep, method, integrator, samples, seed)

    def scene(
        self,
        integrator: str | Mapping[str, object] = "path",
        timestep: int | None = None,
        cameras: Sequence[Camera] | None = None,
        method: Method = "full",
        samples: int = 16,
        skin: Skin | None = None,
    ) -> Any:
        """A loaded ``mi.Scene`` of one timestep (the first by default), to render and to differentiate.

        Parameters
        ----------
        integrator : str or dict
            A plugin: ``"path"``, ``"prb"``, ``"direct"`` or another of Mitsuba's, or ``"shdirect"``, which gets the
            fit's shading model and ambient term; or a dictionary as ``mi.load_dict`` takes it.
        cameras : sequence of Camera, optional
            Default: the fitted cameras.
        samples : int
            Samples per pixel where ``mi.render`` is given none.
        skin : callable, optional
            Another BSDF for the face: a function that is given a dictionary of textures, ``diffuse`` (S, S, 3),
            ``specular`` (S, S), ``slopes`` (S, S, 3; normals as `blinnphong` corrects them) and ``normal`` (S, S, 3;
            the same for Mitsuba's ``normalmap``), and returns the BSDF as ``mi.load_dict`` takes it.

        Notes
        -----
        Ids don't change: the BSDF ``skin``, the emitters ``light`` (``shenv``, or an ``envmap`` after `relight` with
        an image) and ``light_1`` ... (compact lights), the shapes ``face`` and ``rest``, and sensors ``camera_NAME``.
        So ``mi.traverse(scene)`` has ``skin.diffuse_reflectance.data`` (S, S, 3), ``skin.specular_reflectance.data``
        (S, S, 1), ``skin.normal_correction.data``, ``skin.exponent.value`` and ``light.coefficients`` (B*B, 3).
        Lengths are in the result's units, colours linear, row 0 of textures at v = 1 as in the maps. InputError for a
        timestep that was not fitted, a camera with lens distortion, or an integrator that can't be made.
        """
        from mifit.output.scene import load_result_scene

        timestep = self.timesteps[0] if timestep is None else timestep
        return load_result_scene(
            self, timestep, integrator, self.cameras if cameras is None else cameras, method, samples, skin
        )

    def orbit(
        self, yaw: float = 0.0, pitch: float = 0.0, distance: float | None = None, timestep: int | None = None
    ) -> Camera:
        """A camera that looks at the face, with image size and focal length of the fitted cameras.

        ``yaw`` is in degrees about the vertical, 0 straight from the front, positive to see the head's left side;
        ``pitch`` in degrees upwards; ``distance`` from the middle of the face in the result's units, by default that
        of the fitted cameras. InputError for a result without cameras, or a distance that isn't positive.
        """
        from mifit.output.views import orbit_camera

        return orbit_camera(self, self.timesteps[0] if timestep is None else timestep, yaw, pitch, distance)

    @overload
    def relight(
        self, lighting: Lighting, rotate: float | NDArray = 0.0, exposure: Exposure = 1.0
    ) -> Reconstruction: ...
    @overload
    def relight(
        self, lighting: Lighting, *, exposure: Exposure = 1.0, rotations: Sequence[float | NDArray]
    ) -> list[Reconstruction]: ...
    def relight(
        self,
        lighting: Lighting,
        rotate: float | NDArray = 0.0,
        exposure: Exposure = 1.0,
        rotations: Sequence[float | NDArray] | None = None,
    ) -> Reconstruction | list[Reconstruction]:
        """The same face under another light.

        Parameters
        ----------
        lighting : path, (H, W, 3) array, SHLighting or Illumination
            A path or an array is a lat-long environment of linear radiance (``.hdr``, ``.exr``) in the axes of
            Mitsuba's ``envmap``: +y up, the middle column towards +z. `SHLighting` replaces all light by its
            harmonics, `Illumination` all of it, ambient term included; else that grows with the mean radiance.
        rotate : float or (3, 3)
            Turns the light about the vertical (+y) by degrees, or by a rotation R: what came from d comes from R d.
        exposure : float or "auto"
            Factor on the radiance. The exposure of a capture has no known relation to that of an environment file:
            ``"auto"`` keeps the mean luminance of the recovered lighting.
        rotations : sequence, optional
            Several values of ``rotate``, for which the environment is read and projected once; a list is returned.

        Raises
        ------
        InputError
            No environment map, no rotation, or a fit that ended before stage 2.
        """
        from mifit.output.relight import relit

        lit = relit(self, lighting, [rotate] if rotations is None else rotations, exposure)
        return lit[0] if rotations is None else lit

    def with_albedo(self, diffuse: ArrayLike) -> Reconstruction:
        """The same face with another diffuse albedo (S, S, 3), linear reflectance 0..1, row 0 at v = 1, of the old
        one's size.

        InputError for another shape, values outside 0..1, or a result without reflectance.
        """
        return self._with_map("diffuse", diffuse)

    def with_specular(self, specular: ArrayLike) -> Reconstruction:
        """The same face with another specular albedo: a map (S, S), or one number for all of it; see `with_albedo`."""
        return self._with_map("specular", specular)

    def _with_map(self, name: str, values: ArrayLike) -> Reconstruction:
        if self.reflectance is None:
            raise InputError(f"{name}: this result has no reflectance; fit with --until reflectance")
        before = getattr(self.reflectance, name)
        array = np.asarray(values, dtype=np.float32)
        if array.ndim == 0:
            array = np.where(self.reflectance.diffuse.any(axis=-1), array, 0).astype(np.float32)
        if array.shape != before.shape or not np.isfinite(array).all() or array.min() < 0 or array.max() > 1:
            raise InputError(
                f"{name}: found shape {array.shape} with values {np.min(array):g} to {np.max(array):g}, "
                f"expected {before.shape} with reflectances 0 to 1"
            )
        change: Document = {name: array}
        return replace(self, reflectance=replace(self.reflectance, **change), residual=None)

    def with_illumination(self, illumination: Illumination) -> Reconstruction:
        """The same face in another light, taken as it is; see `relight` for environment maps.

        What the capture's own light left unexplained (``reflectance.residual_shading``, ``residual``) is gone with it.
        InputError for a result without reflectance.
        """
        if self.reflectance is None:
            raise InputError("illumination: this result has no reflectance; fit with --until reflectance")
        reflectance = replace(self.reflectance, illumination=illumination, residual_shading=None)
        return replace(self, reflectance=reflectance, residual=None, environment=None, environment_rotation=None)

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Timesteps with geometry."""
        return self.geometry.timesteps

    @property
    def tracked(self) -> Mapping[int, str]:
        """Timesteps that were tracked after the fit, with digests of their images."""
        return {} if self.normals is None else self.normals.tracked

    @property
    def fitted(self) -> tuple[int, ...]:
        """Timesteps that were fitted jointly, not tracked."""
        return tuple(t for t in self.timesteps if t not in self.tracked)

    def seen(self, capture: Capture) -> Capture:
        """A capture with the cameras, gains and exposures that the fit found."""
        capture, photometry = capture.with_fitted(self.cameras), self.geometry.photometry
        return capture.with_photometry(photometry) if photometry else capture

    @property
    def methods(self) -> tuple[Method, ...]:
        """Methods that `render` can show: all three, or ``pca`` alone when only stage 1 ran."""
        return METHODS if self.reflectance is not None else ("pca",)

    @property
    def diagnostics(self) -> list[Diagnostic]:
        """What a person should know of capture and fit, the worst first; a stage that did not converge counts."""
        found = list(self.warnings)
        for name, report in self.reports.items():
            found += report.warnings
            said = any(one.code == "not-converged" for one in report.warnings)
            if report.outcome not in ("converged", "inconsistent") and not said:
                words = report.outcome.replace("_", " ")
                found.append(Diagnostic("not-converged", f"stage {name} ended without convergence ({words})", "note"))
        return worst_first(found)

    @property
    def reports(self) -> dict[str, Report]:
        """How each stage that ran ended, by its name, in order."""
        stages = {
            "geometry": self.geometry,
            "reflectance": self.reflectance,
            "normals": self.normals,
            "mesh": self.mesh,
            "residual": self.residual,
        }
        return {name: stage.report for name, stage in stages.items() if stage is not None}

    @property
    def lighting(self) -> SHLighting:
        """The recovered radiance; without stage 2, that whose irradiance gives stage 1's shading.

        A compact light is in it as far as the bands can show one.
        """
        return self.illumination.smooth()

    @property
    def illumination(self) -> Illumination:
        """What lights the face; without stage 2, the radiance whose irradiance gives stage 1's shading."""
        if self.reflectance is not None:
            return self.reflectance.illumination
        radiance = radiance_of_shading(self.geometry.shading)
        return Illumination(radiance, ambient=self.geometry.ambient)

    @property
    def lobe(self) -> Lobe:
        """The specular lobe; without stage 2 there is no specular albedo, and any will do."""
        return Lobe(1.0) if self.reflectance is None else self.reflectance.lobe

    def index(self, timestep: int) -> int:
        """Position of a timestep in the per-timestep arrays; InputError when it was not fitted."""
        if timestep not in self.timesteps:
            known = ", ".join(map(str, self.timesteps))
            raise InputError(f"timestep {timestep} is not in this result; it has {known}")
        return self.timesteps.index(timestep)

    def camera(self, name: str) -> Camera:
        """A fitted camera by name; InputError when there is none of that name."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(c.name for c in self.cameras) or "none"
        raise InputError(f"camera {name!r} is not in this result; it has {known}")

    def refined_normal(self, timestep: int) -> NDArray | None:
        """(S, S, 3) refined object-space normals of a timestep, or None where stage 3 did not run."""
        if self.normals is None or timestep not in self.normals.timesteps:
            return None
        return self.normals.normal_object[self.normals.timesteps.index(timestep)]

    def with_refined_mesh(self) -> Reconstruction:
        """This face on its refined mesh, which becomes the geometry, to export or render; InputError without one."""
        if self.mesh is None:
            raise InputError("this result has no refined mesh; fit with --until normals, which makes it")
        geometry = replace(self.geometry.at(self.mesh.timesteps), vertices=self.mesh.vertices)
        return replace(self, geometry=geometry, mesh=None)
