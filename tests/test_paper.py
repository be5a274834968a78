"""The paper's terms, weights and units, each against a plain form of its equation."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mifit.appearance import models
from mifit.cli import main
from mifit.config import PRESETS, FitConfig, GeometryConfig, NormalsConfig, ReflectanceConfig
from mifit.core.uv import TexelMap, bend, tangent_plane
from mifit.stages.geometry.images import PixelView
from mifit.stages.geometry.landmarks import LandmarkTerm, LandmarkView, State
from mifit.stages.geometry.parameters import Frames, Layout
from mifit.stages.geometry.points import PointBasis
from mifit.stages.geometry.rendering import RenderingProblem, paper_problem
from mifit.stages.reflectance.maps import TexelSystems, laplacian, solve_maps
from mifit.stages.reflectance.paper_energy import energies, lighting_equations
from tests.output.conftest import ball_camera, ball_model
from tests.stages.test_geometry_terms import SmoothImage, random_points, scene  # noqa: F401

RNG = np.random.default_rng(8)


def test_the_preset_has_the_papers_settings():
    paper, default = FitConfig.paper(), FitConfig()
    g, r, n = paper.geometry, paper.reflectance, paper.normals
    assert (g.objective, g.landmark_weight, g.prior_weight) == ("paper", 10.0, 5e-5)
    assert (r.shading, r.robust, r.specular_difference_weight) == ("printed", False, 0.1)
    # lambda_H = 0.001 for maps and images of 0..255, the same for both maps
    assert r.smoothness_weight == pytest.approx(0.001 * 255 / 255**2) and r.specular_smoothness == 1.0
    assert (n.laplacian_weight, n.magnitude_weight) == (1e-3, 0.3)
    assert not paper.surface.enabled
    assert PRESETS["paper"]() == paper and PRESETS["default"]() == default != paper


def test_presets_and_settings_of_a_file_exclude_each_other(tmp_path, capsys):
    (tmp_path / "c.toml").write_text("")
    arguments = ["fit", str(tmp_path), "--out", str(tmp_path / "o"), "--preset", "paper"]
    assert main([*arguments, "--config", str(tmp_path / "c.toml")]) == 2
    assert "expected one of the two" in capsys.readouterr().err


# Stage 1 --------------------------------------------------------------------------------------------------------------


def test_the_photometric_term_is_a_mean_over_each_views_pixels_of_values_to_255(scene):  # noqa: F811
    flat = SmoothImage(np.full((96, 96, 3), 0.3), np.ones((96, 96)))
    x = np.zeros(scene.layout.size)
    at = scene.layout.at
    x[at("shading")][:3] = 2.0  # the constant harmonic of each channel
    x[at("ambient")] = 0.05
    views, expected = [], 0.0
    for camera, count in zip(scene.cameras, (7, 60), strict=True):
        face, weights = random_points(scene.rng, scene.model, count)
        views.append(PixelView(0, camera, flat, face, weights))
        albedo = np.einsum("nk,nkc->nc", weights, scene.model.mean_albedo[scene.model.faces[face]])
        residual = 255.0 * (0.05 + albedo * 2.0 / np.sqrt(4 * np.pi) - 0.3)
        expected += (residual**2).sum() / count
    problem = RenderingProblem(scene.model, scene.layout, scene.frames, tuple(views), LandmarkTerm((), np.inf), {})
    assert problem.energies(x)["photo"] == pytest.approx(expected, rel=1e-6)
    d = np.zeros(len(x))
    d[at("ambient")] = 1e-5
    slope = (problem.energies(x + d)["photo"] - problem.energies(x - d)["photo"]) / 2e-5
    assert 2.0 * problem.linearize(x).gradient[at("ambient")][0] == pytest.approx(slope, rel=1e-5)


def test_the_papers_weights_of_landmarks_and_prior():
    model, camera = ball_model(), ball_camera()
    layout = Layout(1, model.n_identity, model.n_expression)
    state = State(layout, Frames(np.eye(3)[None], 1.0), np.zeros(layout.size))
    pixels = camera.project(model.mean[model.landmarks[:20]].astype(float)) + np.array((3.0, -4.0))
    basis = PointBasis.at_vertices(model, model.landmarks[:20])
    view = LandmarkView(0, camera, np.arange(20), model.landmarks[:20], pixels, 1.0, basis)
    config = GeometryConfig(objective="paper")
    problem, x = paper_problem(model, state, np.zeros(model.n_albedo + 28), (view,), (), config)
    x[problem.layout.at("identity")], x[problem.layout.at("ambient")] = 0.0, 0.1
    found = problem.energies(x)  # every landmark is five pixels off: w_l times the mean square
    assert found["landmarks"] == pytest.approx(10.0 * 25.0, rel=1e-4)
    assert found["prior"] == 0
    x[problem.layout.at("identity")], x[problem.layout.at("albedo")] = 2.0, 3.0
    x[problem.layout.at("expression", 0)] = 1.0
    sizes = model.n_identity * 4 + model.n_albedo * 9 + model.n_expression
    assert problem.energies(x)["prior"] == pytest.approx(5e-5 * sizes)


# Stage 2 --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def two_views():
    """Six texels of a 4 x 4 map, two views of each of two timesteps, random everything."""
    index = np.array([5, 6, 9, 10, 11, 14])
    count, images = len(index), 4
    texels = TexelMap(4, index, np.zeros(count, np.int32), np.zeros((count, 3), np.float32))
    arrays = {
        "colour": RNG.uniform(0.1, 0.9, (count, images, 3)),
        "measured": RNG.uniform(0.2, 1.0, (count, images)),
        "shade": RNG.uniform(0.5, 1.5, (count, images, 3)),
        "glint": RNG.uniform(0.0, 2.0, (count, images, 3)),
    }
    arrays = {name: value.astype(np.float32) for name, value in arrays.items()}
    maps = np.zeros((16, 4), np.float32)
    maps[index] = RNG.uniform(0.1, 0.9, (count, 4))
    albedo = RNG.uniform(0.2, 0.6, (count, 3)).astype(np.float32)
    return SimpleNamespace(texels=texels, pairs=np.array([(0, 1), (2, 3)]), maps=maps, albedo=albedo, **arrays)


def papers_terms(s, ambient):
    """E_O, E_S and E_H's two parts by loops over the equation."""
    data = difference = 0.0
    values = s.maps[s.texels.index].astype(float)
    for i in range(len(values)):
        x, y = values[i, :3], values[i, 3]
        for j in range(s.colour.shape[1]):
            shown = ambient + x * s.shade[i, j] + y * s.glint[i, j]
            data += s.measured[i, j] * ((s.colour[i, j] - shown) ** 2).sum()
        for a, b in s.pairs:
            seen, shown = s.colour[i, a] - s.colour[i, b], y * (s.glint[i, a] - s.glint[i, b])
            difference += min(s.measured[i, a], s.measured[i, b]) * ((seen - shown) ** 2).sum()
    return data, difference


def test_the_objective_is_the_papers(two_views):
    s = two_views
    seen = SimpleNamespace(colour=s.colour, measured=s.measured)
    surface = SimpleNamespace(
        texels=s.texels, pairs=s.pairs, chunks=lambda: [np.arange(len(s.albedo))], observe=lambda chunk: seen
    )
    forward = SimpleNamespace(shade=lambda seen, light: (s.shade, s.glint))
    config = ReflectanceConfig(smoothness_weight=0.7, specular_smoothness=3.0, specular_difference_weight=0.25)
    maps = s.maps.reshape(4, 4, 4)
    found = energies(surface, forward, np.zeros((9, 3)), 0.05, maps, s.albedo, config)
    data, difference = papers_terms(s, 0.05)
    assert found["data"] == pytest.approx(data, rel=1e-5)
    assert found["difference"] == pytest.approx(0.25 * difference, rel=1e-5)
    # The diffuse part of E_H is that of the offset from the model's albedo, the specular one that of the map.
    offset = maps.astype(float).copy()
    offset.reshape(16, 4)[s.texels.index, :3] -= s.albedo
    rough = np.abs(laplacian(offset)).reshape(16, 4)[s.texels.index].sum(0)
    assert found["smoothness"] == pytest.approx(0.7 * (rough[:3].sum() + 3.0 * rough[3]), rel=1e-5)


def test_the_maps_blocks_are_data_and_difference_terms(two_views):
    s = two_views
    systems = TexelSystems.accumulate(s.colour - 0.05, s.measured[..., None], s.shade, s.glint, s.pairs, 0.25)
    values = s.maps[s.texels.index].astype(float)

    def block():
        x, y = values[:, :3], values[:, 3]
        quadratic = (systems.dd * x**2).sum(1) + 2 * (systems.ds * x).sum(1) * y + systems.ss * y**2
        return float((quadratic - 2 * ((systems.dr * x).sum(1) + systems.sr * y)).sum())

    def papers():
        s.maps[s.texels.index] = values
        data, difference = papers_terms(s, 0.05)
        return data + 0.25 * difference

    start = block(), papers()
    for column in (0, 2, 3):  # the two differ by a constant
        values[:, column] *= 0.5
        assert block() - start[0] == pytest.approx(papers() - start[1], rel=1e-3, abs=1e-4)


def test_the_lightings_equations_are_data_and_difference_terms(two_views):
    s, k = two_views, 3
    rows = RNG.normal(size=(*s.measured.shape, k))
    glint = RNG.normal(size=rows.shape)
    seen = SimpleNamespace(colour=s.colour, measured=s.measured)
    system, right = lighting_equations(seen, s.pairs, 1, rows, glint, 0.25)

    def papers(light):
        c = s.colour[..., 1]
        total = (s.measured * (c - rows @ light) ** 2).sum()
        for a, b in s.pairs:
            both = 0.25 * np.minimum(s.measured[:, a], s.measured[:, b])
            total += (both * (c[:, a] - c[:, b] - (glint[:, a] - glint[:, b]) @ light) ** 2).sum()
        return total

    zero = papers(np.zeros(k))
    for light in RNG.normal(size=(3, k)):
        assert light @ system @ light - 2 * right @ light == pytest.approx(papers(light) - zero, rel=1e-5)


def test_the_maps_are_smoothed_as_an_offset_from_the_models_albedo():
    size, index = 16, np.arange(256)
    rows, columns = np.indices((size, size))
    prior = np.zeros((size, size, 4), np.float32)
    prior[..., :3] = 0.4 + 0.1 * np.where((rows + columns) % 2, 1.0, -1.0)[..., None]
    noisy = prior[..., :3] + 0.1 + 0.05 * np.random.default_rng(1).normal(size=(size, size, 3))
    ones = np.ones((256, 1, 3), np.float32)
    systems = TexelSystems.accumulate(
        noisy.reshape(256, 1, 3).astype(np.float32), ones, ones, 0 * ones, np.zeros((0, 2), int), 0.0
    )  # fmt: skip
    found = solve_maps(systems, index, prior, (1.0, 1.0), iterations=300)[0][..., :3] - prior[..., :3]
    assert found.mean() == pytest.approx(0.1, abs=0.02) and np.abs(laplacian(found)).mean() < 0.02


def test_the_papers_exponent_and_bands():
    for name in ("paper", "printed"):
        model = models.get(name)
        assert (model.exponent, model.bands, model.fresnel, model.normalized, model.has_ambient) == (
            5.0, 3, None, False, True,
        )  # fmt: skip


def test_the_printed_highlight_is_the_quotient(variant):
    import mitsuba as mi

    from mifit.appearance.arrays import on_device
    from mifit.appearance.models import PaperModel, PrintedModel, paper_specular

    n = RNG.normal(size=(200, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    d, v = np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.0, 1.0])
    to = mi.Vector3f(*map(float, v)), mi.Vector3f(*map(float, d))
    cosine, h = n @ d, (d + v) / np.linalg.norm(d + v)
    lit = cosine > 0.05
    found = np.array(paper_specular(on_device(mi.Vector3f, n), *to, 5.0, PrintedModel.guard))
    expected = np.maximum(n @ h, 0) ** 5 / np.maximum(cosine, 1e-9)
    np.testing.assert_allclose(found[lit], expected[lit], rtol=2e-3)
    assert (found[cosine <= 0] == 0).all()
    guarded = np.array(paper_specular(on_device(mi.Vector3f, n), *to, 5.0, PaperModel.guard))
    assert (guarded[lit] < 0.999 * expected[lit]).any()


# Stage 3 --------------------------------------------------------------------------------------------------------------


def test_weights_of_stage_3_are_for_images_and_normal_maps_of_8_bits(variant):
    from mifit.core.uv import rasterize_uv
    from mifit.sampling.observations import Surface
    from mifit.stages.normals.refine_normals import frame_problem
    from tests.stages.normal_scene import build

    small = build("paper")
    size = small.reflectance.diffuse.shape[0]
    texels = rasterize_uv(small.model.uv, small.model.faces_uv, size, small.model.face_mask)
    config = NormalsConfig(laplacian_weight=2e-3, magnitude_weight=0.3)
    surface = Surface(small, small.model, small.geometry, ("left", "right"), size, texels=texels)
    problem, rows, base = frame_problem(surface, small.reflectance, config)
    offsets = 0.1 * np.random.default_rng(0).normal(size=(len(rows), 2))
    found = problem.energies(offsets)
    turned = base[rows]
    delta = bend(turned, tangent_plane(turned), offsets) - turned
    # 255^2 E = sum |255 residual|^2 + w1 |127.5 Laplacian|_1 + w2 |127.5 delta|^2
    assert found["magnitude"] == pytest.approx(0.3 * (127.5**2) * (delta**2).sum() / 255**2, rel=1e-3)
    plain = replace(config, laplacian_weight=4e-3)
    twice = frame_problem(surface, small.reflectance, plain)[0]
    from mifit.core.uv import texel_neighbours

    near = texel_neighbours(TexelMap(size, texels.index[rows], texels.face[rows], texels.weights[rows]))
    rough = np.abs(4 * delta - delta[near].sum(1)).sum()
    key = next(k for k in found if k not in ("data", "magnitude"))
    assert found[key] == pytest.approx(2e-3 * 127.5 * rough / 255**2, rel=0.02)
    assert twice.energies(offsets)[key] == pytest.approx(2 * found[key], rel=1e-4)
