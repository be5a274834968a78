"""What ``mifit.fit`` returns: its record with everything that can be made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.morphable import MorphableModel
from mifit.result import Method, Result

if TYPE_CHECKING:
    from mifit.output.relight import Exposure, Lighting
    from mifit.output.scene import Skin


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
        from mifit.output.scene import render_view

        return render_view(self, camera, timestep, method, integrator, samples, seed)

    def scene(
        self,
        integrator: str | Mapping[str, Any] = "path",
        timestep: int | None = None,
        cameras: Sequence[Camera] | None = None,
        method: Method = "full",
        samples: int = 16,
        skin: Skin | None = None,
    ) -> Any:
        """A loaded Mitsuba scene of one timestep, to render and to differentiate.

        Parameters
        ----------
        integrator : str or dict
            A plugin: ``"path"``, ``"prb"``, ``"direct"`` or another of Mitsuba's, or ``"shdirect"``, which gets the
            fit's shading model and ambient term; or a dictionary as ``mi.load_dict`` takes it.
        timestep : int, optional
            Default: the first that was fitted.
        cameras : sequence of Camera, optional
            Default: the fitted cameras.
        method : {"full", "diffuse", "pca"}
            As in `render`.
        samples : int
            Samples per pixel where ``mi.render`` is given none.
        skin : callable, optional
            Another BSDF for the face: a function that is given a dictionary of textures, ``diffuse`` (S, S, 3),
            ``specular`` (S, S), ``slopes`` (S, S, 3; normals as `blinnphong` corrects them) and ``normal`` (S, S, 3;
            the same for Mitsuba's ``normalmap``), and returns the BSDF as ``mi.load_dict`` takes it.

        Returns
        -------
        mi.Scene
            With ids that don't change: the BSDF ``skin``, the emitters ``light`` (``shenv``, or an ``envmap`` after
            `relight` with an image) and ``light_1`` ... (compact lights), the shapes ``face`` and ``rest``, and sensors
            ``camera_NAME``. So ``mi.traverse(scene)`` has ``skin.diffuse_reflectance.data`` (S, S, 3),
            ``skin.specular_reflectance.data`` (S, S, 1), ``skin.normal_correction.data``, ``skin.exponent.value`` and
            ``light.coefficients`` (B*B, 3). Lengths are in the result's units, colours linear, row 0 of textures at
            v = 1 as in the maps.

        Raises
        ------
        InputError
            A timestep that was not fitted, a camera with lens distortion, or an integrator that can't be made.
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

        Parameters
        ----------
        yaw : float
            Degrees about the vertical; 0 is straight from the front, positive ones see the head's left side.
        pitch : float
            Degrees upwards.
        distance : float, optional
            From the middle of the face, the result's units; default: that of the fitted cameras.
        timestep : int, optional
            Default: the first that was fitted.

        Raises
        ------
        InputError
            A result without cameras, or a distance that isn't positive.
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
        """Put the face under another light.

        Parameters
        ----------
        lighting : path, (H, W, 3) array, SHLighting or Illumination
            A path or an array is a lat-long environment of linear radiance (``.hdr``, ``.exr``) in the axes of
            Mitsuba's ``envmap``: +y up, the middle column towards +z. `SHLighting` replaces all light by its harmonics,
            `Illumination` all of it, ambient term included.
        rotate : float or (3, 3)
            Turns the light about the vertical (+y) by degrees, or by a rotation R: what came from d comes from R d.
        exposure : float or "auto"
            Factor on the radiance; by default the lighting is taken as it is. A capture doesn't tell how its exposure
            relates to that of an environment file: ``"auto"`` keeps the mean luminance of the recovered lighting.
        rotations : sequence, optional
            Several values of ``rotate``, for which the environment is read and projected once.

        Returns
        -------
        Reconstruction, or a list of one for each of ``rotations``
            The same face; its `render` uses all of the environment, without tracing paths (``local``,
            `appearance.environment`) or with (``path``).
            The ambient term grows with the mean radiance, but for `Illumination`, which has its own.

        Raises
        ------
        InputError
            No environment map, no rotation, or a fit that ended before stage 2.
        """
        from mifit.output.relight import relit

        lit = relit(self, lighting, [rotate] if rotations is None else rotations, exposure)
        return lit[0] if rotations is None else lit
