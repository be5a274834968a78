"""Reading FLAME's pickles without running them.

A pickle is a program for a stack machine that may call anything. Here every name that it mentions stands for one of the
few recipes below, which build arrays from their bytes as NumPy pickles them; all other names are refused.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import numpy as np

from mifit.core.files import opened, read_bytes
from mifit.core.limits import MAX_MODEL_BYTES
from mifit.errors import InputError

MAX_STEPS = 20_000
"""Instructions of one pickle, and its largest memo index; FLAME's have a few thousand."""


class Instance:
    """Stands in for an object that isn't an array, such as chumpy's: its state alone."""

    state: object = None

    def __setstate__(self, state: object) -> None:
        self.state = state


class _Dtype:
    """A type of plain numbers, its byte order set by its state as NumPy pickles it."""

    def __init__(self, code: object, *_: object) -> None:
        text = code.decode("latin1") if isinstance(code, bytes) else code
        if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[biuf][1248]", text):
            raise InputError(f"an array has type {_short(text)}, expected plain numbers")
        self.dtype = np.dtype(text)

    def __setstate__(self, state: object) -> None:
        """State: (version, byte order, subarray, names, fields, size, alignment, flags[, metadata])."""
        if not isinstance(state, tuple) or state[2:5] != (None, None, None) or state[1] not in ("<", ">", "|", "="):
            raise InputError("an array's type has fields or no byte order, expected plain numbers")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """An array in the making: empty until its state is there."""

    value: np.ndarray | None = None

    def __init__(self, kind: object = None, shape: object = (0,), code: object = None) -> None:
        if shape != (0,):
            raise InputError(f"an array is built with shape {_short(shape)}, expected (0,)")

    def __setstate__(self, state: object) -> None:
        """State: (version, shape, dtype, whether Fortran order, bytes); every size is checked against the bytes."""
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise InputError(f"an array has a state of type {type(state).__name__}, expected 5 values")
        shape, dtype, fortran, data = state[-4:]
        if isinstance(data, str):
            data = data.encode("latin1")
        if not isinstance(dtype, _Dtype) or not isinstance(data, (bytes, bytearray)):
            raise InputError("an array isn't built of bytes and a type of plain numbers")
        if not isinstance(shape, tuple) or len(shape) > 8 or any(type(n) is not int or n < 0 for n in shape):
            raise InputError(f"an array has shape {_short(shape)}, expected whole numbers")
        if math.prod(shape) * dtype.dtype.itemsize != len(data):
            raise InputError(f"an array claims shape {shape} of {dtype.dtype}, but holds {len(data)} bytes")
        self.value = np.frombuffer(data, dtype.dtype).reshape(shape, order="F" if fortran else "C")


def _frombuffer(data: object, dtype: object, shape: object, order: object, axes: object = None) -> _Array:
    made = _Array()
    made.__setstate__((shape, dtype, order == "F", data))
    assert made.value is not None
    if axes is not None:
        every = list(range(made.value.ndim))
        if not isinstance(axes, tuple) or any(type(n) is not int for n in axes) or sorted(axes) != every:
            raise InputError(f"an array has its axes in the order {_short(axes)}, expected each once")
        made.value = made.value.transpose(axes)
    return made


def _encode(text: object, encoding: object = "latin1") -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise InputError(f"text in encoding {_short(encoding)}, expected latin1")
    return text.encode("latin1")


class _Recipe:
    """What a name stands for: it may be called, if it makes something, and nothing else can be done to it."""

    __slots__ = ("make", "name")

    def __init__(self, make: Callable[..., object] | None, name: str = "") -> None:
        self.make, self.name = make, name

    def __call__(self, *arguments: object) -> object:
        if self.make is None:
            raise InputError(f"wants to run {self.name}, which is refused; expected arrays only")
        return self.make(*arguments)

    def __setstate__(self, state: object) -> None:
        raise InputError("sets the state of a function, which is refused; expected arrays only")


def _object(kind: object, *_: object) -> Instance:
    if kind is not Instance:
        raise InputError(f"an object of type {_short(kind)} is built, expected an array")
    return Instance()


_RECIPES: dict[str, object] = {
    "numpy.dtype": _Recipe(_Dtype),
    "numpy.ndarray": _Recipe(None, "numpy.ndarray"),
    "numpy.core.multiarray._reconstruct": _Recipe(_Array),
    "numpy.core.multiarray.scalar": _Recipe(lambda dtype, data: _frombuffer(data, dtype, (), "C")),
    "numpy.core.numeric._frombuffer": _Recipe(_frombuffer),
    "copyreg._reconstructor": _Recipe(_object),
    "_codecs.encode": _Recipe(_encode),
    "builtins.bytes": _Recipe(lambda: b""),
    "builtins.object": _Recipe(None, "builtins.object"),
    "scipy.sparse._csc.csc_matrix": Instance,
    "chumpy.ch.Ch": Instance,
}
"""By module and name as of today; only what is here may be mentioned, and its meaning is given here."""
_RENAMED = {
    "numpy._core": "numpy.core",
    "copy_reg": "copyreg",
    "__builtin__": "builtins",
    "scipy.sparse.csc": "scipy.sparse._csc",
}


class _Unpickler(pickle._Unpickler):  # type: ignore[name-defined, misc]
    """Python's own machine, in which only text may be a key: anything else could be made to hash for ever."""

    stack: list[object]
    pop_mark: Callable[[], list[object]]
    dispatch: ClassVar[dict[int, Callable[..., None]]] = dict(pickle._Unpickler.dispatch)  # type: ignore[attr-defined]

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set([key, value])

    def load_setitems(self) -> None:
        self._set(self.pop_mark())

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.stack.append({})
        self._set(items)

    def _set(self, values: list[object]) -> None:
        target = self.stack[-1]
        for key, value in zip(values[::2], values[1::2], strict=True):
            key = key.decode("latin1") if isinstance(key, bytes) else key
            if type(key) is not str or type(target) is not dict:
                raise InputError(f"sets an item {_short(key)} of a {type(target).__name__}, expected names of arrays")
            target[key] = value

    dispatch.update({pickle.SETITEM[0]: load_setitem, pickle.SETITEMS[0]: load_setitems, pickle.DICT[0]: load_dict})

    def find_class(self, module: str, name: str) -> object:
        known = next((new + module[len(old) :] for old, new in _RENAMED.items() if module.startswith(old)), module)
        if f"{known}.{name}" not in _RECIPES:
            raise InputError(f"wants to run {module}.{name}, which is refused; expected arrays only")
        return _RECIPES[f"{known}.{name}"]


def _short(value: object) -> str:
    """A value for a message; containers by their type, as they may hold themselves a million times."""
    if type(value) is tuple and len(value) <= 8 and all(type(n) is int and abs(n) < 2**64 for n in value):
        return repr(value)
    if type(value) in (str, bytes) or (type(value) is int and abs(value) < 2**64):
        return repr(value[:40] if isinstance(value, (str, bytes)) else value)
    return f"a {type(value).__name__}"


def is_pickle(path: Path) -> bool:
    """Whether a file begins like a pickle of a dictionary."""
    with opened(path, MAX_MODEL_BYTES) as (f, size):
        head = f.read(2)
        if size < 2:
            return False
        f.seek(-1, 2)
        return (head[:1] == b"\x80" or head[:2] == b"(d") and f.read(1) == b"."


def read_pickle(path: Path) -> dict[str, object]:
    """Read a pickled dictionary of arrays; what isn't an array comes as `Instance`.

    InputError where the pickle names anything but array types (the name is in the message; nothing was run), is
    truncated, or does not hold a dictionary.
    """
    data = read_bytes(path, MAX_MODEL_BYTES, "pickle")
    try:
        # A first pass checks every length; the second one could be told to reserve what isn't there.
        for step, (op, argument, _) in enumerate(pickletools.genops(data)):
            if step > MAX_STEPS or ("PUT" in op.name and (argument or 0) > MAX_STEPS):
                raise InputError(f"found more than {MAX_STEPS} instructions, expected a dictionary of arrays")
            if op.name in ("EMPTY_SET", "ADDITEMS", "FROZENSET"):  # they hash what they are given
                raise InputError(f"uses {op.name}, which is refused; expected arrays only")
        out = _Unpickler(io.BytesIO(data), encoding="latin1").load()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # instructions that make no sense together
        raise InputError(f"{path}: damaged pickle: {type(error).__name__}: {str(error)[:200]}") from None
    if not isinstance(out, dict):
        raise InputError(f"{path}: holds a {type(out).__name__}, expected a dictionary")
    return out


def plain_array(value: object, where: str) -> np.ndarray:
    """Array of a pickled value, out of chumpy if need be; raises InputError for anything else."""
    if isinstance(value, Instance) and isinstance(value.state, dict):  # chumpy keeps the array in its attribute x
        value = value.state.get("x")
    if isinstance(value, _Array):
        value = value.value
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise InputError(f"{where}: found {type(value).__name__}, expected a numeric array")
    return value
