"""What hides a face: painted over images of a small capture, found, and kept out of the albedo."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from stages.memory_capture import make_capture

from mifit.config import ReflectanceConfig
from mifit.core.estimate import GeometryEstimate, Label, ReflectanceEstimate, Report, hidden
from mifit.core.image import linear_to_srgb, srgb_to_linear
from mifit.core.process import one_blas_thread
from mifit.morphable import MorphableModel
from mifit.sampling.observations import Surface
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.stages.reflectance.als import find_forward
from mifit.stages.segment import segment

CAMERAS = ("left", "right")
ANGLES = ((0.0, 0.0, 0.0), (0.0, 9.0, 0.0), (6.0, -9.0, 0.0), (-5.0, 4.0, 2.0))
COLOURS = {"hand": (0.66, 0.5, 0.3), "glasses": (0.1, 0.1, 0.11), "fringe": (0.24, 0.17, 0.1)}
"""As coded in 8 bits, over 255."""
LIFTS = (0, 3, 6, 0, 8, 3, 6, 0)
"""Pixels."""


@pytest.fixture(scope="module")
def head(variant):
    model = MorphableModel.load("builtin:coarse")
    return model, make_capture(model, ANGLES, width=400, height=300)


def geometry_of(model, capture) -> GeometryEstimate:
    count = len(capture.vertices)
    zeros = np.zeros((count, model.n_expression))
    return GeometryEstimate(
        tuple(range(count)), capture.identity, np.zeros(model.n_albedo), zeros, capture.rotation, np.zeros((count, 3)),
        1.0, capture.vertices, model.mean_albedo, np.zeros((9, 3)), 0.0, Report("converged"),
    )  # fmt: skip


def shape_of(kind: str, shape: tuple[int, int], marks: np.ndarray) -> np.ndarray:
    """(H, W) bool: where an object is in an image."""
    out = np.zeros(shape, np.uint8)
    unit = float(np.linalg.norm(marks[45] - marks[36]))
    if kind == "hand":
        centre = 0.45 * marks[2] + 0.55 * marks[48]
        cv2.ellipse(out, tuple(np.int32(centre)), (round(0.2 * unit), round(0.28 * unit)), 20, 0, 360, 1, -1)
        for k in range(4):
            foot = centre + unit * np.array([0.1 * k - 0.16, -0.15])
            cv2.line(
                out,
                tuple(np.int32(foot)),
                tuple(np.int32(foot + unit * np.array([0.03, -0.35]))),
                1,
                round(0.08 * unit),
            )
    elif kind == "glasses":
        for eye in (slice(36, 42), slice(42, 48)):
            centre, radius = marks[eye].mean(axis=0), 0.75 * float(np.ptp(marks[eye][:, 0]))
            cv2.circle(out, tuple(np.int32(centre)), round(radius), 1, max(3, round(0.05 * unit)))
        cv2.line(out, tuple(np.int32(marks[39])), tuple(np.int32(marks[42])), 1, max(3, round(0.05 * unit)))
    else:
        low = [marks[17] - (0, 0.08 * unit), marks[26] - (0, 0.08 * unit)]
        cv2.fillConvexPoly(out, np.int32([*low, low[1] - (0, 0.35 * unit), low[0] - (0, 0.35 * unit)]), 1)
    return out > 0


def painted(head, kinds: dict[tuple[str, int], str], lift: dict[tuple[str, int], int] | None = None):
    """The capture with objects over some of its images, some of them lifted by a few pixels, and where they are."""
    model, capture = head
    areas = {}

    def change(name, timestep, frame):
        kind = kinds.get((name, timestep))
        if kind is None:
            return frame
        rng = np.random.default_rng(timestep)
        marks = capture.camera(name).project(capture.vertices[timestep][model.landmarks])
        area = shape_of(kind, frame.valid.shape, marks - (0, (lift or {}).get((name, timestep), 0)))
        texture = cv2.GaussianBlur(rng.normal(size=(*area.shape, 1)).astype(np.float32), (0, 0), 2) * 0.1
        image = frame.image.copy()
        image[area] = srgb_to_linear(np.clip(np.array(COLOURS[kind]) + texture[..., None], 0, 1).astype(np.float32))[
            area
        ]
        areas[name, timestep] = area
        return replace(frame, image=image)

    return capture.changed(change), areas


@one_blas_thread()
def labels_of(head, capture, shading: str = "prefiltered") -> dict[tuple[str, int], np.ndarray]:
    """Labels of all images; the made-up head casts no shadows, so that the model without them explains it as well."""
    model, original = head
    surface = Surface(capture, model, geometry_of(model, original), CAMERAS, 128, whole=True)
    keys = [(view.camera.name, view.timestep) for view in surface.views()]
    albedo = np.full((len(surface), 3), 0.3, np.float32)
    forward, first = find_forward(surface, albedo, ReflectanceConfig(exponent=20.0, shading=shading), 0)
    return dict(zip(keys, segment(surface, capture, model, forward, first.light), strict=True))


def facial(head, key) -> np.ndarray:
    model, capture = head
    surface = Surface(capture, model, geometry_of(model, capture), CAMERAS, 64)
    view = next(v for v in surface.views() if (v.camera.name, v.timestep) == key)
    return (view.face >= 0) & model.face_mask[np.maximum(view.face, 0)]


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    return float((found & true).sum() / max((found | true).sum(), 1))


def test_a_clean_face_hides_nothing(head) -> None:
    labels = labels_of(head, head[1], "auto")
    assert max(hidden(image).mean() for image in labels.values()) == 0.0
    image = labels["left", 0]
    assert {Label.SKIN, Label.BACKGROUND} <= set(map(int, np.unique(image))) <= set(map(int, Label))


def test_pixels_that_are_not_numbers_are_left_alone(head) -> None:
    rng = np.random.default_rng(0)

    def spoil(name, timestep, frame):
        image = frame.image.copy()
        image[rng.random(image.shape[:2]) < 0.02] = np.nan
        return replace(frame, image=image)

    labels = labels_of(head, head[1].changed(spoil))
    assert max(hidden(image).mean() for image in labels.values()) < 0.01


def test_objects_over_single_images_are_outlined(head) -> None:
    kinds = {("left", 0): "hand", ("left", 1): "glasses", ("right", 2): "fringe"}
    capture, areas = painted(head, kinds)
    labels = labels_of(head, capture, "auto")
    for key, image in labels.items():
        if key in areas:
            inside = facial(head, key)
            assert overlap(hidden(image) & inside, areas[key] & inside) > 0.9, key
        else:
            assert not hidden(image).any(), key
    assert Label.OCCLUDER in labels["left", 0]


def test_a_fringe_in_every_image_is_told_by_its_colour(head) -> None:
    capture, areas = painted(head, {(name, t): "fringe" for name in CAMERAS for t in range(len(ANGLES))})
    for key, image in labels_of(head, capture).items():
        inside = facial(head, key)
        assert overlap(hidden(image) & inside, areas[key] & inside) > 0.9, key


def test_a_fringe_that_hangs_elsewhere_in_each_image_ends_where_that_image_shows(head) -> None:
    """What covers a point in most images is skin in one of them; and dark hair is no reason to mark shaded skin."""
    keys = [(name, t) for name in CAMERAS for t in range(len(ANGLES))]
    capture, areas = painted(head, dict.fromkeys(keys, "fringe"), lift=dict(zip(keys, LIFTS, strict=True)))
    for key, image in labels_of(head, capture).items():
        inside = facial(head, key)
        assert overlap(hidden(image) & inside, areas[key] & inside) > 0.97, key


def test_a_mask_file_decides_alone(head) -> None:
    capture, _ = painted(head, {("left", 0): "hand"})
    capture = capture.changed(lambda name, t, frame: replace(frame, masked=True) if (name, t) == ("left", 0) else frame)
    assert not hidden(labels_of(head, capture)["left", 0]).any()


MAPS = ReflectanceConfig(texture_size=64, shading="prefiltered", bands=3, max_iterations=15)


@pytest.fixture(scope="module")
def before(head) -> ReflectanceEstimate:
    """Maps of the head with nothing over it."""
    model, original = head
    return infer_reflectance(original, model, geometry_of(model, original), CAMERAS, MAPS)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["one view", "every view"])
def test_albedo_elsewhere_stays(head, before, which) -> None:
    model, original = head
    keys = [("left", 0), ("left", 1), ("right", 2)]
    kinds = dict(zip(keys, ("hand", "glasses", "fringe"), strict=True))
    if which == "every view":
        kinds = {(name, t): "fringe" for name in CAMERAS for t in range(len(ANGLES))}
    capture, areas = painted(head, kinds)
    geometry = geometry_of(model, original)
    after = infer_reflectance(capture, model, geometry, CAMERAS, MAPS)
    touched = np.zeros(before.confidence.shape, bool)
    surface = Surface(original, model, geometry, CAMERAS, 64)
    for view in surface.views():
        area = areas.get((view.camera.name, view.timestep))
        if area is not None:
            near = cv2.dilate(area.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool) & (view.face >= 0)
            uv = np.einsum("nk,nkc->nc", view.weights[near], model.uv[model.faces_uv[view.face[near]]])
            touched[np.clip(((1 - uv[:, 1]) * 64).astype(int), 0, 63), np.clip((uv[:, 0] * 64).astype(int), 0, 63)] = (
                True
            )
    touched = cv2.dilate(touched.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    elsewhere = (before.confidence > 0.2) & ~touched
    assert elsewhere.sum() > 300
    assert np.abs(after.diffuse - before.diffuse)[elsewhere].mean() < 0.005
    assert linear_to_srgb(after.diffuse[elsewhere]).mean() == pytest.approx(
        linear_to_srgb(before.diffuse[elsewhere]).mean(), abs=0.005
    )
