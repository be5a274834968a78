"""The benchmark of foreign faces: its measures on a ball that is known, and against the independent scorer."""

import argparse
import json
import runpy
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import mifit
from benchmarks import foreign, foreign_tables, judge, scan
from benchmarks.record import SHARED
from mifit.cli import main
from mifit.render.image_based import image_based
from tests.output.conftest import RADIUS, ball_camera, ball_result

TOOL = SHARED / "tools" / "held_out.py"


def photographs(result, colour):
    """What `image_based` asks of a capture: photographs of the ball whose points have a colour each."""

    def frame(name, timestep):
        camera = next(c for c in (ball_camera("left", -20), ball_camera("right", 20)) if c.name == name)
        image = np.zeros((camera.height, camera.width, 3), np.float32)
        rays = camera.pixel_rays(camera.pixel_centres())
        b = rays @ camera.position
        root = b**2 - (camera.position @ camera.position - RADIUS**2)
        point = camera.position + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * rays
        image[:] = np.where(root[..., None] > 0, colour(point), 0)
        return SimpleNamespace(image=image, valid=np.ones(image.shape[:2], bool))

    return SimpleNamespace(frame=frame)


@pytest.fixture(scope="module")
def sphere():
    mifit.set_variant("auto")
    result = ball_result()
    fine = result.model.mean / np.linalg.norm(result.model.mean, axis=1, keepdims=True) * RADIUS
    return result.model.faces, fine.astype(np.float64)


def test_image_based_rendering_shows_the_points_colours_where_a_view_sees_them(sphere):
    faces, vertices = sphere
    capture = photographs(None, lambda p: 0.5 + p / (3 * RADIUS))
    left, right, middle = ball_camera("left", -20), ball_camera("right", 20), ball_camera("third", 0)
    found = image_based(capture, [left, right], middle, 0, vertices, faces)
    assert found.hit.sum() > 500 and found.seen.sum() > 0.9 * found.hit.sum()
    rays = middle.pixel_rays(middle.pixel_centres())
    b = rays @ middle.position
    root = np.maximum(b**2 - (middle.position @ middle.position - RADIUS**2), 0)
    point = middle.position + (-b - np.sqrt(root))[..., None] * rays
    inner = found.seen & (root > (0.6 * RADIUS) ** 2)
    assert np.abs(found.colour - (0.5 + point / (3 * RADIUS)))[inner].max() < 0.03
    one = image_based(capture, [left], middle, 0, vertices, faces)
    assert (one.hit == found.hit).all() and one.seen.sum() < 0.95 * found.seen.sum()
    columns = np.flatnonzero(found.seen[32] & ~one.seen[32])
    assert len(columns) and columns.min() > 32  # what the left view doesn't see is on the right


def test_what_hides_a_point_from_a_view_is_not_painted_onto_it(sphere):
    faces, vertices = sphere
    left, middle = ball_camera("left", -20), ball_camera("third", 0)
    toward = left.position / np.linalg.norm(left.position)
    plate = 0.2 * vertices + 1.8 * RADIUS * toward  # between the left camera and the ball
    both = np.concatenate([vertices, plate]), np.concatenate([faces, faces + len(vertices)])
    capture = photographs(None, lambda p: 0.5 + p / (3 * RADIUS))
    free, blocked = (image_based(capture, [left], middle, 0, *mesh) for mesh in ((vertices, faces), both))
    rays = middle.pixel_rays(middle.pixel_centres())
    b = rays @ middle.position
    root = b**2 - (middle.position @ middle.position - RADIUS**2)
    point = middle.position + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * rays
    away = point - left.position
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    aside = np.linalg.norm(np.cross(away, 1.8 * RADIUS * toward - left.position), axis=-1)
    ball = free.seen & blocked.hit & (np.abs(free.colour - blocked.colour).max(-1) < 1)
    assert (free.seen & (aside < 0.15 * RADIUS)).sum() > 20
    assert not blocked.seen[ball & (root > (0.3 * RADIUS) ** 2) & (aside < 0.15 * RADIUS)].any()
    assert blocked.seen[free.seen & (aside > 0.3 * RADIUS) & (root > (0.5 * RADIUS) ** 2)].mean() > 0.9


def test_distances_are_those_to_the_nearest_point_of_a_face(sphere):
    faces, vertices = sphere
    middle = vertices[faces].mean(1)
    away = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    distance, face, weights = scan.nearest(middle + 0.1 * away, vertices, faces)
    assert distance == pytest.approx(0.1, abs=1e-6) and (face == np.arange(len(faces))).mean() > 0.99
    assert weights == pytest.approx(1 / 3, abs=0.02)


def test_relit_views_are_compared_after_one_factor_per_channel():
    rng = np.random.default_rng(0)
    truth, region = rng.uniform(0.1, 0.8, (20, 20, 3)), np.ones((20, 20), bool)
    assert judge.scaled_psnr(truth * (0.5, 2.0, 3.0), truth, region) > 100
    assert judge.scaled_psnr(truth[..., ::-1], truth, region) < 25
    region[:, 10:] = False
    spoilt = truth.copy()
    spoilt[:, 10:] = 0
    assert judge.scaled_psnr(spoilt, truth, region) > 100


def test_options_choose_cases_and_hold_the_other_cameras_out(monkeypatch):
    monkeypatch.setattr(foreign.Path, "exists", lambda path: True)
    options = {"captures": ["emily"], "cameras": ("c2", "c3"), "held_out": None, "timesteps": None, "model": None}
    cases, skipped = foreign.cases_of(argparse.Namespace(**options))
    assert not skipped and {c.fitted for c in cases} == {("c2", "c3")}
    assert all(set(c.held_out) == {"c4", "c5"} for c in cases) and {c.model for c in cases} == {"builtin", foreign.ICT}
    assert all(not set(case.fitted) & set(case.held_out) for case in foreign.CASES)


def test_captures_that_are_missing_are_left_out_with_the_reason(tmp_path):
    options = {"captures": [str(tmp_path / "nowhere")], "cameras": ("a",), "held_out": ("b",)}
    cases, skipped = foreign.cases_of(argparse.Namespace(**options, timesteps=None, model=None))
    assert not cases and "nowhere is not there" in skipped[0]


def test_tables_say_what_failed_and_what_did_not_converge():
    figures = {"psnr": 21.34, "pixels": 9, "ssim": 0.5, "flip": 0.25}
    case = {
        "label": "a",
        "held_out": {"full": {"skin": figures, "face": {**figures, "psnr": 18.0}}},
        "fits": {"full": {"unconverged": ["geometry"]}, "refit": {"unconverged": []}},
        "mesh": {"full": {"median_mm": 0.5, "mean_mm": 1.25, "p90_mm": 3.0}},
        "relit": {"full, path": {"mean": 15.04}},
        "seconds": 12.3,
    }
    text = foreign_tables.markdown([case, {"label": "b", "failed": "no | light"}])
    assert "| b | failed: no / light |" in text and "full: geometry" in text and "0.50 / 1.25 / 3.00" in text
    assert "| 21.3 |" in text and "| 18.0 |" in text and "15.0" in text
    assert "| a | 21.3 | - |" in foreign_tables.short([case])
    load = {"before": {"load_average": [1.0]}, "after": {"load_average": [2.5]}}
    run = {
        "settings": {"texels": 256, "relit_samples": 32},
        "conditions": load,
        "seconds": 120,
        "cases": [case],
        "left_out": ["c"],
    }
    assert (
        "256 texels" in (said := foreign_tables.markdown([case], run))
        and "1.0 to 2.5" in said
        and "Left out: c." in said
    )
    rows = [line for line in text.splitlines() if line.startswith("|")]
    for table in (rows[:4], rows[4:8]):
        assert len({line.count("|") for line in table}) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # the scorer leaves files to be closed by the interpreter
@pytest.mark.skipif(not TOOL.exists(), reason=f"needs {TOOL}")
def test_the_independent_scorer_finds_the_same_figures(tmp_path, monkeypatch, capsys):
    mifit.set_variant("auto")
    case = replace(next(c for c in foreign.CASES if c.capture == "scan_studio"), timesteps=(1,))
    capture, model = mifit.Capture.load(case.path), mifit.MorphableModel.load(case.model)
    config = foreign.replace_size(mifit.FitConfig(), 64)
    maps = replace(config.reflectance, shading="prefiltered", bands=4, exponent=40)
    config = replace(config, surface=replace(config.surface, refit=False), reflectance=maps)
    result = mifit.fit(capture, model, case.fitted, case.timesteps, config, until="reflectance")
    replace(result, model_source="builtin").save(tmp_path / "result")

    def command(line, **options):  # the scorer's calls of the command line, without a process for each
        assert line[0] == "mifit" and main(line[1:]) == 0

    monkeypatch.setattr(subprocess, "run", command)
    arguments = ["mifit", tmp_path / "result", case.path, ",".join(case.fitted), ",".join(case.held_out), "1"]
    monkeypatch.setattr(sys, "argv", [str(TOOL), *map(str, arguments)])
    capsys.readouterr()
    runpy.run_path(str(TOOL), run_name="__main__")
    theirs = json.loads(capsys.readouterr().out.splitlines()[-1])
    rows = judge.judge_views(foreign.rows_of({"full": result}), capture, case.held_out, (1,), case.fitted)
    ours = {
        "pca": rows["full: pca"]["face"],
        "diffuse": rows["full: specular dropped"]["face"],
        "full": rows["full"]["face"],
        "full_skin": rows["full"]["seen"],
        "ibr_skin": rows["image-based, mesh of full"]["seen"],
        "ibr_scan_skin": rows["image-based, scan"]["skin"],
    }
    assert {key: figures["psnr"] for key, figures in ours.items()} == pytest.approx(
        {key: theirs[key] for key in ours}, abs=0.05
    )
    mesh = judge.judge_mesh(result, capture, case.fitted)
    assert mesh["median_mm"] == pytest.approx(theirs["mm_median"], abs=0.01)
    assert mesh["mean_mm"] == pytest.approx(theirs["mm_mean"], abs=0.01)
    assert mesh["p90_mm"] == pytest.approx(theirs["mm_p90"], abs=0.02)
