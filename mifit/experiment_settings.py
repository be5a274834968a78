"""What an experiment file may say: one run's settings, with ranges and units."""

from __future__ import annotations

import dataclasses
from typing import Literal

from mifit.config import FitConfig
from mifit.core.limits import MAX_SAMPLES, MAX_SEED
from mifit.schema import Index, Name, flag, number, one_of, part, part_or_none, settings, several, table, text

SEEDS = MAX_SEED
SIDE = 16_384  # pixels
SAMPLES = MAX_SAMPLES


@settings
class SynthRun:
    """A capture made for the experiment (``mifit synth``)."""

    timesteps: int = number(4, "how many", least=1, most=10_000)
    width: int = number(340, "width of the images", "pixels", least=16, most=SIDE)
    height: int = number(240, "height of the images", "pixels", least=16, most=SIDE)
    spp: int = number(48, "samples per pixel", least=1, most=SAMPLES)
    seed: int = number(0, "seed of everything random", least=0, most=SEEDS)
    env: str | None = text(None, "lat-long HDR environment; none: a procedural studio")
    model: str = text("builtin", "morphable model: a path or builtin")


@settings
class FitRun(FitConfig):
    """Fit a capture; the settings of ``mifit fit``, those of its stages among them."""

    capture: str | None = text(None, "capture folder")
    synth: SynthRun | None = part_or_none("a capture made for the experiment, instead of a folder")
    model: str = text("builtin", "morphable model: a path or builtin")
    cameras: tuple[Name, ...] = several(("left", "right"), "cameras to use")
    timesteps: tuple[Index, ...] | None = several(None, "timesteps to use; none: the first four")
    until: Literal["geometry", "reflectance", "normals"] = one_of("normals", "last stage")
    seed: int = number(0, "seed of everything random", least=0, most=SEEDS)

    @property
    def config(self) -> FitConfig:
        """The settings of the stages alone."""
        return FitConfig(**{f.name: getattr(self, f.name) for f in dataclasses.fields(FitConfig)})


@settings
class EvaluateRun:
    """Judge the fit on a view; the settings of ``mifit evaluate``."""

    camera: str = text(..., "camera that is not fitted")
    region: Literal["model", "truth"] = one_of("model", "whose face area counts")
    timesteps: tuple[Index, ...] | None = several(None, "timesteps to judge; none: all of the fit")


@settings
class RelightRun:
    """Light the fit by an environment and compare the fast path with path tracing.

    With ``capture``, photographs of the same head under the environment, the relit views are judged by its ``camera``;
    with ``synth``, that capture is made (``synth.env`` must be the environment).
    """

    env: str = text(..., "lat-long environment, .hdr or .exr")
    rotate: float = number(0.0, "turn of the environment about the vertical", "degrees", least=-3600, most=3600)
    capture: str | None = text(None, "capture folder")
    synth: SynthRun | None = part_or_none("a capture made for the experiment, instead of a folder")
    camera: str = text("third", "camera of that capture")


@settings
class RenderRun:
    """Render a Mitsuba scene; its ``<default>`` names take values from ``parameters``."""

    scene: str = text(..., "scene file")
    parameters: dict[str, bool | int | float | str] = table("values of the scene's <default> names")
    spp: int = number(64, "samples per pixel", least=1, most=SAMPLES)
    seed: int = number(0, "seed of the samples", least=0, most=SEEDS)


@settings
class ReferenceRun:
    """The render of the same scene that a `RenderRun` is compared with."""

    parameters: dict[str, bool | int | float | str] = table("values of the scene's <default> names")
    spp: int = number(1024, "samples per pixel", least=1, most=SAMPLES)
    seed: int = number(1, "seed of the samples", least=0, most=SEEDS)


@settings
class Outputs:
    """What a run leaves in its folder besides ``run.json``."""

    result: bool = flag(True, "the result folder")
    report: bool = flag(False, "report.html")
    images: bool = flag(True, "renders")


@settings
class Jobs:
    """How many runs at a time."""

    jobs: int = number(1, "processes at a time on one machine", least=1, most=1024)


@settings
class Experiment:
    """One run: either ``fit`` with ``evaluate`` and ``relight``, or ``render`` with ``reference``."""

    name: str = text(..., "names the folder of the runs", pattern=r"^[^\x00-\x1f/\\\\.][^\x00-\x1f/\\\\]{0,99}$")
    fit: FitRun | None = part_or_none()
    evaluate: EvaluateRun | None = part_or_none()
    relight: RelightRun | None = part_or_none()
    render: RenderRun | None = part_or_none()
    reference: ReferenceRun | None = part_or_none()
    outputs: Outputs = part(Outputs)
