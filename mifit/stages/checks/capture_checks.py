"""What can be said of a capture before it is fitted: common mistakes in images, landmarks and calibration, by name."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.capture.detect import available, open_detector
from mifit.capture.transforms import UNITS_MM as FILE_UNITS_MM
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic, worst_first
from mifit.core.image import to_8_bit
from mifit.core.process import one_blas_thread
from mifit.morphable import MorphableModel
from mifit.morphable.topology import INNER
from mifit.stages.checks.hypotheses import UNITS_MM, Hypothesis, hypotheses
from mifit.stages.checks.landmark_model import Explanation, FaceStatistics, Shot, explain, noise_of

TIMESTEPS, DELAY_TIMESTEPS = 2, 6
"""Timesteps whose landmarks are judged, and among which delays are looked for."""
FEWEST = 12
"""Landmarks inside the face that an image must show to be judged."""
SOUND, DOUBTFUL = 0.3, 0.9
"""Cost of a landmark (`Explanation`) up to which no mistake is looked for, and beyond which a person is told anyway:
0.9 is that of normal errors as large as a detector's (3/2 of the mean of log(1 + e), e exponential)."""
BETTER = 0.65
"""Part of the cost that undoing a mistake must leave at most. The 51 landmarks of two
views are then less likely as they are by a factor of e^20 or more; errors are correlated, so that a fifth counts."""
ALIKE = 1.15
"""Costs, over the least, of mistakes that landmarks leave open: all are named."""
SHIFTED = 1.5
"""Shift of landmarks from a detector's or from the fitted face, in deviations of one landmark, beyond which no two
detectors differ, and how far single ones may then lie off at the median; on development heads 0.7 and 1.2 at most."""
LARGEST_FACE = 1.6
"""Size of a face over the model's, and its inverse, beyond which nobody's is: outer corners of adults' eyes lie
91 +- 5 mm apart, an infant's 60 mm (Farkas 1994)."""
OFF_CENTRE = 0.05
"""Distance of the principal point from the middle as part of the image's width, and of the pixels' sides: lenses are
centred to 2 %, pixels of cameras square to 1 %; images that were cropped or stretched are not."""
SAME_CODES = 0.5
"""Mean difference in 8-bit codes below which two images are copies: the noise of two exposures is larger."""
RED_OVER_BLUE = 0.85
"""Red over blue of skin below which the channels are exchanged. It is 1.5 to 4 in linear light, and above 1 under
every light from candles to blue sky (Stoerring 2004)."""
RED_OVER_GREEN = (1.25, 3.2)
"""Red over green of skin in linear light, as camera and white balance give it: 1.4 to 2.9 (ISO/TR 16066 set of skins),
a tenth less where the room is bluish. Codes of sRGB that are taken for linear halve its logarithm."""
COLOURS_APART = 0.4
"""Difference of the logarithms of red over blue between cameras at which their colours are questioned."""
CODE_ROUNDING = 0.02
"""Mean distance from whole 8-bit codes, in codes, below which a float image holds such codes; 0.25 for light."""


@one_blas_thread()
def check_capture(
    capture: Capture, model: MorphableModel, cameras: Sequence[str], timesteps: Sequence[int]
) -> list[Diagnostic]:
    """Mistakes in a capture, the worst first; empty where nothing is questioned.

    Parameters
    ----------
    capture : Capture
    model : MorphableModel
        Whose landmarks faces are judged by.
    cameras, timesteps
        What will be fitted; no image of another camera or timestep is read.

    Notes
    -----
    Each common mistake is undone on the landmarks (`hypotheses`), and named where a face explains them far better then.
    Cameras that aren't calibrated are judged by their images alone.
    """
    timesteps = timesteps[:TIMESTEPS]
    found = copy_diagnostics(capture, cameras, timesteps)
    if not found and (capture.calibrated or capture.estimated):
        shots = landmark_shots(capture, cameras, timesteps)
        first = capture.timesteps.index(timesteps[0])
        later = landmark_shots(capture, cameras, capture.timesteps[first : first + DELAY_TIMESTEPS])
        found = landmark_diagnostics(shots, later, FaceStatistics.of(model, capture.unit_mm))
        found = found or intrinsics_diagnostics(capture, cameras) or shift_diagnostics(capture, cameras, timesteps[0])
    if all(one.severity != "fault" for one in found):  # where landmarks are off, so is the skin between them
        found += colour_diagnostics(capture, cameras, timesteps)
    return worst_first(found)


# Landmarks
# ----------------------------------------------------------------------------------------------------------------------


def landmark_shots(capture: Capture, cameras: Sequence[str], timesteps: Sequence[int]) -> list[Shot]:
    """Visible landmarks of every image that shows enough of them; ``step`` counts in ``timesteps``."""
    shots = []
    for step, timestep in enumerate(timesteps):
        for name in cameras:
            found = capture.landmarks(name, timestep)
            if found is not None and found.visible[INNER].sum() >= FEWEST:
                pixels = np.where(found.visible[:, None], found.points, np.nan)
                shots.append(Shot(capture.camera(name), step, pixels))
    return shots


def landmark_offsets(
    capture: Capture, model: MorphableModel, cameras: Sequence[str], timesteps: Sequence[int]
) -> dict[str, float]:
    """Median distance in pixels of each camera's landmarks from a face that suits all cameras, where there are any."""
    shots = landmark_shots(capture, cameras, timesteps[:TIMESTEPS])
    return explain(shots, FaceStatistics.of(model, capture.unit_mm)).offsets if shots else {}


def landmark_diagnostics(shots: Sequence[Shot], later: Sequence[Shot], face: FaceStatistics) -> list[Diagnostic]:
    """What landmarks say of images, poses and lengths; those of ``later``, consecutive timesteps, of delays."""
    if not shots:
        return []
    given = explain(shots, face)
    if given.cost <= SOUND:
        return _size_diagnostics(given, face.unit_mm)
    tried = [(one, explain(one.shots, face, one.shifted)) for one in hypotheses(shots, later)]
    least = min((how.cost for _, how in tried), default=np.inf)
    if least > min(BETTER * given.cost, DOUBTFUL):
        return [_unexplained(given)] if given.cost > DOUBTFUL else _size_diagnostics(given, face.unit_mm)

    def odd(pair: tuple[Hypothesis, Explanation]) -> tuple[bool, ...]:
        """What landmarks leave open: but people stand upright, are of human size, and lenses are centred.

        A shift has two unknowns more than other mistakes, so that it comes last.
        """
        one, how = pair
        off_centre = any(_off_centre(shot.camera) > 2 * OFF_CENTRE for shot in one.shots)
        human = 1 / LARGEST_FACE <= how.size <= LARGEST_FACE
        return one.shifted is not None, not _upright(one.shots), not human, off_centre

    alike = [(one, how) for one, how in tried if how.cost <= ALIKE * least]
    likely = min(map(odd, alike))
    mistakes = [(one, how) for one, how in alike if odd((one, how)) == likely]
    shift = "({:.0f}, {:.0f})"
    texts = [one.text.replace("(x, y)", shift.format(*-how.shift) if one.shifted else "") for one, how in mistakes]
    text = ", or ".join(dict.fromkeys(texts))
    remedy = "; or ".join(dict.fromkeys(one.remedy for one, _ in mistakes))
    figures = f"a face then explains the landmarks at a cost of {least:.2f} each in place of {given.cost:.2f}"
    first, right = mistakes[0]
    camera = first.camera if len({one.camera for one, _ in mistakes if one.shifted}) < 2 else None
    named = Diagnostic(first.code, f"{text}: {figures}; {remedy}", "fault", camera)
    return [named, *_size_diagnostics(right, face.unit_mm)]


def shift_diagnostics(capture: Capture, cameras: Sequence[str], timestep: int) -> list[Diagnostic]:
    """Landmarks that lie beside the face by the same pixels, by a detector where its networks are installed."""
    if not available()["mediapipe"]:
        return []
    detector, said = open_detector("mediapipe"), []
    for shot in landmark_shots(capture, cameras, [timestep]):
        noise = noise_of([shot])
        seen = detector.detect(to_8_bit(capture.frame(shot.camera.name, timestep).image))
        if seen is None:
            continue
        off = (shot.pixels - seen)[INNER]
        x, y = shift = np.nanmedian(off, axis=0)
        single = float(np.nanmedian(np.linalg.norm(off - shift, axis=1)))
        if np.hypot(x, y) > SHIFTED * noise and single < SHIFTED * noise:
            text = (
                f"camera {shot.camera.name}: landmarks lie ({x:.0f}, {y:.0f}) pixels from where a detector sees them, "
                f"expected within {SHIFTED * noise:.0f}; run `mifit landmarks`, or check where pixel coordinates begin"
            )
            said.append(Diagnostic("landmarks-shifted", text, "fault", shot.camera.name))
    return said


def _upright(shots: Sequence[Shot]) -> bool:
    """Whether most images have the eyes above the mouth."""
    below = [np.nanmean(shot.pixels[48:68, 1]) > np.nanmean(shot.pixels[36:48, 1]) for shot in shots]
    return 2 * sum(below) > len(below)


def _unexplained(given: Explanation) -> Diagnostic:
    name = max(given.offsets, key=lambda name: given.offsets[name])
    text = (
        f"landmarks don't fit a face under this calibration (a cost of {given.cost:.2f} each, expected at most "
        f"{DOUBTFUL:g}), and no common mistake explains it; camera {name} is worst, {given.offsets[name]:.1f} pixels "
        "off: look at its landmarks, its calibration, and whether all cameras show one person at one time"
    )
    return Diagnostic("landmarks-unexplained", text, camera=name)


def _size_diagnostics(right: Explanation, unit_mm: float) -> list[Diagnostic]:
    """What the size of the face says, once other mistakes are undone."""
    size = right.size
    if 1 / LARGEST_FACE <= size <= LARGEST_FACE:
        return []
    unit = min(UNITS_MM, key=lambda name: abs(np.log(size * UNITS_MM[name] / unit_mm)))
    factor = UNITS_MM[unit] / unit_mm
    if abs(np.log(size * factor)) <= np.log(LARGEST_FACE):
        named = UNITS_MM[unit] in FILE_UNITS_MM.values()
        text = (
            f"the face is {size:.3g} times a human one: lengths of the cameras are in {unit}, the capture says one is "
            f"{unit_mm:g} mm; "
            + ('correct "units" in transforms.json, or ' if named else "")
            + f"multiply the translations by {factor:g}"
        )
    else:
        text = (
            f"the face is {size:.3g} times a human one, expected {1 / LARGEST_FACE:.2f} to {LARGEST_FACE:.2f}: the "
            "focal length, the distance between the cameras or the unit of length is wrong; calibrate again"
        )
    return [Diagnostic("lengths-wrong", text, "fault")]


# Calibration and images
# ----------------------------------------------------------------------------------------------------------------------


def intrinsics_diagnostics(capture: Capture, cameras: Sequence[str]) -> list[Diagnostic]:
    """Intrinsics that cameras seldom have."""
    found = []
    for name in cameras:
        camera = capture.camera(name)
        if _off_centre(camera) > OFF_CENTRE:
            x, y = camera.cx - camera.width / 2, camera.cy - camera.height / 2
            text = (
                f"camera {name}: the principal point is ({x:.0f}, {y:.0f}) pixels from the image's middle, "
                f"expected within {OFF_CENTRE * camera.width:.0f} unless images are cropped; check cx, cy"
            )
            found.append(Diagnostic("principal-point", text, camera=name))
        if abs(np.log(camera.fy / camera.fx)) > OFF_CENTRE:
            text = (
                f"camera {name}: pixels are {camera.fx / camera.fy:.3f} times as high as wide, expected 1 unless "
                "images are stretched; check fl_x, fl_y"
            )
            found.append(Diagnostic("pixels-not-square", text, camera=name))
    return found


def _off_centre(camera: Camera) -> float:
    """Distance of the principal point from the middle, along an axis, as part of the image's width."""
    return max(abs(camera.cx - camera.width / 2), abs(camera.cy - camera.height / 2)) / camera.width


def copy_diagnostics(capture: Capture, cameras: Sequence[str], timesteps: Sequence[int]) -> list[Diagnostic]:
    """Images that are copies of one another."""
    codes = {(name, t): _codes(capture, name, t) for t in timesteps for name in cameras}
    found = []
    for a, b in combinations(cameras, 2):
        how = [
            how
            for how, change in (("a copy", np.asarray), ("a mirrored copy", np.fliplr))
            if all(_same(change(codes[a, t]), codes[b, t]) for t in timesteps)
        ]
        if how:
            text = f"camera {b}: its images are {how[0]} of those of camera {a}; import the images of each camera"
            found.append(Diagnostic("images-copied", text, "fault", b))
    for first, second in combinations(timesteps, 2):
        if all(_same(codes[name, first], codes[name, second]) for name in cameras):
            text = f"timesteps {first} and {second} are copies of one another and tell nothing more; leave one out"
            found.append(Diagnostic("timesteps-alike", text, "fault"))
    return found


def colour_diagnostics(capture: Capture, cameras: Sequence[str], timesteps: Sequence[int]) -> list[Diagnostic]:
    """Channels and encodings, by the colour of the face between the landmarks."""
    found, ratio = [], {}
    for name in cameras:
        skin = np.concatenate([_skin(capture, name, t) for t in timesteps])
        if len(skin) < FEWEST:
            continue
        image = capture.frame(name, timesteps[0]).image
        stored = image[image.max(axis=2) > 0.05] * 255.0
        rounding = float(np.abs(stored - np.rint(stored)).mean()) if len(stored) else 1.0
        red_green, ratio[name] = (float(np.median(skin[:, 0] / skin[:, k])) for k in (1, 2))
        figures = f"camera {name}: red over green of the face is {red_green:.2f}, red over blue {ratio[name]:.2f}"
        if ratio[name] < RED_OVER_BLUE:
            text = f"{figures}, expected above 1: red and blue are exchanged; store the images as RGB"
            found.append(Diagnostic("channels-exchanged", text, "fault", name))
        elif rounding < CODE_ROUNDING:
            text = (
                f"camera {name}: its float images hold 8-bit codes (values are multiples of 1/255), which are read as "
                "linear light; store them as PNG, or convert sRGB to linear"
            )
            found.append(Diagnostic("encoded-as-linear", text, "fault", name))
        elif not RED_OVER_GREEN[0] <= red_green <= RED_OVER_GREEN[1]:
            low = red_green < RED_OVER_GREEN[0]
            text = (
                f"{figures}; skin has {RED_OVER_GREEN[0]:g} to {RED_OVER_GREEN[1]:g}: "
                + ("encoded values may be read as linear light" if low else "linear values may be read as sRGB")
                + ", or the white balance is far off"
            )
            found.append(Diagnostic("skin-colour", text, camera=name))
    usual = float(np.median(list(ratio.values()))) if ratio else 1.0
    for name, value in ratio.items():
        if not found and abs(np.log(value / usual)) > COLOURS_APART / (2 if len(ratio) == 2 else 1):
            text = (
                f"camera {name}: red over blue of the face is {value:.2f}, in the other cameras' images it is "
                f"{', '.join(f'{other:.2f}' for camera, other in ratio.items() if camera != name)}: another "
                "encoding or white balance; export all cameras alike"
            )
            found.append(Diagnostic("colours-differ", text, camera=name))
    return found


def _codes(capture: Capture, name: str, timestep: int) -> NDArray[np.float32]:
    """(H, W) green as 8-bit sRGB codes of a well exposed image would have it, roughly."""
    image = capture.frame(name, timestep).image[..., 1]
    white = max(float(np.percentile(image, 99)), 1e-30)
    return np.asarray(255.0 * np.clip(image / white, 0.0, 1.0) ** (1 / 2.2), dtype=np.float32)


def _same(a: NDArray, b: NDArray) -> bool:
    """Whether two images show the same; black ones show nothing."""
    return a.shape == b.shape and bool(a.any()) and float(np.abs(a - b).mean()) < SAME_CODES


def _skin(capture: Capture, name: str, timestep: int) -> NDArray[np.float32]:
    """(n, 3) linear colours between the landmarks that are neither clipped nor dark."""
    frame = capture.frame(name, timestep)
    if frame.landmarks is None or frame.visible[INNER].sum() < FEWEST:
        return np.zeros((0, 3), dtype=np.float32)
    hull = cv2.convexHull(frame.landmarks[INNER][frame.visible[INNER]].astype(np.float32))
    inside = np.zeros(frame.valid.shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, np.rint(np.clip(hull, -1e4, 1e4)).astype(np.int32), 1)
    pixels = frame.image[(inside > 0) & frame.valid & ~frame.clipped]
    return np.asarray(pixels[pixels.min(axis=1) > 0.002])
