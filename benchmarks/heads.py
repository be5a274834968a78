"""The heads that benchmarks fit, in two sets: those that may choose numbers, and those that only judge.

A number in the package that is chosen by errors on data is chosen on *development* heads: ``emily`` from c3 and c4,
``scan_city``, ``gloss``, and the first heads of Table 1. All others are *locked*: they may say that a part goes, never
which value it has. Nothing here is read by a fit but the fitted cameras' images and landmarks.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.record import SHARED

ICT = str(SHARED / "models" / "ict_facekit" / "ict_facekit_head.npz")
WORK = Path("out/heads")
"""Where heads that are made on the spot, and captures with changed photographs, are kept."""
DEVELOPMENT_SUBJECTS = 5
"""Heads of Table 1 that may choose numbers: the first ones."""
PAIR, THIRD = ("left", "right"), ("third",)
ALL = (0, 1, 2, 3)


@dataclass(frozen=True)
class Case:
    """One fit of one capture.

    Attributes
    ----------
    capture : str
        A folder, the name of one of the shared captures, ``ict_SEED``: a head made of the ICT model, outside its
        span by a few millimetres, with landmarks as a detector gives them, or ``table1_NUMBER``: a head of Table 1.
    model : str
        The model that is fitted.
    fitted, held_out : tuple of str
        Cameras; the held-out ones are never read by a fit.
    timesteps : tuple of int
    development : bool
        Whether it may choose numbers.
    changed : str
        What is done to the fitted photographs: a key of `CHANGES`, or nothing.
    """

    capture: str
    model: str = "builtin"
    fitted: tuple[str, ...] = PAIR
    held_out: tuple[str, ...] = THIRD
    timesteps: tuple[int, ...] = ALL
    development: bool = False
    changed: str = ""

    @property
    def path(self) -> Path:
        """The capture's folder; one that is made on the spot is made now."""
        shared = SHARED / "captures" / self.capture
        path = shared if shared.is_dir() else Path(self.capture)
        if self.made and not path.is_dir():
            path = made(self.capture)
        return changed(path, self.changed, self.fitted) if self.changed else path

    @property
    def made(self) -> bool:
        """Whether it is made on the spot."""
        return self.capture.startswith(("ict_", "table1_"))

    @property
    def missing(self) -> str:
        """What isn't there of the capture or its model; nothing where the case can run."""
        wanted = [] if self.model == "builtin" else [Path(self.model)]
        if self.made:
            wanted += [SHARED / "hdri", *[Path(ICT)] * self.capture.startswith("ict_")]
        elif not (SHARED / "captures" / self.capture).is_dir():
            wanted.append(Path(self.capture))
        return next((str(path) for path in wanted if not path.exists()), "")

    @property
    def set(self) -> str:
        """Name of the set that it belongs to."""
        return "development" if self.development else "locked"

    @property
    def label(self) -> str:
        """What a table calls it; its cameras where they aren't left and right, third held out."""
        model = "ICT" if self.model == ICT else Path(self.model).stem
        steps = f", {len(self.timesteps)} timesteps" if len(self.timesteps) > 1 else ""
        change = f", {self.changed}" if self.changed else ""
        cameras = f", {','.join(self.fitted)} → {','.join(self.held_out)}"
        usual = (self.fitted, self.held_out) == (PAIR, THIRD)
        return f"{Path(self.capture).name}{change} ({model}{steps}){'' if usual else cameras}"


MADE = tuple(f"ict_{seed}" for seed in (201, 202, 203, 204, 205))
FOREIGN = (
    Case("scan_city", development=True),
    Case("emily", ICT, ("c3", "c4"), ("c2", "c5"), (0,), development=True),
    Case("scan_studio"),
    Case("scan_sun"),
    Case("emily", ICT, ("c2", "c5"), ("c3", "c4"), (0,)),
    Case("emily", "builtin", ("c2", "c5"), ("c3", "c4"), (0,)),
    *(Case(name, timesteps=(0,)) for name in ("soft", "hard", *MADE)),
)
"""Heads that the fitted model doesn't hold."""
OWN = (Case("gloss", ICT, development=True), Case("soft", ICT), Case("hard", ICT))
"""Path-traced heads in the span of the model that is fitted."""


# -- heads made on the spot ------------------------------------------------------------

LIGHTS = ("apartment", "studio", "softbox", "city", "sunset")
OUTSIDE, BIAS = 2.0, 1.9
"""Millimetres by which heads of the ICT model leave its span, and of a detector's bias per landmark: 5 pixels."""


@dataclass(frozen=True)
class Subject:
    """A head of Table 1 by its number; three lights and five tones meet once in fifteen."""

    number: int

    @property
    def seed(self) -> int:
        """Of its identity and skin."""
        return 100 + self.number

    @property
    def tone(self) -> float:
        """Of its skin, fair to deep."""
        return 0.25 * (self.number % 5)

    @property
    def outside(self) -> float:
        """Millimetres by which it leaves the model's span; every third one by more."""
        return 2.5 if self.number % 3 == 2 else 0.5

    def light(self, further: int = 0) -> Path:
        """Its environment, or another one of the three."""
        return SHARED / "hdri" / f"{LIGHTS[(self.number + further) % 3]}.hdr"


def made(name: str, size: tuple[int, int] = (680, 480), spp: int = 64) -> Path:
    """Folder of a head of one timestep with a detector's landmarks, path traced once."""
    from mifit.synth import synthesize

    folder, kind, number = WORK / name, name.rpartition("_")[0], int(name.rpartition("_")[2])
    if not (folder / "transforms.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        if kind == "ict":
            given = SHARED / "hdri" / f"{LIGHTS[number % len(LIGHTS)]}.hdr", ICT, number
            synthesize(folder, 1, 1, *given, *size, spp, outside=OUTSIDE, landmark_bias=BIAS)
        else:
            one = Subject(number)
            given = one.light(), "builtin", one.seed
            synthesize(folder, 1, 1, *given, *size, spp, one.tone, one.outside, landmark_bias=BIAS)
    return folder


# -- photographs that are changed ------------------------------------------------------------


def _gain(image: NDArray, camera: int, timestep: int) -> NDArray:
    return image * (0.8, 0.7, 0.6) if camera == 1 else image


def _exposure(image: NDArray, camera: int, timestep: int) -> NDArray:
    return image * 0.7 if timestep == 1 else image


CHANGES: dict[str, Callable[[NDArray, int, int], NDArray]] = {
    "one camera darker and redder": _gain,
    "one timestep darker": _exposure,
}
"""Linear image, number of its camera and timestep -> the image that is fitted; the held-out photographs stay."""


def changed(folder: Path, change: str, cameras: tuple[str, ...]) -> Path:
    """A copy of a capture whose fitted photographs are changed, made once."""
    from mifit import Capture
    from mifit.core.image import read_image, write_image

    out = WORK / "changed" / f"{folder.name}_{change.replace(' ', '_')}"
    if out.is_dir():
        return out
    part = out.with_suffix(".part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(folder, part)
    for (name, timestep), shot in Capture.load(part).shots.items():
        if name in cameras:
            image = CHANGES[change](read_image(shot.image).astype(np.float64), cameras.index(name), timestep)
            write_image(shot.image, np.clip(image, 0.0, 1.0).astype(np.float32))
    part.rename(out)
    return out
