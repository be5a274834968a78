"""Table 1: errors against a truth that is known exactly, and what the table says of subjects that failed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import heads, table1
from benchmarks.truth import truth_errors
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.morphable.openings import with_eyes
from tests.output.conftest import ball_result
from tests.test_pipeline import mean_geometry, without_eyes


@pytest.fixture
def perfect(tmp_path, monkeypatch):
    """A result and a capture folder whose truth is the result itself, with a flat bump."""
    result = ball_result()
    folder = tmp_path / "truth"
    folder.mkdir()
    for i, t in enumerate(result.timesteps):
        vertices, rotation = result.geometry.vertices[i], result.geometry.rotation[i]
        np.savez(folder / f"{t:04d}.npz", vertices=vertices, R=rotation, t=result.geometry.translation[i])
    size = 2 * len(result.reflectance.diffuse)
    maps = {
        "albedo": result.reflectance.diffuse.repeat(2, 0).repeat(2, 1) * (0.5, 0.6, 0.7),
        "specular": np.random.default_rng(0).uniform(0, 1, (size // 2, size // 2)).repeat(2, 0).repeat(2, 1),
        "roughness": np.full((size, size), 0.4),
        "bump": np.zeros((size, size)),
    }
    np.savez(folder / "maps.npz", **maps)
    frame = {"file_path": "x.png", "timestep_index": 0, "w": 64, "h": 64}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    return result, tmp_path, maps


def test_a_result_that_is_the_truth_has_no_error_but_where_it_was_bent(perfect):
    result, folder, _ = perfect
    found = truth_errors(result, folder, 0.1)
    assert found["mesh_mm"] == 0 and found["rotation_degrees"] == pytest.approx(0, abs=0.01)
    assert found["diffuse_rmse"] == pytest.approx(0, abs=1e-4)  # the truth's own scale per channel doesn't count
    assert found["normal_degrees_stage1"] == pytest.approx(0, abs=0.05)
    model = result.model
    texels = rasterize_uv(model.uv, model.faces_uv, len(result.reflectance.diffuse), model.face_mask)
    bent = []
    for i, t in enumerate(result.timesteps):
        base = vertex_normals(result.geometry.vertices[i], model.faces) @ result.geometry.rotation[i]
        base = normalize(interpolate(base, model.faces, texels.face, texels.weights))
        cosine = np.sum(base * texels.from_map(result.refined_normal(t)), axis=1)
        bent.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
    assert found["normal_degrees"] == pytest.approx(np.mean(bent), abs=0.05) and np.mean(bent) > 3


def test_errors_grow_with_the_distance_from_the_truth(perfect):
    result, folder, maps = perfect
    path = folder / "truth" / "0000.npz"
    moved = dict(np.load(path))
    moved["vertices"] = moved["vertices"] + np.float32((0.3, 0, 0))
    np.savez(path, **moved)
    ramp = np.linspace(0, 1, len(maps["bump"]))[None].repeat(len(maps["bump"]), 0)
    np.savez(folder / "truth" / "maps.npz", **{**maps, "bump": 100 * ramp, "albedo": maps["albedo"][::-1]})
    found = truth_errors(result, folder, 0.1)
    assert found["mesh_mm"] == pytest.approx(0.5 * 0.3 * result.unit_mm, abs=0.002)  # one of two timesteps moved
    assert found["normal_degrees_stage1"] > 5 and found["diffuse_rmse"] > 0.01


def test_a_model_that_got_eyes_is_judged_by_the_truth_of_the_model_as_it_was(tmp_path):
    """Eyes come behind the truth's vertices and move the maps' layout: neither is an error."""
    skin, size = without_eyes(MorphableModel.load("builtin:coarse").subset(identity=2, expression=2, albedo=2)), 128

    def painted(uv):
        return np.float32(0.4) + 0.2 * np.sin(uv @ np.array([[20.0, 3, 9], [5, 25, 14]])).astype(np.float32)

    centres = (np.arange(2 * size) + 0.5) / (2 * size)
    image = painted(np.stack(np.meshgrid(centres, 1 - centres), axis=-1))
    (tmp_path / "truth").mkdir()
    np.savez(tmp_path / "truth" / "0000.npz", vertices=skin.mean, R=np.eye(3), t=np.zeros(3))
    maps = {"albedo": image, "specular": image[..., 1], "roughness": image[..., 0], "bump": image[..., 2]}
    np.savez(tmp_path / "truth" / "maps.npz", **maps)
    frame = {"file_path": "x.png", "timestep_index": 0, "w": 64, "h": 64}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    found = []
    for model in (skin, with_eyes(skin)):
        texels = rasterize_uv(model.uv, model.faces_uv, size, model.face_mask)
        at = painted(interpolate(skin.uv, skin.faces_uv, texels.face, texels.weights))
        normals = interpolate(vertex_normals(model.mean, model.faces), model.faces, texels.face, texels.weights)
        ball, geometry = ball_result(), mean_geometry(model)
        found.append(truth_errors(replace(
            ball, model=model, geometry=geometry,
            reflectance=replace(
                ball.reflectance, diffuse=texels.to_map(at), specular=texels.to_map(at[:, 1]),
                confidence=texels.to_map(np.ones(len(at), np.float32)),
            ),
            normals=replace(
                ball.normals, timesteps=(0,), normal_object=texels.to_map(normalize(normals).astype(np.float32))[None]
            ),
        ), tmp_path, 1.0))  # fmt: skip
    assert found[0]["diffuse_rmse"] < 0.005 and found[0]["specular_correlation"] > 0.99
    assert found[0]["normal_degrees"] > 2
    assert found[1] == pytest.approx(found[0], rel=0.03, abs=0.002)


def test_failed_subjects_stay_in_the_table():
    figures = dict.fromkeys(table1.MEASURES, 1.0)
    row = {
        "subject": 0,
        "set": "locked",
        "light": "studio",
        "tone": 0.25,
        "outside_mm": 0.5,
        "seconds": {"full": 3.0},
        "methods": {"pca": figures, "diffuse": {**figures, "psnr": 2.0}, "full": {**figures, "psnr": 4.5}},
        "truth": {"full": dict.fromkeys(table1.TRUTHS, 0.5), "diffuse": dict.fromkeys(table1.TRUTHS, 0.25)},
        "unconverged": {"full": ["geometry"], "diffuse": []},
    }
    other = {**row, "subject": 2, "methods": {**row["methods"], "full": {**figures, "psnr": 5.5}}}
    other["unconverged"] = {"full": [], "diffuse": []}
    text = table1.markdown([row, other], {1: "InputError: no landmarks"})
    assert "2 of 3 subjects" in text and "| 1 | failed: InputError: no landmarks |" in text
    assert "4.00 dB above `pca` and 3.00 dB above a refit without specular" in text and "5.00 ± 0.50" in text
    assert "| `full`: everything |" in text and "| 1 of 2 |" in text and "| 0 of 2 |" in text
    assert "true geometry is used here" in text and "| geometry | 3 |" in text
    tables = [part.splitlines() for part in text.split("\n\n") if part.startswith("|")]
    assert len(tables) == 4
    for lines in tables:
        assert len({line.count("|") for line in lines}) == 1
    assert "0 of 1 subjects" in table1.markdown([], {0: "RuntimeError: x"})


def test_one_table_has_one_commit(tmp_path, monkeypatch):
    rows = iter([{"subject": 0, "commit": "a", "methods": {"full": {"psnr": 1.0}}},
                 {"subject": 1, "commit": "b", "methods": {"full": {"psnr": 1.0}}}])  # fmt: skip
    monkeypatch.setattr(table1, "run_subject", lambda *arguments: next(rows))
    monkeypatch.setattr(table1, "RESULTS", tmp_path)
    with pytest.raises(RuntimeError, match="judged at the commits a, b"):
        table1.run(2, 1, tmp_path, table1.REDUCED, "builtin", 64, "table1")
    assert not list(tmp_path.iterdir())


def test_every_third_head_is_far_outside_the_model():
    assert [heads.Subject(i).outside > 2 for i in range(15)].count(True) == 5
