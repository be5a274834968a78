"""The membrane: exact where much is known, harmonic where nothing is."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from mifit.core.mesh_solve import membrane


def strip(n: int = 21) -> tuple[np.ndarray, np.ndarray]:
    """A flat strip of quads along x, and a triangle apart from it."""
    x = np.arange(n, dtype=float)
    points = np.concatenate([np.column_stack([x, 0 * x, 0 * x]), np.column_stack([x, 0 * x + 1, 0 * x])])
    low = np.arange(n - 1)
    faces = np.concatenate([np.column_stack([low, low + 1, low + n]), np.column_stack([low + 1, low + n + 1, low + n])])
    apart = np.array([[50.0, 0, 0], [51, 0, 0], [50, 1, 0]])
    return np.concatenate([points, apart]), np.concatenate([faces, [[2 * n, 2 * n + 1, 2 * n + 2]]])


def test_known_ends_are_joined_by_a_line_and_the_unknown_piece_is_zero() -> None:
    vertices, faces = strip()
    known = np.flatnonzero(np.isin(vertices[:, 0], (0, 20)))
    where = sp.csr_matrix((np.ones(4), (np.arange(4), known)), (4, len(vertices)))
    values = np.stack([vertices[known, 0] / 20, 1 - vertices[known, 0] / 20], axis=1)
    found = membrane(vertices, faces, where, np.ones(4), 1e-6)(values)
    np.testing.assert_allclose(found[:42, 0], vertices[:42, 0] / 20, atol=3e-3)  # right angles' cotangents are raised
    np.testing.assert_allclose(found[:42].sum(axis=1), 1.0, atol=1e-4)
    np.testing.assert_allclose(found[42:], 0.0, atol=1e-9)


def test_weights_decide_between_contradictions() -> None:
    vertices, faces = strip(3)
    where = sp.csr_matrix((np.ones(2), ([0, 1], [0, 0])), (2, len(vertices)))
    found = membrane(vertices, faces, where, np.array([1.0, 3.0]), 1e-6)(np.array([[0.0], [1.0]]))
    np.testing.assert_allclose(found[:6], 0.75, atol=1e-4)
