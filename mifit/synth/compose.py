"""``synthesize``: subjects, cameras, light and sensor put together into a capture folder with its ground truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.capture.landmark_files import write_landmarks
from mifit.capture.transforms import MIN_SIDE, Shot, View, write_transforms
from mifit.core.calls import whole
from mifit.core.camera import Camera
from mifit.core.files import replacing, write_json
from mifit.core.image import read_environment, write_image
from mifit.core.limits import MAX_COUNT, MAX_PIXELS, MAX_SEED
from mifit.core.mesh import SplitMesh, split_at_seams, vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.openings import RADIUS_MM, eyeballs, openings
from mifit.progress import Progress, silent
from mifit.render.gbuffer import SurfaceScene
from mifit.render.pathtrace import Material, PathTracer, Surface
from mifit.render.variant import check_active_variant
from mifit.synth import head
from mifit.synth.procedural import studio_environment
from mifit.synth.skin import SkinMaps, SkinStyle, paint

MOST_MM = 20.0
"""Of what moves a head or a landmark away from the model."""
FULL_WELL = 12000.0
"""Electrons of a pixel at linear value 1: shot noise."""
READ_NOISE = 0.0012
"""Standard deviation of the sensor's read noise in linear image units."""


def synthesize(  # noqa: PLR0913
    out: str | Path,
    subjects: int = 1,
    timesteps: int = 4,
    env: str | Path | None = None,
    model: str | Path = "builtin",
    seed: int = 0,
    width: int = 680,
    height: int = 480,
    spp: int = 64,
    tone: float | None = None,
    outside: float = head.OUTSIDE,
    landmark_bias: float = 0.0,
    portrait: bool = False,
    progress: Progress = silent,
) -> Path:
    """Folder of a capture of an unseen subject, rendered with ground truth beside it.

    Cameras ``left``, ``right`` (20 degrees to either side) and ``third`` (above the middle) see a head that moves
    and changes its expression under a fixed environment. Skin has painted detail and microfacet lobes, images
    have shot and read noise and 8-bit sRGB codes. ``truth/NNNN.npz`` holds world-space vertices in the order of the
    model with ``R``, ``t`` and ``scale``; ``truth/maps.npz`` albedo, specular, roughness and bump (millimetres).

    Parameters
    ----------
    out : path
        Capture folder; with several subjects the folder of ``subject_00``, ``subject_01`` ...
    subjects, timesteps : int
    env : path, optional
        Lat-long HDR or EXR environment; a procedural studio by default.
    model : str or path
        Morphable model that heads are drawn from.
    seed : int
        The same seed gives the same files.
    width, height : int
        Image size in pixels.
    spp : int
        Samples per pixel.
    tone : float, optional
        Skin from 0, fair, to 1, deep; drawn for each subject by default.
    outside : float
        Millimetres by which heads leave what the model spans, see `head.neutral_shape`.
    landmark_bias : float
        Millimetres, standard deviation of each coordinate of a landmark's bias, see `head.draw_bias`; by default
        landmarks are true but for noise.
    portrait : bool
        Skin with few marks, which shines less; by default skin has much to find.
    progress : Progress

    Returns
    -------
    Path
        ``out``.

    Raises
    ------
    InputError
        A size, count or file that can't be used.
    """
    out = Path(out)
    for name, value, low, high in (
        ("subjects", subjects, 1, MAX_COUNT),
        ("timesteps", timesteps, 1, MAX_COUNT),
        ("width", width, MIN_SIDE, MAX_PIXELS // MIN_SIDE),
        ("height", height, MIN_SIDE, MAX_PIXELS // MIN_SIDE),
        ("width x height", width * height, MIN_SIDE**2, MAX_PIXELS),
        ("spp", spp, 1, MAX_COUNT),
        ("seed", seed, 0, MAX_SEED),
    ):
        whole(value, low, name, high)
    check_active_variant()
    for name, length in (("outside", outside), ("landmark_bias", landmark_bias)):
        if not 0 <= length <= MOST_MM:
            raise InputError(f"{name}: found {length}, expected 0 to {MOST_MM:g} mm")
    if tone is not None and not 0 <= tone <= 1:
        raise InputError(f"tone: found {tone}, expected 0 (fair) to 1 (deep)")
    shape = MorphableModel.load(model)
    radiance = None if env is None else read_environment(env)
    out.mkdir(parents=True, exist_ok=True)  # a place that can't be written is refused now, not after the first render
    cameras = place_cameras(width, height)
    map_size = 1024 if min(width / 680, height / 480) > 0.6 else 512
    for i in range(subjects):
        folder = out if subjects == 1 else out / f"subject_{i:02d}"
        style = SkinStyle.draw(seed + i, tone)
        style = style.portrait() if portrait else style
        subject = _draw_subject(shape, style, timesteps, map_size, outside, landmark_bias)
        light = studio_environment(seed + i) if radiance is None else radiance

        def advance(done: int, before: int = i * (timesteps + 1)) -> None:
            progress("Rendering", before + done, subjects * (timesteps + 1))

        _write_capture(folder, subject, cameras, light, spp, advance)
    return out


def place_cameras(width: int, height: int, distance: float = 72.0) -> list[Camera]:
    """Cameras left, right (20 degrees off) and third (above the middle), so many centimetres from the origin."""
    places = (("left", -20.0, 0.0), ("right", 20.0, 0.0), ("third", 3.0, 9.0))
    return [camera_at(name, width, height, azimuth, elevation, distance) for name, azimuth, elevation in places]


def camera_at(name: str, width: int, height: int, azimuth: float, elevation: float, distance: float = 72.0) -> Camera:
    """A camera that looks at the origin from degrees to the right of and above the nose."""
    focal = 1530.0 * min(width / 680, height / 480)
    a, e = math.radians(azimuth), math.radians(elevation)
    eye = distance * np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])
    fov = 2.0 * math.degrees(math.atan(0.5 * width / focal))
    return Camera.look_at(eye, width=width, height=height, fov=fov, name=name)


@dataclass(frozen=True)
class _Subject:
    """Everything of one capture but the pixels; lengths in the model's units unless said otherwise."""

    model: MorphableModel
    seed: int
    neutral: NDArray[np.float64]
    poses: list[head.HeadPose]
    scale: float
    skin: dict[str, SkinMaps]
    parts: dict[str, SplitMesh]
    eyes: list[NDArray[np.float64]]
    landmark_bias: float


def _draw_subject(
    model: MorphableModel, style: SkinStyle, timesteps: int, map_size: int, outside: float, landmark_bias: float
) -> _Subject:
    seed = style.seed
    scale = model.unit_mm / 10.0  # the world is in centimetres
    mean_mm = model.mean.astype(np.float64) * model.unit_mm
    normals = vertex_normals(mean_mm, model.faces)
    skin: dict[str, SkinMaps] = {}
    parts: dict[str, SplitMesh] = {}
    rest = ~model.face_mask
    for i, ball in enumerate(eyeballs(model)):
        chosen = np.isin(model.faces[:, 0], ball)
        parts[f"eye{i}"] = head.split_eyeball(model, chosen)
        rest &= ~chosen
    for name, chosen in (("face", model.face_mask), ("rest", rest)):
        if not chosen.any():
            continue
        faces, uv, faces_uv = model.faces[chosen], model.uv, model.faces_uv[chosen]
        if name == "rest":  # its tiles may overlap or lie outside the unit square
            uv, faces_uv = head.wrap_uv(uv, faces_uv)
        skin[name] = paint(rasterize_uv(uv, faces_uv, map_size), mean_mm, normals, faces, model.landmarks, style)
        parts[name] = split_at_seams(faces, faces_uv, uv)
    neutral = head.neutral_shape(model, seed, outside)
    centre = neutral[model.landmarks[27:48]].mean(axis=0) - np.array([0.0, 0.0, 55.0 / model.unit_mm])
    rims = [] if "eye0" in parts else openings(model)[0]
    eyes = [head.eye_centre(neutral[rim] * model.unit_mm) / model.unit_mm for rim in rims]
    poses = head.draw_motion(model, timesteps, seed, scale, centre)
    return _Subject(model, seed, neutral, poses, scale, skin, parts, eyes, landmark_bias)


def _write_capture(
    folder: Path,
    subject: _Subject,
    cameras: list[Camera],
    environment: NDArray[np.float32],
    spp: int,
    advance: Callable[[int], None],
) -> None:
    """Render and write one capture; ``transforms.json`` comes last, so a broken-off folder isn't taken for whole."""
    advance(0)
    tracer = PathTracer(_materials(subject), environment)
    maps = subject.skin["face"]
    halves = {name: getattr(maps, name).astype(np.float16) for name in ("albedo", "specular", "roughness", "bump")}
    with replacing(folder / "truth" / "maps.npz") as temporary:
        np.savez_compressed(temporary, cover=maps.cover, **halves)  # type: ignore[arg-type]
    with replacing(folder / "truth" / "mesh.npz") as temporary:
        np.savez_compressed(temporary, faces=subject.model.faces, face_mask=subject.model.face_mask)
    visibility = SurfaceScene(subject.neutral, subject.model.faces)
    bias = head.draw_bias(subject.seed, subject.landmark_bias / 10.0)  # mm -> cm
    exposure, shots = 0.0, []
    advance(1)
    for t, pose in enumerate(subject.poses):
        world = _world_vertices(subject, pose)
        seed = (subject.seed * 100_003 + t) % (MAX_SEED + 1)
        images = tracer.render(_surfaces(subject, pose, world), cameras, spp, seed=seed)
        if not t:
            exposure = exposure_of(images[0])
        visibility.update(world)
        for c, (camera, image) in enumerate(zip(cameras, images, strict=True)):
            rng = np.random.default_rng([subject.seed, t, c, 21])
            at, beside = (folder / kind / camera.name / f"{t:04d}" for kind in ("images", "landmarks"))
            shot = Shot(camera.name, t, at.with_suffix(".png"), landmarks=beside.with_suffix(".json"))
            write_image(shot.image, expose(image[..., :3] * exposure, rng))
            marks = head.mark(subject.model, world, camera, visibility, rng, bias @ pose.rotation.T)
            write_landmarks(beside.with_suffix(".json"), marks)
            shots.append(shot)
        with replacing(folder / "truth" / f"{t:04d}.npz") as temporary:
            np.savez_compressed(
                temporary,
                vertices=world.astype(np.float32),
                R=pose.rotation,
                t=pose.translation,
                scale=subject.scale,
                expression=pose.expression,
            )
        advance(t + 2)
    note: dict[str, object] = {"seed": subject.seed, "exposure": exposure, "spp": spp, "model": subject.model.name}
    write_json(folder / "truth" / "scene.json", note)
    write_image(folder / "truth" / "environment.exr", environment)
    write_transforms(folder / "transforms.json", [View.of(camera) for camera in cameras], shots, "cm")


def _world_vertices(subject: _Subject, pose: head.HeadPose) -> NDArray[np.float64]:
    moved = (subject.model.expression_jacobian @ pose.expression).reshape(-1, 3)
    return subject.scale * (subject.neutral + moved) @ pose.rotation.T + pose.translation


def _materials(subject: _Subject) -> dict[str, Material]:
    materials = {
        name: Material(maps.albedo, maps.specular, maps.roughness, maps.bump * np.float32(0.1))  # mm -> cm
        for name, maps in subject.skin.items()
    }
    if subject.eyes or "eye0" in subject.parts:
        albedo, flat = head.paint_eye(subject.seed), np.zeros((64, 64), dtype=np.float32)
        materials["eye"] = Material(albedo, flat + 0.9, flat + 0.25, flat)
    return materials


def _surfaces(subject: _Subject, pose: head.HeadPose, world: NDArray) -> list[Surface]:
    normals = vertex_normals(world, subject.model.faces)
    surfaces = [
        Surface(world[part.origin], normals[part.origin], part.uv, part.faces, name.rstrip("01"))
        for name, part in subject.parts.items()
    ]
    unit, uv, faces = head.sphere()
    for centre in subject.eyes:
        offset = unit * (RADIUS_MM / subject.model.unit_mm)
        placed = subject.scale * (centre + offset) @ pose.rotation.T + pose.translation
        surfaces.append(Surface(placed, unit @ pose.rotation.T, uv, faces, "eye"))
    return surfaces


def exposure_of(image: NDArray) -> float:
    """Factor that puts the brightest skin of an RGBA image, highlights aside, near the sensor's upper end.

    InputError where nothing in it is lit.
    """
    seen = image[image[..., 3] > 0.9]
    level = float(np.percentile(seen[:, :3].max(axis=1), 97)) if len(seen) else 0.0
    if not 0 < level < math.inf:
        raise InputError("env: the head is black under this environment, expected some radiance above zero")
    return 0.7 / level


def expose(radiance: NDArray, rng: np.random.Generator) -> NDArray[np.float32]:
    """Shot and read noise on linear pixel values, clipped to the sensor's range 0..1."""
    signal = np.clip(radiance, 0.0, None)
    noisy = signal + rng.standard_normal(signal.shape) * np.sqrt(signal / FULL_WELL + READ_NOISE**2)
    return np.clip(noisy, 0.0, 1.0).astype(np.float32)
