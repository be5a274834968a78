"""Stage 3: known normals are recovered and bounds hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mifit.config import NormalsConfig
from mifit.core import sh
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import TexelMap, bend, rasterize_uv, tangent_plane, texel_neighbours
from mifit.errors import InputError
from mifit.optim import Outcome
from mifit.stages.normals.refine_normals import NormalProblem, NormalView, solve_normals

CAMERAS = ("left", "right")


@pytest.fixture(scope="module")
def scene(variant):
    from normal_scene import build

    return build()


def angles(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1)))


def base_map(scene):
    model, size = scene.model, scene.reflectance.diffuse.shape[0]
    texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
    vertices = scene.geometry.vertices[0]
    base = normalize(interpolate(vertex_normals(vertices, model.faces), model.faces, texels.face, texels.weights))
    return texels, texels.to_map(base)


def refine(scene, **settings):
    from mifit.stages.normals.refine_normals import refine_normals

    config = NormalsConfig(**{"magnitude_weight": 0.01, "laplacian_weight": 1e-3, **settings})
    return refine_normals(scene, scene.model, scene.geometry, scene.reflectance, CAMERAS, config)


# The sphere: a normal map with a known answer in a chart with two poles -----------------------------------------------


def bumpy_sphere(size=96):
    """Normals of a sphere in a lat-long chart, and those of the sphere with bumps."""
    column, row = np.meshgrid(np.arange(size), np.arange(size))
    phi, theta = 2 * np.pi * (column + 0.5) / size, np.pi * (row + 0.5) / size
    n = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], -1).reshape(-1, 3)

    def bumps(p):
        return 0.02 * np.sin(7 * p[:, 0] + 1) * np.sin(6 * p[:, 1]) * np.cos(8 * p[:, 2])

    slope = np.stack([(bumps(n + 1e-5 * e) - bumps(n - 1e-5 * e)) / 2e-5 for e in np.eye(3)], axis=1)
    slope -= np.sum(slope * n, axis=1, keepdims=True) * n
    texels = TexelMap(size, np.arange(size * size), np.zeros(size * size, np.int32), np.zeros((size**2, 3), np.float32))
    return texels, n, normalize(n * (1 + bumps(n))[:, None] - slope)


def sphere_problem(w1=1e-3 * 127.5 / 255**2, w2=1e-3, size=96, seed=0):
    texels, base, true = bumpy_sphere(size)
    radiance = 0.4 * np.random.default_rng(seed).normal(size=(9, 3))
    radiance[0] = 2.0
    factors = sh.cosine_coefficients(3)[sh.bands(3)] / np.pi

    def image(n):
        return sh.basis(n, 3) @ (factors[:, None] * radiance)

    def shade(n, turns=()):
        return image(n), [(image(n + 1e-6 * turn) - image(n - 1e-6 * turn)) / 2e-6 for turn in turns]

    tangents, view = tangent_plane(base), NormalView(np.arange(len(base)), image(true), np.ones(len(base)), shade)
    return NormalProblem(base, tangents, texel_neighbours(texels), [view], w1, w2), base, tangents, true


def solved_sphere(problem, tolerance=1e-3):
    return solve_normals(problem, 60, np.zeros((len(problem.normals), 2)), tolerance)


def test_a_bumpy_sphere_is_recovered_to_two_degrees_at_the_poles_too():
    problem, base, tangents, true = sphere_problem(w2=1e-5)
    solved = solved_sphere(problem)
    error = angles(bend(base, tangents, solved.value.reshape(-1, 2)), true).reshape(96, 96)
    assert angles(base, true).mean() > 3.0
    assert error.mean() < 0.2
    assert np.percentile(error, 99) < 2.0
    assert error[[0, 1, -2, -1]].max() < 2.0
    assert solved.outcome is Outcome.CONVERGED


@pytest.mark.parametrize(("w1", "w2"), [(1e-5, 1e-3), (0.0, 1e-3), (1e-5, 1e-2)])
def test_no_direction_lowers_the_energy_at_the_end(w1, w2):
    problem, *_ = sphere_problem(w1, w2, size=48)
    found, rng = solved_sphere(problem, 1e-6), np.random.default_rng(0)

    def energy(offsets):
        return sum(problem.energies(offsets).values())

    assert found.energy < 0.5 * energy(np.zeros(2 * 48 * 48))
    assert energy(found.value) == pytest.approx(found.energy, rel=1e-5)
    for step in (1e-3, 1e-2):
        assert min(energy(found.value + step * rng.normal(size=found.value.shape)) for _ in range(5)) > found.energy
    assert energy(0.98 * found.value) > found.energy and energy(1.02 * found.value) > found.energy


def test_energies_never_rise():
    solved = solved_sphere(sphere_problem(1e-4, 1e-3, size=48)[0], 1e-6)
    total = np.sum([solved.energies[k] for k in solved.energies], axis=0)
    assert np.all(np.diff(total) <= 0)
    assert len(total) > 3


@pytest.mark.parametrize(("w1", "w2"), [(0.0, 0.0), (1e-2, 0.0), (0.0, 0.5)])
def test_the_gradient_is_that_of_finite_differences(w1, w2):
    problem, base, _, _ = sphere_problem(w1, w2, size=24)
    rng = np.random.default_rng(1)
    x = 0.1 * rng.normal(size=2 * len(base))
    system = problem.linearize(x)
    for step in 1e-5 * rng.normal(size=(5, len(x))):
        up, down = (sum(problem.energies(x + s * step).values()) for s in (1, -1))
        assert 2.0 * system.gradient @ step == pytest.approx(0.5 * (up - down), rel=1e-3)


def test_a_step_solves_the_damped_equations_and_holds_what_is_frozen():
    problem, base, _, _ = sphere_problem(1e-4, 1e-3, size=16)
    rng = np.random.default_rng(2)
    system = problem.linearize(0.1 * rng.normal(size=2 * len(base)))
    frozen = rng.random(2 * len(base)) < 0.1
    step = system.solve(0.5, frozen)
    assert (step[frozen] == 0).all()
    lift = 0.5 * system.blocks[[0, 2]].T.ravel()
    left = (system.product(step) + lift * step + system.gradient)[~frozen]
    assert np.linalg.norm(left) < 0.05 * np.linalg.norm(system.gradient[~frozen])


def test_smoothing_spreads_corrections():
    rough, base, tangents, _ = sphere_problem(0.0, 1e-3, size=48)
    smooth, *_ = sphere_problem(1e-2, 1e-3, size=48)
    near = texel_neighbours(bumpy_sphere(48)[0])

    def roughness(problem):
        n = bend(base, tangents, solved_sphere(problem).value.reshape(-1, 2)) - base
        return np.abs(4 * n - n[near].sum(1)).mean()

    assert roughness(smooth) < 0.5 * roughness(rough)


# The stage on a capture -----------------------------------------------------------------------------------------------


def test_known_normals_are_recovered_from_two_views(scene):
    texels, base = base_map(scene)
    found = refine(scene).normal_object[0]
    seen = texels.mask & (angles(found, base) > 0)
    assert seen.sum() > 0.9 * texels.mask.sum()
    before, after = angles(base, scene.normal_map)[seen], angles(found, scene.normal_map)[seen]
    assert before.mean() > 5.0
    assert after.mean() < 0.25 * before.mean()


def test_the_paper_shading_is_refined(variant):
    from normal_scene import build

    scene = build("paper")
    texels, _ = base_map(scene)
    result = refine(scene)
    assert angles(result.normal_object[0], scene.normal_map)[texels.mask].mean() < 2.5
    assert all(np.isfinite(v).all() for v in result.report.energies.values())


def test_shadowed_shading_is_accepted(scene):
    shadowed = replace(scene, reflectance=replace(scene.reflectance, shading_model="shadowed"))
    texels, _ = base_map(scene)
    # a dome casts no shadow on itself, so the answer is the unshadowed one up to the noise of tracing
    found = refine(shadowed, magnitude_weight=0.3).normal_object[0]
    plain = refine(scene, magnitude_weight=0.3).normal_object[0]
    assert angles(found, plain)[texels.mask].mean() < 1.0


def test_normals_are_unit_where_covered_and_zero_elsewhere(scene):
    texels, _ = base_map(scene)
    result = refine(scene)
    length = np.linalg.norm(result.normal_object[0], axis=-1)
    assert_allclose(length[texels.mask], 1.0, atol=1e-5)
    assert_array_equal(length[~texels.mask], 0.0)
    assert result.normal_object.dtype == np.float32


def test_only_named_cameras_are_read(scene):
    scene.requested.clear()
    refine(scene)
    assert scene.requested == set(CAMERAS)


def test_without_measurements_the_model_is_kept_and_said(scene):
    blind = {k: replace(f, valid=np.zeros_like(f.valid)) for k, f in scene.frames.items()}
    texels, base = base_map(scene)
    result = refine(replace(scene, frames=blind))
    assert angles(result.normal_object[0], base)[texels.mask].max() < 0.1
    assert "timestep 0" in result.report.warnings[0].text


def test_clipped_pixels_and_nan_pixels_count_nothing(scene):
    spoiled = {}
    for key, frame in scene.frames.items():
        image, clipped = frame.image.copy(), frame.clipped.copy()
        clipped[60:90, 60:90] = True
        image[60:90, 60:90] = 7.0
        image[100:104] = np.nan
        spoiled[key] = replace(frame, image=image, clipped=clipped)
    texels, base = base_map(scene)
    found = refine(replace(scene, frames=spoiled)).normal_object[0]
    assert np.isfinite(found).all()
    assert angles(found, scene.normal_map)[texels.mask].mean() < angles(base, scene.normal_map)[texels.mask].mean()


def test_gross_outliers_do_not_pull(scene):
    rng = np.random.default_rng(5)
    spoiled = {}
    for key, frame in scene.frames.items():
        image = frame.image.copy()
        image[rng.random(image.shape[:2]) < 0.03] = 1.0
        spoiled[key] = replace(frame, image=image)
    texels, base = base_map(scene)
    found = refine(replace(scene, frames=spoiled), laplacian_weight=1.0).normal_object[0]
    error = angles(found, scene.normal_map)[texels.mask]
    assert np.median(error) < 0.4 * angles(base, scene.normal_map)[texels.mask].mean()


def test_normals_stay_within_reach_of_the_meshs_whatever_the_images(scene):
    strange = {
        k: replace(f, image=np.random.default_rng(1).random(f.image.shape).astype(np.float32))
        for k, f in scene.frames.items()
    }
    found = refine(replace(scene, frames=strange), magnitude_weight=0.0, laplacian_weight=0.0).normal_object[0]
    texels, base = base_map(scene)
    assert angles(found, base)[texels.mask].max() < np.degrees(2 * np.arctan(np.sqrt(2) / 2)) + 0.1


def test_the_same_inputs_give_the_same_normals(scene):
    assert_array_equal(refine(scene).normal_object, refine(scene).normal_object)


def test_maps_of_different_sizes_are_refused(scene):
    wrong = replace(scene.reflectance, specular=np.zeros((8, 8), np.float32))
    with pytest.raises(InputError, match=r"reflectance maps: found shapes .*expected"):
        refine(replace(scene, reflectance=wrong))
