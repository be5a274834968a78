"""Settings are checked key by key."""

import pytest

from mifit.config import FitConfig, from_mapping
from mifit.errors import InputError


def test_defaults_are_the_papers():
    config = FitConfig()
    assert config.geometry.landmark_weight == 10
    assert config.geometry.prior_weight == 5e-5
    assert config.reflectance.exponent is None  # 5 for the paper's shading, estimated otherwise
    assert config.reflectance.specular_difference_weight == 0.1
    assert config.reflectance.smoothness_weight == 0.001
    assert config.normals.laplacian_weight == 1e-3


def test_nested_values_and_integers_for_floats():
    config = from_mapping(FitConfig, {"reflectance": {"exponent": 20, "solver": "adam"}}, "here")
    assert config.reflectance.exponent == 20.0
    assert isinstance(config.reflectance.exponent, float)
    assert config.reflectance.solver == "adam"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"geometri": {}}, "unknown key 'geometri'; did you mean 'geometry'"),
        ({"reflectance": {"exponnent": 3}}, "did you mean 'exponent'"),
        ({"reflectance": {"exponent": "big"}}, "reflectance: exponent: found 'big'"),
        ({"reflectance": {"exponent": float("nan")}}, "expected a finite number"),
        ({"reflectance": {"texture_size": 2.5}}, "expected a value of type int"),
        ({"reflectance": {"texture_size": True}}, "expected a value of type int"),
        ({"reflectance": {"solver": "sgd"}}, "expected one of"),
        ({"reflectance": 3}, "expected a table"),
        ({"shape": {"rounds": -1}}, "shape.rounds: found -1, expected 0 to 10"),
        ({"shape": {"shading_weight": 0}}, "shape.shading_weight: found 0.0, expected a number above 0"),
        ({"mesh": {"subdivisions": 9}}, "mesh.subdivisions: found 9, expected 0 to 3"),
        ({"mesh": {"detail": 0}}, "mesh.detail: found 0.0, expected a number above 0"),
    ],
)
def test_refusals_name_key_value_and_expectation(values, message):
    with pytest.raises(InputError, match=message):
        from_mapping(FitConfig, values, "here")


def test_files(tmp_path):
    with pytest.raises(InputError, match="no such configuration file"):
        FitConfig.load(tmp_path / "none.toml")
    bad = tmp_path / "bad.toml"
    bad.write_text("a = [")
    with pytest.raises(InputError, match="not a readable TOML file"):
        FitConfig.load(bad)
    good = tmp_path / "good.toml"
    good.write_text("[geometry]\nmax_iterations = 3\n")
    assert FitConfig.load(good).geometry.max_iterations == 3
