"""Experiment files: what one may say, checked whole, and the runs that it asks for."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import mifit
from mifit import checkpoint
from mifit.config import (
    GeometryConfig,
    MeshConfig,
    NormalsConfig,
    ReflectanceConfig,
    ShapeConfig,
    from_mapping,
    read_toml,
)
from mifit.errors import InputError

BUILTIN = ("builtin", "builtin:coarse")


@dataclass(frozen=True)
class SynthRun:
    """A capture made for the experiment (``mifit synth``)."""

    timesteps: int = 4
    width: int = 340
    height: int = 240
    spp: int = 48
    seed: int = 0
    env: str | None = None
    model: str = "builtin"


@dataclass(frozen=True)
class FitRun:
    """Fit a capture; the settings of ``mifit fit``."""

    capture: str | None = None
    synth: SynthRun | None = None
    model: str = "builtin"
    cameras: tuple[str, ...] = ("left", "right")
    timesteps: tuple[int, ...] | None = None
    until: Literal["geometry", "reflectance", "normals"] = "normals"
    seed: int = 0
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    reflectance: ReflectanceConfig = field(default_factory=ReflectanceConfig)
    normals: NormalsConfig = field(default_factory=NormalsConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)


@dataclass(frozen=True)
class EvaluateRun:
    """Judge the fit on a view; the settings of ``mifit evaluate``."""

    camera: str
    region: Literal["model", "truth"] = "model"
    timesteps: tuple[int, ...] | None = None


@dataclass(frozen=True)
class RelightRun:
    """Light the fit by an environment and compare the fast path with path tracing.

    With ``capture``, photographs of the same head under the environment, the relit views are judged by its ``camera``;
    with ``synth``, that capture is made (``synth.env`` must be the environment).
    """

    env: str
    rotate: float = 0.0
    capture: str | None = None
    synth: SynthRun | None = None
    camera: str = "third"


@dataclass(frozen=True)
class RenderRun:
    """Render a Mitsuba scene; its ``<default>`` names take values from ``parameters``."""

    scene: str
    parameters: dict = field(default_factory=dict)
    spp: int = 64
    seed: int = 0


@dataclass(frozen=True)
class ReferenceRun:
    """The render of the same scene that a `RenderRun` is compared with."""

    parameters: dict = field(default_factory=dict)
    spp: int = 1024
    seed: int = 1


@dataclass(frozen=True)
class Outputs:
    """What a run leaves in its folder besides ``run.json``."""

    result: bool = True
    report: bool = False
    images: bool = True


@dataclass(frozen=True)
class Experiment:
    """One run: either ``fit`` with ``evaluate`` and ``relight``, or ``render`` with ``reference``."""

    name: str
    fit: FitRun | None = None
    evaluate: EvaluateRun | None = None
    relight: RelightRun | None = None
    render: RenderRun | None = None
    reference: ReferenceRun | None = None
    outputs: Outputs = field(default_factory=Outputs)


@dataclass(frozen=True)
class Run:
    """One point of a sweep.

    Attributes
    ----------
    experiment : Experiment
        All settings, paths absolute.
    swept : dict
        The keys that the sweep sets and their values.
    digest : str
        Digest of the settings, the inputs' contents and mifit's version.
    """

    experiment: Experiment
    swept: dict[str, Any]
    digest: str

    @property
    def folder(self) -> str:
        """Name of the run's folder: its swept values, readable, and its digest."""
        words = [f"{key.rsplit('.', 1)[-1]}={_plain(value)}" for key, value in self.swept.items()]
        return "_".join([*words, self.digest[:10]])[-120:]


def _plain(value: Any) -> str:
    text = "-".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
    return "".join(c if c.isalnum() or c in ".-+" else "-" for c in Path(text).name)


@dataclass(frozen=True)
class Plan:
    """A validated experiment file.

    Attributes
    ----------
    name : str
    runs : tuple of Run
    jobs : int
        Processes at a time on one machine.
    """

    name: str
    runs: tuple[Run, ...]
    jobs: int


def load_plan(path: str | Path, overrides: Sequence[str] = (), seed: int = 0) -> Plan:
    """Read and validate an experiment file: every run of the sweep, every input that it names.

    Parameters
    ----------
    path : path
    overrides : sequence of str
        ``KEY=VALUE`` with a dotted key and a TOML value (a bare word is a string).
    seed : int
        Seed of the runs where the file gives none.

    Raises
    ------
    InputError
        The file, a key, a value, a sweep or an input is not what it must be.
    """
    path = Path(path)
    table = read_toml(path)
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise InputError(f"--set {text}: expected KEY=VALUE, such as --set fit.reflectance.exponent=8")
        _assign(table, key.strip(), _toml_value(value.strip()), f"--set {text}")
    sweep = table.pop("sweep", {})
    jobs = table.pop("jobs", 1)
    if isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1:
        raise InputError(f"{path}: jobs: found {jobs!r}, expected a whole number of at least 1")
    table.setdefault("name", path.stem)
    digests: dict[tuple[str, ...], str] = {}
    runs = []
    for swept in _points(sweep, str(path)):
        point = json.loads(json.dumps(table, default=str))
        where = f"{path}: sweep {swept}" if swept else str(path)
        for key, value in swept.items():
            _assign(point, key, value, where)
        for kind in ("fit", "render"):
            if isinstance(point.get(kind), dict):
                point[kind].setdefault("seed", seed)
        experiment = _resolved(from_mapping(Experiment, point, where), path.parent, where)
        inputs = _check_inputs(experiment, where, digests)
        key = checkpoint.digest({"version": mifit.__version__, "settings": dataclasses.asdict(experiment), **inputs})
        runs.append(Run(experiment, swept, key))
    if len({run.digest for run in runs}) != len(runs):
        raise InputError(f"{path}: sweep: two runs have the same settings; remove the repeated value")
    return Plan(runs[0].experiment.name, tuple(runs), jobs)


def _toml_value(text: str) -> Any:
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef]
    try:
        return tomllib.loads(f"x = {text}")["x"]
    except (ValueError, RecursionError):
        return text


def _assign(table: dict, key: str, value: Any, where: str) -> None:
    """Set a dotted key in nested tables, which are made as needed."""
    *parents, last = key.split(".")
    for name in parents:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise InputError(f"{where}: {key}: {name} is a value, expected a table")
    table[last] = value


def _points(sweep: Any, where: str) -> Iterator[dict[str, Any]]:
    """The points of a sweep: the product of ``grid``'s lists, or the tables of ``list``; one point without a sweep."""
    if not isinstance(sweep, dict) or set(sweep) - {"grid", "list"} or len(sweep) > 1:
        raise InputError(f"{where}: sweep: found {sweep!r}, expected one table 'grid' or one list 'list'")
    if "grid" in sweep:
        grid = sweep["grid"]
        if not isinstance(grid, dict):
            raise InputError(f"{where}: sweep.grid: found {grid!r}, expected a table of lists")
        grid = dict(_flatten(grid))
        for key, values in grid.items():
            if not isinstance(values, list) or not values:
                raise InputError(f"{where}: sweep.grid: {key}: found {values!r}, expected a list of values")
        for values in itertools.product(*grid.values()):
            yield dict(zip(grid, values, strict=True))
    elif "list" in sweep:
        points = sweep["list"]
        if not isinstance(points, list) or not points or not all(isinstance(p, dict) for p in points):
            raise InputError(f"{where}: sweep.list: found {points!r}, expected a list of tables")
        yield from (dict(_flatten(p)) for p in points)
    else:
        yield {}


def _flatten(table: dict, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested tables -> dotted keys, so that both ``a.b = [1]`` and ``"a.b" = [1]`` work in TOML."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _resolved(experiment: Experiment, folder: Path, where: str) -> Experiment:
    """Check how the parts go together, and make paths absolute (relative ones are from the file's folder)."""
    e = experiment
    if (e.fit is None) == (e.render is None):
        raise InputError(f"{where}: expected one of the tables [fit] and [render]")
    if e.fit is None and (e.evaluate or e.relight):
        raise InputError(f"{where}: [evaluate] and [relight] need [fit]")
    if e.render is None and e.reference:
        raise InputError(f"{where}: [reference] needs [render]")

    def absolute(text: str) -> str:
        return str((folder / text).resolve())

    def model(text: str) -> str:
        return text if text.startswith("builtin") else absolute(text)

    def synthetic(synth: SynthRun) -> SynthRun:
        env = absolute(synth.env) if synth.env else None
        return dataclasses.replace(synth, env=env, model=model(synth.model))

    if e.render:
        e = dataclasses.replace(e, render=dataclasses.replace(e.render, scene=absolute(e.render.scene)))
    if e.fit:
        if (e.fit.capture is None) == (e.fit.synth is None):
            raise InputError(f"{where}: fit: expected one of 'capture' and 'synth'")
        if e.evaluate and e.evaluate.camera in e.fit.cameras:
            raise InputError(
                f"{where}: evaluate.camera: found {e.evaluate.camera!r}, which fit.cameras names too; "
                "expected a camera that is not fitted"
            )
        fit = dataclasses.replace(e.fit, model=model(e.fit.model))
        if fit.capture is not None:
            fit = dataclasses.replace(fit, capture=absolute(fit.capture))
        if fit.synth is not None:
            fit = dataclasses.replace(fit, synth=synthetic(fit.synth))
        e = dataclasses.replace(e, fit=fit)
    if e.relight:
        relight = dataclasses.replace(e.relight, env=absolute(e.relight.env))
        if relight.capture is not None:
            relight = dataclasses.replace(relight, capture=absolute(relight.capture))
        if relight.synth is not None:
            relight = dataclasses.replace(relight, synth=synthetic(relight.synth))
            if relight.capture is not None or relight.synth.env != relight.env:
                raise InputError(f"{where}: relight.synth: expected its 'env' to be relight.env, and no 'capture'")
        e = dataclasses.replace(e, relight=relight)
    return e


def _check_inputs(e: Experiment, where: str, digests: dict[tuple[str, ...], str]) -> dict[str, str]:
    """Open every input that a run names; returns digests of their contents (cached over the runs)."""
    from mifit.capture import Capture

    def cached(key: tuple[str, ...], compute: Any) -> str:
        if key not in digests:
            try:
                digests[key] = compute()
            except InputError as error:
                raise InputError(f"{where}: {error}") from None
        return digests[key]

    def file(name: str) -> str:
        def compute() -> str:
            try:
                return checkpoint.digest(Path(name).read_bytes().hex())
            except OSError as error:
                raise InputError(f"{name}: can't be read: {error.strerror}") from None

        return cached(("file", name), compute)

    out = {}
    if e.render:
        out["scene"] = file(e.render.scene)
    if e.relight:
        out["env"] = file(e.relight.env)
        if e.relight.capture is not None:
            lit = e.relight.capture
            out["lit_capture"] = cached(("lit", lit), lambda: Capture.load(lit).digest())
    if e.fit:
        out["model"] = cached(("model", e.fit.model), lambda: _model_digest(e.fit.model))
        cameras = [*e.fit.cameras, *([e.evaluate.camera] if e.evaluate else [])]
        if e.fit.capture is not None:
            name, wanted = e.fit.capture, e.fit.timesteps

            def capture() -> str:
                from mifit.pipeline import choose

                found = Capture.load(name)
                steps = choose("timestep", found.timesteps, wanted, 4)
                return found.digest(choose("camera", found.cameras, cameras, 2), steps)

            out["capture"] = cached(("capture", name, *cameras, str(wanted)), capture)
        elif e.fit.synth is not None and e.fit.synth.env:
            out["synth_env"] = file(e.fit.synth.env)
    return out


def _model_digest(source: str) -> str:
    """Digest of a model; the built-in ones are known by mifit's version, which every digest holds anyway."""
    if source in BUILTIN:
        return source
    path = Path(source)
    stamp = path.stat() if path.exists() else None
    return _loaded_digest(source, stamp and (stamp.st_mtime_ns, stamp.st_size))


@functools.lru_cache(maxsize=32)
def _loaded_digest(source: str, stamp: tuple[int, int] | None) -> str:
    from mifit.morphable import MorphableModel

    return MorphableModel.load(source).digest
