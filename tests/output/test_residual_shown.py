"""What photographs show beyond the model: part of views in the capture's own light, at the timesteps that have it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mifit.appearance.illumination import Illumination
from mifit.core.estimate import Report, ResidualEstimate
from mifit.core.image import write_image
from mifit.errors import InputError
from mifit.result import Reconstruction
from tests.output.conftest import ball_camera, ball_result


@pytest.fixture(scope="module")
def faces(variant):
    """A result with a residual at its first timestep, and the same without."""
    bare = ball_result()
    radiance = np.full((1, *bare.reflectance.diffuse.shape), 0.1, np.float32)
    radiance[0, ..., 2] = -5.0
    residual = ResidualEstimate((0,), radiance, Report("converged"))
    return replace(bare, residual=residual), bare


def test_full_views_of_its_timestep_have_it(faces):
    shown, plain = (r.render(ball_camera(), 0) for r in faces)
    added = (shown - plain)[plain[..., 3] == 1]
    mapped = added[:, 0] > 0.0999  # elsewhere there are no maps, or in parts of a pixel
    assert mapped.mean() > 0.9 and -1e-5 < added[:, :2].min() and added[:, :2].max() < 0.1001
    assert (shown[plain[..., 3] == 1][mapped][:, 2] == 0).all()  # no light is below none
    for timestep, method in ((3, "full"), (0, "diffuse"), (0, "pca")):
        np.testing.assert_array_equal(*(r.render(ball_camera(), timestep, method) for r in faces))


def test_an_edited_face_and_another_light_have_none(faces):
    result, bare = faces
    albedo = 0.5 * result.reflectance.diffuse
    for change in (
        lambda r: r.with_albedo(albedo),
        lambda r: r.with_specular(0.3),
        lambda r: r.relight(Illumination(np.float64([[0.9, 0.8, 0.7]]))),
    ):
        assert change(result).residual is None
        np.testing.assert_array_equal(*(change(r).render(ball_camera(), 0) for r in (result, bare)))


def test_it_is_kept_in_the_folder(faces, tmp_path):
    result, bare = faces
    result.save(tmp_path / "result")
    loaded = Reconstruction.load(tmp_path / "result", model=result.model)
    assert loaded.residual.timesteps == (0,)
    np.testing.assert_array_equal(loaded.residual.radiance, result.residual.radiance)
    bare.save(tmp_path / "result", force=True)
    assert not list((tmp_path / "result" / "maps").glob("residual*"))
    assert Reconstruction.load(tmp_path / "result", model=result.model).residual is None
    result.save(tmp_path / "result", force=True)
    write_image(tmp_path / "result" / "maps" / "residual_0000.exr", np.zeros((8, 8, 3), np.float32))
    with pytest.raises(InputError, match=r"residual_0000\.exr"):
        Reconstruction.load(tmp_path / "result", model=result.model)
