"""The benchmark of foreign faces: its measures on a ball that is known, and against the independent scorer."""

import argparse
import json
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import mifit
from benchmarks import ablation, foreign, heads, judge
from benchmarks.record import SHARED
from mifit.cli import main
from mifit.errors import InputError
from mifit.output.compare import scaled_psnr
from mifit.output.truth import nearest_points
from mifit.render.image_based import BLENDS, image_based
from tests.output.conftest import RADIUS, ball_camera, ball_result

ROOT = Path(__file__).resolve().parents[1]
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


def test_light_that_is_darker_than_none_leaves_a_gap_in_the_relit_figures(variant, monkeypatch):
    result, camera = ball_result(), ball_camera("third", 0)
    size, below = (camera.height, camera.width), np.full((9, 3), -1.0)
    truth = SimpleNamespace(environment=ROOT / "scenes" / "relighting" / "studio.hdr", image=np.ones((*size, 3)))
    at = SimpleNamespace(camera=camera, box=np.s_[:, :], relit=np.ones(size, bool))
    monkeypatch.setattr(judge, "relit_truths", lambda capture: {"studio": truth})
    monkeypatch.setattr(judge, "view", lambda *_: at)
    dark = result.with_illumination(replace(result.illumination, radiance=below))
    rows = {name: judge.Row.of(each) for name, each in (("paper", dark), ("full", result))}
    capture = SimpleNamespace(timesteps=result.timesteps)
    found = judge.judge_relit(heads.Case("ball"), capture, rows, ("local",), 1, 1)
    assert list(found) == ["full, local"] and found["full, local"]["mean"] > 0
    with pytest.raises(InputError, match="mean luminance"):  # of our own fit it is a failure
        judge.judge_relit(heads.Case("ball"), capture, {"full": rows["paper"]}, ("local",), 1, 1)


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


def test_blends_prefer_the_nearer_view_and_share_their_samples(sphere):
    faces, vertices = sphere
    capture = photographs(None, lambda p: np.full(p.shape, 0.4))
    plain = capture.frame

    def tinted(name, timestep):
        found = plain(name, timestep)
        return SimpleNamespace(image=found.image * ((0.5, 1, 1) if name == "left" else (1, 1, 0.5)), valid=found.valid)

    capture.frame = tinted
    left, right, wanted = ball_camera("left", -20), ball_camera("right", 20), ball_camera("third", 10)
    found = image_based(capture, [left, right], wanted, 0, vertices, faces, blends=BLENDS, oversampling=2)
    inner = found.seen & (np.linalg.norm(wanted.pixel_centres() - 32, axis=-1) < 8)
    red = {blend: image[inner][:, 0].mean() for blend, image in found.colours.items()}
    assert red["nearest"] == pytest.approx(0.4, abs=0.01)  # the right view alone, whose red is whole
    assert red["cosine"] == pytest.approx(0.3, abs=0.03) and red["cosine"] < red["angle"] < red["nearest"]
    once = image_based(capture, [left, right], wanted, 0, vertices, faces, blends=BLENDS)
    assert (found.hit <= once.hit).all() and found.hit.sum() > 0.9 * once.hit.sum()
    assert np.abs(found.colours["angle"] - once.colours["angle"])[inner].max() < 0.02


def test_distances_are_those_to_the_nearest_point_of_a_face(sphere):
    faces, vertices = sphere
    middle = vertices[faces].mean(1)
    away = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    distance, face, weights = nearest_points(middle + 0.1 * away, vertices, faces)
    assert distance == pytest.approx(0.1, abs=1e-6) and (face == np.arange(len(faces))).mean() > 0.99
    assert weights == pytest.approx(1 / 3, abs=0.02)


def test_relit_views_are_compared_after_one_factor_per_channel():
    rng = np.random.default_rng(0)
    truth, region = rng.uniform(0.1, 0.8, (20, 20, 3)), np.ones((20, 20), bool)
    assert scaled_psnr(truth * (0.5, 2.0, 3.0), truth, region) > 100
    assert scaled_psnr(truth[..., ::-1], truth, region) < 25
    region[:, 10:] = False
    spoilt = truth.copy()
    spoilt[:, 10:] = 0
    assert scaled_psnr(spoilt, truth, region) > 100


OPTIONS = {"own": False, "reduced": False, "timesteps": None, "model": None, "cameras": None, "held_out": None}


def test_options_choose_cases_and_hold_the_other_cameras_out(monkeypatch):
    monkeypatch.setattr(heads.Path, "exists", lambda path: True)
    monkeypatch.setattr(heads.Path, "is_dir", lambda path: True)
    options = {**OPTIONS, "captures": ["emily"], "cameras": ("c2", "c3")}
    cases, skipped = foreign.cases_of(argparse.Namespace(**options))
    assert not skipped and {c.fitted for c in cases} == {("c2", "c3")}
    assert all(set(c.held_out) == {"c4", "c5"} for c in cases) and {c.model for c in cases} == {"builtin", heads.ICT}
    reduced, _ = foreign.cases_of(argparse.Namespace(**{**OPTIONS, "captures": None, "reduced": True}))
    assert {c.timesteps for c in reduced} == {(0,)} and len({c.capture for c in reduced}) >= 8


def test_no_head_is_in_both_sets_and_no_held_out_camera_is_fitted():
    for case in (*heads.FOREIGN, *heads.OWN, *ablation.HEADS.values(), *ablation.PHOTOGRAPHED.values()):
        assert not set(case.fitted) & set(case.held_out)
        chosen = {("emily", ("c3", "c4")), ("scan_city", ("left", "right")), ("gloss", ("left", "right"))}
        assert case.development == ((case.capture, case.fitted) in chosen)
    locked = {case.capture for case in heads.FOREIGN if not case.development}
    assert len(locked) >= 8


def test_captures_that_are_missing_are_left_out_with_the_reason(tmp_path):
    options = {"captures": [str(tmp_path / "nowhere")], "cameras": ("a",), "held_out": ("b",)}
    cases, skipped = foreign.cases_of(argparse.Namespace(**{**OPTIONS, **options}))
    assert not cases and "nowhere is not there" in skipped[0]


def figures(psnr):
    return {region: {"psnr": psnr, "ssim": 0.5, "flip": 0.25, "pixels": 9} for region in ("skin", "face", "whole")}


def test_tables_name_sets_blends_failures_and_the_worst_head():
    held_out = {"full": figures(21.34), "image-based, our mesh, nearest": figures(20.0)}
    held_out["image-based, our mesh, cosine"] = figures(19.0)
    case = {
        "label": "a", "set": "locked", "held_out": held_out,
        "fits": {
            "full": {"unconverged": ["geometry"], "seconds": {"geometry": 20.5, "normals": 2.6}},
            "refit": {"unconverged": []},
        },
        "mesh": {"full": {"median_mm": 0.5, "mean_mm": 1.25, "p90_mm": 3.0}},
        "relit": {"full, path": {"mean": 15.04}, "full, local": {"mean": 14.0}}, "fit_cpu": 12.3,
        "seeds": [{"skin": 21.34}, {"skin": 21.0}, {"skin": 21.2}],
    }  # fmt: skip
    worse = {**case, "label": "w", "held_out": {**held_out, "full": figures(18.0)}}
    failed = {"label": "b", "set": "development", "failed": "no | light"}
    text = foreign.markdown([case, worse, failed])
    assert "| b | development | failed: no / light |" in text and "full: geometry" in text
    assert "0.50 / 1.25 / 3.00" in text and "| 20.0 (nearest) |" in text and "15.0" in text
    assert "| a | locked | 21.3 | 0.3 |" in text
    assert "2 locked rows: worst -2.0 dB (w), median -0.3 dB, best +1.3 dB." in text
    front = foreign.short([case, {**case, "set": "development", "label": "chose"}])
    assert "1 locked rows" in front and "| a | 21.3 | 20.0 (nearest) |" in front
    assert "| 15.0 | 23 |" in front and front.count("15.0") == 1
    assert "chose" not in front
    rows = [line for line in text.splitlines() if line.startswith("|")]
    tables = [i for i, line in enumerate(rows) if line.startswith("| head")]
    for first, last in zip(tables, [*tables[1:], len(rows)], strict=True):
        assert len({line.count("|") for line in rows[first:last]}) == 1


def test_paper_settings_in_normalised_units_weigh_alike():
    """Colours over 255 and pixels over the width: the terms keep their ratios, whatever the common factor."""
    capture = SimpleNamespace(camera=lambda name: SimpleNamespace(width=680))
    found = foreign.paper_settings(heads.FOREIGN[0], capture)
    literal, normalised = (found[name].geometry for name in ("paper", "paper, normalised"))
    colour, pixels = 3.0**2, 2.0**2  # squares of a residual of colours and of one of landmarks
    wanted = colour / 255**2 / (10.0 * pixels / 680**2), colour / 255**2 / (5e-5 * 1.0)
    assert colour / (normalised.landmark_weight * pixels) == pytest.approx(wanted[0])
    assert colour / normalised.prior_weight == pytest.approx(wanted[1])
    assert literal.landmark_weight == 10.0 and literal.prior_weight == 5e-5
    assert literal.scale_deviation > 0 and normalised.scale_deviation > 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # the scorer leaves files to be closed by the interpreter
@pytest.mark.skipif(not TOOL.exists(), reason=f"needs {TOOL}")
def test_the_independent_scorer_finds_the_same_figures(tmp_path, monkeypatch, capsys):
    mifit.set_variant("auto")
    case = heads.Case("scan_studio", timesteps=(1,))
    capture, model = mifit.Capture.load(case.path), mifit.MorphableModel.load("builtin:coarse")
    config = foreign.replace_size(mifit.FitConfig(), 64)
    maps = replace(config.reflectance, shading="prefiltered", bands=4, exponent=40)
    config = replace(config, reflectance=maps, surface=mifit.SurfaceConfig(finest=2))
    result = mifit.fit(capture, model, case.fitted, case.timesteps, config, until="reflectance")
    replace(result, model_source="builtin:coarse").save(tmp_path / "result")

    def command(line, **options):  # the scorer's calls of the command line, without a process for each
        assert line[0] == "mifit" and main(line[1:]) == 0

    monkeypatch.setattr(subprocess, "run", command)
    arguments = ["mifit", tmp_path / "result", case.path, ",".join(case.fitted), ",".join(case.held_out), "1"]
    monkeypatch.setattr(sys, "argv", [str(TOOL), *map(str, arguments)])
    capsys.readouterr()
    runpy.run_path(str(TOOL), run_name="__main__")
    theirs = json.loads(capsys.readouterr().out.splitlines()[-1])
    given = {label: judge.Row.of(result, method) for label, method in (("full", "full"), ("pca", "pca"))}
    rows = judge.judge_views(case, capture, given, case.held_out)
    ours = {
        "pca": rows["pca"]["whole"],
        "full": rows["full"]["whole"],
        "ibr_scan_skin": rows["image-based, scan, cosine"]["skin"],
    }
    assert {key: figures["psnr"] for key, figures in ours.items()} == pytest.approx(
        {key: theirs[key] for key in ours}, abs=0.15
    )  # the scorer's image-based rendering takes one sample per pixel
    mesh = judge.judge_mesh(case, capture, given["full"])
    assert mesh["median_mm"] == pytest.approx(theirs["mm_median"], abs=0.01)
    assert mesh["mean_mm"] == pytest.approx(theirs["mm_mean"], abs=0.01)
    assert mesh["p90_mm"] == pytest.approx(theirs["mm_p90"], abs=0.02)
