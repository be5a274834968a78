"""Experiment files: validated whole, run once, resumed after a kill, the same through processes and Dask."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mifit.errors import InputError, MifitError
from mifit.experiments import finished, load_plan, run_experiment
from tests.here import run_here
from tests.variant import VARIANT

SCENES = Path(__file__).resolve().parents[1] / "scenes"
SWEEP = """
name = "small"
jobs = 2
[render]
scene = "{scene}"
spp = 4
parameters = {{ width = 24, height = 16, integrator = "shdirect" }}
[reference]
parameters = {{ integrator = "path" }}
spp = 32
[outputs]
images = false
[sweep.grid]
"render.parameters.exponent" = {exponents}
"""


def write(folder: Path, text: str = SWEEP, exponents=(5, 50), name="sweep.toml") -> Path:
    path = folder / name
    path.write_text(text.format(scene=SCENES / "sh_against_path" / "scene.xml", exponents=list(exponents)))
    return path


def table(folder: Path) -> list:
    """The summary's rows without times."""
    rows = json.loads((folder / "summary.json").read_text())["runs"]
    return [(r["run"], {k: v for k, v in r["metrics"].items() if not k.endswith("seconds")}) for r in rows]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A finished sweep of two runs."""
    folder = tmp_path_factory.mktemp("sweep")
    text = run_experiment(write(folder), out=folder / "out", variant=VARIANT)
    return folder, text


@pytest.mark.slow
def test_sweep_writes_records_and_a_table(done):
    folder, text = done
    plan = load_plan(folder / "sweep.toml")
    assert text.startswith("# small: 2 of 2 runs") and text.count("\n|") == 4
    assert (folder / "out" / "summary.md").read_text().strip() == text
    for run, exponent in zip(plan.runs, (5, 50), strict=True):
        record = finished(folder / "out" / "runs" / run.folder, run)
        assert record["swept"] == {"render.parameters.exponent": exponent}
        assert record["settings"]["render"]["parameters"]["exponent"] == exponent
        assert record["versions"]["variant"] == VARIANT and "mitsuba" in record["versions"]
        assert 0 < record["metrics"]["rmse"] < 0.1 and record["metrics"]["psnr"] > 20
    rows = table(folder / "out")
    assert rows[0][1]["rmse"] != rows[1][1]["rmse"]


@pytest.mark.slow
def test_finished_runs_are_skipped_and_new_ones_added(done):
    folder, _ = done
    before = {p: p.stat().st_mtime_ns for p in (folder / "out" / "runs").glob("*/run.json")}
    steps = []
    grown = write(folder, exponents=(5, 50, 500), name="grown.toml")
    run_experiment(grown, out=folder / "out", variant=VARIANT, progress=lambda *a: steps.append(a))
    assert steps == [("Runs", 2, 3), ("Runs", 3, 3)]
    after = {p: p.stat().st_mtime_ns for p in (folder / "out" / "runs").glob("*/run.json")}
    assert len(after) == 3 and all(after[p] == t for p, t in before.items())


@pytest.mark.slow
def test_killed_sweep_finishes_with_the_same_table(done, tmp_path):
    folder, _ = done
    path = write(folder, exponents=(5, 50), name="again.toml")
    out = tmp_path / "out"
    code = (
        "from mifit.experiments import run_experiment\n"
        f"if __name__ == '__main__': run_experiment({str(path)!r}, overrides=['jobs=1'], out={str(out)!r}, "
        f"variant={VARIANT!r})"
    )
    script = tmp_path / "sweep.py"
    script.write_text(code)
    process = subprocess.Popen([sys.executable, str(script)], start_new_session=True)
    limit = time.monotonic() + 120
    while not list(out.glob("runs/*/run.json")) and process.poll() is None and time.monotonic() < limit:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert len(list(out.glob("runs/*/run.json"))) == 1, "the sweep was to be killed after its first run"
    run_experiment(path, overrides=["jobs=1"], out=out, variant=VARIANT)
    assert table(out) == table(folder / "out")[:2]


@pytest.mark.slow
def test_dask_gives_the_same_figures(done, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra mifit[cluster]")
    folder, _ = done
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
    ) as cluster:
        run_experiment(folder / "sweep.toml", out=tmp_path / "out", variant=VARIANT, dask=cluster.scheduler_address)
    assert table(tmp_path / "out") == table(folder / "out")[:2]


@pytest.mark.slow
def test_a_failing_run_is_named_and_the_others_finish(variant, tmp_path, monkeypatch):
    run_here(monkeypatch)
    path = write(tmp_path)
    text = path.read_text().replace('"render.parameters.exponent" = [5, 50]', '"render.spp" = [4, 2]')
    path.write_text(text.replace('integrator = "shdirect"', 'integrator = "shdirect", exponent = "many"'))
    with pytest.raises(MifitError, match="2 of 2 runs failed") as error:
        run_experiment(path, out=tmp_path / "out", variant=VARIANT)
    assert "many" in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.replace("spp = 4", "sp = 4"), "unknown key 'sp'; did you mean 'spp'"),
        (lambda s: s.replace("[render]", "[rendr]"), "unknown key 'rendr'; did you mean 'render'"),
        (lambda s: s.replace("jobs = 2", "jobs = 0"), "jobs: found 0, expected a whole number from 1 to 1024"),
        (lambda s: s.replace("scene.xml", "none.xml"), "none.xml: no such file"),
        (lambda s: s.replace("[5, 50]", "[]"), r"found \[\], expected a list of values"),
        (lambda s: s.replace("[5, 50]", "[5, 5]"), "two runs have the same settings"),
        (lambda s: s.replace("render.parameters.exponent", "render.exponent"), "unknown key 'exponent'"),
        (lambda s: s.replace("[sweep.grid]", "[sweep.grd]"), "expected one table 'grid' or one list 'list'"),
        (lambda s: s + "[fit]\n", "expected one of the tables"),
        (lambda s: s + "[evaluate]\ncamera = 'third'\n", r"\[evaluate\] and \[relight\] need \[fit\]"),
        (lambda s: s.replace("name", "name = "), "not a readable TOML file"),
    ],
)
def test_bad_files_are_refused_before_anything_runs(tmp_path, change, message):
    path = write(tmp_path)
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=message):
        run_experiment(path, out=tmp_path / "out", variant="none")
    assert not (tmp_path / "out").exists()


def test_fit_experiments_are_checked_against_their_capture(shared, tmp_path):
    text = f"""
[fit]
capture = "{shared / "captures" / "hard"}"
model = "{shared / "models" / "ict_facekit" / "ict_facekit_head.npz"}"
timesteps = [0]
[evaluate]
camera = "third"
[sweep.grid]
fit.reflectance.exponent = [5, 10]
fit.until = ["reflectance", "normals"]
"""
    path = tmp_path / "fit.toml"
    path.write_text(text)
    plan = load_plan(path, ["fit.seed=3", "outputs.report=true"], seed=9)
    assert len(plan.runs) == 4 and len({r.folder for r in plan.runs}) == 4
    run = plan.runs[1]
    assert run.swept == {"fit.reflectance.exponent": 5, "fit.until": "normals"}
    assert run.experiment.fit.seed == 3 and run.experiment.outputs.report
    assert run.experiment.fit.reflectance.exponent == 5.0 and run.folder.startswith("exponent=5_until=normals_")
    assert load_plan(path, seed=9).runs[0].experiment.fit.seed == 9
    for key, value, message in (
        ("fit.timesteps", "[77]", "timestep 77: not in the capture"),
        ("evaluate.camera", '"top"', "camera 'top': not in the capture"),
        ("evaluate.camera", '"left"', "expected a camera that is not fitted"),
        ("fit.model", '"none.npz"', "none.npz"),
        ("fit.capture", '"none"', "none"),
        ("fit.synth.seed", "1", "expected one of 'capture' and 'synth'"),
        ("fit.reflectance.exponent", '"x"', "expected a value of type|expected a finite number|exponent"),
    ):
        with pytest.raises(InputError, match=message):
            load_plan(path, [f"{key}={value}"] + (["sweep={}"] if "exponent" in key else []))
    with pytest.raises(InputError, match="expected KEY=VALUE"):
        load_plan(path, ["fit.seed"])


@pytest.mark.parametrize(
    ("setting", "where"),
    [('fit.cameras=["left","up"]', "fit.cameras"), ('evaluate.camera="up"', "evaluate.camera")],
)
def test_cameras_of_synthetic_captures_are_checked_before_the_first_run(tmp_path, setting, where):
    (tmp_path / "e.toml").write_text("name = 'e'\n[fit.synth]\ntimesteps = 1\n[evaluate]\ncamera = 'third'\n")
    assert load_plan(tmp_path / "e.toml").runs
    with pytest.raises(InputError, match=f"{where}: found 'up', expected one of left, right, third"):
        load_plan(tmp_path / "e.toml", [setting])


def test_digests_follow_contents(tmp_path):
    scene = tmp_path / "scene.xml"
    scene.write_text("<scene version='3.0.0'/>")
    path = tmp_path / "one.toml"
    path.write_text('[render]\nscene = "scene.xml"\n')
    first = load_plan(path).runs[0].digest
    assert load_plan(path).runs[0].digest == first
    scene.write_text("<scene version='3.0.0'> </scene>")
    assert load_plan(path).runs[0].digest != first


@pytest.mark.parametrize("path", sorted(SCENES.glob("*/experiment.toml")), ids=lambda p: p.parent.name)
def test_examples_are_valid(path):
    overrides = []
    if path.parent.name == "relighting":
        assert np.isfinite((path.parent / "studio.hdr").stat().st_size)
    plan = load_plan(path, overrides)
    assert plan.runs and plan.name == path.parent.name


FITS = """
name = "study"
[fit]
model = "builtin:coarse"
timesteps = [0]
[fit.surface]
enabled = false
[fit.geometry]
rounds = 1
[fit.reflectance]
texture_size = 32
shading = "prefiltered"
bands = 4
max_iterations = 3
[fit.normals]
max_iterations = 3
[evaluate]
camera = "third"
[outputs]
result = false
[sweep.grid]
"fit.capture" = "people"
"fit.reflectance.exponent" = [5, 20]
"""


@pytest.mark.slow
def test_a_study_over_a_folder_of_captures_shares_stages_and_gives_intervals(variant, tmp_path, monkeypatch):
    from scipy import stats

    from mifit.synth import synthesize

    for seed in (1, 2):
        folder = tmp_path / "people" / f"p{seed}"
        synthesize(folder, timesteps=1, model="builtin:coarse", width=120, height=90, spp=16, seed=seed)
    path = tmp_path / "study.toml"
    path.write_text(FITS)
    run_here(monkeypatch)
    text = run_experiment(path, out=tmp_path / "out", variant=VARIANT)
    kept = [p.name.partition("_")[0] for p in (tmp_path / "out" / "stages").glob("*.npz")]
    counts = {"geometry": 2, "photometry": 2, "reflectance": 4, "normals": 4, "mesh": 4, "residual": 4}
    assert {name: kept.count(name) for name in kept} == counts
    document = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [group["settings"] for group in document["over_subjects"]] == [
        {"fit.reflectance.exponent": 5},
        {"fit.reflectance.exponent": 20},
    ]
    for group in document["over_subjects"]:
        exponent = group["settings"]["fit.reflectance.exponent"]
        rows = [r for r in document["runs"] if r["swept"]["fit.reflectance.exponent"] == exponent]
        values = np.array([r["metrics"]["psnr_full"] for r in rows])
        mean, half = group["metrics"]["psnr_full"]
        low, high = stats.t.interval(0.95, 1, loc=values.mean(), scale=stats.sem(values))
        assert group["subjects"] == 2 and (mean - half, mean + half) == pytest.approx((low, high))
    assert "95% confidence interval over subjects" in text and text.count(" ± ") >= 4
    pytest.importorskip("matplotlib")
    assert (tmp_path / "out" / "plots" / "psnr_full.svg").read_text().startswith("<?xml")


def test_a_folder_without_captures_is_no_axis(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(FITS)
    with pytest.raises(InputError, match=r"fit\.capture: found no capture in 'people'"):
        load_plan(path)
