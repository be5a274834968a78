"""The report page: self-contained, complete, and its 3D view holds the mesh that was fitted."""

from __future__ import annotations

import base64
import json
import math
import re
from dataclasses import dataclass, replace
from html.parser import HTMLParser

import numpy as np
import pytest

from mifit.core.diagnostics import Diagnostic
from mifit.core.image import to_8_bit
from mifit.core.sh import SHLighting
from mifit.output.evaluate import evaluate
from mifit.output.figures import bounding_box, energy_plot, heat_map, lighting_balls, overlay, tint
from mifit.output.report import viewer_data, write_report
from tests.output.conftest import ball_camera
from tests.output.test_render_evaluate import FakeCapture


@dataclass(frozen=True)
class LandmarkFrame:
    image: np.ndarray
    valid: np.ndarray
    landmarks: np.ndarray | None
    visible: np.ndarray
    clipped: np.ndarray


@dataclass(frozen=True)
class LandmarkCapture(FakeCapture):
    def frame(self, name, t):
        found = super().frame(name, t)
        points = np.random.default_rng(0).uniform(10, 50, (68, 2)) if name == "left" else None
        clipped = np.zeros_like(found.valid)
        if name == "right":
            clipped[:, found.valid.shape[1] // 2 :] = True
        return LandmarkFrame(found.image, found.valid, points, np.ones(68, bool), clipped)


class Page(HTMLParser):
    VOID = ("meta", "img", "br", "input", "line", "path", "link", "hr")

    def __init__(self):
        super().__init__()
        self.open, self.sources, self.text, self.headings = [], [], [], []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.sources += [attrs[k] for k in ("src", "href") if k in attrs]
        if tag == "img":
            assert attrs.get("alt")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)
        if self.open and self.open[-1] == "h2":
            self.headings.append(data)


@pytest.fixture(scope="module")
def capture(ball):
    cameras = (*ball.cameras, ball_camera("third", 5.0))
    return LandmarkCapture(cameras, lambda c, t: ball.render(c, t, method="pca")[..., :3])


def parsed(path):
    page = Page()
    text = path.read_text(encoding="utf-8")
    page.feed(text)
    assert not page.open
    return page, text


def test_report_is_whole_and_self_contained(ball, capture, variant, tmp_path):
    evaluation = evaluate(ball, capture, "third")
    path = write_report(tmp_path, ball, capture, evaluation)
    page, text = parsed(path)
    assert page.headings == [
        "Result", "3D view", "Comparison", "Inputs and fit", "Maps", "Lighting", "Convergence", "Settings",
    ]  # fmt: skip
    assert all(s.startswith(("data:image/", "#s")) for s in page.sources)
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    assert path.stat().st_size < 6e6 and list(tmp_path.iterdir()) == [path]
    words = " ".join(page.text)
    assert f"{evaluation['methods']['full']['psnr']:.2f}" in words and "held out, never fitted" in words
    assert "Warning: one landmark is hidden" in words
    assert "Note: stage reflectance ended without convergence (max iterations)" in words
    assert words.count("Timestep 3") == 2
    assert re.search(r"left: 0\.0% clipped", words)
    assert float(re.search(r"right: (\d+\.\d)% clipped", words)[1]) == pytest.approx(50, abs=15)


def test_report_without_evaluation_and_of_stage_1(stage_1_ball, capture, variant, tmp_path):
    page, _ = parsed(write_report(tmp_path, stage_1_ball, capture))
    assert page.headings == ["Result", "3D view", "Inputs and fit", "Lighting", "Convergence", "Settings"]


def test_text_from_outside_is_escaped(ball, capture, variant, tmp_path):
    harmful = replace(
        ball, config={"x": "</pre><script>alert(1)</script>"}, warnings=(Diagnostic("bold", "<b>bold</b>"),)
    )
    _, text = parsed(write_report(tmp_path, harmful, capture))
    assert "<script>alert" not in text and "<b>bold" not in text


def test_3d_view_holds_the_fitted_mesh(ball):
    data = json.loads(viewer_data(ball, 3))

    def read(key, kind):
        return np.frombuffer(base64.b64decode(data[key]), kind)

    position = read("position", "<i2").reshape(-1, 3) / 32767 * data["radius"] + data["centre"]
    index = read("index", "<u2").reshape(-1, 3)
    rotation = np.array(data["rotation"]).reshape(3, 3)
    world = position @ rotation.T * ball.geometry.scale + ball.geometry.translation[1]
    order = np.concatenate([np.flatnonzero(ball.model.face_mask), np.flatnonzero(~ball.model.face_mask)])
    expected = ball.geometry.vertices[1][ball.model.faces[order]]
    np.testing.assert_allclose(world[index], expected, atol=2e-3)
    has_maps = read("colour", "u1").reshape(-1, 4)[:, 3][index]
    np.testing.assert_array_equal(has_maps, np.where(ball.model.face_mask[order], 255, 0)[:, None].repeat(3, 1))
    irradiance = np.array(data["irradiance"]).reshape(9, 3)
    expected = ball.lighting.irradiance(np.array([0.0, 0.6, 0.8])) / math.pi
    np.testing.assert_allclose(SHLighting(irradiance).evaluate(np.array([0.0, 0.6, 0.8])), expected)


def test_heat_map_is_black_without_error_and_grey_outside():
    photograph = np.full((8, 8, 3), 100, np.uint8)
    render = np.dstack([photograph, np.full((8, 8), 255, np.uint8)])
    region = np.zeros((8, 8), bool)
    region[:4] = True
    same, off = heat_map(photograph, render, region), heat_map(photograph, np.minimum(render + 80, 255), region)
    assert same[:4].max() < 10 and (same[4:] == 35).all()
    assert off[:4].min(-1).min() > 100


def test_overlay_uses_coverage_and_box_has_a_margin():
    photograph = np.full((4, 4, 3), 200, np.uint8)
    render = np.zeros((4, 4, 4), np.uint8)
    render[0, 0] = (100, 100, 100, 255)
    render[0, 1] = (100, 100, 100, 128)
    out = overlay(photograph, render)
    assert out[0, 0, 0] == 100 and out[0, 1, 0] == 150 and out[2, 2, 0] == 200
    mask = np.zeros((100, 100), bool)
    mask[40:61, 50:61] = True
    assert bounding_box(mask, 0.1) == (slice(38, 63), slice(49, 62))


def test_lighting_balls_face_the_light():
    coefficients = np.zeros((9, 3))
    coefficients[0] = 1.0
    coefficients[1] = -0.5  # Y_1,-1 = -k y: light from above
    matt, mirror = lighting_balls(SHLighting(coefficients), 64)
    for ball_image in (matt, mirror):
        assert ball_image[10, 32].mean() > ball_image[53, 32].mean() + 20
    white = to_8_bit(np.ones(1))[0]
    assert (matt[0, 0] == white).all()


def test_plot_has_a_curve_per_energy_and_survives_bad_values():
    svg = energy_plot({"data": [3, 1, 0.1], "prior": [1.0, math.nan, 0.0], "one": [1.0]})
    assert svg.count("<path") == 2 and "nan" not in svg
    assert energy_plot({"zero": [0.0, 0.0]}) == "" and energy_plot({}) == ""


def test_tint_colours_the_area_alone():
    picture = np.full((4, 4, 3), 100, np.uint8)
    area = np.zeros((4, 4), bool)
    area[1, 2] = True
    out = tint(picture, (area, (200, 0, 100)), strength=0.5)
    assert (out[~area] == 100).all() and (out[area] == (150, 50, 100)).all() and (picture == 100).all()
