"""Landmark files: every kind gives the same points, and the wrong count is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mifit.capture.landmark_files import Landmarks, read_landmarks, write_landmarks
from mifit.errors import InputError

POINTS = np.round(np.random.default_rng(2).uniform(0, 300, (68, 2)), 3)


def test_json_round_trip(tmp_path: Path) -> None:
    visible = np.arange(68) % 3 > 0
    write_landmarks(tmp_path / "a b.json", Landmarks(POINTS, visible, 12.5))
    found = read_landmarks(tmp_path / "a b.json")
    np.testing.assert_array_equal(found.points, POINTS)
    np.testing.assert_array_equal(found.visible, visible)
    assert found.deviation == 12.5


@pytest.mark.parametrize("value", ["-1", "NaN", '"wide"', "[1]"])
def test_a_deviation_that_is_none_is_refused(tmp_path: Path, value: str) -> None:
    (tmp_path / "a.json").write_text(f'{{"points": {json.dumps(POINTS.tolist())}, "deviation": {value}}}')
    with pytest.raises(InputError, match=r"a\.json"):
        read_landmarks(tmp_path / "a.json")


def test_every_kind_gives_the_same_points(tmp_path: Path) -> None:
    rows = "\n".join(f"{x + 0.5} {y + 0.5}" for x, y in POINTS)  # iBUG counts pixels from 1
    (tmp_path / "p.pts").write_text(f"version: 1\nn_points: 68\n{{\n{rows}\n}}\n")
    np.save(tmp_path / "p.npy", POINTS - 0.5)  # array coordinates count from 0
    (tmp_path / "p.json").write_text(json.dumps(POINTS.tolist()))
    for suffix in ("pts", "npy", "json"):
        np.testing.assert_allclose(read_landmarks(tmp_path / f"p.{suffix}").points, POINTS, atol=1e-9)
    np.testing.assert_allclose(read_landmarks(tmp_path / "p.npy", first_pixel=0.5).points, POINTS - 0.5)
    np.save(tmp_path / "v.npy", np.column_stack([POINTS, np.arange(68) < 60]))
    assert read_landmarks(tmp_path / "v.npy").visible.sum() == 60


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", json.dumps(POINTS[:67].tolist()), r"a.json: found 67 landmarks .* expected 68 points \(iBUG-68\)"),
        ("a.json", json.dumps({"points": POINTS.tolist(), "visible": [True]}), "found 1 visibility flags, expected 68"),
        ("a.json", json.dumps({"convention": "wflw98", "points": []}), "convention: found 'wflw98', expected 'ibug68'"),
        ("a.json", '{"marks": []}', "found no key 'points'"),
        ("a.json", '{"points": [[1, "x"]]}', "not a readable landmark file"),
        ("a.json", "{", "not a readable landmark file"),
        ("a.pts", "version: 1\n{\n1 2\n3 4\n}", "found 2 landmarks"),
        ("a.pts", "version: 1\n{\n1 2 3\n}", "found 3 numbers"),
        ("a.pts", "1 2 3", r"found no \{ ... \} block"),
        ("a.npy", "no array", "not a readable landmark file"),
        ("a.txt", "", "found suffix '.txt', expected .json, .pts or .npy"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_landmarks(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_bad_arrays_and_missing_files(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((68, 4)))
    with pytest.raises(InputError, match=r"found an array of shape \(68, 4\)"):
        read_landmarks(tmp_path / "a.npy")
    np.save(tmp_path / "b.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="not a readable landmark file"):
        read_landmarks(tmp_path / "b.npy")
    with pytest.raises(InputError, match="no such landmark file"):
        read_landmarks(tmp_path / "c.json")
