"""Eyes and a mouth's inside for a model that has holes there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.sparse as sp
import trimesh

from mifit.core.mesh import vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.morphable.openings import RADIUS_MM, eyeballs, lacks_eyes, leading_faces, skin_weights, with_eyes
from mifit.morphable.topology import closed_borders
from mifit.render.gbuffer import SurfaceScene
from mifit.render.visible import trace_mesh
from tests.stages.memory_capture import look_at_head


@pytest.fixture(scope="module")
def skin(ict_path: Path) -> MorphableModel:
    return MorphableModel.load(ict_path)


@pytest.fixture(scope="module")
def whole(skin: MorphableModel) -> MorphableModel:
    return with_eyes(skin)


def test_what_was_there_stays(skin: MorphableModel, whole: MorphableModel) -> None:
    n, f = skin.n_vertices, len(skin.faces)
    for name in ("mean", "identity", "expression", "mean_albedo", "albedo_modes", "symmetry"):
        np.testing.assert_array_equal(getattr(whole, name)[:n], getattr(skin, name))
    np.testing.assert_array_equal(whole.faces[:f], skin.faces)
    np.testing.assert_array_equal(whole.face_mask, np.append(skin.face_mask, np.zeros(len(whole.faces) - f, bool)))
    assert lacks_eyes(skin) and not lacks_eyes(whole)
    symmetry = whole.symmetry
    np.testing.assert_array_equal(symmetry[symmetry], np.arange(whole.n_vertices))
    np.testing.assert_allclose(whole.mean[symmetry][n:] * [-1, 1, 1], whole.mean[n:], atol=0.05)


def test_the_first_vertices_are_the_model_without_eyes(skin: MorphableModel, whole: MorphableModel) -> None:
    own = leading_faces(whole, skin.n_vertices)
    assert own is not None
    np.testing.assert_array_equal(whole.faces[own], skin.faces)
    np.testing.assert_array_equal(whole.face_mask[own], skin.face_mask)
    everything = leading_faces(whole, whole.n_vertices)
    assert everything is not None and everything.all()
    for count in (0, 3, skin.n_vertices - 1, skin.n_vertices + 1, whole.n_vertices + 1):
        assert leading_faces(whole, count) is None


def test_all_vertices_are_carried_by_those_of_the_skin(skin: MorphableModel, whole: MorphableModel) -> None:
    """As their identity modes are; a model without added pieces carries itself."""
    found, n = skin_weights(whole), skin.n_vertices
    assert found is not None and found.shape == (whole.n_vertices, n)
    assert (found[:n] != sp.identity(n, format="csr")).nnz == 0
    np.testing.assert_allclose(np.asarray(found.sum(axis=1)), 1.0)
    np.testing.assert_allclose(found @ skin.identity[..., 3].astype(np.float64), whole.identity[..., 3], atol=1e-6)
    assert skin_weights(skin) is None


def test_eyeballs_are_round_and_lie_behind_the_lids(whole: MorphableModel) -> None:
    balls = eyeballs(whole)
    assert len(balls) == 2
    for ball, corner in zip(balls, (36, 42), strict=True):
        points = whole.mean[ball].astype(np.float64)
        system = np.column_stack([2 * points, np.ones(len(points))])
        centre = np.linalg.lstsq(system, (points**2).sum(1), rcond=None)[0][:3]
        radius = np.linalg.norm(points - centre, axis=1) * whole.unit_mm
        np.testing.assert_allclose(radius, RADIUS_MM, atol=0.01)
        lids = whole.mean[whole.landmarks[[corner + k for k in (1, 2, 4, 5)]]]
        assert np.abs(np.linalg.norm(lids - centre, axis=1) * whole.unit_mm - RADIUS_MM).max() < 1.6
        normals = vertex_normals(whole.mean.astype(np.float64), whole.faces)[ball]
        assert (np.einsum("nk,nk->n", normals, points - centre) > 0).all()
    blink = [k for k, name in enumerate(whole.expression_names) if "blink" in name.lower()]
    assert blink and np.abs(whole.expression[np.concatenate(balls)][..., blink]).max() * whole.unit_mm < 1.0


def test_nothing_is_seen_through_the_eyes_and_the_mouth(skin, whole, variant) -> None:
    opened = np.zeros(skin.n_expression)
    opened[[k for k, name in enumerate(skin.expression_names) if name.lower() == "jawopen"]] = 1.0
    seen = []
    for model in (skin, whole):
        vertices = model.shape(np.zeros(model.n_identity), opened).astype(np.float64)
        camera = look_at_head("a", 0.0, 400, 400, distance=60.0)
        buffer = SurfaceScene(vertices, model.faces).gbuffer(camera)
        front = (
            np.einsum(
                "fk,fk->f",
                vertex_normals(vertices, model.faces)[model.faces[:, 0]],
                np.array([[0.0, 0, 1]]).repeat(len(model.faces), 0),
            )
            > 0
        )
        marks = camera.project(vertices[model.landmarks])
        points = [marks[part].mean(axis=0) for part in (slice(36, 42), slice(42, 48), slice(60, 68))]
        faces = [int(buffer.face[int(y), int(x)]) for x, y in points]
        seen.append([face >= len(skin.faces) and bool(front[face]) for face in faces])
    assert seen == [[False] * 3, [True] * 3]


def test_the_mouth_is_closed_where_teeth_are(skin: MorphableModel, whole: MorphableModel) -> None:
    """Opened lips show a sheet that faces outward and lies a few millimetres behind the middle between both."""
    opened = np.zeros(skin.n_expression)
    opened[[k for k, name in enumerate(skin.expression_names) if name.lower() == "jawopen"]] = 1.0
    vertices = whole.shape(np.zeros(whole.n_identity), opened).astype(np.float64)
    upper, lower = (vertices[whole.landmarks[k]] for k in (62, 66))
    gap = upper[1] - lower[1]
    assert gap * whole.unit_mm > 8.0
    rays = trimesh.Trimesh(vertices, whole.faces, process=False)
    for part in (0.3, 0.5, 0.7):
        start = lower + part * (upper - lower) + [0.0, 0.0, 10.0]
        # The nearest face that a look straight backward meets.
        corners = vertices[whole.faces] - start
        a, b, c = (corners[:, i, :2] for i in range(3))
        area = [u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] for u, v in ((b, c), (c, a), (a, b))]
        inside = np.flatnonzero((np.minimum.reduce(area) > 0) | (np.maximum.reduce(area) < 0))
        weights = np.stack(area, axis=1)[inside]
        depth = (weights / weights.sum(1, keepdims=True) * corners[inside, :, 2]).sum(1)
        first = inside[np.argmax(depth)]
        between = lower + part * (upper - lower)
        behind = (between[2] - (start[2] + depth.max())) * whole.unit_mm
        assert (whole.faces[first] >= skin.n_vertices).all()
        assert -1.0 < behind < 8.0, (part, behind)
        assert rays.face_normals[first][2] > 0.5


def test_no_gap_is_left_between_lids_and_corners(skin, whole, variant) -> None:
    """From aside, where the ball ends before the lids do."""
    vertices = whole.mean.astype(np.float64)
    for degrees in (-35.0, 0.0, 35.0):
        camera = look_at_head("a", degrees, 700, 700, distance=60.0)
        surface = trace_mesh(vertices, whole.faces, camera, 1)
        seen = np.zeros(camera.height * camera.width, bool)
        seen[surface.pixel] = True
        marks = camera.project(vertices[whole.landmarks]).astype(np.int32)
        for eye in (slice(36, 42), slice(42, 48)):
            inside = np.zeros((camera.height, camera.width), np.uint8)
            cv2.fillConvexPoly(inside, cv2.convexHull(marks[eye]), 1)
            through = (cv2.dilate(inside, np.ones((9, 9))) > 0) & ~seen.reshape(inside.shape)
            assert through.sum() <= 2, degrees  # rays that pass between two faces


def test_the_new_parts_have_a_place_of_their_own_in_the_maps(skin, whole) -> None:
    new = np.arange(len(whole.faces)) >= len(skin.faces)
    assert whole.mapped[new].mean() > 0.99
    texels = rasterize_uv(whole.uv, whole.faces_uv, 256, whole.mapped)
    rows = texels.index // 256
    assert (rows[new[texels.face]] >= 256 * 0.9).all() and (rows[~new[texels.face]] < 256 * 0.92).all()
    assert new[texels.face].sum() > 1500


def test_a_model_with_eyes_is_refused(whole: MorphableModel) -> None:
    builtin = MorphableModel.load("builtin:coarse")
    assert not lacks_eyes(builtin)
    with pytest.raises(InputError, match="found 0 eyes that are holes, expected 2"):
        with_eyes(builtin)


def test_it_is_saved_and_read(skin: MorphableModel, whole: MorphableModel, tmp_path: Path) -> None:
    whole.save(tmp_path / "m.npz")
    again = MorphableModel.load(tmp_path / "m.npz")
    assert again.digest == whole.digest != skin.digest
    assert MorphableModel.load(whole.source).digest == whole.digest
    assert len(closed_borders(again.faces)) >= 3
    assert replace(whole, name="x").n_vertices == again.n_vertices
