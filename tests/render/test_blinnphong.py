"""The `blinnphong` BSDF against Mitsuba's own harness and the float64 form."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import mifit
from mifit.core import sh
from tests import reference

EXPONENTS = (1.0, 5.0, 50.0, 1000.0)
ANGLES = (0.0, 45.0, 80.0)


@pytest.fixture(scope="module", autouse=True)
def plugins(variant: str) -> None:
    mifit.register_plugins()


def direction(angle: float, azimuth: float = 0.0) -> list[float]:
    a, b = np.radians(angle), np.radians(azimuth)
    return [float(np.sin(a) * np.cos(b)), float(np.sin(a) * np.sin(b)), float(np.cos(a))]


def interaction(wi, count: int):
    import drjit as dr
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(np.asarray(wi, dtype=np.float32).T) if np.ndim(wi) > 1 else mi.Vector3f(*wi)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    return si


def bsdf(**parameters):
    import mitsuba as mi

    return mi.load_dict({"type": "blinnphong", **parameters})


def raw(*values: float):
    import mitsuba as mi

    return {"type": "bitmap", "bitmap": mi.Bitmap(np.tile(np.float32(values), (2, 2, 1))), "raw": True}


def hemisphere(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    d[:, 2] = np.abs(d[:, 2])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("exponent", EXPONENTS)
def test_chi2(exponent: float, angle: float) -> None:
    import mitsuba as mi
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    xml = f'<float name="exponent" value="{exponent}"/><float name="specular_reflectance" value="0.5"/>'
    sample, pdf = BSDFAdapter("blinnphong", xml, wi=mi.ScalarVector3f(direction(angle)))
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=200_000, res=61, ires=16)
    assert test.run(significance_level=0.001, test_count=12), test.messages


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("exponent", (1.0, 50.0, 1000.0))
def test_chi2_of_the_carried_lobe(exponent: float, angle: float) -> None:
    import mitsuba as mi
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    xml = f'<float name="exponent" value="{exponent}"/><float name="fresnel" value="8"/>'
    sample, pdf = BSDFAdapter("blinnphong", xml, wi=mi.ScalarVector3f(direction(angle)))
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=200_000, res=61, ires=16)
    assert test.run(significance_level=0.001, test_count=9), test.messages


@pytest.mark.parametrize("fresnel", [{}, {"fresnel": 8.0}])
def test_chi2_with_a_corrected_normal(fresnel: dict) -> None:
    import mitsuba as mi
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    scene = {"type": "blinnphong", "specular_reflectance": 0.5, "normal_correction": raw(0.4, -0.3, 0.0), **fresnel}
    sample, pdf = BSDFAdapter("blinnphong", scene, wi=mi.ScalarVector3f(direction(40, 70)))
    test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=200_000, res=61, ires=16)
    assert test.run(significance_level=0.01), test.messages


@pytest.mark.parametrize("normalized", [True, False])
@pytest.mark.parametrize("exponent", EXPONENTS)
def test_eval_is_the_float64_form(exponent: float, normalized: bool) -> None:
    import mitsuba as mi

    wi, wo = hemisphere(500), hemisphere(500, 1)
    plugin = bsdf(diffuse_reflectance=0.3, specular_reflectance=0.6, exponent=exponent, normalized=normalized)
    value = plugin.eval(mi.BSDFContext(), interaction(wi, 500), mi.Vector3f(wo.T.astype(np.float32)))
    lobe = reference.specular_brdf(wo, wi, np.array([0.0, 0, 1]), exponent, normalized)
    expected = (0.3 / np.pi + 0.6 * lobe) * wo[:, 2]
    assert np.abs(np.array(value)[0] - expected).max() < 3e-4 * expected.max()


@pytest.mark.parametrize("normalized", [True, False])
@pytest.mark.parametrize("exponent", EXPONENTS)
def test_the_carried_lobe_is_the_float64_form(exponent: float, normalized: bool) -> None:
    import mitsuba as mi

    wi, wo = hemisphere(500), hemisphere(500, 1)
    wo[::2] = wi[::2] * [-1, -1, 1] + 0.02 * wo[::2]  # near the mirror direction, where sharp lobes are
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    plugin = bsdf(
        diffuse_reflectance=0.3, specular_reflectance=0.05, exponent=exponent, normalized=normalized, fresnel=8.0
    )
    value = plugin.eval(mi.BSDFContext(), interaction(wi, 500), mi.Vector3f(wo.T.astype(np.float32)))
    lobe = reference.carried_brdf(wo, wi, np.array([0.0, 0, 1]), exponent, 8.0, normalized)
    expected = (0.3 / np.pi + 0.05 * lobe) * wo[:, 2]  # 9 * 0.05 + 0.3 < 1: the rise is never stopped
    assert np.abs(np.array(value)[0] - expected).max() < 1e-3 * expected.max()


def test_the_carried_lobe_rises_as_fitted() -> None:
    """Its albedo is ``C_s (1 + k (1 - n.v)^5)``, which local shading has, but for the part below the horizon."""
    d, w = sh.quadrature(256)
    for angle in (0.0, 30.0, 50.0, 60.0):
        cosine = np.cos(np.radians(angle))
        lobe = reference.carried_brdf(d, np.array(direction(angle)), np.array([0.0, 0, 1]), 150.0, 8.0)
        albedo = float((w * lobe * np.maximum(d[:, 2], 0)).sum())
        assert albedo == pytest.approx(1 + 8 * (1 - cosine) ** 5, rel=0.05)
        plain = reference.specular_brdf(d, np.array(direction(angle)), np.array([0.0, 0, 1]), 150.0)
        if angle >= 50:
            assert albedo > 1.8 * float((w * plain * np.maximum(d[:, 2], 0)).sum())


@pytest.mark.parametrize("fresnel", [{}, {"fresnel": 8.0}])
@pytest.mark.parametrize("exponent", EXPONENTS)
def test_eval_pdf_and_sample_agree(exponent: float, fresnel: dict) -> None:
    import mitsuba as mi

    plugin = bsdf(specular_reflectance=0.4, exponent=exponent, normal_correction=raw(0.2, 0.1, 0), **fresnel)
    rng, si = np.random.default_rng(0), interaction(hemisphere(1000), 1000)
    u = rng.random((3, 1000)).astype(np.float32)
    ctx = mi.BSDFContext()
    bs, weight = plugin.sample(ctx, si, mi.Float(u[0]), mi.Point2f(u[1:]))
    value, pdf = plugin.eval_pdf(ctx, si, bs.wo)
    assert np.array_equal(np.array(value), np.array(plugin.eval(ctx, si, bs.wo)))
    assert np.array_equal(np.array(pdf), np.array(plugin.pdf(ctx, si, bs.wo)))
    valid = np.array(bs.pdf) > 0
    assert valid.sum() > 500
    assert np.allclose(np.array(pdf), np.array(bs.pdf), rtol=1e-5)
    ratio = np.array(value)[:, valid] / np.array(pdf)[valid]
    assert np.allclose(np.array(weight)[:, valid], ratio, rtol=1e-4)
    assert not np.array(weight)[:, ~valid].any()


def test_components_add_up() -> None:
    import mitsuba as mi

    plugin = bsdf(specular_reflectance=0.4, exponent=10.0)
    si, wo = interaction(hemisphere(100), 100), mi.Vector3f(hemisphere(100, 1).T.astype(np.float32))
    parts = []
    for component, flag in ((0, mi.BSDFFlags.GlossyReflection), (1, mi.BSDFFlags.DiffuseReflection)):
        assert mi.has_flag(plugin.flags(component), flag)
        assert mi.has_flag(plugin.flags(component), mi.BSDFFlags.FrontSide)
        ctx = mi.BSDFContext()
        ctx.component = component
        parts.append(np.array(plugin.eval(ctx, si, wo)))
        bs, weight = plugin.sample(ctx, si, mi.Float(0.5), mi.Point2f(0.3, 0.7))
        assert np.allclose(np.array(bs.pdf), np.array(plugin.pdf(ctx, si, bs.wo)), rtol=1e-4)
        assert np.isfinite(np.array(weight)).all()
    assert np.allclose(sum(parts), np.array(plugin.eval(mi.BSDFContext(), si, wo)), rtol=1e-5)


def test_reciprocity() -> None:
    import mitsuba as mi

    wi, wo = hemisphere(300), hemisphere(300, 1)
    kinds = ({}, {"normalized": False}, {"fresnel": 8.0}, {"fresnel": 8.0, "normalized": False})
    for kind in kinds:
        plugin, ctx = bsdf(specular_reflectance=0.2, exponent=30.0, **kind), mi.BSDFContext()
        one = plugin.eval(ctx, interaction(wi, 300), mi.Vector3f(wo.T.astype(np.float32)))
        two = plugin.eval(ctx, interaction(wo, 300), mi.Vector3f(wi.T.astype(np.float32)))
        assert np.allclose(np.array(one) * wi[:, 2], np.array(two) * wo[:, 2], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("fresnel", [{}, {"fresnel": 0.0}, {"fresnel": 8.0}])
@pytest.mark.parametrize("exponent", [*EXPONENTS, 1e4])
def test_a_white_furnace_never_gains_energy(exponent: float, fresnel: dict) -> None:
    """Reflected share of constant light, for albedos that ask for twice the energy: at most one, to three sigma."""
    import mitsuba as mi

    count = 40_000
    u = np.random.default_rng(0).random((3, count)).astype(np.float32)
    for diffuse, specular in ((1.0, 1.0), (0.0, 1.0), (1.0, 0.0), (0.5, 0.2)):
        plugin = bsdf(diffuse_reflectance=diffuse, specular_reflectance=specular, exponent=exponent, **fresnel)
        for angle in (0.0, 30.0, 60.0, 85.0, 89.0):
            si = interaction(direction(angle), count)
            _, weight = plugin.sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(u[1:]))
            w = np.array(weight)[0]
            assert w.mean() <= 1.0 + 3 * w.std() / np.sqrt(count) + 1e-5
            if ((diffuse, angle) == (0.0, 0.0) and not fresnel) or specular == 0.0:
                assert w.mean() > 0.97


def test_every_parameter_can_be_written() -> None:
    import mitsuba as mi

    plugin = bsdf(
        diffuse_reflectance={"type": "rgb", "value": 0.2},
        specular_reflectance=0.3,
        exponent=8.0,
        normal_correction=raw(0.0, 0.0, 0.0),
        fresnel=2.0,
    )
    si, wo = interaction(direction(60), 1), mi.Vector3f(*direction(50, 170))
    parameters = mi.traverse(plugin)
    expected = {
        "diffuse_reflectance.value",
        "specular_reflectance.value",
        "exponent.value",
        "normal_correction.data",
        "fresnel.value",
    }
    assert expected <= set(parameters.keys())
    before = np.array(plugin.eval(mi.BSDFContext(), si, wo))
    for key in expected:
        value = parameters[key]
        parameters[key] = type(value)(value + 0.2 if key != "exponent.value" else value * 2)
        parameters.update()
        after = np.array(plugin.eval(mi.BSDFContext(), si, wo))
        assert np.abs(after - before).max() > 1e-4, key
        before = after
    assert "BlinnPhong[" in str(plugin) and "normal_correction" in str(plugin) and "fresnel" in str(plugin)


def test_textures_and_a_textured_exponent() -> None:
    import mitsuba as mi

    plugin = bsdf(exponent=raw(12.0), specular_reflectance=0.5)
    same = bsdf(exponent=12.0, specular_reflectance=0.5)
    si, wo = interaction(hemisphere(50), 50), mi.Vector3f(hemisphere(50, 1).T.astype(np.float32))
    ctx = mi.BSDFContext()
    assert np.allclose(np.array(plugin.eval(ctx, si, wo)), np.array(same.eval(ctx, si, wo)), rtol=1e-4)
    assert mi.has_flag(plugin.flags(), mi.BSDFFlags.SpatiallyVarying)
    assert not mi.has_flag(same.flags(), mi.BSDFFlags.SpatiallyVarying)


def test_the_correction_tilts_the_normal() -> None:
    import mitsuba as mi

    slopes = np.array([0.3, -0.2])
    n = np.array([*slopes, 1.0]) / np.linalg.norm([*slopes, 1.0])
    wi, wo = hemisphere(200), hemisphere(200, 1)
    plugin = bsdf(diffuse_reflectance=0.5, specular_reflectance=0.3, exponent=9.0, normal_correction=raw(*slopes, 0))
    value = plugin.eval(mi.BSDFContext(), interaction(wi, 200), mi.Vector3f(wo.T.astype(np.float32)))
    lobe = reference.specular_brdf(wo, wi, n, 9.0)
    # The lobe is zero where either side is below the corrected normal; the base only where the light is.
    expected = np.where(wo @ n > 0, (0.5 / np.pi + 0.3 * lobe) * (wo @ n), 0.0)
    assert ((wi @ n <= 0) & (wo @ n > 0)).any()
    assert np.abs(np.array(value)[0] - expected).max() < 1e-4


@pytest.mark.parametrize("fresnel", [{}, {"fresnel": 8.0}])
def test_an_interpolated_normal_that_faces_away_reflects_diffusely(fresnel: dict) -> None:
    """The surface itself faces the view, so what is seen there is not the black of a back."""
    import mitsuba as mi

    plugin = bsdf(diffuse_reflectance=0.3, specular_reflectance=0.5, exponent=20.0, **fresnel)
    wo = hemisphere(300)
    si = interaction(direction(95), 300)
    light = mi.Vector3f(wo.T.astype(np.float32))
    assert (np.array(plugin.eval(mi.BSDFContext(), si, light)) == 0).all()
    si.n = mi.Normal3f(*direction(20))
    value, pdf = plugin.eval_pdf(mi.BSDFContext(), si, light)
    assert np.allclose(np.array(value)[0], 0.3 / np.pi * wo[:, 2], rtol=1e-5)
    assert np.allclose(np.array(pdf), wo[:, 2] / np.pi, rtol=1e-5)
    rng = np.random.default_rng(0)
    drawn, weight = plugin.sample(
        mi.BSDFContext(), si, mi.Float(rng.random(300)), mi.Point2f(rng.random((2, 300)).astype(np.float32))
    )
    assert (np.array(drawn.wo)[2] > 0).all() and np.allclose(np.array(weight), 0.3, rtol=1e-4)


def test_diffuse_reflectance_and_the_back() -> None:
    import mitsuba as mi

    plugin = bsdf(diffuse_reflectance=0.3, specular_reflectance=0.1)
    si = interaction(direction(30), 1)
    assert np.allclose(np.array(plugin.eval_diffuse_reflectance(si)), 0.3)
    behind = interaction(direction(150), 1)
    assert not np.array(plugin.eval(mi.BSDFContext(), behind, mi.Vector3f(*direction(20)))).any()
    two_sided = mi.load_dict({"type": "twosided", "b": {"type": "blinnphong"}})
    assert np.array(two_sided.eval(mi.BSDFContext(), behind, mi.Vector3f(*direction(160)))).all()


@pytest.mark.parametrize("exponent", [1.0, 1e4])
@pytest.mark.parametrize("albedo", [0.0, 1.0])
@pytest.mark.parametrize("fresnel", [{}, {"fresnel": 0.0}, {"fresnel": 8.0}])
def test_values_and_gradients_are_finite_at_the_edges(exponent: float, albedo: float, fresnel: dict) -> None:
    import drjit as dr
    import mitsuba as mi

    plugin = bsdf(
        diffuse_reflectance=albedo,
        specular_reflectance=albedo,
        exponent=exponent,
        normal_correction=raw(0.0, 0.0, 0.0),
        **fresnel,
    )
    # Straight down, grazing, opposite directions (a half vector of zero), n . h = 0, in the surface, a zero vector.
    wi = np.array([[0, 0, 1], [1, 0, 1e-7], [1, 0, 0], [1, 0, 1e-4], [0, 1, 0], [0, 0, 0]], float)
    wo = np.array([[0, 0, 1], [0, 1, 1e-7], [-1, 0, 0], [-1, 0, 1e-4], [1, 0, 0], [0, 0, 1]], float)
    parameters = mi.traverse(plugin)
    keys = [k for k in parameters.keys() if k.endswith((".value", ".data"))]
    for key in keys:
        dr.enable_grad(parameters[key])
    parameters.update()
    si, toward = interaction(wi, 6), mi.Vector3f(wo.T.astype(np.float32))
    value, pdf = plugin.eval_pdf(mi.BSDFContext(), si, toward)
    _, weight = plugin.sample(mi.BSDFContext(), si, mi.Float(0.2), mi.Point2f(0.0, 0.5))
    for result in (value, pdf, weight):
        assert np.isfinite(np.array(result)).all()
    dr.backward(dr.sum(value, axis=None) + dr.sum(weight, axis=None))
    for key in keys:
        assert np.isfinite(np.array(dr.grad(parameters[key]))).all(), key


PROGRAM = """
import numpy as np, mifit
mifit.set_variant('{variant}')
import mitsuba as mi
mifit.register_plugins()
sphere = {{'type': 'sphere', 'bsdf': {{'type': 'blinnphong', 'specular_reflectance': 0.3}}}}
sensor = {{'type': 'perspective', 'to_world': mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]), 'fov': 8,
          'film': {{'type': 'hdrfilm', 'width': 4, 'height': 4, 'pixel_format': 'rgb'}}}}
light = {light}
scene = mi.load_dict({{'type': 'scene', 'o': sphere, 's': sensor, 'l': light, 'i': {{'type': 'direct'}}}})
print('MEAN', float(np.array(mi.render(scene, spp=512))[1:3, 1:3].mean()))
"""
CONSTANT = "{'type': 'constant', 'radiance': {'type': 'rgb', 'value': 1.0}}"
HARMONIC = "{'type': 'shenv', 'coefficients': mi.TensorXf(np.float32([[3.5449077] * 3]))}"


@pytest.mark.parametrize(
    ("name", "light"),
    [("scalar_rgb", CONSTANT), ("scalar_rgb", HARMONIC), ("llvm_ad_spectral", CONSTANT)],
)
def test_other_variants_render_the_same(name: str, light: str) -> None:
    """Under constant light of one, straight on, the pixel is 0.5 + 0.3 times the lobe's albedo of one."""
    program = PROGRAM.format(variant=name, light=light)
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert "MEAN" in result.stdout, result.stderr
    assert float(result.stdout.split("MEAN")[1]) == pytest.approx(0.8, abs=0.03)
