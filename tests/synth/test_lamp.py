"""A path-traced head beside a bare bulb: in which direction the brightest light of the fit is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.truth import true_geometry
from mifit.capture import Capture
from mifit.config import ReflectanceConfig
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from mifit.stages.infer_reflectance import infer_reflectance
from mifit.synth import synthesize

LAMP = np.array([30.0, 35.0, 65.0])
"""Centimetres: 77 from the middle of the face, 35 degrees to the side of the nose."""


@pytest.mark.slow
def test_a_bulb_beside_a_moving_head_is_found(variant: str, tmp_path: Path) -> None:
    """Skin of stock Mitsuba, with gloss, relief and light from skin to skin, none of which the fit's model has."""
    out = synthesize(
        tmp_path / "c", timesteps=4, model="builtin:coarse", width=240, height=170, spp=16, seed=3, lamp=tuple(LAMP)
    )
    assert json.loads((out / "truth" / "scene.json").read_text())["lamp"] == LAMP.tolist()
    capture, model = Capture.load(out), MorphableModel.load("builtin:coarse")
    geometry = true_geometry(capture, model, (0, 1, 2, 3))
    config = ReflectanceConfig(texture_size=64, segment=False)
    found = infer_reflectance(capture, model, geometry, ("left", "right"), config)
    light = max(found.illumination.lights, key=lambda each: each.colour.sum())
    towards = LAMP - geometry.vertices[0].mean(axis=0)
    assert light.direction @ towards / np.linalg.norm(towards) > np.cos(np.radians(6.0))


def test_a_lamp_in_the_head_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lamp: found \(0, 0, 5\), expected x, y, z at 20 cm or more"):
        synthesize(tmp_path / "c", lamp=(0, 0, 5))
    assert not (tmp_path / "c").exists()
