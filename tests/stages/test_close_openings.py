"""Stage 1b's lips and lids: what the images show closed is closed, anything else is left as it is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from memory_capture import MemoryCapture, look_at_head
from scipy.spatial import cKDTree

import mifit.stages.find_surface as stage
from mifit.capture import Frame
from mifit.config import SurfaceConfig
from mifit.core.estimate import GeometryEstimate, Report
from mifit.core.mesh import face_cross
from mifit.morphable import MorphableModel
from mifit.morphable.openings import with_eyes
from mifit.stages.geometry.parameters import exponential
from mifit.stages.geometry.surfaces import displaced, moved_by
from mifit.stages.surface.close_openings import LIDS, LIPS, close_again, close_openings
from mifit.stages.surface.closed_line import heights, read_strip
from mifit.stages.surface.margins import COLUMNS, Gap, Margins
from tests.morphable.intersections import intersections
from tests.test_pipeline import without_eyes

BOTH = ("left", "right")
RED, INSIDE, TEETH = (0.35, 0.16, 0.14), (0.02, 0.006, 0.005), (0.3, 0.27, 0.24)
SKIN, LASHES = (0.42, 0.26, 0.2), (0.12, 0.06, 0.05)
OPEN = {"white": (0.4, 0.37, 0.35), "iris": (0.035, 0.02, 0.014)}
ABOVE_MM = 0.6
"""Of the true lip line above the middle between the modelled margins."""


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=10, albedo=5)


@pytest.fixture(scope="module")
def start(model):
    """Two timesteps of the mean head, whose margins are about 2 mm apart."""
    rotation = np.stack([np.eye(3), exponential(np.radians([-5.0, 8.0, 2.0]))])
    expression = np.zeros((2, model.n_expression))
    none = np.zeros(model.n_identity), np.zeros(model.n_albedo)
    vertices = (model.mean.astype(np.float64) @ rotation.transpose(0, 2, 1)).astype(np.float32)
    return GeometryEstimate(
        (0, 1), none[0], none[1], expression, rotation, np.zeros((2, 3)), 1.0, vertices, model.mean_albedo,
        np.zeros((9, 3)), 0.0, Report("converged"),
    )  # fmt: skip


def close_lips(capture, model, geometry, cameras):
    """The lips alone, and what was seen of them."""
    found, details = close_openings(capture, model, geometry, cameras, LIPS)
    return found, details.get("mouth", {})


def gap_of(model, geometry, k, marks):
    shape = displaced(model, geometry).shape(geometry.identity, geometry.expression[k]).astype(np.float64)
    return Gap.of(shape, Margins.of(model, marks))


def mouth_of(model, geometry, k):
    return gap_of(model, geometry, k, LIPS[0].marks)


def opening_mm(model, geometry, k):
    mouth = mouth_of(model, geometry, k)
    return (mouth.upper - mouth.lower)[:, 1] * model.unit_mm


def true_line(model, start):
    return mouth_of(model, start, 0).middle + np.array([0.0, ABOVE_MM / model.unit_mm, 0.0])


def photographed(model, start, mouths):
    """Images of nothing but lips, with a lip line (``"closed"``), a band or nothing for a mouth, per timestep."""
    cameras = {name: look_at_head(name, angle, 850, 600) for name, angle in zip(BOTH, (-20.0, 20.0), strict=True)}
    rng, frames, mouth = np.random.default_rng(0), {}, mouth_of(model, start, 0)
    for k, what in enumerate(mouths):
        for name, camera in cameras.items():
            image = np.tile(np.float32(RED), (600, 850, 1))

            def pixels(points, camera=camera, k=k):
                return np.round(16 * (camera.project(points @ start.rotation[k].T) - 0.5)).astype(np.int32)

            if what == "closed":
                line = pixels(true_line(model, start))
                cv2.polylines(image, [line], False, INSIDE, 1, cv2.LINE_AA, 4)
            elif what != "nothing":
                band = np.concatenate([pixels(mouth.upper), pixels(mouth.lower)[::-1]])
                cv2.fillPoly(image, [band], TEETH if what == "teeth" else INSIDE, cv2.LINE_AA, 4)
                cv2.polylines(image, [pixels(mouth.upper), pixels(mouth.lower)], False, INSIDE, 1, cv2.LINE_AA, 4)
            image = cv2.GaussianBlur(image, (0, 0), 0.6) * (1 + 0.01 * rng.normal(size=image.shape))
            everywhere = np.ones(image.shape[:2], bool)
            marks = np.zeros((68, 2))
            frames[name, k] = Frame(image.astype(np.float32), everywhere, ~everywhere, marks, np.zeros(68, bool))
    return MemoryCapture(cameras, frames, start.vertices, start.rotation, start.identity)


@pytest.fixture(scope="module")
def closed(model, start):
    return close_lips(photographed(model, start, ("closed", "closed")), model, start, BOTH)


def test_lips_close_on_the_line(model, start, closed):
    found, details = closed
    assert details["closed"] == [0, 1]
    for k in range(2):
        assert np.median(opening_mm(model, start, k)) > 1.5
        assert np.abs(opening_mm(model, found, k)).max() < 0.3
        off = (mouth_of(model, found, k).middle - true_line(model, start))[:, 1] * model.unit_mm
        assert np.abs(off).max() < 0.3


def test_the_result_is_consistent_in_itself(model, closed):
    found, _ = closed
    carried = displaced(model, found)
    for k in range(2):
        shape = carried.shape(found.identity, found.expression[k])
        np.testing.assert_allclose(found.vertices[k], shape @ found.rotation[k].T, atol=1e-4)


def test_no_face_of_the_face_area_flips(model, start, closed):
    found, _ = closed
    facial = model.faces[model.face_mask]
    for k in range(2):
        before, after = (face_cross(g.vertices[k], facial) for g in (start, found))
        assert ((before * after).sum(1) > 0).all()


def test_the_face_area_does_not_intersect_itself(model, start, closed):
    facial = model.faces[model.face_mask]
    before, after = (intersections(10.0 * g.vertices[0], facial) for g in (start, closed[0]))
    assert len(after) <= len(before)


def test_the_rest_of_the_face_stays(model, start, closed):
    marks = model.landmarks[:48]
    assert np.linalg.norm(closed[0].vertices[:, marks] - start.vertices[:, marks], axis=2).max() < 0.02


@pytest.mark.parametrize("what", ["inside", "teeth", "nothing"])
def test_a_mouth_not_seen_closed_is_left_alone(model, start, what):
    found, details = close_lips(photographed(model, start, (what, what)), model, start, BOTH)
    assert details["closed"] == [] and found is start


def test_an_open_timestep_stays_as_open(model, start):
    found, details = close_lips(photographed(model, start, ("closed", "inside")), model, start, BOTH)
    assert details["closed"] == [0]
    assert np.abs(opening_mm(model, found, 0)).max() < 0.8
    before, after = (np.median(opening_mm(model, g, 1)) for g in (start, found))
    assert after > 0.7 * before


def test_lips_that_touch_stay(model, closed):
    found, _ = closed
    again, _ = close_lips(photographed(model, found, ("nothing", "nothing")), model, found, BOTH)
    assert again is found


def test_columns_that_are_not_seen_have_no_vote():
    strip = np.ones((len(COLUMNS), len(heights(2.0)), 3))
    seen = np.arange(len(COLUMNS)) < 0.4 * len(COLUMNS)
    strip[:, len(heights(2.0)) // 2] = 0.05
    opening = np.full(len(COLUMNS), 2.0)
    assert read_strip(strip, seen, opening, 0.8).inside is None
    assert read_strip(strip, np.ones(len(seen), bool), opening, 0.8).inside == 0.0


def test_a_model_whose_face_area_has_no_mouth_is_left_alone(model, start):
    whole = replace(model, face_mask=np.ones(len(model.faces), bool))
    found, details = close_lips(photographed(model, start, ("closed", "closed")), whole, start, BOTH)
    assert found is start and details == {}


def eyed(model, start, eyes):
    """Images of nothing but skin with eyes that are shut, show white or a dark iris, or with nothing, per timestep.

    Two words are of the right and the left eye.
    """
    cameras = {name: look_at_head(name, angle, 1700, 1200) for name, angle in zip(BOTH, (-20.0, 20.0), strict=True)}
    rng, frames = np.random.default_rng(0), {}
    for k, shown in enumerate(eyes):
        for name, camera in cameras.items():
            image = np.tile(np.float32(SKIN), (1200, 1700, 1))
            for opening, what in zip(LIDS, shown.split() * 2, strict=False):
                gap = gap_of(model, start, 0, opening.marks)

                def pixels(points, camera=camera, k=k):
                    return np.round(16 * (camera.project(points @ start.rotation[k].T) - 0.5)).astype(np.int32)

                if what == "shut":
                    cv2.polylines(image, [pixels(shut_line(model, gap))], False, LASHES, 2, cv2.LINE_AA, 4)
                elif what in OPEN:
                    band = np.concatenate([pixels(gap.upper), pixels(gap.lower)[::-1]])
                    cv2.fillPoly(image, [band], OPEN[what], cv2.LINE_AA, 4)
                    cv2.polylines(image, [pixels(gap.upper), pixels(gap.lower)], False, LASHES, 2, cv2.LINE_AA, 4)
            image = cv2.GaussianBlur(image, (0, 0), 0.6) * (1 + 0.01 * rng.normal(size=image.shape))
            everywhere = np.ones(image.shape[:2], bool)
            marks = np.zeros((68, 2))
            frames[name, k] = Frame(image.astype(np.float32), everywhere, ~everywhere, marks, np.zeros(68, bool))
    return MemoryCapture(cameras, frames, start.vertices, start.rotation, start.identity)


def shut_line(model, gap):
    """Nearer to the lower lid, as of an eye whose upper lid came down."""
    return 0.3 * gap.upper + 0.7 * gap.lower


@pytest.fixture(scope="module")
def squinting(model, start):
    """Lids that are some 6 mm apart, as detectors leave those of a closed eye."""
    blink = [k for k, name in enumerate(model.expression_names) if "blink" in name.lower()]
    expression = np.zeros((2, model.n_expression))
    expression[:, blink] = 0.6
    shapes = np.stack([model.shape(start.identity, x) for x in expression]).astype(np.float64)
    vertices = (shapes @ start.rotation.transpose(0, 2, 1)).astype(np.float32)
    return replace(start, expression=expression, vertices=vertices)


@pytest.fixture(scope="module")
def shut(model, squinting):
    return close_openings(eyed(model, squinting, ("shut", "shut")), model, squinting, BOTH, LIDS)


@pytest.mark.parametrize("opening", LIDS, ids=lambda opening: opening.name)
def test_lids_close_on_the_line(model, squinting, shut, opening):
    found, details = shut
    assert details[opening.name]["closed"] == [0, 1]
    for k in range(2):
        before, after = (gap_of(model, g, k, opening.marks) for g in (squinting, found))
        assert 4.0 < before.height(model.unit_mm) < opening.widest_mm
        assert np.abs((after.upper - after.lower)[:, 1]).max() * model.unit_mm < 0.3
        off = (after.middle - shut_line(model, before))[:, 1] * model.unit_mm
        assert np.abs(off[6:-6]).max() < 0.3


def test_lids_take_their_rims_along_and_leave_the_rest(model, squinting, shut):
    """The rims, which end in the mesh's border, stay behind the lids instead of showing through them."""
    facial = model.faces[model.face_mask]
    before, after = (face_cross(g.vertices[0], facial) for g in (squinting, shut[0]))
    assert ((before * after).sum(1) > 0).all()
    near = np.setdiff1d(np.flatnonzero(np.linalg.norm(shut[0].vertices - squinting.vertices, axis=2)[0] > 0.01), facial)
    assert len(near) > 20
    marks = np.r_[model.landmarks[:36], model.landmarks[48:]]
    assert np.linalg.norm(shut[0].vertices[:, marks] - squinting.vertices[:, marks], axis=2).max() < 0.02
    skin = without_eyes(model).faces
    less, more = (intersections(10.0 * g.vertices[0], skin) for g in (squinting, shut[0]))
    assert len(more) <= len(less)


@pytest.mark.parametrize("what", ["white", "iris", "nothing", "shut white", "white shut"])
def test_an_eye_not_seen_shut_is_left_alone(model, squinting, what):
    """Nor is one whose fellow is open: what looks like a closed one is a blurred one more often than a wink."""
    found, details = close_openings(eyed(model, squinting, (what, what)), model, squinting, BOTH, LIDS)
    assert all(details[opening.name]["closed"] == [] for opening in LIDS) and found is squinting


def test_a_blink_leaves_the_eyes_of_other_timesteps_open(model, squinting):
    found, details = close_openings(eyed(model, squinting, ("shut", "white")), model, squinting, BOTH, LIDS)
    assert details["left eye"]["closed"] == [0]
    for opening in LIDS:
        gaps = [gap_of(model, g, k, opening.marks).height(model.unit_mm) for g in (squinting, found) for k in (0, 1)]
        assert abs(gaps[2]) < 1.2 and gaps[3] > 0.7 * gaps[1]


def raised(model, found, opening, height_mm):
    """A fit whose upper lid has been moved up."""
    margins = Margins.of(model, opening.marks)
    movement = np.zeros_like(model.mean)
    movement[np.setdiff1d(margins.upper, margins.lower)] = (0.0, height_mm / model.unit_mm, 0.0)
    return moved_by(model, found, movement)


def test_margins_that_have_moved_are_put_together_again(model, shut):
    found, details = shut
    apart = found
    for opening in LIDS:
        apart = raised(model, apart, opening, 1.0)
    again = close_again(model, apart, details, LIDS)
    for opening in LIDS:
        closed, moved, after = (gap_of(model, g, 0, opening.marks) for g in (found, apart, again))
        assert moved.height(model.unit_mm) > 0.9 and abs(after.height(model.unit_mm)) < 0.1
        rise = np.median((after.middle - closed.middle)[:, 1]) * model.unit_mm
        assert rise == pytest.approx(0.5, abs=0.1)
    assert close_again(model, apart, {name: {"closed": []} for name in details}, LIDS) is apart


def test_added_eyes_follow_the_lids(model, squinting):
    """What closes the corners of added eyes touches the lids' rims, though no edge joins them."""
    bare = without_eyes(model)
    whole = with_eyes(bare)
    shapes = np.stack([whole.shape(squinting.identity, x) for x in squinting.expression]).astype(np.float64)
    vertices = (shapes @ squinting.rotation.transpose(0, 2, 1)).astype(np.float32)
    start = replace(squinting, vertices=vertices, vertex_albedo=whole.mean_albedo)
    found, _ = close_openings(eyed(whole, start, ("shut", "shut")), whole, start, BOTH, LIDS)
    skin = np.unique(whole.faces[: len(bare.faces)])
    away, nearest = cKDTree(whole.mean[skin]).query(whole.mean[bare.n_vertices :])
    touching = np.flatnonzero(away * model.unit_mm < 0.1)
    moved = (found.vertices - start.vertices)[0]
    rim = skin[nearest[touching]]
    assert np.linalg.norm(moved[rim], axis=1).max() * model.unit_mm > 2.0
    np.testing.assert_allclose(moved[bare.n_vertices + touching], moved[rim], atol=0.02)


def test_lips_and_lids_are_left_alone_on_request(model, start, monkeypatch):
    """What shows no texture leaves the surface where it is, so that nothing but these can move."""
    capture = photographed(model, start, ("closed", "closed"))
    asked = []
    monkeypatch.setattr(stage, "close_openings", lambda *given: asked.append(given[4]) or (given[2], {}))
    for lips in (False, True):
        config = SurfaceConfig(finest=4, close_lips=lips, close_lids=not lips)
        stage.find_surface(capture, model, start, BOTH, config)
        assert asked[-2:] == ([(), LIPS] if lips else [LIDS, ()])
