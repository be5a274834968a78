"""What a fit ends with: a face that can be rendered, relit, saved and read back."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate, MeshEstimate, NormalsEstimate, ReflectanceEstimate, Report
from mifit.core.sh import SHLighting, bands, cosine_coefficients, order_of
from mifit.errors import InputError

if TYPE_CHECKING:
    from mifit.morphable import MorphableModel

Method = Literal["full", "diffuse", "pca"]
METHODS: tuple[Method, ...] = ("pca", "diffuse", "full")


@dataclass(frozen=True)
class Reconstruction:
    """The result of ``mifit.fit``.

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
    warnings : tuple of str
        Things a person should know about the whole fit, in words.
    environment : (H, W, 3) float32, optional
        Lat-long radiance that `relight` put in place of the recovered lighting; path tracing uses it whole. Not saved.
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
    warnings: tuple[str, ...] = ()
    environment: NDArray[np.float32] | None = field(default=None, repr=False)
    mesh: MeshEstimate | None = field(default=None, repr=False)

    @property
    def timesteps(self) -> tuple[int, ...]:
        """Timesteps with geometry."""
        return self.geometry.timesteps

    @property
    def methods(self) -> tuple[Method, ...]:
        """Methods that `render` can show: all three, or ``pca`` alone when only stage 1 ran."""
        return METHODS if self.reflectance is not None else ("pca",)

    @property
    def reports(self) -> dict[str, Report]:
        """How each stage that ran ended, by its name, in order."""
        stages = {
            "geometry": self.geometry,
            "reflectance": self.reflectance,
            "normals": self.normals,
            "mesh": self.mesh,
        }
        return {name: stage.report for name, stage in stages.items() if stage is not None}

    @property
    def lighting(self) -> SHLighting:
        """The recovered radiance; without stage 2, that whose irradiance gives stage 1's shading.

        A compact light is in it as far as the bands can show one.
        """
        if self.reflectance is not None:
            radiance, key = self.reflectance.radiance, self.reflectance.key
            return SHLighting(radiance if key is None else radiance + key.coefficients(order_of(radiance)))
        return SHLighting(self.geometry.shading * (math.pi / cosine_coefficients(3)[bands(3)])[:, None])

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

    def displacement(self, timestep: int) -> NDArray:
        """(S, S) distance of the refined mesh from the fitted one, along its normals; InputError without one."""
        if self.mesh is None or timestep not in self.mesh.timesteps:
            raise InputError(
                f"timestep {timestep} has no refined mesh in this result; fit with --until normals, which makes it"
            )
        return self.mesh.displacement[self.mesh.timesteps.index(timestep)]

    def with_refined_mesh(self) -> Reconstruction:
        """This face on its refined mesh: `mesh` becomes model and geometry, for export or for rendering.

        Raises
        ------
        InputError
            The result has no refined mesh.
        """
        from mifit.stages.refine_mesh import finer_model, split_faces

        if self.mesh is None:
            raise InputError("this result has no refined mesh; fit with --until normals, which makes it")
        matrix = split_faces(self.model, self.mesh.subdivisions).matrix
        geometry = replace(
            self.geometry.at(self.mesh.timesteps),
            vertices=self.mesh.vertices,
            vertex_albedo=(matrix @ self.geometry.vertex_albedo).astype(np.float32),
        )
        return replace(self, model=finer_model(self.model, self.mesh.subdivisions), geometry=geometry, mesh=None)

    def save(self, folder: str | Path) -> None:
        """Write the result folder (docs/formats.md); ``result.json`` comes last and marks it whole."""
        from mifit.output.folder import save

        save(self, Path(folder))

    @classmethod
    def load(cls, folder: str | Path, model: MorphableModel | None = None) -> Reconstruction:
        """Read a result folder.

        Parameters
        ----------
        folder : path
        model : MorphableModel, optional
            The model that was fitted, when its file is no longer where ``result.json`` says.

        Raises
        ------
        InputError
            The folder is no result, damaged, of another format version, or the model is another one.
        """
        from mifit.output.folder_reading import load

        return load(Path(folder), model)

    def render(
        self,
        camera: Camera,
        timestep: int = 0,
        method: Method = "full",
        integrator: Literal["local", "path"] = "local",
        samples: int | None = None,
        seed: int = 0,
    ) -> NDArray[np.float32]:
        """Render one view.

        Parameters
        ----------
        camera : Camera
            Undistorted camera in the capture's world space.
        timestep : int
        method : {"full", "diffuse", "pca"}
            ``pca`` is the stage-1 model (vertex albedo under its shading coefficients and ambient term),
            ``diffuse`` the final geometry, normals and diffuse albedo without specular, ``full`` everything.
        integrator : {"local", "path"}
            ``local`` shades the visible surface as the fit did; ``path`` traces paths through a Mitsuba scene
            with shadows and interreflection.
        samples : int, optional
            ``local``: samples along one side of a pixel (default 2); ``path``: samples per pixel (default 64).
        seed : int
            For ``path``.

        Returns
        -------
        (H, W, 4) float32
            Linear colour (not premultiplied; 0 where the model covers nothing) and the model's coverage.

        Raises
        ------
        InputError
            Timestep not fitted, unknown method or integrator, or a method whose stage did not run.
        """
        self.index(timestep)
        if method not in METHODS:
            raise InputError(f"method: found {method!r}, expected one of {', '.join(METHODS)}")
        if method not in self.methods:
            raise InputError(
                f"method {method!r} needs reflectance, but this fit ended after the geometry stage; "
                "use 'pca', or fit with --until reflectance"
            )
        if integrator == "local":
            from mifit.output.deferred import render_local

            return render_local(self, camera, timestep, method, samples or 2)
        if integrator == "path":
            from mifit.output.scene import render_path

            return render_path(self, camera, timestep, method, samples or 64, seed)
        raise InputError(f"integrator: found {integrator!r}, expected 'local' or 'path'")

    def relight(
        self, environment: str | Path | NDArray, rotate: float = 0.0, exposure: float | None = None
    ) -> Reconstruction:
        """Put the face under another environment.

        Parameters
        ----------
        environment : path or (H, W, 3) array
            Lat-long linear radiance (``.hdr``, ``.exr``) in the axes of Mitsuba's ``envmap``: +y up, the middle column
            towards +z.
        rotate : float
            Turns the environment about the vertical (+y) by degrees.
        exposure : float, optional
            Factor on its radiance. A capture doesn't tell how its exposure relates to that of an environment
            file; by default the mean radiance stays that of the recovered lighting.

        Returns
        -------
        Reconstruction
            The same face; its `render` uses the environment's spherical harmonics (``local``), or all of it
            (``path``). The ambient term grows with the mean radiance.

        Raises
        ------
        InputError
            No environment map, or a fit that ended before stage 2.
        """
        from mifit.output.relight import relit

        return relit(self, environment, rotate, exposure)
