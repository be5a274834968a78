"""Parting the found albedo into skin and light that the mesh doesn't explain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit.core.mesh import interpolate
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.stages.reflectance.residual_shading import SIDED_SPREAD, SYMMETRIC_SPREAD, facial_share, separate_shading

SIZE = 96


@pytest.fixture(scope="module")
def head():
    model = MorphableModel.load("builtin")
    return model, rasterize_uv(model.uv, model.faces_uv, SIZE, model.mapped)


def skin(head, spread=0.1):
    """An albedo map alike on both halves, with a spread of its log luminance as asked for."""
    model, texels = head
    place = interpolate(model.mean, model.faces, texels.face, texels.weights)
    scale = np.ptp(model.mean[:, 1])
    pattern = np.sin(40.0 * place[:, 1] / scale) + np.cos(60.0 * np.abs(place[:, 0]) / scale)
    pattern *= spread / pattern[facial_share(model, texels) > 0.99].std()
    return texels.to_map((np.float32([0.45, 0.3, 0.22]) * np.exp(pattern)[:, None]).astype(np.float32))


def one_sided(head, strength):
    """Light that falls on one half of the face more than on the other, and was taken for albedo."""
    model, texels = head
    place = interpolate(model.mean, model.faces, texels.face, texels.weights)
    return texels.to_map(np.exp(strength * np.tanh(place[:, 0] / (0.05 * np.ptp(model.mean[:, 0])))).astype(np.float32))


def spreads(head, albedo):
    parted = separate_shading(*head, albedo, np.ones((SIZE, SIZE), np.float32))
    return parted.symmetric, parted.sided


def test_the_face_without_eyes_and_mouth_is_judged(head):
    model, texels = head
    share = facial_share(model, texels)
    place = interpolate(model.mean, model.faces, texels.face, texels.weights)
    parts = {"eye": slice(36, 42), "mouth": slice(60, 68), "nose": slice(30, 31)}
    middle = {name: model.mean[model.landmarks[rows]].mean(axis=0) for name, rows in parts.items()}
    near = {name: np.linalg.norm(place - at, axis=1).argmin() for name, at in middle.items()}
    assert share[near["nose"]] == 1.0
    assert share[near["eye"]] < 0.1 and share[near["mouth"]] < 0.6
    back = place[:, 2]
    assert share[back < np.quantile(back, 0.05)].max() == 0.0 and 0.2 < (share > 0.99).mean() < 0.8


def test_skin_as_it_is_stays(head):
    albedo = skin(head, 0.15)
    parted = separate_shading(*head, albedo, np.ones((SIZE, SIZE), np.float32))
    assert parted.symmetric == pytest.approx(0.15, abs=0.02) and parted.sided < 0.02
    np.testing.assert_allclose(parted.skin, albedo, atol=1e-5)
    np.testing.assert_allclose(parted.residual_shading, 1.0, atol=1e-4)


@pytest.mark.parametrize("strength", [0.3, 0.6])
def test_light_from_one_side_is_parted(head, strength):
    true = skin(head)
    found = np.clip(true * one_sided(head, strength)[..., None], 0, 1)
    parted = separate_shading(*head, found, np.ones((SIZE, SIZE), np.float32))
    inside = head[1].to_map(facial_share(*head).astype(np.float32)) > 0.99

    def error(albedo):
        difference = np.log(albedo[inside] / true[inside]).mean(axis=1)
        return difference.std()

    assert error(parted.skin) < 0.5 * error(found)
    assert spreads(head, parted.skin)[1] < 1.2 * SIDED_SPREAD < spreads(head, found)[1]
    np.testing.assert_allclose(parted.skin * parted.residual_shading[..., None], found, atol=1e-5)
    assert parted.skin[inside].mean() == pytest.approx(found[inside].mean(), rel=0.02)  # its level stays
    assert parted.skin.max() <= 1.0


def test_more_contrast_than_skin_has_is_parted(head):
    found = np.clip(skin(head, 0.6), 0, 1)
    parted = separate_shading(*head, found, np.ones((SIZE, SIZE), np.float32))
    assert spreads(head, parted.skin)[0] < 1.1 * SYMMETRIC_SPREAD
    ratio = parted.skin / np.maximum(found, 1e-6)
    covered = found.min(axis=-1) > 0.01
    np.testing.assert_allclose(ratio[covered, 0], ratio[covered, 2], rtol=1e-3)  # colour is left alone


def test_a_face_that_was_hardly_seen_is_left_alone(head):
    found = skin(head, 0.6)
    parted = separate_shading(*head, found, np.zeros((SIZE, SIZE), np.float32))
    assert parted.symmetric is None and parted.skin is found and (parted.residual_shading == 1.0).all()


def test_without_a_symmetry_all_contrast_is_judged_as_one(head):
    model, texels = replace(head[0], symmetry=None), head[1]
    found = skin(head) * one_sided(head, 0.6)[..., None]
    parted = separate_shading(model, texels, np.clip(found, 0, 1), np.ones((SIZE, SIZE), np.float32))
    assert parted.sided == 0.0 and parted.symmetric > 0.5
    inside = texels.to_map(facial_share(model, texels).astype(np.float32)) > 0.99
    assert np.log(parted.skin[inside]).mean(axis=1).std() < 1.1 * SYMMETRIC_SPREAD
