"""Whether a calibration agrees with dense matches of a head that turns, and which error would explain them better.

Points are tracked through all images (`tracks`) and adjusted with the head's poses and expressions while the cameras
stay (`bundle`). Then one error at a time is opened: all focal lengths, the focal length of a camera, a turn of a camera
about its centre, which moves the image as another principal point does. What lowers the energy, by more than matches
leave open, is named. Lengths scale with the distance between the cameras: no match shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import rigid
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate
from mifit.core.files import Document
from mifit.extras.bundle import Bundle, Freedom, Sightings, adjust_bundle
from mifit.extras.tracks import FEWEST_IMAGES, focal_of, follow_head, points_of, sightings_of
from mifit.morphable import MorphableModel
from mifit.progress import Progress, silent
from mifit.stages.surface.sweep import FEWEST

FOCALS, FOCAL, TURN = 0.08, 0.005, 0.3
"""Errors below which nothing is named: of all focal lengths, of one of them relative to the others, and degrees.
Expressions take up to half of the first on development captures; of the others, good calibrations leave a tenth."""
EXPLAINED = 0.005
"""Part of the energy that an error must explain."""
ALIKE = 0.9
"""Part of the best one's share from which errors explain the matches equally well."""
PRIOR = 0.3, np.radians(5.0)
"""Standard deviations of a focal length's logarithm and of a turn, beforehand."""


@dataclass(frozen=True)
class CameraError:
    """An error of the calibration that matches were adjusted with: of one camera, or of all where it is None.

    ``value`` is the correction, of the focal length relative to it, or of a turn, degrees about the camera's own x, y
    and z, and ``deviation`` its standard deviation, as the matches give it. ``explained`` is the part of the energy
    that it takes away, ``text`` says it in words.
    """

    camera: str | None
    value: tuple[float, ...]
    deviation: float
    explained: float
    text: str

    @property
    def large(self) -> bool:
        """Whether it is beyond what matches leave open."""
        least = TURN if len(self.value) > 1 else FOCALS if self.camera is None else FOCAL
        return self.explained > EXPLAINED and float(np.linalg.norm(self.value)) > max(least, 3.0 * self.deviation)


@dataclass(frozen=True)
class CalibrationCheck:
    """The test of a calibration by matches of ``points`` tracked in `FEWEST_IMAGES` or more images.

    Too few test nothing, and the rest is empty: ``residual``, the median distance of a match from its point under the
    calibration as it is, pixels; ``errors``, each as if it were the only one, the likeliest first.
    """

    points: int
    residual: float | None = None
    errors: tuple[CameraError, ...] = ()

    @property
    def diagnostics(self) -> list[Diagnostic]:
        """The error that explains the matches, with those that do equally well; nothing where none is large."""
        best = [one for one in self.errors if one.large and one.explained >= ALIKE * self.errors[0].explained]
        if not best:
            return []
        text = (
            f"matches of {self.points} points contradict the calibration; {', or '.join(one.text for one in best)} "
            f"explains {best[0].explained:.1%} of their residuals: calibrate again"
        )
        camera = best[0].camera if len({one.camera for one in best}) == 1 else None
        return [Diagnostic("calibration-doubtful", text, camera=camera)]

    @property
    def lines(self) -> list[str]:
        """Residual and errors in words, a line each; or why nothing was tested."""
        if self.residual is None:
            return [
                f"calibration: not tested, {self.points} points are found in {FEWEST_IMAGES} or more images, "
                f"expected {FEWEST}; add timesteps where the head turns"
            ]
        head = f"calibration: matches of {self.points} points are {self.residual:.2f} pixels off"
        return [head, *(f"  {one.text} explains {one.explained:.1%} of that" for one in self.errors)]

    def document(self) -> Document:
        """Plain values for JSON."""
        errors = [asdict(one) for one in self.errors]
        return {"points": self.points, "residual_pixels": self.residual, "errors": errors}


def check_calibration(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    cameras: Sequence[str],
    progress: Progress = silent,
) -> CalibrationCheck:
    """Test the calibration of cameras that a head was fitted with; no other camera is read.

    Points need `FEWEST_IMAGES` images: one timestep of two cameras tests nothing.
    """
    views = [capture.camera(name) for name in cameras]
    if len(views) < 2 or len(views) * len(geometry.timesteps) < FEWEST_IMAGES:
        return CalibrationCheck(0)
    tracks, texels = follow_head(capture, model, views, geometry.timesteps, list(geometry.vertices), progress)
    if len(tracks.texel) < FEWEST:
        return CalibrationCheck(len(tracks.texel))
    head = (geometry.vertices[0] - geometry.translation[0]) @ geometry.rotation[0]
    points, modes = points_of(tracks, texels, model, head)
    heads = rigid(geometry.rotation, geometry.translation)
    focal, poses = np.array([focal_of(view) for view in views]), np.array([view.world_to_camera for view in views])
    start = Bundle(focal, poses, heads, points, geometry.expression - geometry.expression[0])
    return explain_matches(start, sightings_of(tracks, views), geometry.scale * modes, cameras, progress)


def explain_matches(
    start: Bundle, seen: Sightings, modes: NDArray, names: Sequence[str], progress: Progress = silent
) -> CalibrationCheck:
    """Adjust matches with the cameras as they are, then with one error at a time.

    ``modes`` (N, 3, K) are expressions of the points, ``names`` the cameras'.
    """
    count = len(names)
    all_focals = np.eye(7 * count, count)
    tried: list[tuple[str | None, NDArray]] = [(None, all_focals.sum(axis=1, keepdims=True))]
    for c, name in enumerate(names):
        turn, first = np.zeros((7 * count, 3)), count + 6 * c
        turn[first : first + 3] = np.eye(3)
        turn[first + 3 : first + 6] = np.cross(np.eye(3), start.cameras[c, :3, 3]).T  # its centre stays
        tried += [(name, all_focals[:, c : c + 1]), (name, turn)]
    progress("test cameras", 0, len(tried) + 1)
    given = adjust_bundle(start, seen, Freedom(np.zeros((7 * count, 0)), np.zeros(0), np.zeros((0, 0))), modes)
    found = []
    for done, (camera, design) in enumerate(tried):
        progress("test cameras", done + 1, len(tried) + 1)
        size = design.shape[1]
        precision = np.eye(size) / PRIOR[size > 1] ** 2
        how = adjust_bundle(given.bundle, seen, Freedom(design, np.zeros(size), precision), modes)
        value = np.degrees(how.movement) if size > 1 else np.expm1(how.movement)
        deviation = float(how.deviations.max()) * (np.degrees(1.0) if size > 1 else 1.0)
        explained = max(1.0 - how.energy / given.energy, 0.0)
        text = _text(camera, value, 0.0 if camera is None else start.focal[names.index(camera)])
        found.append(CameraError(camera, tuple(value.tolist()), deviation, explained, text))
    progress("test cameras", len(tried) + 1, len(tried) + 1)
    return CalibrationCheck(len(start.points), given.residual, tuple(sorted(found, key=lambda one: -one.explained)))


def _text(camera: str | None, value: NDArray, focal: float) -> str:
    """A correction in words."""
    if len(value) == 1:
        which = "all focal lengths" if camera is None else f"the focal length of {camera}"
        return f"{which} by {100 * value[0]:+.1f} %"
    x, y, _ = focal * np.radians(value)
    size = np.linalg.norm(value)
    return f"a turn of {camera} by {size:.2f} degrees (a principal point by {y:+.0f}, {-x:+.0f} pixels)"
