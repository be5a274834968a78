"""Rows in memory and in a file: the same values, views that stay, nothing left behind, a full disk named."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest

from mifit.core import arrays as rows
from mifit.core.arrays import Rows
from mifit.errors import InputError


@pytest.fixture(params=["memory", "file"])
def limit(request, monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    if request.param == "file":
        monkeypatch.setattr(rows, "IN_MEMORY", 0)
    return request.param


def test_rows_are_what_was_added_and_earlier_views_stay(limit, tmp_path):
    values = np.random.default_rng(0).random((5, 3, 2)).astype(np.float32)
    made = Rows(5, (3, 2), np.float32)
    views = [made.add(row) for row in values[:3]]
    assert made.extend(values[3:]).shape == (5, 3, 2)
    for count, view in enumerate(views, start=1):
        np.testing.assert_array_equal(view, values[:count])
    assert type(made.all) is np.ndarray and made.all.dtype == np.float32
    np.testing.assert_array_equal(made.all, values)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(IndexError):
        made.add(values[0])


def test_rows_beyond_the_limit_are_in_a_file(limit):
    made = Rows(2, (4,), np.float64).extend(np.ones((2, 4)))
    base = made
    while isinstance(base, np.ndarray) and base.base is not None:
        base = base.base
    assert isinstance(base, np.ndarray) == (limit == "memory")  # else it is the mapped file


def test_no_rows_need_no_file(monkeypatch):
    monkeypatch.setattr(rows, "IN_MEMORY", 0)
    assert Rows(0, (3,), np.float32).all.shape == (0, 3)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="needs posix_fallocate")
def test_a_full_disk_is_named_before_anything_is_written(monkeypatch, tmp_path):
    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(rows, "IN_MEMORY", 0)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(InputError, match="no room for 1 MiB of frames"):
        Rows(4, (2**16,), np.float32)
    assert list(tmp_path.iterdir()) == []
