"""Reading FLAME's pickles without running them.

A pickle is a program for a stack machine that may call anything. Here Python's own machine runs with what could do
harm replaced: a name stays a name, arrays are built from their bytes by NumPy's recipes as they are written down here,
and only text may be a key. Nothing of the file is ever called, hashed or imported.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mifit.core.files import opened, read_bytes
from mifit.core.limits import MAX_MODEL_BYTES
from mifit.errors import InputError

MAX_STEPS = 10**6
"""Instructions of one pickle; FLAME's have a few thousand."""


class Name(NamedTuple):
    """A module's name in a pickle: a word and nothing more."""

    module: str
    name: str


class Instance:
    """Stands in for an object that isn't an array: its class's name and its state."""

    def __init__(self, kind: Name) -> None:
        self.kind, self.state = kind, object()

    def build(self, state: object) -> None:
        """Take the state as it is."""
        self.state = state


class Dtype:
    """A type of plain numbers, its byte order set by its state as NumPy pickles it."""

    def __init__(self, text: object) -> None:
        if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[biuf][1248]", text):
            raise InputError(f"an array has type {_short(text)}, expected plain numbers")
        self.dtype = np.dtype(text)

    def build(self, state: object) -> None:
        """State: (version, byte order, subarray, names, fields, size, alignment, flags[, metadata])."""
        known = isinstance(state, tuple) and len(state) >= 5 and state[2:5] == (None, None, None)
        if not isinstance(state, tuple) or not known or state[1] not in ("<", ">", "|", "="):
            raise InputError("an array's type has fields or no byte order, expected plain numbers")
        self.dtype = self.dtype.newbyteorder(state[1])


class Array:
    """An array in the making: empty until its state or buffer is there."""

    def __init__(self) -> None:
        self.value: np.ndarray | None = None

    def build(self, state: object) -> None:
        """State: (version, shape, dtype, whether Fortran order, bytes)."""
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise InputError(f"an array has a state of type {type(state).__name__}, expected 5 values")
        shape, dtype, fortran, data = state[-4:]
        self.fill(data, dtype, shape, "F" if fortran else "C")

    def fill(self, data: object, dtype: object, shape: object, order: object) -> None:
        """Set the values from bytes; every size is checked against them."""
        if isinstance(data, str):
            data = data.encode("latin1")
        if not isinstance(dtype, Dtype) or not isinstance(data, (bytes, bytearray)) or order not in ("C", "F"):
            raise InputError("an array isn't built of bytes and a type of plain numbers")
        if not isinstance(shape, tuple) or len(shape) > 8 or any(type(n) is not int or n < 0 for n in shape):
            raise InputError(f"an array has shape {_short(shape)}, expected whole numbers")
        if math.prod(shape) * dtype.dtype.itemsize != len(data):
            raise InputError(f"an array claims shape {shape} of {dtype.dtype}, but holds {len(data)} bytes")
        self.value = np.frombuffer(data, dtype.dtype).reshape(shape, order=order)


def _reconstruct(kind: object, shape: object, code: object) -> Array:
    if type(kind) is not Name or kind not in _ARRAY_TYPES or shape != (0,):
        raise InputError(f"an array is built with shape {_short(shape)}, expected (0,)")
    return Array()


def _frombuffer(data: object, dtype: object, shape: object, order: object, axes: object = None) -> Array:
    made = Array()
    made.fill(data, dtype, shape, "C" if order == "K" else order)
    if axes is not None:
        assert made.value is not None
        every = list(range(made.value.ndim))
        if not isinstance(axes, tuple) or any(type(n) is not int for n in axes) or sorted(axes) != every:
            raise InputError(f"an array has its axes in the order {_short(axes)}, expected each once")
        made.value = made.value.transpose(axes)
    return made


def _dtype(code: object, *_: object) -> Dtype:
    return Dtype(code.decode("latin1") if isinstance(code, bytes) else code)


def _scalar(dtype: object, data: object) -> Array:
    made = Array()
    made.fill(data, dtype, (), "C")
    return made


def _encode(text: object, encoding: object = "latin1") -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise InputError(f"text in encoding {_short(encoding)}, expected latin1")
    return text.encode("latin1")


def _empty() -> bytes:
    return b""


def _object(kind: object, *_: object) -> Instance:
    if type(kind) is not Name or kind not in _INSTANCES:
        raise InputError(f"an object of type {_short(kind)} is built, expected an array")
    return Instance(kind)


_ARRAY_TYPES = {Name("numpy", "ndarray")}
_INSTANCES = {
    Name("scipy.sparse.csc", "csc_matrix"),
    Name("scipy.sparse._csc", "csc_matrix"),
    Name("chumpy.ch", "Ch"),
}
_RECIPES: dict[Name, Callable[..., Any]] = {
    Name("numpy", "dtype"): _dtype,
    Name("numpy.core.multiarray", "_reconstruct"): _reconstruct,
    Name("numpy._core.multiarray", "_reconstruct"): _reconstruct,
    Name("numpy.core.multiarray", "scalar"): _scalar,
    Name("numpy._core.multiarray", "scalar"): _scalar,
    Name("numpy.core.numeric", "_frombuffer"): _frombuffer,
    Name("numpy._core.numeric", "_frombuffer"): _frombuffer,
    Name("copy_reg", "_reconstructor"): _object,
    Name("copyreg", "_reconstructor"): _object,
    Name("_codecs", "encode"): _encode,
    Name("__builtin__", "bytes"): _empty,
    Name("builtins", "bytes"): _empty,
}
_ADMITTED = {*_RECIPES, *_ARRAY_TYPES, *_INSTANCES, Name("__builtin__", "object"), Name("builtins", "object")}
"""Names that a pickle may mention; only the recipes have a meaning, and it is given here."""


def _short(value: object) -> str:
    """A value for a message; containers by their type, as they may hold themselves a million times."""
    if isinstance(value, Name):
        return f"{value.module}.{value.name}"[:80]
    if type(value) is tuple and len(value) <= 8 and all(type(n) is int and abs(n) < 2**64 for n in value):
        return repr(value)
    if type(value) in (str, bytes) or (type(value) is int and abs(value) < 2**64):
        return repr(value[:40] if isinstance(value, (str, bytes)) else value)
    return f"a {type(value).__name__}"


_REFUSED = {
    "INST", "OBJ", "EXT1", "EXT2", "EXT4", "PERSID", "BINPERSID", "NEWOBJ_EX", "EMPTY_SET", "ADDITEMS", "FROZENSET",
    "NEXT_BUFFER", "READONLY_BUFFER",
}  # fmt: skip
"""Instructions that make objects in other ways. Sizes are checked where the instructions are counted."""


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

    Raises
    ------
    InputError
        The pickle names anything but array types (the name is in the message; nothing was run), is truncated, or
        does not hold a dictionary.
    """
    data = read_bytes(path, MAX_MODEL_BYTES, "pickle")
    try:
        for step, (op, argument, _) in enumerate(pickletools.genops(data)):
            if step > MAX_STEPS:
                raise InputError(f"found more than {MAX_STEPS} instructions, expected a dictionary of arrays")
            if op.name in _REFUSED or op.proto > 5:
                raise InputError(f"uses {op.name}, which is refused; expected arrays only")
            if "PUT" in op.name and (argument or 0) > 2**32:  # larger ones could be chosen to collide
                raise InputError(f"memo index {_short(argument)}, expected at most {2**32}")
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
    if isinstance(value, Array):
        value = value.value
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        kind = value.kind.name if isinstance(value, Instance) else type(value).__name__
        raise InputError(f"{where}: found {kind}, expected a numeric array")
    return value


class _Unpickler(pickle._Unpickler):  # type: ignore[name-defined, misc]
    """Python's machine; a name is a `Name`, which can't be called."""

    stack: list[object]
    pop_mark: Callable[[], list[object]]
    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)  # type: ignore[attr-defined]

    def find_class(self, module: str, name: str) -> Name:
        if Name(module, name) not in _ADMITTED:
            raise InputError(f"wants to run {module}.{name}, which is refused; expected arrays only")
        return Name(module, name)

    def load_reduce(self) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        if type(function) is not Name or function not in _RECIPES or type(arguments) is not tuple:
            raise InputError(f"wants to run {_short(function)}, which is refused; expected arrays only")
        self.stack.append(_RECIPES[function](*arguments))

    def load_newobj(self) -> None:
        _, kind = self.stack.pop(), self.stack.pop()
        self.stack.append(_object(kind))

    def load_build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if not isinstance(target, (Array, Dtype, Instance)):
            kind = type(target).__name__
            raise InputError(f"sets the state of a {kind}, which is refused; expected arrays only")
        target.build(state)

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
        if type(target) is not dict or len(values) % 2:
            raise ValueError("items without a dictionary")
        for key, value in zip(values[::2], values[1::2], strict=True):
            if isinstance(key, (bytes, bytearray)):
                key = key.decode("latin1")
            if type(key) is not str:
                raise InputError(f"a key is a {type(key).__name__}, expected text")
            target[key] = value


for _op in ("REDUCE", "NEWOBJ", "BUILD", "SETITEM", "SETITEMS", "DICT"):
    _Unpickler.dispatch[getattr(pickle, _op)[0]] = getattr(_Unpickler, f"load_{_op.lower()}")
