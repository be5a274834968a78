"""Experiment files: what one may say, checked whole, and the runs that it asks for."""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

import mifit
from mifit import cache
from mifit.config import (
    FitConfig,
    Index,
    Name,
    flag,
    from_mapping,
    number,
    one_of,
    parse_toml,
    part,
    read_toml,
    settings,
    several,
    text,
)
from mifit.core.files import Document, check_file, file_digest, file_name
from mifit.core.limits import MAX_COUNT, MAX_FILE_BYTES, MAX_SEED, MAX_SETTINGS_BYTES
from mifit.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Part = TypeVar("Part", bound="DataclassInstance")


@settings
class SynthRun:
    """A capture made for the experiment (``mifit synth``)."""

    timesteps: int = number(4, "how many", least=1, most=10_000)
    width: int = number(340, "width of the images", "pixels", least=16, most=16_384)
    height: int = number(240, "height of the images", "pixels", least=16, most=16_384)
    spp: int = number(48, "samples per pixel", least=1, most=MAX_COUNT)
    seed: int = number(0, "seed of everything random", least=0, most=MAX_SEED)
    env: str | None = text(None, "lat-long HDR environment; none: a procedural studio")
    model: str = text("builtin", "morphable model: a path or builtin")


@settings
class FitRun(FitConfig):
    """Fit a capture; the settings of ``mifit fit``, those of its stages among them."""

    capture: str | None = text(None, "capture folder")
    synth: SynthRun | None = part(None, "a capture made for the experiment, instead of a folder")
    model: str = text("builtin", "morphable model: a path or builtin")
    cameras: tuple[Name, ...] = several(("left", "right"), "cameras to use")
    timesteps: tuple[Index, ...] | None = several(None, "timesteps to use; none: the first four")
    until: Literal["geometry", "reflectance", "normals"] = one_of("normals", "last stage")
    seed: int = number(0, "seed of everything random", least=0, most=MAX_SEED)

    @property
    def config(self) -> FitConfig:
        """The settings of the stages alone."""
        return FitConfig(**{f.name: getattr(self, f.name) for f in dataclasses.fields(FitConfig)})


@settings
class EvaluateRun:
    """Judge the fit on a view; the settings of ``mifit evaluate``."""

    camera: str = text(..., "camera that is not fitted")
    region: Literal["face", "skin", "truth"] = one_of("face", "which pixels count")
    timesteps: tuple[Index, ...] | None = several(None, "timesteps to judge; none: all of the fit")


@settings
class RelightRun:
    """Light the fit by an environment and compare the fast path with path tracing."""

    env: str = text(..., "lat-long environment, .hdr or .exr")
    rotate: float = number(0.0, "turn of the environment about the vertical", "degrees", least=-3600, most=3600)


@settings
class RenderRun:
    """Render a Mitsuba scene; its ``<default>`` names take values from ``parameters``."""

    scene: str = text(..., "scene file")
    parameters: dict[str, bool | int | float | str] = part(dict, "values of the scene's <default> names")
    spp: int = number(64, "samples per pixel", least=1, most=MAX_COUNT)
    seed: int = number(0, "seed of the samples", least=0, most=MAX_SEED)


@settings
class ReferenceRun:
    """The render of the same scene that a `RenderRun` is compared with."""

    parameters: dict[str, bool | int | float | str] = part(dict, "values of the scene's <default> names")
    spp: int = number(1024, "samples per pixel", least=1, most=MAX_COUNT)
    seed: int = number(1, "seed of the samples", least=0, most=MAX_SEED)


@settings
class Outputs:
    """What a run leaves in its folder besides ``run.json``."""

    result: bool = flag(True, "the result folder")
    report: bool = flag(False, "report.html")
    images: bool = flag(True, "renders")


@settings
class Experiment:
    """One run: either ``fit`` with ``evaluate`` and ``relight``, or ``render`` with ``reference``."""

    name: str = text(..., "names the folder of the runs", pattern=r"^[^\x00-\x1f/\\\\.][^\x00-\x1f/\\\\]{0,99}$")
    fit: FitRun | None = part()
    evaluate: EvaluateRun | None = part()
    relight: RelightRun | None = part()
    render: RenderRun | None = part()
    reference: ReferenceRun | None = part()
    outputs: Outputs = part(Outputs)


@dataclass(frozen=True)
class Run:
    """One point of a sweep: all settings with absolute paths, and the keys that the sweep sets with their values.

    ``digest`` is that of the settings, the inputs' contents and mifit's version.
    """

    experiment: Experiment
    swept: Document
    digest: str

    @property
    def folder(self) -> str:
        """Name of the run's folder: its swept values, readable, and its digest."""
        words = [f"{_plain(key.rsplit('.', 1)[-1])}={_plain(value)}" for key, value in self.swept.items()]
        return "_".join([file_name("_".join(words)), self.digest[:10]] if words else [self.digest[:10]])


def _plain(value: object) -> str:
    text = "-".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
    return "".join(c if c.isalnum() or c in ".-+" else "-" for c in Path(text).name)


@dataclass(frozen=True)
class Plan:
    """A validated experiment file; ``jobs`` are processes at a time on one machine."""

    name: str
    runs: tuple[Run, ...]
    jobs: int


def load_plan(path: str | Path, overrides: Sequence[str] = (), seed: int = 0) -> Plan:
    """The validated content of an experiment file: every run of the sweep, every input that it names.

    ``overrides`` are ``KEY=VALUE`` with a dotted key and a TOML value (a bare word is a string); ``seed`` is that of
    the runs where the file gives none. InputError where the file, a key, a value, a sweep or an input is not what it
    must be.
    """
    path = Path(path)
    check_file(path, MAX_SETTINGS_BYTES, "experiment file")
    document = read_toml(path)
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key.strip():
            raise InputError(f"--set {override}: expected KEY=VALUE, such as --set fit.reflectance.exponent=8")
        _assign(document, key.strip(), _toml_value(value.strip()), f"--set {override}")
    sweep = document.pop("sweep", {})
    jobs = document.pop("jobs", 1)
    if isinstance(jobs, bool) or not isinstance(jobs, int) or not 1 <= jobs <= 1024:
        raise InputError(f"{path}: jobs: found {jobs!r}, expected a whole number from 1 to 1024")
    document.setdefault("name", path.stem)
    points = []
    for swept in _points(sweep, path):
        point = copy.deepcopy(document)
        where = f"{path}: sweep {swept}" if swept else str(path)
        for key, value in swept.items():
            _assign(point, key, value, where)
        for kind in ("fit", "render"):
            if isinstance(point.get(kind), dict):
                point[kind].setdefault("seed", seed)
        points.append((_resolved(from_mapping(Experiment, point, where), path.parent, where), swept, where))
    runs, digest_of = [], functools.cache(_digest)
    for experiment, swept, where in points:
        try:
            inputs = {name: digest_of(*given) for name, given in _inputs(experiment).items()}
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        key = cache.digest({"version": mifit.__version__, "settings": dataclasses.asdict(experiment), **inputs})
        runs.append(Run(experiment, swept, key))
    if len({run.digest for run in runs}) != len(runs):
        raise InputError(f"{path}: sweep: two runs have the same settings; remove the repeated value")
    return Plan(runs[0].experiment.name, tuple(runs), jobs)


def _toml_value(text: str) -> object:
    try:
        return parse_toml(f"x = {text}")["x"]
    except (ValueError, RecursionError):
        return text


def _assign(table: dict, key: str, value: object, where: str) -> None:
    """Set a dotted key in nested tables, which are made as needed; a capture takes the place of a synthetic one."""
    *parents, last = key.split(".")
    for name in parents:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise InputError(f"{where}: {key}: {name} is a value, expected a table")
    table[last] = value
    other = {"capture": "synth", "synth": "capture"}.get(last)
    if other and parents == ["fit"]:
        table.pop(other, None)


def _points(sweep: object, where: Path) -> Iterator[Document]:
    """The points of a sweep: the product of ``grid``'s lists, of which a folder of captures is one, or ``list``."""
    if not isinstance(sweep, dict) or set(sweep) - {"grid", "list"} or len(sweep) > 1:
        raise InputError(f"{where}: sweep: found {sweep!r}, expected one table 'grid' or one list 'list'")
    points = sweep.get("list", [{}])
    grid = sweep.get("grid", {})
    if not isinstance(grid, dict):
        raise InputError(f"{where}: sweep.grid: found {grid!r}, expected a table of lists")
    grid = dict(_flatten(grid))
    if isinstance(folder := grid.get("fit.capture"), str):
        found = sorted(path.parent.name for path in (where.parent / folder).glob("*/transforms.json"))
        if not found:
            raise InputError(
                f"{where}: sweep.grid: fit.capture: found no capture in {folder!r}, expected folders of them"
            )
        grid["fit.capture"] = [os.path.join(folder, name) for name in found]
    for key, values in grid.items():
        if not isinstance(values, list) or not values:
            raise InputError(f"{where}: sweep.grid: {key}: found {values!r}, expected a list of values")
    if not isinstance(points, list) or not points or not all(isinstance(p, dict) for p in points):
        raise InputError(f"{where}: sweep.list: found {points!r}, expected a list of tables")
    count = len(points) * math.prod(map(len, grid.values()))
    if count > MAX_COUNT:
        raise InputError(f"{where}: sweep: found {count} runs, expected at most {MAX_COUNT}; split the sweep")
    for point, values in itertools.product(points, itertools.product(*grid.values())):
        yield dict(_flatten(point)) | dict(zip(grid, values, strict=True))


def _flatten(table: dict, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Nested tables -> dotted keys, so that both ``a.b = [1]`` and ``"a.b" = [1]`` work in TOML."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _resolved(e: Experiment, folder: Path, where: str) -> Experiment:
    """Check how the parts go together, and make paths absolute (relative ones are from the file's folder)."""
    refused = {
        "expected one of the tables [fit] and [render]": (e.fit is None) == (e.render is None),
        "[evaluate] and [relight] need [fit]": e.fit is None and (e.evaluate or e.relight),
        "[reference] needs [render]": e.render is None and e.reference,
        "fit: expected one of 'capture' and 'synth'": e.fit and (e.fit.capture is None) == (e.fit.synth is None),
    }
    for message, found in refused.items():
        if found:
            raise InputError(f"{where}: {message}")
    if e.fit and e.evaluate and e.evaluate.camera in e.fit.cameras:
        raise InputError(
            f"{where}: evaluate.camera: found {e.evaluate.camera!r}, which fit.cameras names too; "
            "expected a camera that is not fitted"
        )
    named: list[tuple[str, str]] = []
    if e.fit and e.fit.synth:
        named += [("fit.cameras", name) for name in e.fit.cameras]
        named += [("evaluate.camera", e.evaluate.camera)] if e.evaluate else []
    for key, name in named:
        if name not in ("left", "right", "third"):  # `synth.compose.place_cameras`
            raise InputError(
                f"{where}: {key}: found {name!r}, expected one of left, right, third, as synthetic captures have"
            )
    return _absolute(e, folder)


def _absolute(settings: Part, folder: Path) -> Part:
    """Settings whose paths are absolute, in their parts too."""
    changed: Document = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if isinstance(value, (FitRun, SynthRun, RelightRun, RenderRun)):
            changed[field.name] = _absolute(value, folder)
        elif field.name in ("scene", "env", "capture", "model") and isinstance(value, str):
            if field.name != "model" or value.partition(":")[0] not in ("builtin", "auto"):
                changed[field.name] = os.path.abspath(folder / value)  # links stay: following a loop of them raises
    return dataclasses.replace(settings, **changed)


def _inputs(e: Experiment) -> dict[str, tuple]:
    """What a run reads: the arguments of `_digest` for each input."""
    found: dict[str, tuple] = {}
    if e.render:
        found["scene"] = ("file", e.render.scene)
    if e.relight:
        found["env"] = ("file", e.relight.env)
    if e.fit:
        found["model"] = ("model", e.fit.model)
        if e.fit.capture is not None:
            cameras = (*e.fit.cameras, *([e.evaluate.camera] if e.evaluate else []))
            found["capture"] = ("capture", e.fit.capture, cameras, e.fit.timesteps)
        elif e.fit.synth and e.fit.synth.env:
            found["synth_env"] = ("file", e.fit.synth.env)
    return found


def _digest(
    kind: str, name: str, cameras: tuple[str, ...] | None = None, timesteps: tuple[int, ...] | None = None
) -> str:
    """Digest of the content of an input; InputError where it can't be used."""
    if kind == "file":
        return file_digest(name, MAX_FILE_BYTES).hex()
    if kind == "model":  # a built-in one is known by mifit's version, which every key holds
        path = Path(name)
        stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.exists() else None
        return name if name in ("builtin", "builtin:coarse") else _model_digest(name, stamp)
    from mifit.fitting import choose, choose_timesteps

    capture = mifit.Capture.load(name)
    return capture.digest(choose("camera", capture.cameras, cameras, 2), choose_timesteps(capture, timesteps))


@functools.lru_cache(maxsize=32)
def _model_digest(path: str, stamp: tuple[int, int] | None) -> str:
    return mifit.MorphableModel.load(path).digest
