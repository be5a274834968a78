"""Texels that no image showed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from mifit.core.mesh import interpolate
from mifit.core.uv import TexelMap, rasterize_uv
from mifit.morphable import MorphableModel
from mifit.morphable.openings import eyeballs
from mifit.morphable.pigment import HAEMOGLOBIN, MELANIN
from mifit.stages.reflectance.fill import (
    beyond_pigments,
    blend_unseen,
    light_error,
    light_known,
    light_level,
    pigment_weight,
)


@pytest.fixture(scope="module")
def half_seen():
    """A face whose albedo is striped alike on both sides, of which one side was seen."""
    model = MorphableModel.load("builtin:coarse")
    texels = rasterize_uv(model.uv, model.faces_uv, 96, model.face_mask)
    point = interpolate(model.mean.astype(float) * model.unit_mm, model.faces, texels.face, texels.weights)
    stripes = 0.25 * np.sin(np.abs(point[:, 0]) / 12) * np.cos(point[:, 1] / 15)
    truth = ((1.0 + stripes[:, None]) * (0.5, 0.4, 0.3, 0.4)).astype(np.float32)
    seen = point[:, 0] > 0
    found = np.where(seen[:, None], truth, 0.9).astype(np.float32)
    return model, texels, truth, found, seen


def test_the_unseen_side_takes_what_the_other_shows(half_seen):
    model, texels, truth, found, seen = half_seen
    errors = []
    for given in (replace(model, symmetry=None), model):
        told = np.ones(len(truth), np.float32)
        blend = blend_unseen(given, texels, texels.to_map(found), seen.astype(float), told)
        filled = np.concatenate([texels.from_map(blend.diffuse), texels.from_map(blend.specular)[:, None]], axis=1)
        errors.append(np.sqrt(np.mean((filled - truth)[~seen] ** 2)))
        np.testing.assert_allclose(filled[seen], truth[seen], atol=0.03)
        np.testing.assert_array_equal(texels.from_map(blend.confidence), seen)
        np.testing.assert_array_equal(blend.specular_confidence, blend.confidence)
    assert errors[1] < 0.01 and errors[1] < 0.3 * errors[0]


def test_what_was_seen_but_told_nothing_of_its_gloss_says_so(half_seen):
    """The maps stay as they were found; the specular one's confidence is its own."""
    model, texels, truth, _, seen = half_seen
    told = np.where(np.arange(len(truth)) % 3 == 0, 0.0, 0.8).astype(np.float32)
    blend = blend_unseen(replace(model, symmetry=None), texels, texels.to_map(truth), seen.astype(float), told)
    np.testing.assert_array_equal(texels.from_map(blend.specular_confidence), seen * told)
    np.testing.assert_array_equal(texels.from_map(blend.confidence), seen)
    np.testing.assert_allclose(texels.from_map(blend.specular)[seen], truth[seen, 3], atol=0.03)


def test_far_from_all_that_was_seen_skin_has_its_typical_colour(half_seen):
    """However dark the border of what was seen is."""
    model, texels, truth, _, seen = half_seen
    x = interpolate(model.mean.astype(float) * model.unit_mm, model.faces, texels.face, texels.weights)[:, 0]
    border = seen & (x < 6.0)
    found = np.where(border[:, None], 0.05, truth).astype(np.float32)
    confidence = np.where(border, 0.1, seen.astype(float))
    told = np.ones(len(truth), np.float32)
    blend = blend_unseen(replace(model, symmetry=None), texels, texels.to_map(found), confidence, told)
    far = texels.from_map(blend.diffuse)[x < -40.0]
    assert np.median(far) > 0.6 * np.median(truth[:, :3]) and (texels.from_map(blend.confidence)[x < 0] == 0).all()


def test_a_dark_feature_is_no_want_of_light():
    brightness = np.full((100, 100), 0.3, np.float32)
    brightness[40:46, 20:60] = 0.01
    brightness[:, 80:] = 0.01
    known = light_known(light_level(brightness), 0.015)
    assert (known[:, :75] > 0.98).all() and (known[:, 80:] == 0).all()


def test_the_error_of_the_light_is_what_darkens_dim_skin(half_seen):
    """An error of a tenth of the light on bright skin: dim skin is estimated too dark, and the image counts less."""
    model, texels, _, _, seen = half_seen
    skin = interpolate(model.mean_albedo, model.faces, texels.face, texels.weights)
    level = np.where(seen, 0.5, 0.08)
    confidence = np.ones(len(level))

    def error(light):
        maps = texels.to_map(np.c_[skin * (light / level)[:, None], np.full(len(level), 0.3)].astype(np.float32))
        return light_error(model, texels, maps, confidence, level), maps

    right, wrong = error(level)[0], error(np.maximum(level - 0.05, 0.0))
    assert right == 0.0 and 0.04 < wrong[0] < 0.09
    lit = light_known(level, wrong[0])
    blend = blend_unseen(replace(model, symmetry=None), texels, wrong[1], confidence, confidence, lit)
    assert (texels.from_map(blend.confidence)[~seen] == 0).all() and (lit[seen] > 0.9).all()
    assert np.median(texels.from_map(blend.diffuse)[~seen] / skin[~seen]) > 0.8


def test_a_mark_on_one_side_is_not_painted_onto_the_other(half_seen):
    """Where both sides were seen, each keeps its own."""
    model, texels, truth, _, seen = half_seen
    marked = np.where(seen[:, None], truth + 0.2, truth).astype(np.float32)
    sure = np.ones(len(truth), np.float32)
    found = texels.from_map(blend_unseen(model, texels, texels.to_map(marked), sure, sure).diffuse)
    np.testing.assert_allclose(found, marked[:, :3], atol=0.03)


def test_the_lit_half_decides_what_skin_is(half_seen):
    """Light that is wrong on one half changes its colour: the other half, where there is more light, knows better."""
    model, texels, truth, _, seen = half_seen
    tinted = np.where(seen[:, None], truth, truth * (0.9, 0.6, 0.5, 1.0)).astype(np.float32)
    sure, lit = np.ones(len(truth), np.float32), np.where(seen, 1.0, 0.5)
    found = texels.from_map(blend_unseen(model, texels, texels.to_map(tinted), sure, sure, lit).diffuse)
    inside = np.abs(interpolate(model.mean, model.faces, texels.face, texels.weights)[:, 0] * model.unit_mm) > 5.0
    error, before = (np.abs(v - truth[:, :3])[~seen & inside].mean() for v in (found, tinted[:, :3]))
    assert error < 0.25 * before
    np.testing.assert_allclose(found[seen & inside], truth[seen & inside, :3], atol=0.03)


def test_skin_is_what_pigments_make_of_the_skin_around():
    """Moles and redness are skin. Sheen, a shadow that has the sky's colour, and light from other skin are not."""
    texels = TexelMap(100, np.arange(100**2), np.zeros(100**2, np.int32), np.ones((100**2, 3)) / 3)
    skin, rng = np.array([0.5, 0.3, 0.2]), np.random.default_rng(0)
    albedo = skin * rng.normal(1.0, 0.02, (100**2, 1))
    y, x = np.divmod(np.arange(100**2), 100)
    marks = dict(zip(("mole", "red", "hair", "sheen", "shadow", "orange"), (8, 25, 42, 58, 75, 92), strict=True))
    spots = {name: np.hypot(x - at, y - 50) < 1.5 for name, at in marks.items()}
    albedo[spots["mole"]] *= np.exp(-0.5 * MELANIN)
    albedo[spots["red"]] *= np.exp(-0.3 * HAEMOGLOBIN)
    albedo[spots["hair"]] *= 0.4
    albedo[spots["sheen"]] += 0.15
    albedo[spots["shadow"]] *= (0.5, 0.7, 0.9)
    albedo[spots["orange"]] *= (1.4, 1.2, 1.0)
    plain = ~np.any(list(spots.values()), axis=0)
    found = pigment_weight(texels, albedo, np.ones_like(albedo), np.ones(len(albedo)))
    assert found[plain].min() > 0.5 and found[plain].mean() > 0.9
    assert min(found[spots[name]].min() for name in ("mole", "red", "hair")) > 0.7
    assert max(found[spots[name]].max() for name in ("sheen", "shadow", "orange")) < 0.3
    assert np.isfinite(pigment_weight(texels, albedo, np.ones_like(albedo), np.zeros(len(albedo)))).all()


def test_distances_from_what_pigments_make_are_those_of_non_negative_least_squares():
    changes = np.random.default_rng(1).normal(0.0, 0.3, (200, 3))
    axes = np.stack([MELANIN, HAEMOGLOBIN, np.ones(3)], axis=1)
    np.testing.assert_allclose(beyond_pigments(changes), [nnls(axes, -c)[1] ** 2 for c in changes], atol=1e-9)


def test_sheen_in_the_albedo_gives_way_to_the_skin_around(half_seen):
    model, texels, truth, *_ = half_seen
    shiny = truth.astype(np.float32).copy()
    place = interpolate(model.mean, model.faces, texels.face, texels.weights) * model.unit_mm
    spot = np.linalg.norm(place - place[len(place) // 3], axis=1) < 3.0
    shiny[spot, :3] += 0.2
    sure = np.ones(len(truth), np.float32)
    given = model, texels, texels.to_map(shiny), sure, sure
    kept, found = (texels.from_map(blend_unseen(*given, lit).diffuse)[spot] for lit in (None, sure))
    before, after = (np.abs(each - truth[spot, :3]).mean() for each in (kept, found))
    assert before > 0.15 and after < 0.3 * before


def test_a_fine_mark_stays_on_its_side(half_seen):
    model, texels, truth, _, seen = half_seen
    dots = np.flatnonzero(seen)[::37]
    marked = truth.copy()
    marked[dots, :3] *= 0.6
    sure = np.ones(len(truth), np.float32)
    found = texels.from_map(blend_unseen(model, texels, texels.to_map(marked), sure, sure, sure).diffuse)
    assert np.median(found[dots] / truth[dots, :3]) < 0.7
    np.testing.assert_allclose(found[~seen], truth[~seen, :3], atol=0.05)


def test_eyes_keep_what_each_of_them_shows():
    """An iris is dark without want of light, and two need not be alike."""
    model = MorphableModel.load("builtin:coarse")
    texels = rasterize_uv(model.uv, model.faces_uv, 128, model.mapped)
    left, right = (np.isin(model.faces, ball).all(axis=1)[texels.face] for ball in eyeballs(model))
    assert left.sum() > 20 < right.sum()
    found = np.full((len(texels.face), 4), 0.4, np.float32)
    found[left, :3], found[right, :3] = (0.1, 0.2, 0.5), (0.3, 0.2, 0.1)
    sure = np.ones(len(found), np.float32)
    lit = np.where(left | right, 0.0, 1.0)
    shown = texels.from_map(blend_unseen(model, texels, texels.to_map(found), sure, sure, lit).diffuse)
    for eye in (left, right):
        np.testing.assert_allclose(np.median(shown[eye], axis=0), np.median(found[eye, :3], axis=0), atol=0.03)
