"""Landmark files: points come back, and the wrong count is named."""

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


def test_a_bare_list_is_read(tmp_path: Path) -> None:
    (tmp_path / "p.json").write_text(json.dumps(POINTS.tolist()))
    np.testing.assert_array_equal(read_landmarks(tmp_path / "p.json").points, POINTS)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", json.dumps(POINTS[:67].tolist()), r"a.json: found 67 landmarks .* expected 68 points \(iBUG-68\)"),
        ("a.json", json.dumps({"points": POINTS.tolist(), "visible": [True]}), "found 1 visibility flags, expected 68"),
        ("a.json", json.dumps({"convention": "wflw98", "points": []}), "convention: found 'wflw98', expected 'ibug68'"),
        ("a.json", '{"marks": []}', "found no key 'points'"),
        ("a.json", '{"points": [[1, "x"]]}', "not a readable landmark file"),
        ("a.json", "{", "not a readable landmark file"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_landmarks(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such landmark file"):
        read_landmarks(tmp_path / "c.json")
