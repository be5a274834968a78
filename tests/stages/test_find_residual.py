"""What photographs show beyond the model: shared by the views of a timestep, and by no other timestep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stages.reflectance_scene import EXPONENT, SIZE, render, turning_dome

from mifit.appearance.illumination import Illumination
from mifit.appearance.lobe import Lobe
from mifit.config import ResidualConfig
from mifit.core.estimate import Label, NormalsEstimate, ReflectanceEstimate, Report
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError
from mifit.stages.find_residual import find_residual

SHADED = 1
"""The timestep with a shadow that the light doesn't explain."""
BAND = slice(20, 28)
"""Rows of the map that lie in it."""
FITTED = ("left", "right")


@pytest.fixture(scope="module")
def dome(variant):
    """A dome whose images at one timestep have a shadow across it, in all views, and what is known of it."""
    scene = turning_dome()
    dark = scene.diffuse.copy()
    dark[BAND] *= 0.5
    for name in ("left", "right", "third"):
        colour, _ = render(
            scene, name, SHADED, dark, scene.specular, scene.radiance, EXPONENT, scene.shading, scene.fresnel
        )
        scene.frames[name, SHADED] = replace(scene.frames[name, SHADED], image=colour)
    known = ReflectanceEstimate(
        scene.diffuse,
        scene.specular,
        np.ones((SIZE, SIZE), np.float32),
        Illumination(scene.radiance),
        Lobe(EXPONENT, scene.fresnel, normalized=True),
        scene.shading,
        Report("converged"),
    )
    return scene, known


def found(dome, cameras=FITTED, **changes):
    scene, known = dome
    config, normals = ResidualConfig(prior=changes.pop("prior", 0.5)), changes.pop("normals", None)
    return find_residual(scene, scene.model, scene.geometry, replace(known, **changes), normals, cameras, config)


def texels(dome):
    model = dome[0].model
    inside = np.zeros((SIZE, SIZE), bool)
    inside[8:40, 8:40] = rasterize_uv(model.uv, model.faces_uv, SIZE, model.face_mask).mask[8:40, 8:40]
    return inside


def test_a_shadow_is_kept_where_and_when_it_is(dome):
    residual = found(dome)
    band = texels(dome)
    band[: BAND.start + 2] = band[BAND.stop - 2 :] = False
    outside = texels(dome)
    outside[BAND.start - 2 : BAND.stop + 2] = False
    kept = residual.at(SHADED)
    assert kept[band].mean() < -0.1 and np.abs(kept[outside]).mean() < 0.01
    for timestep in (0, 2, 3):
        assert np.abs(residual.at(timestep)[texels(dome)]).mean() < 0.01
    assert residual.at(7) is None and np.isfinite(residual.radiance).all()
    assert residual.report.details["left"] < 0.5 * residual.report.details["residual"]


def test_a_view_that_was_not_read_shows_it_too(dome):
    kept, third = found(dome).at(SHADED), found(dome, ("third",), prior=1e-6).at(SHADED)
    both = texels(dome) & (kept != 0).any(-1) & (third != 0).any(-1)
    before, after = np.sqrt((third[both] ** 2).mean()), np.sqrt(((third - kept)[both] ** 2).mean())
    assert before > 0.05 and after < 0.4 * before


def test_two_views_say_more_than_one(dome):
    one, two = (found(dome, cameras).at(SHADED) for cameras in (("left",), FITTED))
    both = texels(dome) & (one != 0).all(-1) & (two != 0).all(-1)
    both[: BAND.start + 2] = both[BAND.stop - 2 :] = False
    # Of the same darkness one view keeps 1 / 1.5, two views 2 / 2.5.
    assert np.median(one[both] / two[both]) == pytest.approx((1 / 1.5) / (2 / 2.5), abs=0.06)


def test_what_hides_the_face_is_left_out(dome):
    scene, _ = dome
    height, width = scene.frames["left", SHADED].valid.shape
    labels = np.full((height, width), Label.OCCLUDER, np.uint8)
    covered = found(dome, labels=(labels,), labelled=(("left", SHADED),))
    np.testing.assert_array_equal(covered.at(SHADED), found(dome, ("right",)).at(SHADED))
    np.testing.assert_array_equal(covered.at(0), found(dome).at(0))


def test_normals_of_another_size_are_refused(dome):
    scene, known = dome
    normals = NormalsEstimate((0,), np.zeros((1, 8, 8, 3), np.float32), Report("converged"))
    with pytest.raises(InputError, match="found normals of 8 texels a side, expected 48"):
        find_residual(scene, scene.model, scene.geometry, known, normals, FITTED)


def test_refined_normals_are_shaded(dome):
    """Normals that are bent by 20 degrees explain less of the images than those that made them."""
    scene, known = dome
    flat = np.zeros((4, SIZE, SIZE, 3), np.float32)
    flat[..., 2] = 1.0
    bent = NormalsEstimate((0, 1, 2, 3), flat, Report("converged"))
    plain, worse = (
        find_residual(scene, scene.model, scene.geometry, known, normals, FITTED).report.details["residual"]
        for normals in (None, bent)
    )
    assert worse > 1.5 * plain


def test_refined_normals_turn_with_the_head(dome):
    """The mesh's own normals, told in object space, change nothing; those of a head that doesn't turn would."""
    scene, _ = dome
    model = scene.model
    texels = rasterize_uv(model.uv, model.faces_uv, SIZE, model.face_mask)
    maps = []
    for vertices, rotation in zip(scene.geometry.vertices, scene.geometry.rotation, strict=True):
        world = vertex_normals(vertices.astype(float), model.faces)
        own = normalize(interpolate(world, model.faces, texels.face, texels.weights)) @ rotation
        maps.append(texels.to_map(own.astype(np.float32)))
    refined = NormalsEstimate(scene.geometry.timesteps, np.stack(maps), Report("converged"))
    plain, told = found(dome), found(dome, normals=refined)
    for timestep in scene.geometry.timesteps:
        assert np.abs(plain.at(timestep) - told.at(timestep)).max() < 1e-3
