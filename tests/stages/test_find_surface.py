"""Stage 1b: a surface beyond the model's span is found; where nothing asks for it the surface stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp
from memory_capture import make_capture
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mifit.config import GeometryConfig, SurfaceConfig
from mifit.core.camera import Camera
from mifit.core.mesh import vertex_normals
from mifit.core.uv import rasterize_uv
from mifit.morphable import MorphableModel
from mifit.morphable.openings import skin_weights, with_eyes
from mifit.render.gbuffer import SurfaceScene
from mifit.stages.eyes import eyeballs
from mifit.stages.find_surface import Skin, State, find_surface, neighbours
from mifit.stages.fit_geometry import fit_geometry, fit_pose_expression
from mifit.stages.geometry.parameters import exponential
from mifit.stages.geometry.surfaces import Scenes, displaced
from mifit.stages.surface.band import FeatureImage
from mifit.stages.surface.displace import THINNEST, Measurements, SurfacePrior, Walls, solve_surface
from mifit.stages.surface.outline import joined
from mifit.stages.surface.sweep import GLARE_DEVIATIONS, SAME, Posed, _precision, _Sweep, _without_glare, match
from mifit.stages.surface.views import pose_texels, shows_surface
from tests.morphable.intersections import intersections
from tests.test_pipeline import without_eyes

QUICK = GeometryConfig(pixels=400, max_iterations=15)
COARSE = SurfaceConfig(finest=1)
"""A quarter of the pixels, where a tenth of a millimetre doesn't matter."""
BOTH = ("left", "right")
STEPS = (0, 1)


@pytest.fixture(scope="module")
def model(variant):
    return MorphableModel.load("builtin:coarse").subset(identity=30, expression=20, albedo=10)


def bumps(model):
    """Displacements of 2 mm along the normals of cheeks, brow and chin, model units: too narrow for its modes."""
    mean, marks = model.mean, model.mean[model.landmarks]
    normal = vertex_normals(mean, model.faces)
    out = np.zeros_like(mean)
    centres = (marks[[36, 48, 2]].mean(0), marks[[45, 54, 14]].mean(0), marks[[21, 22]].mean(0), marks[[8, 57]].mean(0))
    for centre, height in zip(centres, (0.2, -0.2, 0.15, 0.15), strict=True):
        near = np.linalg.norm((mean - centre)[:, :2], axis=1)
        out += np.where(mean[:, 2:] > 0, height * np.exp(-((near / 1.1) ** 2))[:, None] * normal, 0.0)
    return out.astype(np.float32)


def captured(model, displacement, **options):
    """A capture of the displaced model."""
    return make_capture(replace(model, mean=model.mean + displacement), [(0, 0, 0), (-6, 10, 3)], **options)


def fitted_to(model, capture, timesteps=STEPS):
    return fit_geometry(capture, model, BOTH, timesteps, QUICK)


def seen_vertices(model, capture):
    """Vertices of the face area that face both cameras at the first timestep."""
    vertices = capture.vertices[0]
    normal = vertex_normals(vertices, model.faces)
    facial = np.zeros(len(vertices), bool)
    facial[model.faces[model.face_mask]] = True
    for name in BOTH:
        towards = capture.camera(name).position - vertices
        facial &= (towards * normal).sum(1) > 0.5 * np.linalg.norm(towards, axis=1)
    return np.flatnonzero(facial)


def off_mm(model, capture, estimate):
    """Distance of the estimate along the true normals at the seen vertices, first timestep, in mm."""
    normal = vertex_normals(capture.vertices[0], model.faces)
    rows = seen_vertices(model, capture)
    return 10.0 * np.abs(((estimate.vertices[0] - capture.vertices[0]) * normal).sum(1))[rows]


@pytest.fixture(scope="module")
def bumpy(model):
    return captured(model, bumps(model), width=510, height=360)


@pytest.fixture(scope="module")
def start(model, bumpy):
    return fitted_to(model, bumpy)


@pytest.fixture(scope="module")
def first(start):
    """The start at its first timestep, where one is enough."""
    return start.at(STEPS[:1])


@pytest.fixture(scope="module")
def found(model, bumpy, start):
    return find_surface(bumpy, model, start, BOTH)


def test_a_surface_beyond_the_span_is_found(model, bumpy, start, found):
    before, after = off_mm(model, bumpy, start), off_mm(model, bumpy, found)
    assert after.mean() < 0.6 * before.mean()
    assert np.median(after) < 0.3


def test_added_eyes_go_along_with_the_skin_and_leave_it_alone(model, bumpy, monkeypatch):
    """Slivers of other pieces once made the skin less stiff: their bending counted as the skin's."""
    skin = without_eyes(model)
    whole, n = with_eyes(skin), skin.n_vertices
    found = find_surface(bumpy, skin, fitted_to(skin, bumpy, STEPS[:1]), BOTH, COARSE)
    met = []
    monkeypatch.setattr(
        "mifit.stages.find_surface.Scenes", lambda faces, *rest: met.append(faces) or Scenes(faces, *rest)
    )
    eyed = find_surface(bumpy, whole, fitted_to(whole, bumpy, STEPS[:1]), BOTH, COARSE)
    assert met[0].max() < n  # what balls mirror isn't matched at the lids
    moved = eyed.displacement
    for ball in eyeballs(whole):
        np.testing.assert_allclose(moved[ball] - moved[ball[0]], 0.0, atol=1e-6)
    assert np.abs(moved[n:]).max() > 0.005
    balls = np.concatenate(eyeballs(whole))
    np.testing.assert_allclose(moved[balls], (skin_weights(whole) @ moved[:n])[balls], atol=1e-6)
    bare, whole_face = (np.linalg.norm(g.displacement[:n], axis=1).mean() for g in (found, eyed))
    assert 0.7 < whole_face / bare < 1.4


def covered_wrongly(model, capture, estimate):
    """Pixels of both views beside the face that our head covers and the true one doesn't, or the reverse."""
    wrong = 0
    for name in BOTH:
        camera, marks = capture.camera(name), capture.frame(name, 0).landmarks
        ours, true = (
            SurfaceScene(vertices.astype(np.float64), model.faces).gbuffer(camera).mask
            for vertices in (estimate.vertices[0], capture.vertices[0])
        )
        rows = slice(int(marks[17:27, 1].max()), int(marks[8, 1]))
        wrong += int((ours[rows] != true[rows]).sum())
    return wrong


def test_outlines_follow_the_images(model, bumpy, first, monkeypatch):
    """A head fitted 2 mm too narrow: matching alone doesn't see what turns away from both views."""
    inwards = -0.2 * vertex_normals(model.mean, model.faces)
    narrow = replace(model, mean=(model.mean + inwards).astype(np.float32))
    vertices = first.vertices + inwards @ first.rotation.transpose(0, 2, 1)
    fitted = replace(first, vertices=vertices.astype(np.float32))
    outlined = covered_wrongly(model, bumpy, find_surface(bumpy, narrow, fitted, BOTH, COARSE))
    monkeypatch.setattr("mifit.stages.find_surface.find_borders", lambda *_: joined([]))
    matched = covered_wrongly(model, bumpy, find_surface(bumpy, narrow, fitted, BOTH, COARSE))
    assert outlined < 0.1 * min(matched, covered_wrongly(model, bumpy, fitted))


def test_the_estimate_is_consistent_in_itself(model, found):
    carried = displaced(model, found)
    for k in range(len(STEPS)):
        shape = carried.shape(found.identity, found.expression[k])
        expected = found.scale * shape @ found.rotation[k].T + found.translation[k]
        np.testing.assert_allclose(found.vertices[k], expected, atol=1e-4)


def test_a_displacement_holds_no_rigid_motion(model, start):
    """What bends stays a displacement, what turns and shifts the face becomes its pose, and the surface is the same."""
    rng = np.random.default_rng(3)
    turn = Rotation.from_rotvec(np.radians([0.4, -0.6, 0.3])).as_matrix()
    state = State.of(model, start)
    shapes = model.shape(state.identity, state.expression.mean(axis=0)).astype(np.float64)
    bent = shapes + 0.02 * rng.normal(size=shapes.shape)
    off = replace(state, displacement=bent @ turn.T + (0.1, 0.0, -0.2) - shapes)
    skin = Skin.of(model)
    found, own = off.without_motion(model, skin), slice(skin.count)
    assert np.abs(found.displacement[own]).max() < 0.15 < np.abs(off.displacement[own]).max()
    assert np.degrees(Rotation.from_matrix(found.rotation[0].T @ state.rotation[0] @ turn).magnitude()) < 0.05
    np.testing.assert_allclose(
        found.world(model)[:, own], off.world(model)[:, own], atol=0.01
    )  # cm: expressions differ a little


def test_the_skin_does_not_intersect_itself(model, bumpy, first):
    """But for the insides of the lips: they touch behind the edge, and rounding says whether two faces cross there."""
    found = find_surface(bumpy, model, first, BOTH, replace(COARSE, close_lips=False))
    lips = cKDTree(model.mean[model.landmarks[60:68]]).query(model.mean)[0] < 10.0 / model.unit_mm
    left_out = np.union1d(np.concatenate(eyeballs(model)), np.flatnonzero(lips))
    skin = model.faces[~np.isin(model.faces, left_out).any(1)]
    before, after = (intersections(10.0 * g.vertices[0], skin) for g in (first, found))
    assert len(after) <= len(before)


def test_a_head_that_the_model_spans_stays_right(model):
    capture = captured(model, np.zeros_like(model.mean), width=510, height=360)
    start = fitted_to(model, capture, STEPS[:1])
    found = find_surface(capture, model, start, BOTH)
    assert off_mm(model, capture, found).mean() < max(off_mm(model, capture, start).mean(), 0.15)


def test_where_nothing_is_seen_the_surface_stays(model, bumpy, first):
    blank = bumpy.changed(lambda name, t, frame: replace(frame, image=np.full_like(frame.image, 0.3)))
    found = find_surface(blank, model, first, BOTH)
    np.testing.assert_allclose(found.vertices, first.vertices, atol=1e-3)


def test_one_view_says_so(model, bumpy, start):
    found = find_surface(bumpy, model, start, ("left",))
    assert found.displacement is None and any("one view" in w.text for w in found.report.warnings)
    np.testing.assert_array_equal(found.vertices, start.vertices)


def test_tracking_moves_the_displaced_surface(model, bumpy, found):
    tracked = fit_pose_expression(bumpy, model, found.at((0,)), BOTH, 1, QUICK)
    np.testing.assert_array_equal(tracked.displacement, found.displacement)
    shape = displaced(model, tracked).shape(tracked.identity, tracked.expression[0])
    expected = tracked.scale * shape @ tracked.rotation[0].T + tracked.translation[0]
    np.testing.assert_allclose(tracked.vertices[0], expected, atol=1e-4)


def test_the_solution_is_the_minimum(model):
    """Conjugate gradients on the coupled system against a dense solution of the same energy."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0), indexing="ij"), axis=-1).reshape(-1, 2)
    vertices = np.column_stack([grid, 0.2 * rng.normal(size=36)])
    quads = [(6 * i + j, 6 * i + j + 6, 6 * i + j + 7, 6 * i + j + 1) for i in range(5) for j in range(5)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    modes = rng.normal(size=(36, 3, 5))
    prior = SurfacePrior.of(vertices, faces, modes, longest=10.0)
    points = sp.csr_matrix(rng.dirichlet(np.ones(36), size=80))
    normals = rng.normal(size=(80, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets, precision = rng.normal(size=80), rng.uniform(0.5, 2.0, 80)
    displacement, coefficients, moved = np.zeros((36, 3)), np.zeros(5), np.zeros(80)
    free = np.tile([-np.inf, np.inf], (5, 1))
    for _ in range(60):  # conjugate gradients go on from where they ended
        measured = Measurements(points, normals, offsets - moved, precision, np.full((80, 1), 1e9))
        surface = prior.move(coefficients) + displacement
        displacement, coefficients = solve_surface(prior, measured, surface, free, 0.5)
        moved = ((points @ (prior.move(coefficients) + displacement)) * normals).sum(1)
    rows = np.einsum("nv,nc->nvc", points.toarray(), normals).reshape(80, -1)
    plate = np.kron(0.5 * prior.plate.toarray(), np.eye(3))
    both = np.concatenate([rows @ prior.modes, rows], axis=1)  # of m and d
    matrix = both.T @ (precision[:, None] * both) + la.block_diag(np.eye(5), plate)
    expected = np.linalg.solve(matrix, both.T @ (precision * offsets))
    np.testing.assert_allclose(coefficients, expected[:5], atol=0.02 * np.abs(expected[:5]).max())
    got, wanted = moved, both @ expected
    np.testing.assert_allclose(got, wanted, atol=0.02 * np.abs(wanted).max())


def test_what_the_modes_explain_is_left_to_them():
    """Bumps in the span of the modes: the coefficients find them, and the displacement what is beyond."""
    side = 25
    across, up = (v.ravel() for v in np.meshgrid(*[np.arange(float(side))] * 2, indexing="ij"))
    corner = (side * np.arange(side - 1)[:, None] + np.arange(side - 1)).ravel()
    faces = np.concatenate([corner[:, None] + (0, side, side + 1), corner[:, None] + (0, side + 1, 1)])
    grid = np.column_stack([across, up, np.zeros(side * side)])
    bumps = [np.exp(-0.5 * ((across - x) ** 2 + (up - y) ** 2) / 9.0) for x, y in ((6, 6), (18, 6), (6, 18), (18, 18))]
    modes = np.zeros((len(grid), 3, 3))
    modes[:, 2] = np.stack(bumps[:3], axis=1)
    prior = SurfacePrior.of(grid, faces, modes, longest=200.0)
    normals, points = np.tile([0.0, 0.0, 1.0], (len(grid), 1)), sp.identity(len(grid), format="csr")
    height = np.stack(bumps, axis=1) @ (1.5, -1.0, 0.5, 1.0)
    true = np.zeros((len(grid), 3))
    true[:, 2] = height

    def swept(bounds):
        now = np.zeros((len(grid), 3))
        for _ in range(5):
            far = np.full((len(grid), 1), 1e9)
            measured = Measurements(points, normals, height - now[:, 2], np.full(len(grid), 100.0), far)
            displacement, coefficients = solve_surface(prior, measured, now, bounds, 8.0)
            now = prior.move(coefficients) + displacement
        return displacement, coefficients, now

    bounds = np.tile([-np.inf, np.inf], (3, 1))
    displacement, coefficients, _ = swept(bounds)
    # The prior of unit deviation shrinks them.
    best = np.linalg.solve(8.0 * prior.gram + np.eye(3), 8.0 * prior.bent.T @ true.ravel())
    np.testing.assert_allclose(coefficients, best, atol=0.02)
    assert (np.abs(best - (1.5, -1.0, 0.5)) < 0.2).all()
    beyond = true[:, 2] - prior.move(best)[:, 2]
    np.testing.assert_allclose(displacement[:, 2], beyond, atol=0.05)

    # A mode that would leave its bounds stays at them, and the displacement takes the rest.
    bounds[0, 1] = 1.0
    displacement, coefficients, now = swept(bounds)
    assert coefficients[0] == 1.0 and displacement[:, 2] @ bumps[0] > 0.3 * bumps[0] @ bumps[0]
    np.testing.assert_allclose(now[:, 2], height, atol=0.1)


def test_a_highlight_that_one_view_shows_counts_little_and_exposure_nothing():
    rng = np.random.default_rng(5)
    difference = 0.4 + 0.01 * rng.normal(size=1000)
    difference[:50] += 0.6
    weight = _without_glare(difference, GLARE_DEVIATIONS)
    assert weight[:50].max() < 0.05 and weight[50:].min() > 0.5 and np.median(weight) > 0.9


def test_offsets_that_scatter_and_lone_matches_are_less_precise_by_scatter():
    """Three bands of a square: even offsets, offsets anywhere, and even ones of which a tenth matched."""
    size = 60
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
    texels = rasterize_uv(corners, np.array([[0, 1, 2], [0, 2, 3]]), size)
    rng = np.random.default_rng(2)
    band = np.minimum(texels.index // size // 20, 2)
    steps = np.where(band == 1, rng.uniform(-3.0, 3.0, len(band)), 0.5).astype(np.float32)
    matched = (band < 2) | (rng.uniform(size=len(band)) < 0.1)
    precision = _precision(texels, np.where(matched, steps, np.float32(0.0)), matched, np.zeros(len(band)), 1.0)
    assert (precision[~matched] == 0).all() and (precision[matched] > 0).all()
    even, anywhere, lone = (np.median(precision[matched & (band == b)]) for b in range(3))
    assert even > 15 * anywhere and even > 15 * lone


def test_a_wall_keeps_a_part_of_its_thickness():
    """Views see one side of a sheet of a quarter's thickness and move it beyond the other, which follows."""
    across = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    quads = [(6 * i + j, 6 * i + j + 6, 6 * i + j + 7, 6 * i + j + 1) for i in range(5) for j in range(5)]
    up = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    vertices, faces = (
        np.concatenate([across + np.array([0.0, 0.0, 0.25]), across]),
        np.concatenate([up, up[:, ::-1] + 36]),
    )
    prior, walls = SurfacePrior.of(vertices, faces, np.zeros((72, 3, 1)), longest=10.0), Walls.of(vertices, faces, 0.5)
    assert len(walls.least) == 72 and not Walls.of(vertices, faces, 0.2).least.size
    assert not walls.at(vertices).precision.any()
    points = sp.identity(72, format="csr")[:36]
    normal, ones = np.tile([0.0, 0.0, 1.0], (36, 1)), np.ones(36)

    def thickness(with_walls: bool) -> np.ndarray:
        moved = np.zeros((72, 3))
        for _ in range(3):
            seen = Measurements(points, normal, -1.0 - moved[:36, 2], 100.0 * ones, np.full((36, 1), 1e9))
            rows = seen.with_others(walls.at(vertices + moved)) if with_walls else seen
            moved, _ = solve_surface(prior, rows, moved, np.array([[-np.inf, np.inf]]), 0.1)
        np.testing.assert_allclose(moved[:36, 2], -1.0, atol=0.1)
        return (vertices + moved)[:36, 2] - (vertices + moved)[36:, 2]

    assert thickness(False).max() < -0.5
    assert thickness(True).min() > 0.5 * THINNEST * 0.25


def test_an_outlier_counts_little():
    """A point twice the distance at which the penalty turns has a twenty-fifth of its weight."""
    grid = np.stack(np.meshgrid(np.arange(6.0), np.arange(6.0), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    quads = [(6 * i + j, 6 * i + j + 6, 6 * i + j + 7, 6 * i + j + 1) for i in range(5) for j in range(5)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    prior = SurfacePrior.of(grid, faces, np.zeros((36, 3, 1)), longest=10.0)
    up, points = np.tile([0.0, 0.0, 1.0], (36, 1)), sp.identity(36, format="csr")
    offsets = np.zeros(36)
    offsets[14] = 2.0
    heights = [
        solve_surface(
            prior,
            Measurements(points, up, offsets, np.ones(36), np.full((36, 1), turn)),
            np.zeros((36, 3)),
            np.array([[-np.inf, np.inf]]),
            1.0,
        )[0][14, 2]
        for turn in (1e9, 1.0)
    ]
    assert 0 < heights[1] < 0.1 * heights[0]


def test_biased_landmarks_bend_the_shape_less(model, bumpy):
    """Landmarks that are off the same way in every image: the surface that all views see sets them right."""
    before = after = 0.0
    for seed in (5, 6):  # the result of one set hangs on single landmarks
        offset = 6.0 * np.random.default_rng(seed).normal(size=(68, 2))
        biased = bumpy.changed(lambda name, t, frame, by=offset: replace(frame, landmarks=frame.landmarks + by))
        start = fitted_to(model, biased, STEPS[:1])
        before += off_mm(model, bumpy, start).mean()
        after += off_mm(model, bumpy, find_surface(biased, model, start, BOTH, COARSE)).mean()
    assert after < 0.3 * before


def test_expressions_stay_within_their_bounds(model, found):
    low, high = model.expression_bounds.T
    assert np.isfinite(low).any()
    assert (found.expression >= low - 1e-6).all() and (found.expression <= high + 1e-6).all()


@pytest.mark.parametrize("pair", [((0, 0), (0, 1)), ((0, 0), (1, 0)), ((0, 1), (1, 0))])
def test_a_known_offset_is_found_between_views_and_over_time(model, bumpy, pair):
    """The true surface, moved outwards by 1.5 mm: views of one timestep, or of two, tell by how much."""
    texels = rasterize_uv(model.uv, model.faces_uv, 240, model.face_mask)
    cells = rasterize_uv(model.uv, model.faces_uv, 120, model.face_mask)
    steps = []
    for timestep, vertices in enumerate(bumpy.vertices):
        moved = vertices + 0.15 * vertex_normals(vertices, model.faces)
        scene = SurfaceScene(moved, model.faces)
        steps.append(pose_texels(bumpy, scene, moved, model.faces, texels, BOTH, timestep, 1.0))
    found = match(texels, cells, steps, bumpy.rotation, 0.06, [pair])
    good = found.precision > np.quantile(found.precision[found.precision > 0], 0.5)
    assert good.sum() > 200
    assert np.median(found.offset[good]) == pytest.approx(-0.15, abs=0.02)


def test_features_of_the_face_know_nothing_of_the_background(model, bumpy):
    """Timesteps are aligned by them: a background that stays would hold a head that moves."""
    texels = rasterize_uv(model.uv, model.faces_uv, 240, model.face_mask)
    vertices = bumpy.vertices[0]
    scene = SurfaceScene(vertices, model.faces)

    def lit(name, _, frame):
        behind = ~scene.gbuffer(bumpy.camera(name)).mask[..., None]
        return replace(frame, image=np.where(behind, np.float32(5.0), frame.image))

    for factor in (1.0, 0.5):
        features = [
            np.stack([image.sample(at.position) for image in at.images])[..., :2]
            for capture in (bumpy, bumpy.changed(lit))
            for at in [pose_texels(capture, scene, vertices, model.faces, texels, BOTH, 0, factor)]
        ]
        assert features[0][..., 1].mean() > 0.5
        np.testing.assert_allclose(*features, atol=1e-5)


def test_a_surface_is_left_out_at_its_outline_but_not_where_it_hides_itself(variant):
    """A nose that is too small grows only if what shows beyond its own outline is compared."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    near, far = (np.column_stack([half * square, np.full(4, depth)]) for half, depth in ((0.25, 1.0), (1.0, 2.0)))
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    scene = SurfaceScene(np.concatenate([near, far]), np.concatenate([faces, faces + 4]))
    camera = Camera("ahead", 64, 64, 48.0, 48.0, 32.0, 32.0, np.eye(4))  # the far one covers 24 pixels to each side
    shown = shows_surface(scene, camera)
    assert shown[32, 12:52].all()
    assert not shown[32, :9].any() and not shown[32, 55:].any()


def test_what_one_view_alone_shows_changes_nothing_in_the_comparison():
    """A bright cheek that each view sees on its own side of a nose: on the nose both show the same."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
    texels = rasterize_uv(corners, np.array([[0, 1, 2], [0, 2, 3]]), 64)
    row, column = np.divmod(texels.index, 64)
    camera = Camera("ahead", 64, 64, 64.0, 64.0, 32.0, 32.0, np.eye(4))
    at = np.stack([(column + 0.5) / 64 - 0.5, (row + 0.5) / 64 - 0.5, np.ones(len(row))], axis=1)
    nose = 0.1 * np.random.default_rng(0).standard_normal((64, 64)).astype(np.float32)
    images, seen = [], np.ones((2, len(row)), np.float32)
    for view, (own, hidden) in enumerate([(column < 24, column >= 40), (column >= 40, column < 24)]):
        log = nose + np.float32(2.0) * texels.to_map(own.astype(np.float32))
        images.append(FeatureImage(camera, 1.0, np.stack([log, np.ones_like(log), log], axis=-1)))
        seen[view, hidden] = 0.0
    posed = Posed(at, np.tile([0.0, 0.0, -1.0], (len(at), 1)), images, seen)
    sweep = _Sweep.of(texels, (posed, 0), (posed, 1), np.eye(3), 0.1)
    assert set(column[sweep.texel]) == set(range(24, 40))
    unlike, darker = sweep.compare(0.0)
    assert unlike.max() < np.log(SAME)
    np.testing.assert_allclose(darker, 0.0, atol=1e-3)


def test_matches_off_the_epipolar_line_count_little(model, bumpy):
    """One camera turned by three pixels: what is found scatters, and is hardly trusted."""
    texels = rasterize_uv(model.uv, model.faces_uv, 240, model.face_mask)
    cells = rasterize_uv(model.uv, model.faces_uv, 120, model.face_mask)
    vertices, right = bumpy.vertices[0], bumpy.camera("right")
    turn = np.eye(4)
    turn[:3, :3] = exponential(np.array([3.0 / right.fy, 0.0, 0.0]))
    turned = replace(right, world_to_camera=turn @ right.world_to_camera)
    off = replace(bumpy, cameras_by_name={**bumpy.cameras_by_name, "right": turned})
    scene, trust = SurfaceScene(vertices, model.faces), []
    for capture in (bumpy, off):
        step = pose_texels(capture, scene, vertices, model.faces, texels, BOTH, 0, 1.0)
        found = match(texels, cells, [step], bumpy.rotation[:1], 0.06, [((0, 0), (0, 1))])
        trust.append(found.precision.sum())
    assert trust[1] < 0.1 * trust[0]


def test_the_report_says_whether_the_surface_rests(model, bumpy, first, found, monkeypatch):
    phase = found.report.details["phases"][-1]
    assert phase["outcome"] == "converged" and phase["levels"] == sorted(phase["levels"], reverse=True)
    assert set(phase["levels"]) == set(range(max(phase["levels"]) + 1))
    monkeypatch.setattr("mifit.stages.find_surface.SETTLED", 1e-9)  # never
    restless = find_surface(bumpy, model, first, BOTH, SurfaceConfig(finest=2)).report.details["phases"][-1]
    assert restless["levels"] == [2, 2, 2] and restless["outcome"] == "max_iterations"


def test_views_are_compared_with_their_neighbours():
    def camera(degrees):
        turn = np.radians(degrees)
        pose = np.eye(4)
        pose[:3, 3] = -np.array([50.0 * np.sin(turn), 0.0, 50.0 * np.cos(turn)])
        return Camera(str(degrees), 64, 64, 100.0, 100.0, 32.0, 32.0, pose)

    def pairs(*degrees):
        return neighbours([camera(d) for d in degrees], np.zeros(3))

    assert pairs(0) == [] and pairs(0, 40) == [(0, 1)] and pairs(0, 30, 70) == [(0, 1), (0, 2), (1, 2)]
    assert pairs(*range(0, 175, 25)) == [(0, 1), (0, 2), (1, 2), (2, 3), (3, 4), (4, 5), (4, 6), (5, 6)]


def test_a_camera_off_its_calibration_is_told_by_the_epipolar_lines(model, bumpy, first, found):
    """Turned by 3 pixels of its image, half of which the surface can't follow."""
    assert found.report.details["phases"][-1]["epipolar_pixels"]["left, right"] < 0.3
    assert not any("epipolar" in one.text for one in found.report.warnings)
    right = bumpy.camera("right")
    turn = np.eye(4)
    turn[:3, :3] = exponential(np.array([3.0 / right.fy, 0.0, 0.0]))
    turned = replace(right, world_to_camera=turn @ right.world_to_camera)
    off = replace(bumpy, cameras_by_name={**bumpy.cameras_by_name, "right": turned})
    told = find_surface(off, model, first, BOTH, COARSE)
    assert 2.5 < told.report.details["phases"][-1]["epipolar_pixels"]["left, right"] < 3.5
    assert any("epipolar" in one.text for one in told.report.warnings)
