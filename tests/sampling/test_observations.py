"""Observations: colours, weights and visibility against a scene whose answer is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mifit.core.camera import Camera
from mifit.core.estimate import GeometryEstimate, Report
from mifit.errors import InputError

SIZE = 16


@dataclass(frozen=True)
class Quad:
    """As much of a morphable model as the observations need: a square facing +z, 2 units wide."""

    name: str = "quad"
    faces: np.ndarray = None
    uv: np.ndarray = None
    faces_uv: np.ndarray = None
    face_mask: np.ndarray = None
    unit_mm: float = 10.0


@dataclass(frozen=True)
class FakeFrame:
    image: np.ndarray
    valid: np.ndarray
    clipped: np.ndarray


class FakeCapture:
    def __init__(self, cameras, images):
        self._cameras, self._images = cameras, images
        self.read = set()

    def camera(self, name):
        return self._cameras[name]

    def frame(self, name, timestep):
        self.read.add(name)
        return self._images[name]


VERTICES = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32)


def quad(mask=(True, True)):
    faces = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    return Quad("quad", faces, uv, faces, np.array(mask))


def geometry(vertices=VERTICES):
    return GeometryEstimate(
        (0,),
        np.zeros(1),
        np.zeros(1),
        np.zeros((1, 1)),
        np.eye(3)[None],
        np.zeros((1, 3)),
        1.0,
        np.asarray(vertices)[None],
        np.full((len(vertices), 3), 0.4, np.float32),
        np.zeros((9, 3)),
        0.0,
        Report("converged"),
    )


def camera(angle=0.0, name="left", distance=4.0):
    """Looks at the origin from ``angle`` radians about the vertical axis; the square is 32 pixels wide head on."""
    eye = distance * np.array([np.sin(angle), 0.0, np.cos(angle)])
    z = -eye / distance
    x = np.cross([0.0, -1.0, 0.0], z)
    rotation = np.stack([x, np.cross(z, x), z])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return Camera(name, 48, 48, 16 * distance, 16 * distance, 24.0, 24.0, pose)


def ramp():
    """Colours linear in the pixel, so that bilinear reading is exact."""
    y, x = np.mgrid[0:48, 0:48] + 0.5
    return np.stack([x / 100, y / 100, (x + y) / 200], axis=-1).astype(np.float32)


def capture(angles=(0.0,), image=None, valid=None, clipped=None, distance=4.0):
    names = ["left", "right", "third"][: len(angles)]
    image = ramp() if image is None else image
    frame = FakeFrame(
        image,
        np.ones(image.shape[:2], bool) if valid is None else valid,
        np.zeros(image.shape[:2], bool) if clipped is None else clipped,
    )
    return FakeCapture(
        {n: camera(a, n, distance) for n, a in zip(names, angles, strict=True)}, dict.fromkeys(names, frame)
    )


def observe(shot, model=None, cameras=("left",), geo=None, robust=False):
    from mifit.sampling.observations import Surface

    surface = Surface(shot, model or quad(), geo or geometry(), cameras, SIZE, robust)
    return surface, surface.observe(np.arange(len(surface)))


def test_colours_are_those_of_the_projected_points(variant):
    _, seen = observe(capture())
    inside = seen.weight[:, 0] > 0
    assert inside.mean() > 0.7
    pixel = camera().project(seen.point[:, 0].astype(float))
    expected = np.stack([pixel[:, 0] / 100, pixel[:, 1] / 100, pixel.sum(1) / 200], axis=-1)
    np.testing.assert_allclose(seen.colour[inside, 0], expected[inside], atol=1e-5)
    # Row 0 of a map is v = 1: the first texels lie at the top, where the image's rows are small.
    assert seen.point[0, 0, 1] > 0.9 and pixel[0, 1] < 10


def test_weights_count_pixels(variant):
    _, seen = observe(capture())
    full = seen.weight[seen.weight > 0]
    np.testing.assert_allclose(full, (32 / SIZE) ** 2, rtol=0.02)  # 32 pixels over 16 texels


def test_oblique_views_weigh_less_and_see_along_the_right_direction(variant):
    far = 100.0  # so far that perspective plays no part
    _, seen = observe(capture((0.0, 0.7), distance=far), cameras=("left", "right"))
    both = (seen.weight > 0).all(1)
    ratio = seen.weight[both, 1] / seen.weight[both, 0]
    np.testing.assert_allclose(ratio, np.cos(0.7), rtol=0.03)
    assert both.mean() > 0.5
    toward = camera(0.7, distance=far).position - seen.point[:, 0]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    np.testing.assert_allclose(seen.view[:, 1], toward, atol=1e-5)


def test_grazing_views_and_what_lies_near_the_outline_count_for_less(variant):
    image = np.full((48, 48, 3), 0.5, np.float32)
    photo = capture((0.0, 1.2), image)
    _, plain = observe(photo, cameras=("left", "right"))
    surface, seen = observe(photo, cameras=("left", "right"), robust=True)
    both = (plain.weight > 0).all(1)
    assert both.sum() > 50
    assert (seen.weight[both, 1] < 0.85 * plain.weight[both, 1]).all()
    inside = both & (np.abs(seen.point[:, 0, :2]) < 0.5).all(-1)
    assert (seen.weight[inside, 0] > 0.9 * plain.weight[inside, 0]).all()
    edge, middle = (np.linalg.norm(seen.point[:, 0, :2] - (x, 0), axis=1).argmin() for x in (-0.8, 0.0))
    assert surface.quality()[edge] < surface.quality()[middle]


def test_pixels_left_out_are_read_as_if_they_had_never_been_there(variant):
    from mifit.sampling.observations import Surface

    shot, everywhere = capture((-0.2, 0.2)), np.arange(SIZE * SIZE)
    hidden = [np.zeros((48, 48), bool) for _ in range(2)]
    hidden[0][14:22, 20:30] = True
    fresh = Surface(shot, quad(), geometry(), ("left", "right"), SIZE).without(hidden)
    read = Surface(shot, quad(), geometry(), ("left", "right"), SIZE)
    before = read.observe(everywhere)
    after, expected = read.without(hidden).observe(everywhere), fresh.observe(everywhere)
    for name in ("colour", "weight", "clipped", "inlier"):
        np.testing.assert_array_equal(getattr(after, name), getattr(expected, name))
    assert ((before.weight > 0) & (after.weight == 0))[:, 0].any()
    np.testing.assert_array_equal(read.observe(everywhere).weight, before.weight)


def test_equal_meshes_are_made_and_their_shadows_traced_once(variant):
    from mifit.sampling.observations import Surface

    shot, model = capture(), quad()
    first, second = (Surface(shot, model, geometry(), ("left",), SIZE) for _ in range(2))
    assert second.meshes[0] is first.meshes[0]
    moved = Surface(shot, model, geometry(VERTICES + 0.1), ("left",), SIZE)
    assert moved.meshes[0] is not first.meshes[0]


def test_only_named_cameras_are_read(variant):
    shot = capture((-0.3, 0.3, 0.0))
    observe(shot, cameras=("left", "right"))
    assert shot.read == {"left", "right"}


def test_back_sides_invalid_and_non_finite_pixels_count_nothing(variant):
    _, behind = observe(capture((np.pi,)))
    assert (behind.weight == 0).all()
    image = ramp()
    image[:, :24] = np.nan
    _, seen = observe(capture(image=image))
    left = seen.point[:, 0, 0] < -0.1
    assert (seen.weight[left] == 0).all() and (seen.weight[seen.point[:, 0, 0] > 0.2] > 0).mean() > 0.7
    assert np.isfinite(seen.colour).all()
    valid = np.ones((48, 48), bool)
    valid[:24] = False
    _, seen = observe(capture(valid=valid))
    assert (seen.weight[seen.point[:, 0, 1] > 0.1] == 0).all()


def test_clipped_pixels_are_bounds_not_measurements(variant):
    clipped = np.zeros((48, 48), bool)
    clipped[:, 30:] = True
    _, seen = observe(capture(clipped=clipped))
    right = (seen.point[:, 0, 0] > 0.5) & (seen.weight[:, 0] > 0)
    assert right.any() and seen.clipped[right].all() and (seen.measured[right] == 0).all()


def test_an_occluder_hides_what_is_behind_it(variant):
    near = VERTICES * 0.4 + [0.0, 0.0, 1.0]
    model = quad((True, True, False, False))
    model = replace(
        model,
        faces=np.concatenate([model.faces, model.faces + 4]),
        faces_uv=np.concatenate([model.faces_uv, model.faces_uv]),
    )
    _, seen = observe(capture(), model, geo=geometry(np.concatenate([VERTICES, near]).astype(np.float32)))
    middle = np.abs(seen.point[:, 0, :2]).max(1) < 0.4
    rim = (np.abs(seen.point[:, 0, :2]).max(1) > 0.7) & (np.abs(seen.point[:, 0, :2]).max(1) < 0.85)
    assert (seen.weight[middle] == 0).all()
    assert (seen.weight[rim] > 0).mean() > 0.9


def test_nothing_to_observe_is_an_error_with_a_reason(variant):
    from mifit.sampling.observations import Surface

    with pytest.raises(InputError, match="0 cameras"):
        Surface(capture(), quad(), geometry(), [], SIZE)
    with pytest.raises(InputError, match="covers no texel"):
        Surface(capture(), quad((False, False)), geometry(), ["left"], SIZE)
    surface = Surface(capture((np.pi,)), quad(), geometry(), ["left"], SIZE)
    with pytest.raises(InputError, match="no image shows"):
        surface.sample(10, np.random.default_rng(0))


def test_the_outlines_reach_is_in_millimetres_whatever_the_pixels(variant):
    """Twice as many pixels of the same square see its edge with the same probability."""
    fine = replace(camera(), width=96, height=96, fx=128.0, fy=128.0, cx=48.0, cy=48.0)
    grey = capture(image=np.full((48, 48, 3), 0.5, np.float32))
    large = capture(image=np.full((96, 96, 3), 0.5, np.float32))
    large._cameras["left"] = fine
    model, beside = quad(), geometry(0.3 * VERTICES)  # 6 millimetres wide: all of it is near the outline
    share = []
    for shot in (grey, large):
        (_, plain), (_, seen) = (observe(shot, model, geo=beside, robust=robust) for robust in (False, True))
        middle = np.linalg.norm(plain.point[:, 0, :2], axis=1) < 0.1
        share.append((seen.weight[middle, 0] / plain.weight[middle, 0]).mean())
    assert 0.5 < share[0] < 0.95 and share[1] == pytest.approx(share[0], abs=0.04)


def test_quality_falls_with_the_cosine(variant):
    middle = [SIZE * SIZE // 2 + SIZE // 2 + k for k in (-1, 0)]
    found = [observe(capture((angle,), distance=100.0))[0].quality()[middle].mean() for angle in (0.0, 0.9)]
    assert found[0] == pytest.approx(1.0, abs=0.01) and found[1] == pytest.approx(np.cos(0.9), abs=0.03)
