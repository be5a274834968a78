"""Captures that show no face, or from nowhere: a fit ends with a result and a warning, or in one line with code 2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mifit.cli import main
from mifit.core.process import no_chatter
from mifit.stages.geometry.place_head import SIZES
from tests.checks.wrong_captures import Change, Rough, both, lengths, read, scale, write

FACTOR = 0.2
QUICK = """
geometry.rounds = 1
surface.finest = 1
normals.max_iterations = 3
reflectance = {texture_size = 32, bands = 4, shading = "prefiltered", exponent = 50, max_iterations = 3}
"""
rng = np.random.default_rng(0)


def pixels(change: Callable[[np.ndarray], np.ndarray], *cameras: str) -> Change:
    def apply(rough: Rough) -> None:
        for frame in rough.of(*cameras or ("left", "right")):
            frame["image"] = change(frame["image"])

    return apply


def noise(image: np.ndarray) -> np.ndarray:
    return rng.integers(0, 256, image.shape).astype(np.uint8)


def half_nan(image: np.ndarray) -> np.ndarray:
    out = (image / 255.0).astype(np.float32) ** 2.2
    out[:, ::2] = np.nan
    return out


def tiny(rough: Rough) -> None:
    """Images of 16 x 16 pixels."""
    for frame in rough.frames.values():
        height, width = frame["image"].shape[:2]
        size = np.array([16 / width, 16 / height])
        frame["image"] = cv2.resize(frame["image"], (16, 16))
        frame["points"] = frame["points"] * size
        for key, factor in zip(("fl_x", "fl_y", "cx", "cy"), (*size, *size), strict=True):
            frame[key] *= factor


def together(*frames: dict) -> None:
    for frame in frames:
        frame["points"] = np.tile(frame["points"].mean(0), (68, 1))


def everywhere(rough: Rough) -> None:
    for frame in both(rough):
        frame["points"] = rng.random((68, 2)) * frame["image"].shape[1::-1]


ODD: dict[str, tuple[Change, str]] = {
    "noise": (pixels(noise), "warning"),
    "noise in one": (pixels(noise, "left"), "warning"),
    "constant": (pixels(lambda image: np.full_like(image, 128)), "of one colour"),
    "white": (pixels(lambda image: np.full_like(image, 255)), "black or clipped"),
    "one black": (pixels(np.zeros_like, "right"), "black or clipped"),
    "NaN": (pixels(lambda image: np.full(image.shape, np.nan, np.float32)), "black or clipped"),
    "half NaN": (pixels(half_nan), ""),
    "hardly any light": (pixels(lambda image: (image / 255.0).astype(np.float32) * 1e-30), "no pixel of the face"),
    "16 pixels": (tiny, "no image shows the fitted face"),
    "landmarks in one point": (lambda r: together(*both(r)), "expected the points of a face"),
    "landmarks of one in one point": (lambda r: together(*r.of("left")), "expected the points of a face"),
    "landmarks unseen": (lambda r: [f.update(visible=np.zeros(68, bool)) for f in both(r)], "0 visible landmarks"),
    "landmarks anywhere": (everywhere, "don't fit a face"),
    "head of a millimetre": (lambda r: lengths(r, 0.001), "the face is 0.00"),
    "head 10 m away": (lambda r: lengths(r, 14.0), "times a human one"),
    "no focal length": (lambda r: [scale(both(r), key, 1e-3) for key in ("fl_x", "fl_y")], "don't fit a face"),
    "cameras turned away": (lambda r: [f.update(pose=f["pose"] * (-1, 1, -1, 1)) for f in both(r)], "at no timestep"),
}
"""What is odd, and what is said of it."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ODD)
def test_a_fit_of_an_odd_capture_ends_in_words(name, shared, tmp_path, capfd, monkeypatch, variant):
    monkeypatch.setattr("mifit.core.process._around", no_chatter)  # as the command does
    monkeypatch.setattr("mifit.stages.geometry.place_head.SIZES", SIZES[::10])  # which is found doesn't matter here
    change, said = ODD[name]
    rough = read(shared / "captures/soft", timesteps=1, factor=FACTOR, cameras=("left", "right"))
    change(rough)
    folder = write(rough, tmp_path / "capture")
    (tmp_path / "fit.toml").write_text(QUICK)
    out = tmp_path / "out"
    options = ("--config", str(tmp_path / "fit.toml"), "--model", "builtin:coarse", "--quiet")
    code = main(["fit", str(folder), "--out", str(out), *options])
    error = capfd.readouterr().err
    assert code in (0, 2) and "internal error" not in error, error
    assert said in error
    lines = [line for line in error.splitlines() if not line.startswith(("mifit: warning: ", "mifit: fault: "))]
    assert len(lines) == (code == 2), error
    assert (out / "result.json").is_file() == (code == 0) and out.is_dir() == (code == 0)


def test_an_empty_landmark_file_is_named(shared, tmp_path, capsys):
    rough = read(shared / "captures/soft", timesteps=1, factor=FACTOR, cameras=("left", "right"))
    folder: Path = write(rough, tmp_path / "capture")
    (folder / "landmarks/left/0000.json").write_text("")
    assert main(["fit", str(folder), "--out", str(tmp_path / "out"), "--model", "builtin:coarse", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert "landmarks/left/0000.json" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()
