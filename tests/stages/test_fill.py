"""Texels that no image showed."""

from dataclasses import replace

import numpy as np
import pytest

from mifit.core.mesh import interpolate
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.stages.reflectance.fill import blend_unseen, mirrored_coordinates


@pytest.fixture(scope="module")
def half_seen():
    """A face whose albedo is striped alike on both sides, of which one side was seen."""
    model = MorphableModel.load("builtin:coarse")
    texels = rasterize_uv(model.uv, model.faces_uv, 96, model.face_mask)
    point = interpolate(model.mean.astype(float) * model.unit_mm, model.faces, texels.face, texels.weights)
    stripes = 0.1 * np.sin(np.abs(point[:, 0]) / 12) * np.cos(point[:, 1] / 15)
    truth = (0.4 + stripes[:, None] * (1.0, 0.8, 0.6, 0.3)).astype(np.float32)
    seen = point[:, 0] > 0
    found = np.where(seen[:, None], truth, 0.9).astype(np.float32)
    return model, texels, truth, found, seen


def test_the_unseen_side_takes_what_the_other_shows(half_seen):
    model, texels, truth, found, seen = half_seen
    albedo = np.full((len(truth), 3), 0.4, np.float32)
    errors = []
    for mirrored in (None, mirrored_coordinates(model, texels)):
        told = np.ones(len(truth), np.float32)
        blend = blend_unseen(model, texels, albedo, texels.to_map(found), seen.astype(float), told, mirrored)
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
    albedo = np.full((len(truth), 3), 0.4, np.float32)
    blend = blend_unseen(model, texels, albedo, texels.to_map(truth), seen.astype(float), told)
    np.testing.assert_array_equal(texels.from_map(blend.specular_confidence), seen * told)
    np.testing.assert_array_equal(texels.from_map(blend.confidence), seen)
    np.testing.assert_allclose(texels.from_map(blend.specular)[seen], truth[seen, 3], atol=0.03)


def test_a_model_without_symmetry_is_refused(half_seen):
    model, texels, *_ = half_seen
    with pytest.raises(InputError, match=r"symmetric_fill: model .* has no symmetry"):
        mirrored_coordinates(replace(model, symmetry=None), texels)
