"""Reading FLAME's pickles without running them.

A pickle is a program. This reader admits the few constructors that arrays need, replaces each by its own harmless
version, and refuses every other name before anything is executed.
"""

from __future__ import annotations

import io
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any

import numpy as np

from mifit.errors import InputError

_MAX_BYTES = 2 << 30


class Sparse:
    """Stands in for scipy.sparse.csc_matrix: keeps its state, does nothing."""

    def __setstate__(self, state: dict) -> None:
        self.state = state


class Chumpy:
    """Stands in for chumpy.Ch: the array is its attribute ``x``."""

    def __setstate__(self, state: dict) -> None:
        self.x = state.get("x")


def _reconstruct(kind: type, shape: tuple, code: Any) -> np.ndarray:
    if kind is not np.ndarray or tuple(shape) != (0,):
        raise InputError(f"an array is built with shape {shape}, expected (0,)")
    return np.ndarray((0,), dtype="u1")


def _dtype(code: Any, *_: Any) -> np.dtype:
    text = code.decode("latin1") if isinstance(code, bytes) else str(code)
    if not re.fullmatch(r"[<>|=]?[biuf][1248]", text):
        raise InputError(f"an array has type {text!r}, expected plain numbers")
    return np.dtype(text)


def _scalar(dtype: np.dtype, data: Any) -> Any:
    raw = data.encode("latin1") if isinstance(data, str) else data
    return np.frombuffer(raw, dtype, 1)[0]


def _encode(text: str, encoding: str = "latin1") -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise InputError(f"text in encoding {encoding!r}, expected latin1")
    return text.encode("latin1")


def _new_object(kind: type, base: type, state: Any) -> Any:
    if kind not in (Sparse, Chumpy):
        raise InputError(f"an object of type {kind.__name__} is built, expected an array")
    return kind()


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): _dtype,
    ("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy._core.multiarray", "_reconstruct"): _reconstruct,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy._core.multiarray", "scalar"): _scalar,
    ("scipy.sparse.csc", "csc_matrix"): Sparse,
    ("scipy.sparse._csc", "csc_matrix"): Sparse,
    ("chumpy.ch", "Ch"): Chumpy,
    ("copy_reg", "_reconstructor"): _new_object,
    ("copyreg", "_reconstructor"): _new_object,
    ("__builtin__", "object"): object,
    ("builtins", "object"): object,
    ("_codecs", "encode"): _encode,
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ADMITTED[module, name]
        except KeyError:
            raise InputError(f"wants to run {module}.{name}, which is refused; expected arrays only") from None


def is_pickle(path: Path) -> bool:
    """Whether a file begins like a pickle of a dictionary."""
    try:
        with path.open("rb") as f:
            head = f.read(2)
            f.seek(-1, 2)
            return (head[:1] == b"\x80" or head[:2] == b"(d") and f.read(1) == b"."
    except OSError:
        return False


def read_pickle(path: Path) -> dict[str, Any]:
    """Read a pickled dictionary of arrays; sparse and chumpy arrays come as ``Sparse`` and ``Chumpy``.

    Raises
    ------
    InputError
        The pickle names anything but array types (the name is in the message; nothing was run), is truncated, or
        does not hold a dictionary.
    """
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path}: {path.stat().st_size} bytes, expected at most {_MAX_BYTES}")
    data = path.read_bytes()
    try:
        # first pass: nothing is executed, lengths are checked against the file, names against the list
        for op, argument, _ in pickletools.genops(data):
            if op.name in ("GLOBAL", "INST"):
                module, name = str(argument).split(" ", 1)
                if (module, name) not in _ADMITTED:
                    raise InputError(f"wants to run {module}.{name}, which is refused; expected arrays only")
            elif op.name in ("EXT1", "EXT2", "EXT4", "PERSID", "BINPERSID"):
                raise InputError(f"uses {op.name}, which is refused; expected arrays only")
            elif op.name in ("PUT", "LONG_BINPUT") and int(str(argument)) > len(data):
                raise InputError(f"memo index {argument}, expected less than {len(data)}")
        out = _Unpickler(io.BytesIO(data), encoding="latin1").load()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # a hostile stream can make the unpickler raise anything
        raise InputError(f"{path}: damaged pickle: {type(error).__name__}: {str(error)[:200]}") from None
    if not isinstance(out, dict):
        raise InputError(f"{path}: holds a {type(out).__name__}, expected a dictionary")
    return {k.decode("latin1") if isinstance(k, bytes) else str(k): v for k, v in out.items()}


def plain_array(value: Any, where: str) -> np.ndarray:
    """Array of a pickled value, out of chumpy if need be; raises InputError for anything else."""
    if isinstance(value, Chumpy):
        value = value.x
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise InputError(f"{where}: found {type(value).__name__}, expected a numeric array")
    return value
