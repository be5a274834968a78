"""What `mifit.fit` checks and says before and after its stages."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import mifit
from mifit.config import FitConfig
from mifit.core.estimate import GeometryEstimate, Report, ResidualEstimate
from mifit.core.photometry import Photometry
from mifit.errors import InputError
from mifit.fitting import PARTS, Source, check_images, choose_timesteps, eyes_note, keys, one_place, steps
from mifit.morphable import MorphableModel
from mifit.morphable.openings import eyeballs, leading_faces, with_eyes
from tests.output.conftest import ball_camera, ball_result


def capture_of(image, valid, clipped=False):
    frame = SimpleNamespace(image=image, valid=valid, clipped=np.full(valid.shape, clipped))
    return SimpleNamespace(frame=lambda name, timestep: frame)


def test_an_image_without_light_is_refused():
    image, valid = np.zeros((4, 5, 3), np.float32), np.ones((4, 5), bool)
    with pytest.raises(InputError, match="camera left, timestep 3: every usable pixel is black or clipped"):
        check_images(capture_of(image, valid), ["left"], [3])
    image[1, 2, 0] = 1e-4
    check_images(capture_of(image, valid), ["left"], [3])
    with pytest.raises(InputError, match="black"):
        check_images(capture_of(image, image[..., 0] == 0), ["left"], [3])
    with pytest.raises(InputError, match="clipped"):
        check_images(capture_of(image + 1, valid, clipped=True), ["left"], [3])
    for value in (0.3, 1e-30):
        with pytest.raises(InputError, match="of one colour"):
            check_images(capture_of(np.full_like(image, value), valid), ["left"], [3])


def test_the_order_in_which_timesteps_are_named_does_not_matter():
    capture = SimpleNamespace(timesteps=(0, 1, 2, 5, 7))
    assert choose_timesteps(capture, [5, 0, 2, 5]) == (0, 2, 5)
    assert choose_timesteps(capture, None) == (0, 1, 2, 5)
    with pytest.raises(InputError, match="timestep 3: not in the capture; it has 0, 1, 2, 5, 7"):
        choose_timesteps(capture, [3, 0])


def test_a_model_whose_eyes_are_holes_brings_a_note():
    """Of eyes that it got and of the maps' layout, or of the holes that it kept."""
    model = MorphableModel.load("builtin:coarse").subset(identity=2, expression=2, albedo=2)
    skin = without_eyes(model)
    assert eyes_note(model, model) == ()
    assert "[geometry] eyes = true puts simple ones there" in eyes_note(skin, skin)[0].text
    (given,) = eyes_note(skin, with_eyes(skin))
    assert "maps lies 9 % higher" in given.text and "[geometry] eyes = false leaves" in given.text


def without_eyes(model):
    """What it was before it got eyes: its first vertices."""
    count = min(int(ball.min()) for ball in eyeballs(model))
    own = leading_faces(model, count)
    shapes = ("mean", "identity", "expression", "mean_albedo", "albedo_modes", "symmetry")
    kept = {name: getattr(model, name)[:count] for name in shapes}
    kept |= {name: getattr(model, name)[own] for name in ("faces", "faces_uv", "face_mask")}
    return dataclasses.replace(model, **kept, fingerprint="")


def test_a_fit_gives_a_model_eyes_that_has_none(monkeypatch):
    """What runs sees the model with eyes, unless the settings say no; one that has eyes is left alone."""
    seen = []
    monkeypatch.setattr("mifit.fitting.run_steps", lambda steps, source, *_: seen.append(source.model) or 1 / 0)
    model = MorphableModel.load("builtin:coarse").subset(identity=2, expression=2, albedo=2)
    skin = without_eyes(model)
    holes = FitConfig(geometry=mifit.GeometryConfig(eyes=False))
    for given, config in ((skin, None), (skin, holes), (skin, FitConfig.paper()), (model, None)):
        with pytest.raises(ZeroDivisionError):
            mifit.fit(made_up_capture(), given, config=config)
    assert len(eyeballs(seen[0])) == 2 and seen[0].n_vertices > skin.n_vertices
    assert seen[1] is skin and seen[2] is skin and seen[3] is model


def mean_geometry(model, timesteps=(0,)):
    """The model's mean as if it had been fitted, at the origin."""
    n, t = len(model.mean), len(timesteps)
    return GeometryEstimate(
        timesteps, np.zeros(model.n_identity), np.zeros(model.n_albedo), np.zeros((t, model.n_expression)),
        np.tile(np.eye(3), (t, 1, 1)), np.zeros((t, 3)), 1.0, np.tile(model.mean, (t, 1, 1)),
        np.full((n, 3), 0.3, np.float32), np.zeros((9, 3)), 0.0, Report("converged"),
    )  # fmt: skip


def test_a_result_with_added_eyes_is_read_with_the_model_that_was_given(tmp_path):
    """From the model's file, or with the model as it was before the fit."""
    skin = without_eyes(MorphableModel.load("builtin:coarse").subset(identity=2, expression=2, albedo=2))
    skin.save(tmp_path / "skin.npz")
    whole = with_eyes(MorphableModel.load(tmp_path / "skin.npz"))
    assert whole.source == f"{tmp_path / 'skin.npz'}+eyes"
    result = dataclasses.replace(
        ball_result(), model=whole, model_source=whole.source, geometry=mean_geometry(whole), reflectance=None,
        normals=None, mesh=None, residual=None,
    )  # fmt: skip
    result.save(tmp_path / "result")
    for model in (None, skin, whole):
        again = mifit.Reconstruction.load(tmp_path / "result", model=model)
        assert again.model.digest == whole.digest
        np.testing.assert_allclose(again.geometry.vertices[0], whole.mean, atol=1e-4)
    other = without_eyes(MorphableModel.load("builtin:coarse").subset(identity=3, expression=2, albedo=2))
    with pytest.raises(InputError, match="was made with model"):
        mifit.Reconstruction.load(tmp_path / "result", model=other)


def test_views_from_one_place_bring_a_warning():
    cameras = {name: ball_camera(name, angle) for name, angle in (("a", 0.0), ("b", 1.0), ("c", 20.0), ("blind", 40.0))}
    capture = SimpleNamespace(
        camera=cameras.get, frame=lambda name, t: SimpleNamespace(visible=np.full(68, name != "blind"))
    )
    geometry = ball_result().geometry
    assert one_place(capture, ["a"], geometry)[0].text.startswith("landmarks in camera a alone: how far away")
    assert one_place(capture, ["a", "b"], geometry)[0].text.startswith("cameras 1.0 degrees apart")
    assert one_place(capture, ["blind", "c"], geometry)[0].text.startswith("landmarks in camera c alone")
    assert one_place(capture, ["a", "b", "c"], geometry) == ()


pytestmark = pytest.mark.usefixtures("variant")
ORDER = (
    "geometry", "surface", "photometry", "shading", "reflectance", "normals", "mesh", "residual",
)  # fmt: skip
FIRST = {
    "geometry": 0, "surface": 1, "photometry": 2, "reflectance": 3, "normals": 5, "mesh": 6, "residual": 7,
}  # fmt: skip
"""Section of the settings -> the first step that reads it; all later ones depend on that one's estimate."""


def another(section, name, value):
    """The settings of one section with one of them changed to something else that is allowed."""
    allowed = {
        "objective": "paper", "shading": "paper",
        "exponent": 77.0, "bands": 5,
    }  # fmt: skip
    if isinstance(value, bool):
        changed = not value
    elif name in allowed:
        changed = allowed[name]
    else:
        changed = type(value)(2 * value + 1)
    return dataclasses.replace(section, **{name: changed})


BASE = FitConfig()
SETTINGS = [
    (section.name, setting.name)
    for section in dataclasses.fields(FitConfig)
    for setting in dataclasses.fields(getattr(BASE, section.name))
]


def changed_config(section, name):
    part = getattr(BASE, section)
    return dataclasses.replace(BASE, **{section: another(part, name, getattr(part, name))})


class Stages:
    """Stand-ins for all stages that give parts of a made-up result and remember what ran."""

    def __init__(self, monkeypatch):
        self.ran, self.saw = [], []
        residual = ResidualEstimate((0,), np.zeros((1, 32, 32, 3), np.float32), Report("converged"))
        result = dataclasses.replace(ball_result(), residual=residual)
        for name, part in {
            "fit_geometry": "geometry", "find_surface": "geometry", "refine_surface": "geometry",
            "infer_reflectance": "reflectance",
            "refine_normals": "normals", "refine_mesh": "mesh", "find_residual": "residual",
        }.items():  # fmt: skip
            monkeypatch.setattr(f"mifit.fitting.{name}", self.stand_in(name, getattr(result, part)))
        for name in ("check_capture", "check_fit"):
            monkeypatch.setattr(f"mifit.fitting.{name}", lambda *_: [])
        monkeypatch.setattr(
            "mifit.fitting.find_photometry",
            lambda capture, *_: self.stand_in("find_photometry", Photometry())(capture),
        )

    def stand_in(self, name, estimate):
        def run(capture, *arguments, **options):
            self.ran.append(name)
            self.saw.append(capture)
            return estimate

        return run


def made_up_capture(digest="digest", timesteps=(0, 3)):
    """What `mifit.fit` asks of a capture before and after its stages."""
    image = np.linspace(0.1, 1.0, 60, dtype=np.float32).reshape(4, 5, 3)
    frame = SimpleNamespace(image=image, valid=image[..., 0] > 0, clipped=image[..., 0] > 2, visible=np.ones(68, bool))
    cameras = {c.name: c for c in ball_result().cameras}
    return SimpleNamespace(
        cameras=tuple(cameras), timesteps=timesteps, camera=cameras.get, frame=lambda name, t: frame, calibrated=True,
        digest=lambda cameras, timesteps: digest, units="cm", unit_mm=10.0,
    )  # fmt: skip


@pytest.fixture
def stages(monkeypatch):
    return Stages(monkeypatch)


@pytest.fixture
def fitted(stages):
    """A function that fits a made-up capture with given settings, and the stages that it ran."""
    capture = made_up_capture()
    model = ball_result().model

    def run(config, folder, **options):
        stages.ran.clear()
        mifit.fit(capture, model, config=config, checkpoints=folder, **options)
        return list(stages.ran)

    return run


RUNS = (
    "fit_geometry",
    "find_surface",
    "find_photometry",
    "refine_surface",
    "infer_reflectance",
    "refine_normals",
    "refine_mesh",
    "find_residual",
)


@pytest.mark.parametrize(("section", "name"), SETTINGS, ids=[f"{a}.{b}" for a, b in SETTINGS])
def test_a_changed_setting_reruns_the_steps_that_depend_on_it(fitted, tmp_path, section, name):
    assert fitted(BASE, tmp_path) == list(RUNS)
    assert fitted(BASE, tmp_path) == []
    ran = fitted(changed_config(section, name), tmp_path)
    if section == "mesh":
        assert ran == ["refine_mesh"]  # the residual is that of the fitted mesh
    elif (section, name) == ("residual", "enabled"):
        assert ran == []
    elif (section, name) == ("surface", "enabled"):
        assert ran == ["find_photometry", *RUNS[4:]]
    elif (section, name) == ("surface", "shading"):
        assert ran == ["find_surface", "find_photometry", *RUNS[4:]]
    elif (section, name) == ("reflectance", "robust"):
        assert ran == list(RUNS[4:])
    elif section == "photometry":
        assert ran == list(RUNS[3:])
    else:
        assert ran == list(RUNS[FIRST[section] :])


@pytest.mark.parametrize("change", ["digest", "cameras", "timesteps", "seed", "model"])
def test_a_changed_source_reruns_everything(change):
    model = ball_result().model
    source = Source(SimpleNamespace(), "digest", model, ("left",), (0,), 0)
    other = {
        "digest": "other", "cameras": ("left", "right"), "timesteps": (0, 1), "seed": 1,
        "model": dataclasses.replace(model, mean=model.mean + np.float32(0.01)),
    }  # fmt: skip
    before = keys(steps(BASE), source)
    after = keys(steps(BASE), dataclasses.replace(source, **{change: other[change]}))
    assert tuple(before) == ORDER and not set(before.values()) & set(after.values())


def test_stages_that_a_shorter_fit_ran_serve_a_longer_one(fitted, tmp_path):
    assert fitted(BASE, tmp_path, until="geometry") == list(RUNS[:4])
    assert fitted(BASE, tmp_path, until="reflectance") == list(RUNS[4:5])
    assert fitted(BASE, tmp_path) == ["refine_normals", "refine_mesh", "find_residual"]


def test_a_step_is_given_what_its_key_is_made_of():
    """Names of inputs and settings are those that its function takes: there is nothing else that it could read."""
    for step in steps(BASE):
        code = step.run.__code__
        assert step.run.__closure__ is None and code.co_argcount == 3 + len(step.settings)
        read = {c for c in code.co_consts if c in PARTS}
        assert read == set(step.inputs)
