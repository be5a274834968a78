"""Shape from shading in the model's own space: derivatives, a known answer, and what must not pull."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_geometry_terms import head

from mifit.core.mesh import face_cross
from mifit.core.sh import basis
from mifit.solve import minimize
from mifit.solve.systems import DenseSystem
from mifit.stages.geometry.normal import prior_energy
from mifit.stages.geometry.parameters import Frames, Layout, exponential
from mifit.stages.geometry.shading import ShadingTerm

STEPS = 3


@pytest.fixture
def scene():
    """A head at three poses under coloured light, shaded from its true identity; points have random albedo."""
    rng = np.random.default_rng(3)
    model = head(rng)
    layout = Layout(STEPS, 4, 3)
    turns = [(0.0, 0.0, 0.0), (0.0, 0.45, 0.1), (0.3, -0.4, 0.0)]
    frames = Frames(np.stack([exponential(np.array(t)) for t in turns]), 1.0)
    light = rng.normal(size=(9, 3)) * 0.25
    light[0] = 3.0

    def shade(normals, image):
        return basis(normals, 3) @ light, 0.02 + 0.1 * basis(normals, 3)[:, 4:5] ** 2 * np.ones(3)

    n = 300
    area = np.linalg.norm(face_cross(model.mean, model.faces), axis=1)
    face = rng.choice(len(area), n, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), n)
    term = ShadingTerm(
        model, layout, frames, face, weights, np.arange(STEPS), np.zeros((n, STEPS, 3)), np.zeros((n, STEPS, 3)), shade
    )
    x = np.zeros(layout.size)
    x[layout.at("identity")] = rng.normal(size=4)
    for k in range(STEPS):
        x[layout.at("expression", k)] = 0.5 * rng.normal(size=3)
    albedo = rng.uniform(0.2, 0.8, (n, 3))
    colour = np.empty_like(term.colour)
    for j in range(STEPS):
        body, rest = shade(term._points(x, j)[0], j)
        colour[:, j] = albedo * body + rest
    seen = rng.random((n, STEPS, 1)) < 0.9
    return replace(term, colour=colour, precision=np.where(seen, 1e4, 0.0) * np.ones(3)), x, albedo


def test_truth_has_no_residual_and_its_albedo(scene):
    term, x, albedo = scene
    assert term.energy(x) < 1e-16
    often = (term.precision[..., 0] > 0).sum(1) > 0
    found = term.residual([term._points(x, k)[0] for k in range(STEPS)])[2]
    np.testing.assert_allclose(found[often], albedo[often], atol=1e-9)


def test_gradient_is_that_of_the_energy(scene):
    term, x, _ = scene
    at = x + 0.05 * np.random.default_rng(0).normal(size=len(x))
    gradient = term.linearize(at).gradient
    expected = np.zeros_like(x)
    for i in range(len(x)):
        step = np.zeros_like(x)
        step[i] = 1e-5
        expected[i] = (term.energy(at + step) - term.energy(at - step)) / 4e-5  # half: the energy has no half
    np.testing.assert_allclose(gradient, expected, atol=2e-3 * np.abs(expected).max())
    for k in range(STEPS):
        assert np.abs(expected[term.layout.at("rotation", k)]).max() > 0
        assert not gradient[term.layout.at("translation", k)].any()


def test_curvature_leaves_out_what_albedo_explains(scene):
    """At the truth H is the exact second derivative of the energy with the albedos eliminated."""
    term, x, _ = scene
    hessian = term.linearize(x).hessian
    direction = np.random.default_rng(1).normal(size=len(x)) * 1e-4
    assert direction @ hessian @ direction == pytest.approx(term.energy(x + direction), rel=0.02)


def test_shape_is_found_through_unknown_paint(scene):
    term, x, _ = scene

    class Problem:
        """Shading with a weak prior about the poses and translations, which shading leaves open."""

        def energies(self, y):
            return {"shading": term.energy(y), "prior": prior_energy(term.layout, y, {"translation": 1.0})}

        def linearize(self, y):
            system, weak = term.linearize(y), np.zeros((len(y), len(y)))
            for k in range(STEPS):
                at = term.layout.at("translation", k)
                weak[at, at] = np.eye(3)
            return DenseSystem(system.hessian + weak, system.gradient + weak @ y)

    start = x.copy()
    start[term.layout.at("identity")] += 0.4
    found = minimize(Problem(), start, max_iterations=25)
    before, after = ([term._points(y, k)[0] for k in range(STEPS)] for y in (start, found.value))
    truth = [term._points(x, k)[0] for k in range(STEPS)]

    def degrees(a):
        return np.degrees(np.mean([np.linalg.norm(p - q, axis=1) for p, q in zip(a, truth, strict=True)]))

    assert degrees(before) > 1.0
    assert degrees(after) < 0.1 * degrees(before)


@pytest.mark.slow
def test_a_fit_with_a_round_of_shading_keeps_every_stage(tiny_capture, variant, tmp_path):
    import mifit
    from mifit.config import FitConfig, ReflectanceConfig, ShapeConfig, SurfaceConfig

    capture, model = mifit.Capture.load(tiny_capture), mifit.MorphableModel.load("builtin:coarse")
    reflectance = ReflectanceConfig(texture_size=64, shading="prefiltered", bands=4, exponent=100.0)
    surface = SurfaceConfig(refit=False)

    def fit(rounds):
        config = FitConfig(surface=surface, reflectance=reflectance, shape=ShapeConfig(rounds))
        return mifit.fit(capture, model, ["left", "right"], [0, 1], config, "reflectance", checkpoints=tmp_path)

    plain, found = fit(0), fit(1)
    assert {p.name for p in tmp_path.glob("*.npz")} == {
        f"{name}.npz" for name in ("geometry", "surface", "falloff", "reflectance", "geometry_1", "reflectance_1")
    }
    energies = found.geometry.report.energies
    assert sum(v[-1] for v in energies.values()) < sum(v[0] for v in energies.values())
    assert energies["shading"][-1] < energies["shading"][0]
    assert found.geometry.report.details["phases"][-1]["name"] == "shading"
    moved = np.linalg.norm(found.geometry.vertices - plain.geometry.vertices, axis=-1)
    assert 0 < moved.max() < 1.0  # centimetres
    np.testing.assert_allclose(
        found.geometry.rotation @ found.geometry.rotation.transpose(0, 2, 1), np.tile(np.eye(3), (2, 1, 1)), atol=1e-9
    )
    assert found.seconds > plain.seconds
