"""Reading FLAME's pickles without running them.

A pickle is a program for a stack machine that may call anything. This reader is such a machine for a subset: it
builds lists, dictionaries and tuples, and arrays by NumPy's own recipes for pickling them, from their bytes. Nothing of
the file is ever called, hashed (only text may be a key) or imported.
"""

from __future__ import annotations

import math
import pickletools
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

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
        self.kind, self.state = kind, None

    def build(self, state: Any) -> None:
        """Take the state as it is."""
        self.state = state


class Dtype:
    """A type of plain numbers, its byte order set by its state as NumPy pickles it."""

    def __init__(self, text: Any) -> None:
        if not isinstance(text, str) or not re.fullmatch(r"[<>|=]?[biuf][1248]", text):
            raise InputError(f"an array has type {_short(text)}, expected plain numbers")
        self.dtype = np.dtype(text)

    def build(self, state: Any) -> None:
        """State: (version, byte order, subarray, names, fields, size, alignment, flags[, metadata])."""
        order = state[1] if isinstance(state, tuple) and len(state) >= 5 else None
        if type(order) is not str or order not in "<>|=" or any(part is not None for part in state[2:5]):
            raise InputError("an array's type has fields or no byte order, expected plain numbers")
        self.dtype = self.dtype.newbyteorder(order)  # type: ignore[arg-type]


class Array:
    """An array in the making: empty until its state or buffer is there."""

    def __init__(self) -> None:
        self.value: np.ndarray | None = None

    def build(self, state: Any) -> None:
        """State: (version, shape, dtype, whether Fortran order, bytes)."""
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise InputError(f"an array has a state of type {type(state).__name__}, expected 5 values")
        shape, dtype, fortran, data = state[-4:]
        self.fill(data, dtype, shape, "F" if fortran else "C")

    def fill(self, data: Any, dtype: Any, shape: Any, order: Any) -> None:
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


def _reconstruct(kind: Any, shape: Any, code: Any) -> Array:
    if type(kind) is not Name or kind not in _ARRAY_TYPES or shape != (0,):
        raise InputError(f"an array is built with shape {_short(shape)}, expected (0,)")
    return Array()


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> Array:
    made = Array()
    made.fill(data, dtype, shape, "C" if order == "K" else order)
    if axes is not None:
        if not isinstance(axes, tuple) or any(type(n) is not int for n in axes) or sorted(axes) != [*range(len(shape))]:
            raise InputError(f"an array has its axes in the order {_short(axes)}, expected each once")
        assert made.value is not None
        made.value = made.value.transpose(axes)
    return made


def _dtype(code: Any, *_: Any) -> Dtype:
    return Dtype(code.decode("latin1") if isinstance(code, bytes) else code)


def _scalar(dtype: Any, data: Any) -> Array:
    made = Array()
    made.fill(data, dtype, (), "C")
    return made


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise InputError(f"text in encoding {_short(encoding)}, expected latin1")
    return text.encode("latin1")


def _empty() -> bytes:
    return b""


def _object(kind: Any, *_: Any) -> Instance:
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


def _short(value: Any) -> str:
    """A value for a message; containers by their type, as they may hold themselves a million times."""
    if isinstance(value, Name):
        return f"{value.module}.{value.name}"[:80]
    if type(value) is tuple and len(value) <= 8 and all(type(n) is int and abs(n) < 2**64 for n in value):
        return repr(value)
    if type(value) in (str, bytes) or (type(value) is int and abs(value) < 2**64):
        return repr(value[:40] if isinstance(value, (str, bytes)) else value)
    return f"a {type(value).__name__}"


_MARK = object()
_VALUES = {
    "NONE", "NEWTRUE", "NEWFALSE", "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8", "UNICODE",
    "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8",
}  # fmt: skip
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}


def is_pickle(path: Path) -> bool:
    """Whether a file begins like a pickle of a dictionary."""
    with opened(path, MAX_MODEL_BYTES) as (f, size):
        head = f.read(2)
        if size < 2:
            return False
        f.seek(-1, 2)
        return (head[:1] == b"\x80" or head[:2] == b"(d") and f.read(1) == b"."


def read_pickle(path: Path) -> dict[str, Any]:
    """Read a pickled dictionary of arrays; what isn't an array comes as `Instance`.

    Raises
    ------
    InputError
        The pickle names anything but array types (the name is in the message; nothing was run), is truncated, or
        does not hold a dictionary.
    """
    data = read_bytes(path, MAX_MODEL_BYTES, "pickle")
    try:
        out = _Machine().run(pickletools.genops(data))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # instructions that make no sense together
        raise InputError(f"{path}: damaged pickle: {type(error).__name__}: {str(error)[:200]}") from None
    if not isinstance(out, dict):
        raise InputError(f"{path}: holds a {type(out).__name__}, expected a dictionary")
    return out


def plain_array(value: Any, where: str) -> np.ndarray:
    """Array of a pickled value, out of chumpy if need be; raises InputError for anything else."""
    if isinstance(value, Instance) and isinstance(value.state, dict):  # chumpy keeps the array in its attribute x
        value = value.state.get("x")
    if isinstance(value, Array):
        value = value.value
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        kind = value.kind.name if isinstance(value, Instance) else type(value).__name__
        raise InputError(f"{where}: found {kind}, expected a numeric array")
    return value


class _Machine:
    """Stack and memo."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, instructions: Iterator[tuple[Any, Any, Any]]) -> Any:
        for step, (op, argument, _) in enumerate(instructions):
            if step > MAX_STEPS:
                raise InputError(f"found more than {MAX_STEPS} instructions, expected a dictionary of arrays")
            if op.name == "STOP":
                return self.stack.pop()
            if op.name in _VALUES:
                self.stack.append(_CONSTANTS.get(op.name, argument))
            elif not self.collect(op.name) and not self.remember(op.name, argument):
                self.make(op.name, argument)
        raise ValueError("no end")

    def collect(self, op: str) -> bool:
        """Containers, and what moves values of the stack; False for another instruction."""
        stack = self.stack
        match op:
            case "MARK":
                stack.append(_MARK)
            case "POP":
                stack.pop()
            case "POP_MARK":
                self.marked()
            case "DUP":
                stack.append(stack[-1])
            case "EMPTY_TUPLE" | "EMPTY_LIST" | "EMPTY_DICT":
                stack.append({"EMPTY_TUPLE": tuple, "EMPTY_LIST": list, "EMPTY_DICT": dict}[op]())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                values = tuple(stack[-int(op[-1]) :])
                del stack[-int(op[-1]) :]
                stack.append(values)
            case "TUPLE":
                stack.append(tuple(self.marked()))
            case "LIST":
                stack.append(self.marked())
            case "DICT":
                items = self.marked()
                stack.append({})
                self.set_items(items)
            case "APPEND":
                value = stack.pop()
                self.extend([value])
            case "APPENDS":
                self.extend(self.marked())
            case "SETITEM":
                value, key = stack.pop(), stack.pop()
                self.set_items([key, value])
            case "SETITEMS":
                self.set_items(self.marked())
            case _:
                return False
        return True

    def remember(self, op: str, argument: Any) -> bool:
        """The memo, and what says nothing of the values; False for another instruction."""
        match op:
            case "PROTO" | "FRAME":
                pass
            case "MEMOIZE":
                self.memo[len(self.memo)] = self.stack[-1]
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                if argument > 2**32:  # larger ones could be chosen to collide
                    raise InputError(f"memo index {_short(argument)}, expected at most {2**32}")
                self.memo[argument] = self.stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                self.stack.append(self.memo[argument])
            case _:
                return False
        return True

    def make(self, op: str, argument: Any) -> None:
        """Names, and what they are used for: all that could do harm."""
        match op:
            case "GLOBAL":
                self.name(*str(argument).split(" ", 1))
            case "STACK_GLOBAL":
                name, module = self.stack.pop(), self.stack.pop()
                if type(name) is not str or type(module) is not str:
                    raise ValueError("a name that isn't text")
                self.name(module, name)
            case "REDUCE":
                arguments, function = self.stack.pop(), self.stack.pop()
                if type(function) is not Name or function not in _RECIPES or type(arguments) is not tuple:
                    raise InputError(f"wants to run {_short(function)}, which is refused; expected arrays only")
                self.stack.append(_RECIPES[function](*arguments))
            case "NEWOBJ":
                _, kind = self.stack.pop(), self.stack.pop()
                self.stack.append(_object(kind))
            case "BUILD":
                state, target = self.stack.pop(), self.stack[-1]
                if not isinstance(target, (Array, Dtype, Instance)):
                    kind = type(target).__name__
                    raise InputError(f"sets the state of a {kind}, which is refused; expected arrays only")
                target.build(state)
            case "INST":
                self.name(*str(argument).split(" ", 1))  # says which, where it is one that is never admitted
                raise InputError("uses INST, which is refused; expected arrays only")
            case _:
                raise InputError(f"uses {op}, which is refused; expected arrays only")

    def name(self, module: str, name: str) -> None:
        if Name(module, name) not in _ADMITTED:
            raise InputError(f"wants to run {module}.{name}, which is refused; expected arrays only")
        self.stack.append(Name(module, name))

    def marked(self) -> list[Any]:
        """What lies above the last mark; both leave the stack."""
        at = len(self.stack) - 1
        while self.stack[at] is not _MARK:
            at -= 1
            if at < 0:
                raise ValueError("no mark")
        values = self.stack[at + 1 :]
        del self.stack[at:]
        return values

    def set_items(self, values: list[Any]) -> None:
        target = self.stack[-1]
        if type(target) is not dict or len(values) % 2:
            raise ValueError("items without a dictionary")
        for key, value in zip(values[::2], values[1::2], strict=True):
            if isinstance(key, (bytes, bytearray)):
                key = key.decode("latin1")
            if type(key) is not str:
                raise InputError(f"a key is a {type(key).__name__}, expected text")
            target[key] = value

    def extend(self, values: list[Any]) -> None:
        if type(self.stack[-1]) is not list:
            raise ValueError("values without a list")
        self.stack[-1].extend(values)
