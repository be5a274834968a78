"""Stage 2 on captures whose albedo and lighting are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import EXPONENT, SIZE, render, turning_dome

from mifit.appearance.illumination import DistantLight
from mifit.config import ReflectanceConfig
from mifit.errors import InputError
from mifit.sampling.observations import Surface
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.reflectance.albedo_priors import specular_pull
from mifit.stages.reflectance.maps import WEAK, TexelSystems, laplacian, solve_maps

CONFIG = ReflectanceConfig(
    texture_size=SIZE, shading="prefiltered", bands=4, exponent=EXPONENT, specular_albedo=1.0, smoothness_weight=1e-5
)


@pytest.fixture(scope="module")
def dome(variant):
    return turning_dome()


@pytest.fixture(scope="module")
def found(dome):
    return infer(dome)


def infer(scene, config=CONFIG, cameras=("left", "right"), **geometry):
    return infer_reflectance(scene, scene.model, replace(scene.geometry, **geometry), cameras, config)


def errors(scene, estimate):
    """RMSE of the diffuse and the specular map where both were seen well."""
    good = estimate.confidence > 0.9
    assert good.mean() > 0.3
    scale = scene.diffuse[good].mean() / estimate.diffuse[good].mean()
    diffuse = np.sqrt(np.mean((scale * estimate.diffuse[good] - scene.diffuse[good]) ** 2))
    specular = np.sqrt(np.mean((scale * estimate.specular[good] - scene.specular[good]) ** 2))
    return diffuse, specular


def held_out(scene, estimate):
    """RMSE on the third view, linear colour."""
    total = []
    for t in scene.geometry.timesteps:
        image, mask = render(
            scene,
            "third",
            t,
            estimate.diffuse,
            estimate.specular,
            estimate.illumination.radiance,
            estimate.lobe.exponent,
            estimate.shading_model,
            estimate.lobe.fresnel,
            estimate.illumination.ambient,
        )
        true = scene.frame("third", t).image
        total.append(((image - true)[mask]) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(total))))


def test_own_shading_is_recovered(dome, found):
    diffuse, specular = errors(dome, found)
    assert diffuse < 0.008 and specular < 0.01  # a dome shows too few normals to pin the low bands further
    assert held_out(dome, found) < 0.004
    assert found.report.outcome == "converged"


def test_maps_are_finite_in_the_box_and_confident_where_seen(found):
    for image in (found.diffuse, found.specular, found.confidence, found.specular_confidence):
        assert image.dtype == np.float32 and np.isfinite(image).all() and image.min() >= 0 and image.max() <= 1
    assert found.diffuse.shape == (SIZE, SIZE, 3) and found.specular.shape == (SIZE, SIZE)
    assert found.illumination.radiance.shape == (16, 3) and found.hair is None
    assert (found.specular_confidence <= found.confidence).all() and found.specular_confidence.max() > 0.3


def test_the_gauge_is_the_albedo_of_the_fitted_model(dome, found):
    expected = dome.geometry.vertex_albedo.mean()
    assert abs(found.diffuse[found.confidence > 0.5].mean() / expected - 1) < 0.05
    darker = replace(dome.geometry, vertex_albedo=dome.geometry.vertex_albedo * np.float32(0.7))
    other = infer(replace(dome, geometry=darker))
    ratio = other.diffuse[found.confidence > 0.9].mean() / found.diffuse[found.confidence > 0.9].mean()
    assert abs(ratio / 0.7 - 1) < 0.03
    np.testing.assert_allclose(other.illumination.radiance[0] * 0.7, found.illumination.radiance[0], rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("exposure", [1e-3, 1e3])
def test_exposure_goes_into_the_lighting(dome, exposure):
    scaled = dome.changed(lambda f: replace(f, image=f.image * np.float32(exposure)))
    config = replace(CONFIG, texture_size=24, robust=False, smoothness_weight=0.0)
    other, plain = infer(scaled, config), infer(dome, config)
    np.testing.assert_allclose(other.illumination.radiance[0] / exposure, plain.illumination.radiance[0], rtol=0.02)
    good = plain.confidence > 0.9
    np.testing.assert_allclose(other.diffuse[good].mean(), plain.diffuse[good].mean(), rtol=0.02)


def test_without_highlights_the_specular_map_is_dark(variant):
    matt = turning_dome(gloss=0.0)
    estimate = infer(matt)
    assert estimate.specular[estimate.confidence > 0.9].mean() < 0.01
    assert errors(matt, estimate)[0] < 0.01


def test_bad_pixels_change_little(dome, found):
    rng = np.random.default_rng(0)

    def spoil(frame):
        image = frame.image.copy()
        image[rng.random(image.shape[:2]) < 0.02] = np.nan
        return replace(frame, image=image)

    spoiled = dome.changed(spoil)
    spoiled.frames["left", 1].image[40:60, 70:90] = 5.0  # a reflection that no model explains
    estimate = infer(spoiled)
    assert np.isfinite(estimate.diffuse).all() and np.isfinite(estimate.specular).all()
    assert errors(dome, estimate)[0] < 0.05


def test_two_equal_views_still_end(dome):
    twin = infer(dome, cameras=("left", "left"))
    assert np.isfinite(twin.diffuse).all() and np.isfinite(twin.illumination.radiance).all()


def test_the_same_seed_gives_the_same_result(dome, found):
    again = infer(dome)
    np.testing.assert_array_equal(again.diffuse, found.diffuse)
    np.testing.assert_array_equal(again.illumination.radiance, found.illumination.radiance)


def test_auto_is_the_shadowed_model_without_lights_that_are_not_there(dome):
    estimate = infer(dome, replace(CONFIG, shading="auto"))
    assert estimate.shading_model == "shadowed" and estimate.illumination.lights == ()
    assert estimate.report.details["shading"] == {"model": "shadowed", "exponent": EXPONENT, "lights": 0}


def test_lights_that_shading_showed_keep_their_places(dome):
    given = DistantLight(np.array([0.0, 0.6, 0.8]), 0.05, np.zeros(3))
    (found,) = infer(dome, replace(CONFIG, shading="auto"), lights=(given,)).illumination.lights
    assert found.radius == given.radius and (found.direction == given.direction).all()


def test_without_specular_reflection_all_is_diffuse(dome):
    estimate = infer(dome, replace(CONFIG, specular=False))
    assert not estimate.specular.any() and estimate.diffuse.mean() > 0.05


def test_unseen_texels_show_the_models_albedo(dome):
    only = infer(dome, cameras=("left",), vertices=dome.geometry.vertices)
    assert np.isfinite(only.diffuse).all()
    unseen = (only.confidence == 0) & (only.diffuse.sum(-1) > 0)
    if unseen.any():
        assert np.abs(only.diffuse[unseen] - dome.geometry.vertex_albedo[0]).max() < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("shading", ["paper", "printed"])
def test_the_papers_objective_falls_to_its_end(variant, shading):
    scene = turning_dome("paper", None, exponent=5.0, steps=2)
    config = ReflectanceConfig(texture_size=24, shading=shading, robust=False, smoothness_weight=1e-4)
    found = infer(scene, config)
    total = np.sum([found.report.energies[k] for k in ("data", "difference", "smoothness")], axis=0)
    assert (np.diff(total) < 0).all() and len(total) > 5
    assert found.report.details["objective"]["total"] == pytest.approx(total[-1], rel=1e-3)
    assert total[-1] < 0.2 * total[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"texture_size": 4}, "texture_size: found 4"),
        ({"bands": 11}, "bands: found 11"),
        ({"exponent": 0.5}, "exponent: found 0.5"),
        ({"smoothness_weight": -1.0}, "smoothness_weight: found -1"),
        ({"max_iterations": 0}, "max_iterations: found 0"),
    ],
)
def test_settings_out_of_range_are_refused(dome, change, message):
    with pytest.raises(InputError, match=message):
        infer(dome, replace(CONFIG, **change))


def test_blocks_solve_in_closed_form():
    rng = np.random.default_rng(1)
    colour = rng.uniform(0.1, 0.5, (7, 6, 3)).astype(np.float32)
    weight, shade, glint = (rng.uniform(0.1, 1.0, (7, 6, 3)).astype(np.float32) for _ in range(3))
    pairs = np.array([[0, 1], [2, 3]])
    systems, prior = TexelSystems.accumulate(colour, weight, shade, glint, pairs, 0.1), np.zeros((3, 3, 4), np.float32)
    given = systems, np.arange(7), prior, (0.0, 0.0)
    found = solve_maps(*given, pulls=(0, 0), iterations=2000, tolerance=1e-7)[0].reshape(-1, 4)[:7]
    x, y = found[:, :3], found[:, 3]

    def energy(x, y):
        value = (weight * (colour - x[:, None] * shade - y[:, None, None] * glint) ** 2).sum((1, 2))
        for a, b in pairs:
            both = 0.1 * np.minimum(weight[:, a], weight[:, b])
            step = colour[:, a] - colour[:, b] - y[:, None] * (glint[:, a] - glint[:, b])
            value += (both * step**2).sum(1)
        return value

    best = energy(x, y)
    for _ in range(50):
        dx, dy = rng.normal(0, 0.02, x.shape), rng.normal(0, 0.02, y.shape)
        assert (energy(np.clip(x + dx, 0, 1), np.clip(y + dy, 0, 1)) >= best - 1e-5).all()


def test_admm_reaches_the_minimum_of_the_l1_problem():
    size = 12
    rng = np.random.default_rng(2)
    n = size * size
    ones, zero = np.ones((n, 3), np.float32), np.zeros((n, 3), np.float32)
    target = rng.uniform(0.2, 0.8, (n, 4)).astype(np.float32)
    systems = TexelSystems(ones, zero, target[:, :3].copy(), ones[:, 0], target[:, 3].copy())
    prior = np.zeros((size, size, 4), np.float32)
    weights = (0.02, 0.05)

    def energy(image):
        rough = np.abs(laplacian(image)).sum((0, 1))
        return ((image.reshape(n, 4) - target) ** 2).sum() + rough @ np.array([0.02, 0.02, 0.02, 0.05])

    found, _ = solve_maps(systems, np.arange(n), prior, weights, pulls=(0, 0), iterations=400)
    best = energy(found.astype(np.float64))
    assert best < 0.9 * energy(target.reshape(size, size, 4).astype(np.float64))
    for _ in range(200):
        step = rng.normal(0, 1e-2, found.shape) * (rng.random(found.shape) < 0.1)
        assert energy(np.clip(found + step, 0, 1)) > best - 1e-3


@pytest.mark.parametrize(("iterations", "outcome"), [(1, "max_iterations"), (3000, "converged")])
def test_the_report_says_how_the_maps_ended(dome, monkeypatch, iterations, outcome):
    monkeypatch.setattr("mifit.stages.reflectance.als.MAP_ITERATIONS", iterations)
    details = infer(dome, replace(CONFIG, texture_size=16)).report.details
    assert details["maps_outcome"] == outcome


def test_maps_are_the_same_in_parts_and_texels_without_a_block_follow_the_others(monkeypatch):
    size, rng = 16, np.random.default_rng(5)
    index = np.flatnonzero(rng.random(size * size) < 0.7)
    ones = np.ones((len(index), 3), np.float32)
    target = rng.uniform(-0.2, 1.2, (len(index), 4)).astype(np.float32)
    systems = TexelSystems(ones, 0.3 * ones, target[:, :3].copy(), ones[:, 0], target[:, 3].copy())
    prior = np.full((size, size, 4), 0.5, np.float32)
    given = systems, index, prior, (0.02, 0.05)
    whole, _ = solve_maps(*given, iterations=30)
    monkeypatch.setattr("mifit.core.process.BLOCK", 64 * 3 * size)
    np.testing.assert_allclose(solve_maps(*given, iterations=30)[0], whole, atol=1e-6)
    seen = np.zeros(size * size, bool)
    seen[index] = True
    smooth = [np.abs(laplacian(whole)).reshape(-1, 4)[rows].mean() for rows in (seen, ~seen)]
    assert smooth[1] < smooth[0]  # what nothing measures is drawn by its neighbours alone


def test_weights_ignore_the_map_size(dome):
    sums = []
    for size in (24, SIZE):
        surface = Surface(dome, dome.model, dome.geometry, ("left",), size)
        sums.append(surface.observe(np.arange(len(surface))).weight.sum())
    assert abs(sums[0] / sums[1] - 1) < 0.1


def test_noise_decides_how_far_the_specular_albedo_is_told_by_the_images():
    """Texels whose images say 0.1 with unit curvature: believed when the noise is small, not when it is large."""
    n = 6
    ones, none = np.ones((n * n, 3), np.float32), np.zeros((n * n, 3), np.float32)
    systems = TexelSystems(ones, none, 0.4 * ones, ones[:, 0], 0.1 * ones[:, 0])
    prior = np.full((n, n, 4), 0.01, np.float32)
    pulls = [specular_pull(0.01, sigma) for sigma in (1e-5, 1.5e-3, 0.1)]
    values = [solve_maps(systems, np.arange(n * n), prior, (0, 0), None, (pull, WEAK))[0] for pull in pulls]
    np.testing.assert_allclose([v[..., 3].mean() for v in values], [0.1, 0.055, 0.01], atol=2e-3)
    np.testing.assert_allclose([v[..., :3].mean() for v in values], 0.4, atol=2e-3)
