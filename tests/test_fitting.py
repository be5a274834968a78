"""`mifit fit` into a folder: what is refused before work starts, what goes on, and what is never lost."""

import dataclasses
import shutil
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import mifit
import mifit.fitting
from mifit.cli import fits
from mifit.config import FitConfig, MeshConfig, ReflectanceConfig
from mifit.core.diagnostics import Diagnostic
from mifit.errors import InputError
from mifit.fitting import fit_into, fitted_to
from mifit.morphable import MorphableModel
from mifit.morphable.openings import eyeballs, with_eyes
from mifit.result import Reconstruction, ownership
from mifit.result.ownership import CHECKPOINTS
from tests.output.conftest import ball_result
from tests.output.test_result_safety import tree
from tests.test_pipeline import Stages, made_up_capture, mean_geometry, without_eyes
from tests.variant import VARIANT

pytestmark = pytest.mark.usefixtures("variant")
ALL = [
    "fit_geometry", "find_surface", "find_photometry", "refine_surface", "infer_reflectance", "refine_normals",
    "refine_mesh", "find_residual",
]  # fmt: skip


@pytest.fixture
def fit(monkeypatch, tmp_path):
    """Fit a made-up capture into a folder with stand-ins for the stages; returns those that ran."""
    stages = Stages(monkeypatch)
    model = ball_result().model
    model.save(tmp_path / "ball.npz")
    model = mifit.MorphableModel.load(tmp_path / "ball.npz")

    def run(folder, capture=None, **options):
        stages.ran.clear()
        fit_into(folder, capture or made_up_capture(), model, **options)
        return list(stages.ran)

    return run


@pytest.fixture
def tracked(fit, tmp_path):
    """A result with a tracked timestep."""
    folder = tmp_path / "tracked"
    fit(folder)
    result = Reconstruction.load(folder)
    normals = dataclasses.replace(result.normals, tracked={3: "digest"})
    dataclasses.replace(result, normals=normals).save(folder)
    return folder


def test_a_foreign_folder_is_refused_before_any_work(fit, tmp_path, monkeypatch):
    (tmp_path / "photos" / "maps").mkdir(parents=True)
    (tmp_path / "photos" / "maps" / "mine.png").write_text("mine")
    with pytest.raises(InputError, match="photos: found a folder that mifit did not make"):
        fit(tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="did not make"):
        fit("")  # the current folder
    assert fit(tmp_path / "photos", force=True) == ALL
    assert (tmp_path / "photos" / "maps" / "mine.png").read_text() == "mine"


def test_a_result_is_not_replaced_unasked(fit, tmp_path):
    assert fit(tmp_path / "out") == ALL
    before = tree(tmp_path / "out")
    with pytest.raises(InputError, match="holds a result already"):
        fit(tmp_path / "out")
    assert fit(tmp_path / "out", resume=True) == [] and tree(tmp_path / "out") == before
    assert fit(tmp_path / "out", force=True) == ALL


def test_a_shorter_fit_keeps_what_a_longer_one_made(fit, tmp_path):
    fit(tmp_path / "out")
    before = tree(tmp_path / "out")
    assert fit(tmp_path / "out", resume=True, until="geometry") == [] and tree(tmp_path / "out") == before
    other = FitConfig(reflectance=ReflectanceConfig(exponent=33.0))
    with pytest.raises(InputError, match="has stage reflectance and stage normals, which going on with another config"):
        fit(tmp_path / "out", resume=True, until="geometry", config=other)
    assert tree(tmp_path / "out") == before
    assert fit(tmp_path / "out", resume=True, config=other) == ALL[3:]


def test_a_fit_that_gave_its_model_eyes_goes_on_with_the_model_as_it_was(monkeypatch, tmp_path):
    model = MorphableModel.load("builtin:coarse").subset(identity=2, expression=2, albedo=2)
    without_eyes(model).save(tmp_path / "skin.npz")
    skin = MorphableModel.load(tmp_path / "skin.npz")
    stages, geometry = Stages(monkeypatch), mean_geometry(with_eyes(skin), (0, 3))
    for name in ("fit_geometry", "find_surface", "refine_surface"):
        monkeypatch.setattr(f"mifit.fitting.{name}", stages.stand_in(name, geometry))
    out, options = tmp_path / "out", {"until": "geometry", "resume": True}
    first = fit_into(out, made_up_capture(), skin, **options)
    assert stages.ran == ALL[:4] and len(eyeballs(first.model)) == 2
    before = tree(out)
    again = fit_into(out, made_up_capture(), skin, **options)
    assert stages.ran == ALL[:4] and tree(out) == before and again.model.digest == first.model.digest
    assert any("[geometry] eyes = false" in one.text for one in again.warnings)
    shutil.rmtree(out / CHECKPOINTS)  # the result alone says that all is there
    fit_into(out, made_up_capture(), skin, **options)
    assert stages.ran == ALL[:4]


def test_tracked_frames_stay(fit, tracked):
    before = tree(tracked)
    assert fit(tracked, resume=True, timesteps=[0]) == []
    with pytest.raises(InputError, match="timesteps 3, which were tracked"):
        fit(tracked, resume=True, timesteps=[0], config=FitConfig(mesh=MeshConfig(detail=0.4)))
    assert tree(tracked) == before


def test_what_is_wrong_with_a_capture_is_told_before_the_work(fit, tmp_path, monkeypatch):
    found, events = [Diagnostic("mirrored", "text", "fault", "left")], []
    geometry = mifit.fitting.fit_geometry
    monkeypatch.setattr("mifit.fitting.check_capture", lambda *_: found)
    monkeypatch.setattr("mifit.fitting.fit_geometry", lambda *a, **k: events.append("work") or geometry(*a, **k))
    fit(tmp_path / "out", tell=events.append)
    assert events == [found, "work"]
    assert fit(tmp_path / "out", tell=events.append, resume=True) == [] and events == [found, "work"]


def test_two_fits_into_one_folder_exclude_each_other(fit, tmp_path):
    ownership.claim(tmp_path / "out")
    with ownership.locked(tmp_path / "out"), ThreadPoolExecutor() as other:
        with pytest.raises(InputError, match="another mifit is writing into it"):
            other.submit(fit, tmp_path / "out").result()


def test_a_result_knows_the_capture_it_was_fitted_to(fit, tmp_path):
    fit(tmp_path / "out")
    result = Reconstruction.load(tmp_path / "out")
    assert fitted_to(result, made_up_capture())
    assert not fitted_to(result, made_up_capture(digest="another person"))
    assert not fitted_to(result, made_up_capture(timesteps=(0,)))


def test_a_result_knows_its_model(fit, tmp_path, monkeypatch):
    fit(tmp_path / "out")
    monkeypatch.chdir("/")
    assert Reconstruction.load(tmp_path / "out").model.source == str(tmp_path / "ball.npz")
    builtin = mifit.MorphableModel.load("builtin:coarse")
    assert builtin.source == "builtin:coarse" and dataclasses.replace(builtin, unit_mm=1.0).source == ""


def test_the_models_digest_is_that_of_its_content(tmp_path):
    model = mifit.MorphableModel.load("builtin:coarse")
    assert model.fingerprint
    for name in ("mean", "mean_albedo", "albedo_modes", "identity"):
        changed = dataclasses.replace(model, **{name: getattr(model, name) * np.float32(1.01)})
        assert changed.digest != model.digest, name
    model.save(tmp_path / "m.npz")
    assert mifit.MorphableModel.load(tmp_path / "m.npz").digest == model.digest
    with np.load(tmp_path / "m.npz") as data:
        arrays = dict(data)
    np.savez(tmp_path / "m.npz", **{**arrays, "mean": arrays["mean"] * np.float32(1.01)})
    assert mifit.MorphableModel.load(tmp_path / "m.npz").digest != model.digest


def test_the_demo_leaves_the_users_capture_alone(variant, tmp_path, monkeypatch):
    made = []

    def synthesize(folder, **_):
        made.append(folder)
        folder.mkdir(parents=True)
        (folder / "transforms.json").write_text("{}")

    monkeypatch.setattr("mifit.synth.synthesize", synthesize)
    monkeypatch.setattr(fits, "_fit_and_judge", lambda *arguments: None)
    arguments = SimpleNamespace(out=tmp_path / "out", quiet=True, debug=False, variant=VARIANT, seed=0)
    mine = tmp_path / "out" / "capture" / "images" / "mine.png"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(InputError, match="did not make"):
        fits.demo(arguments)
    assert mine.read_text() == "mine" and not made
    arguments.out = tmp_path / "again"
    fits.demo(arguments)
    fits.demo(arguments)  # its own capture is replaced
    assert (tmp_path / "again" / "capture" / "transforms.json").is_file() and len(made) == 2
    (tmp_path / "again" / "capture" / "mine.png").write_text("mine")
    with pytest.raises(InputError, match=r"found mine\.png"):
        fits.demo(arguments)
    assert (tmp_path / "again" / "capture" / "mine.png").read_text() == "mine"


def test_the_demo_shows_a_picture_of_the_first_step_and_reports_once(variant, tmp_path, monkeypatch):
    result, reports, events = ball_result(), [], []
    early = dataclasses.replace(result, reflectance=None, normals=None, mesh=None)

    def fit_into(folder, capture, model, watch, config, **options):
        assert config.reflectance.texture_size <= fits.DEMO["width"]  # a texel shows in a pixel of its own
        ownership.claim(folder)
        watch(early)
        events.append((folder / "first.png").read_bytes())
        watch(result)
        result.save(folder)
        return result

    frame = SimpleNamespace(image=np.full((64, 64, 3), 0.2, np.float32))
    monkeypatch.setattr("mifit.Capture.load", lambda path: SimpleNamespace(frame=lambda camera, timestep: frame))
    monkeypatch.setattr("mifit.MorphableModel.load", lambda name: result.model)
    monkeypatch.setattr("mifit.fitting.fit_into", fit_into)
    monkeypatch.setattr("mifit.output.report.write_report", lambda *arguments: reports.append(arguments))
    monkeypatch.setattr(fits, "judge", lambda arguments, judged, capture: events.append(judged))
    arguments = SimpleNamespace(out=tmp_path / "out", quiet=True, seed=0)
    fits._fit_and_judge(arguments, tmp_path / "capture", lambda *step: None)
    picture = cv2.imread(str(tmp_path / "out" / "first.png"))
    assert (tmp_path / "out" / "first.png").read_bytes() == events[0]  # of the first step, and still there
    assert picture.shape == (64, 128, 3) and np.ptp(picture[:, :64]) == 0 and np.ptp(picture[:, 64:]) > 20
    assert events[1] is result and reports == []  # `judge` writes it
    assert "first.png" in ownership.written(tmp_path / "out")
