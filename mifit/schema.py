"""What settings are made of: frozen dataclasses whose every field carries its range, its unit and its meaning.

Values are checked by pydantic where they are read, from TOML, from dictionaries or from Python, all in one way; a
refusal is one line that names the key, the value found and what was expected.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic.fields import FieldInfo
from typing_extensions import dataclass_transform

from mifit.errors import InputError

T = TypeVar("T")
Name = Annotated[str, pydantic.Field(strict=True, pattern=r"^[^\x00]+$")]
Index = Annotated[int, pydantic.Field(strict=True, ge=0)]
_LONGEST_VALUE = 60  # characters of a refused value that a message repeats
_MOST_ERRORS = 3


def number(
    default: Any,
    meaning: str,
    unit: str = "",
    *,
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
) -> Any:
    """A field with a number between bounds, in a unit."""
    field: dict[str, Any] = {"ge": least, "gt": above, "le": most, "strict": True, "json_schema_extra": {"unit": unit}}
    return pydantic.Field(default, description=meaning, **{k: v for k, v in field.items() if v is not None})


def one_of(default: Any, meaning: str) -> Any:
    """A field with one of the values that its ``Literal`` lists."""
    return pydantic.Field(default, description=meaning)


def flag(default: bool, meaning: str) -> Any:
    """A field that is true or false."""
    return pydantic.Field(default, description=meaning, strict=True)


def text(default: Any, meaning: str, *, pattern: str = r"^[^\x00]+$") -> Any:
    """A field with text that isn't empty; ``...`` as the default: it must be given."""
    return pydantic.Field(default, description=meaning, strict=True, pattern=pattern)


def several(default: Any, meaning: str) -> Any:
    """A field with a list that isn't empty, of type ``tuple[Name, ...]`` or ``tuple[Index, ...]``."""
    return pydantic.Field(default, description=meaning, min_length=1)


def part(cls: type, meaning: str = "") -> Any:
    """A field with the settings of a part."""
    return pydantic.Field(default_factory=cls, description=meaning)


def part_or_none(meaning: str = "") -> Any:
    """A field with the settings of a part that may be missing."""
    return pydantic.Field(None, description=meaning)


def table(meaning: str) -> Any:
    """A field with names of the user's own and their values."""
    return pydantic.Field(default_factory=dict, description=meaning)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass of checked settings; a bad value raises InputError."""
    config = pydantic.ConfigDict(extra="forbid", allow_inf_nan=False)
    made = pydantic.dataclasses.dataclass(frozen=True, config=config)(cls)
    construct = made.__init__

    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        try:
            construct(self, *args, **kwargs)
        except pydantic.ValidationError as error:
            raise InputError(_message("", made, error, cls.__name__.removesuffix("Config").lower())) from None

    made.__init__ = __init__  # type: ignore[method-assign]
    return typing.cast("type[T]", made)


def from_mapping(cls: type[T], values: Any, where: str) -> T:
    """Build settings from nested dictionaries; missing keys keep their defaults.

    Parameters
    ----------
    cls : type
        A class made by `settings`.
    values : dict
    where : str
        File or option that the values come from, for messages.

    Raises
    ------
    InputError
        An unknown key (the nearest known one is named) or a value of the wrong type or out of range.
    """
    if not isinstance(values, dict):
        raise InputError(f"{where}: found {_shown(values)}, expected a table of settings for {cls.__name__}")
    try:
        return pydantic.TypeAdapter(cls).validate_python(values)
    except pydantic.ValidationError as error:
        raise InputError(_message(where, cls, error)) from None


def read_toml(path: str | Path) -> dict[str, Any]:
    """Parse a TOML file; raises InputError when it is missing or malformed."""
    try:
        return parse_toml(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such configuration file") from None
    except (OSError, ValueError, RecursionError) as error:  # ValueError: also whole numbers of thousands of digits
        raise InputError(f"{path}: not a readable TOML file: {error}") from None


def parse_toml(text: str) -> dict[str, Any]:
    """Parse TOML; raises ValueError or RecursionError."""
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef]
    return tomllib.loads(text)


def list_settings(cls: type, prefix: str = "") -> Iterator[tuple[str, Any, str, str]]:
    """Every setting below a class: dotted key, default, what is expected, meaning."""
    for name, field in _fields(cls).items():
        inner = _settings_in(field.annotation)
        if inner is not None:
            yield from list_settings(inner, f"{prefix}{name}.")
        else:
            default = None if field.is_required() else field.get_default(call_default_factory=True)
            yield prefix + name, default, expectation(field), field.description or ""


def expectation(field: FieldInfo) -> str:
    """What a field takes, in words: ``a whole number from 3 to 10``, ``a number above 0, at most 100 px``."""
    words = _kind(field.annotation)
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    bounds: dict[str, Any] = {
        name: getattr(item, name) for item in field.metadata for name in ("ge", "gt", "le") if hasattr(item, name)
    }
    if "ge" in bounds and "le" in bounds:
        words += f" from {_plain(bounds['ge'])} to {_plain(bounds['le'])}"
    elif bounds:
        named = {"ge": "not below", "gt": "above", "le": "at most"}
        words += " " + ", ".join(
            f"{named[k]} {_plain(v)}" for k, v in sorted(bounds.items(), key=lambda b: b[0] == "le")
        )
    if extra.get("unit"):
        words += f" {extra['unit']}"
    return words


def _message(where: str, cls: type, error: pydantic.ValidationError, table: str = "") -> str:
    """One line for all that is wrong, or for the first few; ``table``: the name of what is made."""
    found = [_line(cls, e, [table] if table else []) for e in error.errors(include_url=False)[:_MOST_ERRORS]]
    return (f"{where}: " if where else "") + "; ".join(dict.fromkeys(found))


def _line(cls: type, error: Any, before: list[str]) -> str:
    """Say what is wrong with one key, whose path starts with the names ``before``."""
    path = [str(key) for key in error["loc"]]
    owner: type | None = cls
    field = None
    for depth, key in enumerate(path):
        known = _fields(owner) if owner is not None else {}
        if owner is None:
            break  # inside a list or a table of the user's own
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known keys: {', '.join(known)}"
            place = ".".join([*before, *path[:depth]])
            return f"{place}{': ' if place else ''}unknown key '{_shorter(key)}'; {hint}"
        field = known[key]
        owner = _settings_in(field.annotation)
    name = _shorter(".".join([*before, *path]))
    if error["type"] == "missing":
        return f"key '{name}' is missing"
    if error["type"] == "value_error":  # of one value, or of a table: then it says itself which key it means
        separator = "" if not name else ": " if owner is None else "."
        return f"{name}{separator}{error['ctx']['error']}"
    assert field is not None, error
    return f"{name}: found {_shown(error['input'])}, expected {expectation(field)}"


def _fields(cls: type) -> dict[str, FieldInfo]:
    return getattr(cls, "__pydantic_fields__", {})


def _settings_in(annotation: Any) -> type | None:
    """The settings class in a type such as ``FitRun | None``."""
    options = typing.get_args(annotation) if _is_union(annotation) else (annotation,)
    return next((o for o in options if isinstance(o, type) and _fields(o)), None)


def _is_union(annotation: Any) -> bool:
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)


def _kind(annotation: Any) -> str:
    """A type in words."""
    origin, options = typing.get_origin(annotation), typing.get_args(annotation)
    if _is_union(annotation):
        return " or ".join(_kind(o) for o in options if o is not type(None))
    if origin is typing.Literal:
        return f"one of {', '.join(map(repr, options))}"
    if origin is tuple:
        return {Index: "a list of whole numbers not below 0", Name: "a list of names"}.get(options[0], "a list")
    if _fields(annotation):
        return f"a table of settings for {annotation.__name__}"
    names: dict[Any, str] = {int: "a whole number", float: "a finite number", bool: "true or false", str: "text"}
    return names.get(annotation, "a table")


def _plain(value: float) -> str:
    return f"{value:g}" if abs(value) < 1e5 or isinstance(value, float) else str(value)


def _shown(value: Any) -> str:
    return _shorter(repr(value)) if not isinstance(value, int) or abs(value) < 1 << 200 else "a number of many digits"


def _shorter(text: str) -> str:
    return text if len(text) <= _LONGEST_VALUE else text[:_LONGEST_VALUE] + "..."
