"""What callers hand to public functions: objects of the right classes, numbers and arrays that are some."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.limits import MAX_SEED
from mifit.errors import InputError

P = ParamSpec("P")
R = TypeVar("R")
OBJECTS = ("Capture", "MorphableModel", "Reconstruction", "Camera")
"""Classes that arguments are checked for, beside all settings and estimates."""


def finite(values: ArrayLike, shape: tuple[int, ...], name: str) -> NDArray[np.float64]:
    """The values as float64; InputError where they aren't finite or of another shape, in which -1 stands for any."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        expected = ", ".join("n" if n == -1 else str(n) for n in shape)
        raise InputError(f"{name}: found shape {array.shape}, expected ({expected})")
    if not np.isfinite(array).all():
        raise InputError(f"{name}: found {array if array.ndim == 0 else 'values'} not finite, expected finite numbers")
    return array


def whole(value: object, low: int, name: str, high: int = 2**31 - 1) -> int:
    """A whole number from ``low`` to ``high``; InputError for another."""
    if not isinstance(value, (int, np.integer)) or not low <= value <= high:
        raise InputError(f"{name}: found {value!r}, expected a whole number from {low} to {high}")
    return int(value)


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """The function, which refuses objects of other classes than its annotations name, and a mesh of another model.

    TypeError for an object of another class; what has ``cameras`` or a ``frame`` counts as a capture. InputError for a
    ``seed`` that is no whole number, and for a geometry that doesn't have the vertices of the model that it comes with.
    """
    signature = inspect.signature(function)
    kinds = {name: str(p.annotation) for name, p in signature.parameters.items()}

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        given = signature.bind(*args, **kwargs).arguments
        for name, value in given.items():
            kind = kinds[name].removesuffix(" | None")
            if (value is None and kind != kinds[name]) or _fits(value, kind):
                continue
            raise TypeError(f"{function.__name__}: {name}: found {type(value).__name__}, expected {kind}")
        whole(given.get("seed", 0), 0, f"{function.__name__}: seed", MAX_SEED)
        model, geometry = given.get("model"), given.get("geometry")
        if model is not None and geometry is not None and geometry.vertices.shape[1] != len(model.mean):
            raise InputError(
                f"{function.__name__}: found a geometry of {geometry.vertices.shape[1]} vertices, expected the "
                f"{len(model.mean)} of model {model.name}; fit the geometry with this model"
            )
        return function(*args, **kwargs)

    return run


def _fits(value: object, kind: str) -> bool:
    """Whether a value is what an annotation asks for; annotations of other kinds fit everything."""
    if kind in OBJECTS or kind.endswith(("Config", "Estimate")):
        stands_in = kind == "Capture" and (hasattr(value, "cameras") or hasattr(value, "frame"))
        return stands_in or kind in {cls.__name__ for cls in type(value).__mro__}
    if kind == "Progress" or kind.startswith("Callable"):
        return callable(value)
    return kind != "str | Path" or isinstance(value, (str, os.PathLike))
