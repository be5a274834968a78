"""Config, experiment, model and result readers give a valid object or a mifit error, whatever the file holds."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mifit.config import FitConfig
from mifit.core.arrays import read_ply
from mifit.experiments import load_plan
from mifit.morphable import MorphableModel
from mifit.result import Reconstruction
from tests.fuzz.conftest import as_json, bounded, read_or_refuse, spoilt_bytes, spoilt_documents
from tests.output.conftest import ball_model, ball_result

SETTINGS = dataclasses.asdict(FitConfig())
EXPERIMENT = {
    "name": "sweep",
    "jobs": 2,
    "fit": {"synth": {"timesteps": 2, "width": 64, "height": 48}, "model": "builtin:coarse", "until": "geometry",
            "timesteps": [0, 1], "geometry": {}, "reflectance": {"texture_size": 64}},
    "evaluate": {"camera": "third", "region": "truth"},
    "sweep": {"grid": {"fit.seed": [0, 1], "fit.reflectance.exponent": [5.0, 9.0]}},
    "outputs": {"report": True},
}  # fmt: skip


def toml(value: Any, prefix: str = "") -> str:
    """A nested dictionary as TOML; what TOML can't hold (None, odd keys) is written as it comes."""
    lines, tables = [], []
    for key, item in value.items():
        if isinstance(item, dict):
            tables.append(f"[{prefix}{json.dumps(str(key))}]\n" + toml(item, f"{prefix}{json.dumps(str(key))}."))
        else:
            text = json.dumps(item).replace("NaN", "nan").replace("Infinity", "inf").replace("null", "nan")
            lines.append(f"{json.dumps(str(key))} = {text}")
    return "\n".join([*lines, *tables]) + "\n"


@bounded(200)
@given(st.data())
def test_config(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "fit.toml"
    if data.draw(st.booleans()):
        path.write_text(toml(data.draw(spoilt_documents(SETTINGS))), errors="replace")
    else:
        path.write_bytes(data.draw(spoilt_bytes(toml(SETTINGS).encode())))
    found = read_or_refuse(lambda: FitConfig.load(path))
    if found is not None:
        assert found.reflectance.texture_size >= 1 and found.normals.max_iterations >= 1
        assert math.isfinite(found.reflectance.smoothness_weight)


@bounded(200)
@given(st.data())
def test_experiment(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "experiment.toml"
    if data.draw(st.booleans()):
        path.write_text(toml(data.draw(spoilt_documents(EXPERIMENT))), errors="replace")
    else:
        path.write_bytes(data.draw(spoilt_bytes(toml(EXPERIMENT).encode())))
    overrides = data.draw(
        st.lists(st.sampled_from(["fit.seed=3", "fit=1", "=", "a..b=[", "sweep=4", "name=x", "jobs=-1"]), max_size=2)
    )
    plan = read_or_refuse(lambda: load_plan(path, overrides))
    if plan is not None:
        assert plan.runs and plan.jobs >= 1 and all(run.digest and "/" not in run.folder for run in plan.runs)


@pytest.mark.parametrize("value", ["[" * 100_000, "9" * 10_000, "{a=" * 20_000, '"\\uD800"', "1e99999"])
def test_values_that_parsers_choke_on(saved: tuple[Path, MorphableModel], tmp_path: Path, value: str) -> None:
    path = tmp_path / "x.toml"
    path.write_text(f"[geometry]\nlandmark_weight = {value}\n")
    assert read_or_refuse(lambda: FitConfig.load(path)) is None
    assert read_or_refuse(lambda: load_plan(path)) is None
    path.write_text(toml(EXPERIMENT))
    read_or_refuse(lambda: load_plan(path, [f"fit.seed={value}"]))
    document = saved[0] / "result.json"
    whole = document.read_text()
    try:
        document.write_text(whole.replace('"seconds": ', f'"seconds": {value}, "x": ', 1))
        read_or_refuse(lambda: use(*saved))
    finally:
        document.write_text(whole)


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A small model's file."""
    path = tmp_path_factory.mktemp("model") / "ball.npz"
    ball_model().save(path)
    return path.read_bytes()


@bounded(150)
@given(st.data())
def test_model_bytes(tmp_path: Path, model_file: bytes, data: st.DataObject) -> None:
    path = tmp_path / "model.npz"
    path.write_bytes(data.draw(spoilt_bytes(model_file)))
    found = read_or_refuse(lambda: MorphableModel.load(path))
    assert found is None or np.isfinite(found.mean).all()


@bounded(150)
@given(st.data())
def test_model_arrays(tmp_path: Path, data: st.DataObject) -> None:
    """Arrays of the right names but of other shapes, types and values."""
    path = tmp_path / "model.npz"
    model = ball_model(6, 8)
    arrays = {f.name: np.asarray(getattr(model, f.name)) for f in dataclasses.fields(model) if f.name != "symmetry"}
    arrays["mifit_model"] = np.asarray(1)
    for name in data.draw(st.lists(st.sampled_from(sorted(arrays)), min_size=1, max_size=3, unique=True)):
        value = arrays[name]
        change = data.draw(st.sampled_from(["nan", "huge", "negative", "empty", "flat", "text", "complex", "missing"]))
        if change == "missing":
            arrays.pop(name, None)
            continue
        with np.errstate(all="ignore"):
            arrays[name] = {
                "nan": lambda v: np.full(v.shape, np.nan),
                "huge": lambda v: np.full(v.shape, 1e300),
                "negative": lambda v: np.full(v.shape, -1),
                "empty": lambda v: np.zeros((0, *v.shape[1:])) if v.ndim else np.zeros(0),
                "flat": lambda v: v.ravel(),
                "text": lambda v: np.full(v.shape, "x"),
                "complex": lambda v: np.full(v.shape, 1j),
            }[change](value)
    np.savez(path, **arrays)
    found = read_or_refuse(lambda: MorphableModel.load(path))
    if found is not None:
        assert np.isfinite(found.mean).all() and found.faces.min() >= 0 and found.unit_mm > 0


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MorphableModel]:
    """A result folder and the model it needs."""
    folder = tmp_path_factory.mktemp("result") / "ball"
    result = ball_result()
    result.save(folder)
    return folder, result.model


def use(folder: Path, model: MorphableModel) -> None:
    found = Reconstruction.load(folder, model)
    assert np.isfinite(found.geometry.vertices).all()
    for camera in found.cameras:
        assert camera.width >= 1 and np.isfinite(camera.world_to_camera).all()
    if found.reflectance is not None:
        assert np.isfinite(found.illumination.radiance).all() and np.isfinite(found.reflectance.diffuse).all()


@bounded(150)
@given(st.data())
def test_result_document(saved: tuple[Path, MorphableModel], data: st.DataObject) -> None:
    folder, model = saved
    path = folder / "result.json"
    whole = path.read_text()
    try:
        if data.draw(st.booleans()):
            path.write_text(as_json(data.draw(spoilt_documents(json.loads(whole)))))
        else:
            path.write_bytes(data.draw(spoilt_bytes(whole.encode())))
        read_or_refuse(lambda: use(folder, model))
    finally:
        path.write_text(whole)


@pytest.mark.filterwarnings("ignore:.*has changed since")
@bounded(100)
@given(st.data())
def test_result_files(saved: tuple[Path, MorphableModel], data: st.DataObject) -> None:
    folder, model = saved
    files = sorted(p for p in folder.rglob("*") if p.suffix in (".ply", ".exr") and "scene" not in p.parts[-2])
    path = data.draw(st.sampled_from(files))
    whole = path.read_bytes()
    try:
        if data.draw(st.sampled_from([True, True, True, False])):
            path.write_bytes(data.draw(spoilt_bytes(whole)))
        else:
            path.unlink()
        read_or_refuse(lambda: use(folder, model))
    finally:
        path.write_bytes(whole)


def test_the_undamaged_result_is_read(saved: tuple[Path, MorphableModel]) -> None:
    use(*saved)


@bounded(100)
@given(st.data())
def test_ply(saved: tuple[Path, MorphableModel], tmp_path: Path, data: st.DataObject) -> None:
    path = Path(shutil.copy(saved[0] / "geometry" / "0000.ply", tmp_path / "mesh.ply"))
    path.write_bytes(data.draw(spoilt_bytes(path.read_bytes())))
    read_or_refuse(lambda: read_ply(path))
