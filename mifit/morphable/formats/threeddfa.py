"""3DDFA's cut of BFM 2009: ``Model_Shape.mat`` with ``Model_Expression.mat`` beside it. Micrometres."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mifit.errors import InputError
from mifit.morphable.assemble import complete, interleaved, single
from mifit.morphable.formats.bfm2009 import check_modes, triangles, vector
from mifit.morphable.formats.mat5 import read_mat
from mifit.morphable.model import MorphableModel
from mifit.morphable.topology import oriented_outwards

KEYS = ("mu_shape", "w", "sigma", "tri", "keypoints")


def load_3ddfa(path: Path) -> MorphableModel:
    """Read shape and expressions; keypoints are the 68 landmarks. The albedo is the pigment model's."""
    data = read_mat(path, KEYS)
    n3, k = check_modes(path, data["w"], "w")
    mean = vector(path, data["mu_shape"], "mu_shape", n3)
    identity = interleaved(data["w"] * (vector(path, data["sigma"], "sigma", k) / 1000.0))
    faces = triangles(path, data["tri"], "tri", n3 // 3)
    beside = path.parent / "Model_Expression.mat"
    expression = np.zeros((n3 // 3, 3, 0), dtype=np.float32)
    if beside.is_file():
        extra = read_mat(beside, ("mu_exp", "w_exp", "sigma_exp"))
        _, ke = check_modes(beside, extra["w_exp"], "w_exp", n3)
        expression = interleaved(extra["w_exp"] * (vector(beside, extra["sigma_exp"], "sigma_exp", ke) / 1000.0))
        mean = mean + vector(beside, extra["mu_exp"], "mu_exp", n3)
    return complete(
        "3ddfa",
        single(mean / 1000.0).reshape(-1, 3),
        oriented_outwards(mean.reshape(-1, 3), faces),
        identity,
        expression,
        1.0,
        landmarks=_keypoints(path, data["keypoints"], n3 // 3),
        source=path,
    )


def _keypoints(path: Path, values: np.ndarray, n: int) -> np.ndarray:
    """68 vertex indices from 1-based vertices, or from 1-based positions of coordinates (x, y, z of each)."""
    k = values.ravel().astype(np.int64)
    if k.size == 204:
        k = (k[::3] - 1) // 3 + 1
    if k.size != 68 or k.min() < 1 or k.max() > n:
        raise InputError(f"{path}: keypoints has {k.size} values up to {k.max()}, expected 68 vertices of {n}, 1-based")
    return k - 1
