"""Hair that images show on the scalp."""

import numpy as np
import pytest

from mifit.core.mesh import interpolate
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.morphable.topology import scalp_depth
from mifit.stages.reflectance.fill import Filled
from mifit.stages.reflectance.hair import MARGIN, find_hair, paint

LIGHT, ERROR = 0.3, 0.02


@pytest.fixture(scope="module")
def head():
    """A bald head seen from the front: its texels, their albedo and confidence, how far they are behind the hairline
    and above the ears, and on which side."""
    model = MorphableModel.load("builtin:coarse")
    texels = rasterize_uv(model.uv, model.faces_uv, 128, model.mapped)
    at = model.faces, texels.face, texels.weights
    behind, above = (interpolate(depth[:, None], *at)[:, 0] for depth in scalp_depth(model.mean, model.landmarks))
    point = interpolate(model.mean.astype(float) * model.unit_mm, *at)
    seen = (point[:, 2] > 0.0).astype(np.float32)
    return model, texels, interpolate(model.mean_albedo, *at), seen, behind, above, point[:, 0]


def found(head, albedo, light=LIGHT):
    model, texels, _, seen, *_ = head
    maps = texels.to_map(np.c_[albedo, np.full(len(albedo), 0.03)].astype(np.float32))
    return find_hair(model, texels, maps, seen, seen * light * albedo.mean(axis=1), ERROR)


def haired(head, where=True):
    _, _, skin, _, behind, above, _ = head
    dark = (behind > 0.1) & (above > 0) & where
    return np.where(dark[:, None], 0.12 * skin, skin)


def test_a_dark_band_on_the_scalp_becomes_hair_of_one_colour(head):
    """Where images didn't look, too; before the hairline that they show, and on ears and neck, skin stays as it was."""
    _, texels, skin, seen, behind, above, _ = head
    hair = found(head, haired(head))
    assert hair is not None and (hair.colour < 0.2 * np.median(skin, axis=0)).all()
    before = Filled(*(texels.to_map(x.astype(np.float32)) for x in (skin, np.full(len(skin), 0.03), seen, seen)))
    after = paint(texels, before, hair)
    inside, outside = (np.minimum(behind, above) > 0.3), (behind < -0.2) | (above < -0.3)
    assert (inside & (seen == 0)).sum() > 500 and (inside & (seen > 0)).sum() > 100
    np.testing.assert_allclose(
        texels.from_map(after.diffuse)[inside], np.tile(hair.colour, (inside.sum(), 1)), atol=1e-3
    )
    assert texels.from_map(after.specular)[inside].max() < 1e-3
    for name in ("diffuse", "specular"):
        of = texels.from_map(getattr(after, name))[outside], texels.from_map(getattr(before, name))[outside]
        np.testing.assert_array_equal(*of)
    assert after.confidence is before.confidence and after.specular_confidence is before.specular_confidence
    border = hair.share[(np.abs(behind - 0.1) < 0.1) & (above > 0.2)]
    assert ((border > 0.2) & (border < 0.8)).any()


def test_the_hairline_is_where_images_show_it(head):
    """Before the canon's, or behind it."""
    _, _, skin, seen, behind, above, _ = head
    for line in (-0.5 * MARGIN, 0.25):
        albedo = np.where(((behind > line) & (above > 0))[:, None], 0.12 * skin, skin)
        share = found(head, albedo).share
        looked = (above > 0.2) & (seen > 0)
        assert share[looked & (behind > line + 0.1)].min() > 0.8
        assert share[looked & (behind < line - 0.1) & (behind > -1.0)].max() < 0.2


def test_a_bald_head_has_none(head):
    """Brows, beard and a shaved scalp of skin's own spread are no hair on it."""
    _, _, skin, _, behind, above, side = head
    model = head[0]
    assert found(head, skin) is None
    shaved = np.where(((behind > 0) & (above > 0))[:, None], 0.7 * skin, skin)
    assert found(head, shaved) is None
    beard = np.where(((above < 0) & (np.abs(side) < 60.0))[:, None], 0.1 * skin, skin)
    assert found(head, beard) is None
    assert (scalp_depth(model.mean, model.landmarks)[0][model.landmarks[17:]] < -MARGIN).all()


def test_a_shadow_on_one_side_is_no_hair(head):
    assert found(head, haired(head, head[-1] > 0)) is None
    assert found(head, haired(head)) is not None


def test_what_an_error_of_the_light_explains_is_no_hair(head):
    """In hardly any light, and where only the light is dim while the albedo is skin's."""
    assert found(head, haired(head), 0.02) is None
    assert found(head, head[2], 0.05) is None


def test_a_head_of_which_nothing_was_seen_has_none(head):
    model, texels, skin, seen, *_ = head
    maps = texels.to_map(np.c_[skin, skin[:, 0]].astype(np.float32))
    assert find_hair(model, texels, maps, 0 * seen, 0 * seen, ERROR) is None
