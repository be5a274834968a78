"""A hand painted over one input image of a small capture is kept out of the albedo."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from stages.reflectance_scene import turning_dome
from stages.test_infer_reflectance import infer

from mifit.synth.compose import expose

HAND = (0.42, 0.30, 0.24)
VIEW = ("left", 1)


def hand(shape, centre, size):
    """(H, W) bool: a palm and four fingers."""
    out = np.zeros(shape, np.uint8)
    x, y = centre
    cv2.ellipse(out, (round(x), round(y)), (round(0.5 * size), round(0.6 * size)), 0, 0, 360, 1, -1)
    for k in range(4):
        foot = np.array([x + (k - 1.5) * 0.26 * size, y - 0.4 * size])
        tip = foot + size * np.array([0.05 * (k - 1.5), -0.75])
        cv2.line(out, tuple(np.round(foot).astype(int)), tuple(np.round(tip).astype(int)), 1, round(0.2 * size))
    return out > 0


@pytest.fixture(scope="module")
def clean(variant):
    rng = np.random.default_rng(0)
    scene = turning_dome()
    return scene.changed(lambda f: replace(f, image=np.where(f.valid[..., None], expose(f.image, rng), 0)))


@pytest.fixture(scope="module")
def occluded(clean):
    """The scene with a hand over one image, the hand, and what was fitted to it."""
    frame = clean.frames[VIEW]
    rows, columns = np.nonzero(frame.valid)
    size = 0.22 * np.ptp(columns)
    shape = hand(frame.valid.shape, (columns.mean() + 0.4 * size, rows.mean() + 0.3 * size), size)
    image = np.where(shape[..., None], np.float32(HAND), frame.image)
    scene = replace(clean, frames={**clean.frames, VIEW: replace(frame, image=image)})
    return scene, shape, infer(scene)


def test_the_albedo_under_the_hand_stays_clean(occluded, clean):
    scene, shape, fitted = occluded
    from mifit.sampling.observations import Surface

    before = infer(clean)
    surface = Surface(scene, scene.model, scene.geometry, ("left",), fitted.diffuse.shape[0])
    seen = surface.observe(np.arange(len(surface)))
    pixel = scene.camera("left").project(seen.point[:, VIEW[1]].astype(np.float64)).astype(int)
    inside = (pixel >= 0).all(1) & (pixel < shape.shape[::-1]).all(1) & (seen.weight[:, VIEW[1]] > 0)
    under = np.zeros(len(pixel), bool)
    under[inside] = shape[pixel[inside, 1], pixel[inside, 0]]
    row = surface.texels.index[under]
    moved = np.abs(fitted.diffuse - before.diffuse).reshape(-1, 3)[row]
    painted = np.abs(np.float32(HAND) - clean.frames[VIEW].image[shape]).mean()
    assert under.sum() > 50 and painted > 0.1  # a hand unlike the skin under it
    assert np.median(moved) < 0.01 and np.sqrt((moved**2).mean()) < 0.02  # of albedos about 0.4
