"""Settings are checked key by key."""

import dataclasses
import re
from collections.abc import Iterator

import pytest

from mifit.config import FitConfig, MeshConfig, ReflectanceConfig, from_mapping, list_settings
from mifit.errors import InputError
from mifit.experiments import load_plan
from mifit.experiments.plan import (
    EvaluateRun,
    Experiment,
    FitRun,
    Outputs,
    ReferenceRun,
    RelightRun,
    RenderRun,
    SynthRun,
)


def test_defaults_are_the_papers():
    config = FitConfig()
    assert config.geometry.landmark_weight == 10
    assert config.geometry.prior_weight == 5e-5
    assert config.reflectance.exponent is None  # 5 for the paper's shading, estimated otherwise
    assert config.reflectance.specular_difference_weight == 0.1
    assert config.reflectance.smoothness_weight == 0.001
    assert config.normals.laplacian_weight == 1e-3


def test_nested_values_and_integers_for_floats():
    config = from_mapping(FitConfig, {"reflectance": {"exponent": 20, "shading": "paper"}}, "here")
    assert config.reflectance.exponent == 20.0
    assert isinstance(config.reflectance.exponent, float)
    assert config.reflectance.shading == "paper"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"geometri": {}}, "unknown key 'geometri'; did you mean 'geometry'"),
        ({"reflectance": {"exponnent": 3}}, "reflectance: unknown key 'exponnent'; did you mean 'exponent'"),
        ({"reflectance": {"exponent": "big"}}, "reflectance.exponent: found 'big', expected a finite number from 1 to"),
        ({"reflectance": {"exponent": float("nan")}}, "exponent: found nan, expected a finite number"),
        ({"reflectance": {"smoothness_weight": float("inf")}}, "smoothness_weight: found inf, expected a finite"),
        ({"reflectance": {"smoothness_weight": 10**400}}, "smoothness_weight: found a number of many digits"),
        ({"reflectance": {"texture_size": 2.5}}, "found 2.5, expected a whole number from 16 to 4096 texels"),
        ({"reflectance": {"texture_size": True}}, "found True, expected a whole number"),
        ({"reflectance": {"texture_size": 10**9}}, "found 1000000000, expected a whole number from 16 to 4096 texels"),
        ({"reflectance": {"bands": 99}}, "reflectance.bands: found 99, expected a whole number from 3 to 10"),
        ({"reflectance": {"exponent": -1}}, "reflectance.exponent: found -1, expected a finite number from 1 to 10000"),
        ({"reflectance": {"robust": 1}}, "reflectance.robust: found 1, expected true or false"),
        ({"geometry": {"objective": "sgd"}}, "found 'sgd', expected one of 'landmarks', 'paper'"),
        ({"reflectance": {"shading": "shadow"}}, "reflectance.shading: found 'shadow', expected one of"),
        ({"reflectance": 3}, "reflectance: found 3, expected a table"),
        ({"surface": {"finest": -1}}, "surface.finest: found -1, expected a whole number from 0 to 6"),
        ({"mesh": {"detail": 0}}, "mesh.detail: found 0, expected a finite number above 0, at most 100 centimetres"),
        ({"mesh": {"detail": 0}, "residual": {"prior": 0}}, "mesh.detail: found 0, .*; residual.prior: found 0"),
        ({"mesh": {"detail": "x" * 9999}}, r"found 'x{59}\.\.\., expected"),
        (3, "here: found 3, expected a table of settings for FitConfig"),
    ],
)
def test_refusals_name_key_value_and_expectation(values, message):
    with pytest.raises(InputError, match=message) as error:
        from_mapping(FitConfig, values, "here")
    assert str(error.value).startswith("here: ") and "\n" not in str(error.value) and len(str(error.value)) < 300


def test_settings_made_in_python_are_checked_alike_and_stay_as_they_are():
    with pytest.raises(InputError, match=r"^reflectance\.bands: found 99, expected a whole number from 3 to 10$"):
        ReflectanceConfig(bands=99)
    config = ReflectanceConfig()
    with pytest.raises(InputError, match="exponent: found 0"):
        dataclasses.replace(config, exponent=0)
    with pytest.raises(InputError, match="reflectance: unknown key 'band'; did you mean 'bands'"):
        ReflectanceConfig(band=3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.bands = 5
    assert dataclasses.replace(config, bands=5).bands == 5 and config.bands == 10
    assert hash(FitConfig()) == hash(FitConfig())


def bounded_settings() -> Iterator:
    """Every number of a fit and of an experiment that has a bound, with a value beyond it."""
    for cls, start in ((FitConfig, {}), (Experiment, {"name": "x"})):
        for key, _, expected, _ in list_settings(cls):
            bounds = re.search(r"(?:from (\S+) to (\S+))|(?:above (\S+), at most (\S+))", expected)
            if bounds is None:
                continue
            low, high, above, most = bounds.groups()
            step = 1 if "whole" in expected else 1e-3
            for value in (float(low) - step if low else float(above), 2 * float(high or most) + 1):
                yield pytest.param(cls, start, key, int(value) if step == 1 else value, id=f"{key}={value:g}")


@pytest.mark.parametrize(("cls", "start", "key", "value"), list(bounded_settings()))
def test_every_number_has_bounds_that_hold(cls, start, key, value):
    needed = {"relight": {"env": "a.hdr"}, "evaluate": {"camera": "third"}, "render": {"scene": "s.xml"}}
    *parents, last = key.split(".")
    values = {**start, **{p: dict(needed.get(p, {})) for p in parents[:1]}}
    table = values
    for parent in parents:
        table = table.setdefault(parent, {})
    table[last] = value
    with pytest.raises(InputError, match=f"^here: {key}: found .*, expected "):
        from_mapping(cls, values, "here")


def test_every_setting_is_within_its_bounds_and_explained():
    found = [*list_settings(FitConfig), *list_settings(Experiment)]
    assert all(meaning for *_, meaning in found)
    numbers = [key for key, default, expected, _ in found if "number" in expected and "list" not in expected]
    bounded = {parameter.values[2] for parameter in bounded_settings()}
    assert set(numbers) == bounded and len(bounded) > 50
    # Pydantic takes defaults as they are: hand each one over.
    from_mapping(FitConfig, dataclasses.asdict(FitConfig()), "defaults")
    for cls, needed in (
        (SynthRun, {}), (FitRun, {}), (EvaluateRun, {"camera": "c"}), (RelightRun, {"env": "e"}),
        (RenderRun, {"scene": "s"}), (ReferenceRun, {}), (Outputs, {}),
    ):  # fmt: skip
        made = from_mapping(cls, needed, "here")
        assert from_mapping(cls, dataclasses.asdict(made), "defaults") == made


def test_every_number_of_a_fit_says_where_it_comes_from():
    for key, _, expected, meaning in list_settings(FitConfig):
        if "number" in expected:
            source = re.search(
                r"\((paper|cost|limit|set by hand|estimated|measured|chosen on|units|all|the most)[^()]*\)$", meaning
            )
            assert source, key


def test_an_experiment_has_every_setting_of_a_fit():
    keys = {key for key, *_ in list_settings(FitRun)}
    assert {key for key, *_ in list_settings(FitConfig)} < keys
    run = from_mapping(FitRun, {"capture": "x", "mesh": {"detail": 0.5}}, "here")
    assert run.config == FitConfig(mesh=MeshConfig(detail=0.5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "../elsewhere"}, "name: found '../elsewhere', expected"),
        ({"name": ""}, "name: found ''"),
        ({"fit": {"cameras": []}}, r"fit.cameras: found \[\], expected a list of names"),
        ({"fit": {"cameras": "left"}}, "fit.cameras: found 'left', expected a list of names"),
        ({"fit": {"timesteps": [0, -1]}}, "fit.timesteps.1: found -1, expected a list of whole numbers not below 0"),
        ({"fit": {"model": "a\0b"}}, "fit.model: found"),
        ({"fit": {"until": "normal"}}, "fit.until: found 'normal', expected one of 'geometry', 'reflectance'"),
        ({"fit": {"synth": {"env": 3}}}, "fit.synth.env: found 3, expected text"),
        ({"evaluate": {"camera": ""}}, "evaluate.camera: found ''"),
        ({"evaluate": {}}, "key 'evaluate.camera' is missing"),
        (
            {"render": {"scene": "s", "parameters": {"spp": [1]}}},
            r"parameters.spp.*: found \[1\], expected a table",
        ),
        ({"outputs": {"report": "yes"}}, "outputs.report: found 'yes', expected true or false"),
        ({"fit": {"reflectance": {"bands": 99}}}, "fit.reflectance.bands: found 99"),
    ],
)
def test_values_of_experiments_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        from_mapping(Experiment, {"name": "x", **change}, "here")


def test_a_fit_with_bad_settings_ends_before_it_reads_anything(tmp_path):
    with pytest.raises(InputError, match="bands: found 99"):
        config = tmp_path / "c.toml"
        config.write_text("[reflectance]\nbands = 99\n")
        FitConfig.load(config)
    config = tmp_path / "sweep.toml"
    config.write_text('name = "x"\n[fit]\ncapture = "there/is/none"\n[sweep.grid]\n"fit.reflectance.bands" = [5, 99]\n')
    with pytest.raises(InputError, match=r"fit\.reflectance\.bands: found 99"):
        load_plan(config)


def test_a_sweep_that_has_no_end_is_refused(tmp_path):
    path = tmp_path / "sweep.toml"
    axes = "\n".join(f'"fit.synth.{key}" = {list(range(16, 1016))}' for key in ("seed", "width", "height", "spp"))
    path.write_text(f"[fit]\nsynth = {{}}\n[sweep.grid]\n{axes}\n")
    with pytest.raises(InputError, match=r"sweep: found 1000000000000 runs, expected at most 100000;"):
        load_plan(path)


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
