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
from typing import Any

import mifit
from mifit import checkpoint
from mifit.core.files import check_file, file_digest, file_name
from mifit.core.limits import MAX_IMAGE_BYTES, MAX_RUNS, MAX_SETTINGS_BYTES
from mifit.errors import InputError
from mifit.experiment_settings import Experiment, Jobs, SynthRun
from mifit.schema import (
    from_mapping,
    parse_toml,
    read_toml,
)

BUILTIN = ("builtin", "builtin:coarse")


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
        words = [f"{_plain(key.rsplit('.', 1)[-1])}={_plain(value)}" for key, value in self.swept.items()]
        return "_".join([file_name("_".join(words)), self.digest[:10]] if words else [self.digest[:10]])


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
    check_file(path, MAX_SETTINGS_BYTES, "experiment file")
    document = read_toml(path)
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key.strip():
            raise InputError(f"--set {override}: expected KEY=VALUE, such as --set fit.reflectance.exponent=8")
        _assign(document, key.strip(), _toml_value(value.strip()), f"--set {override}")
    sweep = document.pop("sweep", {})
    jobs = from_mapping(Jobs, {"jobs": document.pop("jobs", 1)}, str(path)).jobs
    document.setdefault("name", path.stem)
    points = []
    for swept in _points(_with_captures(sweep, path), str(path)):
        point = copy.deepcopy(document)
        where = f"{path}: sweep {swept}" if swept else str(path)
        for key, value in swept.items():
            _assign(point, key, value, where)
        for kind in ("fit", "render"):
            if isinstance(point.get(kind), dict):
                point[kind].setdefault("seed", seed)
        points.append((_resolved(from_mapping(Experiment, point, where), path.parent, where), swept, where))
    digests: dict[tuple[str, ...], str] = {}
    runs = []
    for experiment, swept, where in points:
        inputs = _check_inputs(experiment, where, digests)
        key = checkpoint.digest({"version": mifit.__version__, "settings": dataclasses.asdict(experiment), **inputs})
        runs.append(Run(experiment, swept, key))
    if len({run.digest for run in runs}) != len(runs):
        raise InputError(f"{path}: sweep: two runs have the same settings; remove the repeated value")
    return Plan(runs[0].experiment.name, tuple(runs), jobs)


def _toml_value(text: str) -> Any:
    try:
        return parse_toml(f"x = {text}")["x"]
    except (ValueError, RecursionError):
        return text


def _assign(table: dict, key: str, value: Any, where: str) -> None:
    """Set a dotted key in nested tables, which are made as needed; a capture takes the place of a synthetic one."""
    *parents, last = key.split(".")
    for name in parents:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise InputError(f"{where}: {key}: {name} is a value, expected a table")
    table[last] = value
    other = {"capture": "synth", "synth": "capture"}.get(last)
    if other and parents in (["fit"], ["relight"]):
        table.pop(other, None)


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
        _check_count(math.prod(map(len, grid.values())), where)
        for values in itertools.product(*grid.values()):
            yield dict(zip(grid, values, strict=True))
    elif "list" in sweep:
        points = sweep["list"]
        if not isinstance(points, list) or not points or not all(isinstance(p, dict) for p in points):
            raise InputError(f"{where}: sweep.list: found {points!r}, expected a list of tables")
        _check_count(len(points), where)
        yield from (dict(_flatten(p)) for p in points)
    else:
        yield {}


def _with_captures(sweep: Any, path: Path) -> Any:
    """A sweep in whose grid a folder of captures stands for the list of them."""
    if not isinstance(sweep, dict) or not isinstance(sweep.get("grid"), dict):
        return sweep
    grid = dict(_flatten(sweep["grid"]))
    for key in ("fit.capture", "relight.capture"):
        if isinstance(grid.get(key), str):
            folder = grid[key]
            found = sorted(p.parent.name for p in (path.parent / folder).glob("*/transforms.json"))
            if not found:
                raise InputError(f"{path}: sweep.grid: {key}: found no capture in {folder!r}, expected folders of them")
            grid[key] = [os.path.join(folder, name) for name in found]
    return {**sweep, "grid": grid}


def _check_count(count: int, where: str) -> None:
    if count > MAX_RUNS:
        raise InputError(f"{where}: sweep: found {count} runs, expected at most {MAX_RUNS}; split the sweep")


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
        return os.path.abspath(folder / text)  # links stay: following a loop of them raises

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
            made = synthetic(relight.synth)
            relight = dataclasses.replace(relight, synth=made)
            if relight.capture is not None or made.env != relight.env:
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
            return file_digest(name, MAX_IMAGE_BYTES).hex()

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
                from mifit.pipeline import choose, choose_timesteps

                found = Capture.load(name)
                steps = choose_timesteps(found, wanted)
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
