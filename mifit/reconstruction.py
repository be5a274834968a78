"""What ``mifit.fit`` returns: its record with everything that can be made of it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.result import METHODS, Method, Result


class Reconstruction(Result):
    """A face that can be rendered, relit, saved and read back; its attributes are those of `mifit.result.Result`."""

    def save(self, folder: str | Path, force: bool = False) -> None:
        """Write the result folder (docs/formats.md), or replace the result that is in it.

        A save that fails leaves the older result as it was. Files that mifit did not write, or that were changed since,
        are never deleted.

        Raises
        ------
        InputError
            The folder holds other files and no result, and ``force`` isn't given.
        """
        from mifit.output.scene import write_scene
        from mifit.result.writing import save

        save(self, Path(folder), lambda path: write_scene(self, path, self.timesteps[0]), force)

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
        from mifit.result.reading import load

        return load(cls, Path(folder), model)

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
