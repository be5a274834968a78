"""Checkpoints come back exactly, or not at all."""

import numpy as np
import pytest

from mifit import checkpoint
from mifit.core.estimate import NormalsEstimate, Report


@pytest.fixture
def estimate():
    rng = np.random.default_rng(0)
    report = Report("converged", {"data": [2.0, 1.0]}, 1.5, ("a warning",), {"figure": 3})
    return NormalsEstimate((0, 2), rng.random((2, 4, 4, 3), dtype=np.float32), report)


def test_round_trip(tmp_path, estimate):
    checkpoint.save(tmp_path, "normals", estimate, "key")
    back = checkpoint.load(tmp_path, "normals", NormalsEstimate, "key")
    assert back is not None
    assert back.timesteps == estimate.timesteps
    assert back.report == estimate.report
    np.testing.assert_array_equal(back.normal_object, estimate.normal_object)
    assert [p.name for p in tmp_path.iterdir()] == ["normals.npz"]


def test_other_key_missing_and_damaged(tmp_path, estimate):
    assert checkpoint.load(tmp_path, "normals", NormalsEstimate, "key") is None
    checkpoint.save(tmp_path, "normals", estimate, "key")
    assert checkpoint.load(tmp_path, "normals", NormalsEstimate, "other") is None
    path = tmp_path / "normals.npz"
    path.write_bytes(path.read_bytes()[:200])
    assert checkpoint.load(tmp_path, "normals", NormalsEstimate, "key") is None


def test_digest_follows_every_value():
    assert checkpoint.digest({"a": 1, "b": [1, 2]}) == checkpoint.digest({"b": [1, 2], "a": 1})
    assert checkpoint.digest({"a": 1}) != checkpoint.digest({"a": 2})
