from __future__ import annotations

import numpy as np
import pytest

from mifit.appearance import lobe as bp
from mifit.core import sh
from mifit.errors import InputError
from tests import reference

EXPONENTS = (1.0, 5.0, 50.0, 1000.0)


def unit(v) -> np.ndarray:
    v = np.asarray(v, dtype=float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_samples_integrate_the_brdf(exponent: float) -> None:
    """The half-vector quadrature against one over light directions."""
    d, w = sh.quadrature(300)
    view = np.array([np.sin(0.7), 0.0, np.cos(0.7)])
    f = reference.specular_brdf(d, view, np.array([0.0, 0.0, 1.0]), exponent) * np.maximum(d[:, 2], 0)
    light, weight = bp.lobe_samples(np.cos(0.7), exponent)
    assert weight.sum() == pytest.approx((w * f).sum(), rel=2e-3)
    assert np.abs(weight @ light - (w * f) @ d)[[0, 2]].max() < 3e-3


def test_the_normalised_lobe_reflects_all_light_at_most() -> None:
    for exponent in np.geomspace(1, 1e4, 9):
        albedo = [bp.lobe_samples(cosine, exponent)[1].sum() for cosine in np.linspace(0.02, 1.0, 12)]
        assert max(albedo) <= 1.0 + 1e-4
        assert albedo[-1] == pytest.approx(1.0, abs=1e-3)


def test_the_plain_lobe_is_the_papers() -> None:
    light, view, n = unit([0.2, 0.1, 1.0]), unit([-0.3, 0.4, 1.0]), np.array([0.0, 0.0, 1.0])
    h = unit(light + view)
    assert reference.specular_brdf(light, view, n, 5.0, normalized=False) == pytest.approx(h[2] ** 5 / np.pi)
    assert reference.specular_brdf(-light, view, n, 5.0) == 0.0


def test_reciprocity() -> None:
    d = unit(np.random.default_rng(0).normal(size=(2, 100, 3)))
    d[..., 2] = np.abs(d[..., 2])
    n = np.array([0.0, 0.0, 1.0])
    assert np.array_equal(reference.specular_brdf(d[0], d[1], n, 20.0), reference.specular_brdf(d[1], d[0], n, 20.0))


def test_the_table_holds_the_moments() -> None:
    for exponent in (1.0, 1.7, 12.0, 333.0, 9000.0):
        for cosine in (0.999, 0.7, 0.3, 0.02):
            assert np.abs(bp.tabulated_moments(4, cosine, exponent) - bp.lobe_moments(cosine, exponent, 4)).max() < 2e-3


@pytest.mark.parametrize("exponent", EXPONENTS)
@pytest.mark.parametrize("cosine", [0.99, 0.7, 0.3])
def test_the_prefiltered_lobe_has_the_exact_transfer_vector(exponent: float, cosine: float) -> None:
    light, weight = bp.lobe_samples(cosine, exponent)
    exact = weight @ sh.basis(light, 3)
    exact[[1, 4, 5]] = 0.0  # odd in y; the samples cover one half
    moments = bp.tabulated_moments(3, cosine, exponent)
    sine = np.sqrt(1 - cosine**2)
    axis = unit((1 - moments[1]) * np.array([-sine, 0.0, cosine]) + moments[1] * np.array([0.0, 0.0, 1.0]))
    factors = moments[0] * np.concatenate([[1.0], moments[2:]])[sh.bands(3)]
    error = np.linalg.norm(factors * sh.basis(axis, 3) - exact) / np.linalg.norm(exact)
    assert error < 0.06


def test_the_view_along_the_normal_has_the_closed_form_without_foreshortening() -> None:
    """Where the cosine hardly matters, the Legendre factors are those of cos(angle / 2) ** exponent."""
    moments = bp.lobe_moments(0.9999, 3000.0, 4)
    t, w = np.polynomial.legendre.leggauss(400)
    lobe = (0.5 * (1 + t)) ** 1500.0 * w
    expected = np.polynomial.legendre.legvander(t, 3).T @ lobe / lobe.sum()
    assert np.abs(moments[2:] - expected[1:]).max() < 1e-3


def test_the_view_along_the_normal_has_no_tilt() -> None:
    with pytest.raises(InputError, match="no tilt"):
        bp.lobe_moments(1.0, 5.0, 3)
