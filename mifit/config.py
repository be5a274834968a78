"""Settings of a fit: one table for each stage, each value with its range, unit and meaning.

Settings are frozen dataclasses. pydantic checks values where they are read, from TOML, from dictionaries or from
Python, all in one way; a refusal is one line that names the key, the value found and what was expected.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import pydantic
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails
from typing_extensions import dataclass_transform

from mifit.errors import InputError

T = TypeVar("T")
Name = Annotated[str, pydantic.Field(strict=True, pattern=r"^[^\x00]+$")]
Index = Annotated[int, pydantic.Field(strict=True, ge=0)]


def number(
    default: float | None,
    meaning: str,
    unit: str = "",
    *,
    source: str = "",
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
) -> Any:
    """A field with a number between bounds, in a unit; ``source`` says where its default comes from.

    ``chosen on scan_city`` names the head whose errors chose it; ``set by hand``: no data did.
    """
    meaning += f" ({source})" if source else ""
    field: dict = {"ge": least, "gt": above, "le": most, "strict": True, "json_schema_extra": {"unit": unit}}
    return pydantic.Field(default, description=meaning, **{k: v for k, v in field.items() if v is not None})


def one_of(default: str, meaning: str) -> Any:
    """A field with one of the values that its ``Literal`` lists."""
    return pydantic.Field(default, description=meaning)


def flag(default: bool, meaning: str) -> Any:
    """A field that is true or false."""
    return pydantic.Field(default, description=meaning, strict=True)


def text(default: object, meaning: str, *, pattern: str = r"^[^\x00]+$") -> Any:
    """A field with text that isn't empty; ``...`` as the default: it must be given."""
    return pydantic.Field(default, description=meaning, strict=True, pattern=pattern)


def several(default: tuple | None, meaning: str) -> Any:
    """A field with a list that isn't empty, of type ``tuple[Name, ...]`` or ``tuple[Index, ...]``."""
    return pydantic.Field(default, description=meaning, min_length=1)


def part(cls: type | None = None, meaning: str = "") -> Any:
    """A field with the settings of a part; ``dict``: names of the user's own and their values; None: may be missing."""
    if cls is None:
        return pydantic.Field(None, description=meaning)
    return pydantic.Field(default_factory=cls, description=meaning)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def settings(cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass of checked settings; a bad value raises InputError."""
    config = pydantic.ConfigDict(extra="forbid", allow_inf_nan=False)
    made = pydantic.dataclasses.dataclass(frozen=True, config=config)(cls)
    construct = made.__init__

    def __init__(self: object, *args: object, **kwargs: object) -> None:
        try:
            construct(self, *args, **kwargs)
        except pydantic.ValidationError as error:
            raise InputError(_message("", made, error, cls.__name__.removesuffix("Config").lower())) from None

    made.__init__ = __init__  # type: ignore[method-assign]
    return typing.cast("type[T]", made)


def from_mapping(cls: type[T], values: object, where: str) -> T:
    """Settings of a class made by `settings`, from nested dictionaries; missing keys keep their defaults.

    ``where`` is the file or option that the values come from, for messages. InputError for an unknown key (the nearest
    known one is named) or a value of the wrong type or out of range.
    """
    if not isinstance(values, dict):
        raise InputError(f"{where}: found {_shown(values)}, expected a table of settings for {cls.__name__}")
    try:
        return pydantic.TypeAdapter(cls).validate_python(values)
    except pydantic.ValidationError as error:
        raise InputError(_message(where, cls, error)) from None


DEEPEST = 50
"""Levels of tables and lists in a TOML file: a dotted key makes thousands, and what copies them recurses."""


def read_toml(path: str | Path) -> dict:
    """Parse a TOML file; raises InputError when it is missing or malformed."""
    try:
        return parse_toml(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such configuration file") from None
    except (OSError, ValueError, RecursionError) as error:  # ValueError: also whole numbers of thousands of digits
        raise InputError(f"{path}: not a readable TOML file: {error}") from None


def parse_toml(text: str) -> dict:
    """Parse TOML; raises ValueError or RecursionError."""
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef]
    document = tomllib.loads(text)
    level: list = [document]
    for _ in range(DEEPEST):
        level = [v for t in level for v in (t.values() if isinstance(t, dict) else t) if isinstance(v, (dict, list))]
    if level:
        raise ValueError(f"found more than {DEEPEST} levels of tables and lists, expected fewer")
    return document


WEIGHT = 1e9  # above any weight that makes sense, below what overflows in float32


@settings
class GeometryConfig:
    """Stage 1, morphable-model fitting (paper, section 4).

    ``objective = "landmarks"`` weights landmarks by their noise and leaves the images to the surface; ``"paper"`` is
    the paper's objective as written, whose weights are for colours of 0..255 and for pixels.
    """

    objective: Literal["landmarks", "paper"] = one_of("landmarks", "what is minimised")
    eyes: bool = flag(True, "give a model whose eyes are holes simple eyes and the inside of a mouth")
    rounds: int = number(
        2, "objective paper: outer steps, in each of which visibility is found anew", source="cost", least=0, most=100
    )
    landmark_noise: float = number(
        1.0,
        "least standard deviation of a landmark coordinate; residuals may raise it",
        "pixels",
        source="set by hand",
        above=0,
        most=1000,
    )
    scale_deviation: float = number(
        0.0,
        "standard deviation of the model's log scale; 0: the units are trusted",
        source="units are given",
        least=0,
        most=10,
    )
    landmark_weight: float = number(
        10.0, "objective paper: weight of the landmarks", source="paper", least=0, most=WEIGHT
    )
    prior_weight: float = number(
        5e-5, "objective paper: weight of the model's prior", source="paper", least=0, most=WEIGHT
    )
    pixels: int = number(
        2000, "facial pixels per image, chosen at random", source="set by hand", least=1, most=1_000_000
    )
    robust_colour: float = number(
        30.0,
        "albedo and lighting: residual from which a pixel counts as an outlier",
        "of 255",
        source="set by hand",
        above=0,
        most=WEIGHT,
    )
    max_iterations: int = number(30, "Gauss-Newton iterations of a round", source="limit", least=1, most=10_000)


SHADINGS = ["auto", "paper", "printed", "prefiltered", "shadowed"]
"""What ``shading`` may be; registering a shading model (``appearance.models``) adds its name."""


def _known_shading(name: str) -> str:
    if name not in SHADINGS:
        near = difflib.get_close_matches(name, SHADINGS, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"found {name!r}, expected one of {', '.join(map(repr, SHADINGS))}{hint}")
    return name


@settings
class SurfaceConfig:
    """The surface beyond the model's span (``stages.find_surface``); needs two views or more."""

    enabled: bool = flag(True, "move the surface to where all views agree; false: it stays in the model's span")
    reach: float = number(
        8.0, "distance from the surface that is searched first", "millimetres", source="set by hand", above=0, most=100
    )
    stiffness: float = number(
        4.0,
        "resistance of the displacement to bending, relative to the precision of measurements",
        source="chosen on scan_city",
        above=0,
        most=WEIGHT,
    )
    shading: bool = flag(True, "move the surface by what its shading and highlights show, once the light is known")
    close_lips: bool = flag(True, "close the lips on the lip line where the images show a closed mouth")
    close_lids: bool = flag(True, "close the lids where the images show closed eyes")
    finest: int = number(
        0, "times that the images are halved at the finest level", source="all that images hold", least=0, most=6
    )


@settings
class PhotometryConfig:
    """Gains of cameras and exposures of images (``stages.photometry``)."""

    enabled: bool = flag(
        True, "divide images by gains of cameras and exposures of images where they surely differ; needs two timesteps"
    )


@settings
class ReflectanceConfig:
    """Stage 2, reflectance inference (paper, section 5)."""

    texture_size: int = number(512, "side of the maps", "texels", source="cost", least=16, most=4096)
    shading: Annotated[str, pydantic.AfterValidator(_known_shading)] = one_of(
        "auto", "paper, printed, prefiltered, shadowed, or another that is registered; auto is shadowed"
    )
    bands: int = number(
        10,
        "bands of the lighting of prefiltered and shadowed; paper has 3",
        source="the most that Dr.Jit evaluates",
        least=3,
        most=10,
    )
    exponent: float | None = number(
        None,
        "Blinn-Phong exponent; none: 5 for paper, else 80",
        source="chosen on gloss",
        least=1,
        most=10_000,
    )
    specular: bool = flag(True, "find specular reflection; false: all is diffuse")
    specular_albedo: float = number(
        0.03,
        "most specular albedo to expect, below 1 at most twice the least; more for what outshines skin",
        source="measured index of refraction of skin",
        above=0,
        most=2,
    )
    specular_difference_weight: float = number(0.1, "the paper's lambda_S", source="paper", least=0, most=WEIGHT)
    smoothness_weight: float = number(0.001, "the paper's lambda_H", source="paper", least=0, most=WEIGHT)
    specular_smoothness: float = number(
        1000.0,
        "factor on lambda_H for the specular map: one channel, seen only where there is a highlight",
        source="set by hand",
        least=0,
        most=WEIGHT,
    )
    robust: bool = flag(
        True,
        "give outliers less weight, and weight by a noise model; false: minimise the paper's objective as it stands",
    )
    segment: bool = flag(
        True, "leave out what hides the face in an image: hair, cloth, glasses, a hand; with robust alone"
    )
    residual_shading: bool = flag(
        True, "both halves of the face share their skin; the rest belongs to the capture's light; with robust alone"
    )
    max_iterations: int = number(30, "Gauss-Newton iterations of the lighting", source="limit", least=1, most=10_000)


@settings
class NormalsConfig:
    """Stage 3, normal refinement (paper, section 6).

    With the paper's w2 normals of path-traced captures get worse than the model's.
    """

    laplacian_weight: float = number(
        1e-3, "the paper's w1, for images and normal maps in 8-bit steps", source="paper", least=0, most=WEIGHT
    )
    magnitude_weight: float = number(
        3.0, "the paper's w2, likewise", source="chosen on soft; paper: 0.3", least=0, most=WEIGHT
    )
    max_iterations: int = number(100, "iterations at most", source="limit", least=1, most=100_000)


@settings
class MeshConfig:
    """Vertices from refined normals (``stages.refine_mesh``)."""

    detail: float = number(
        0.3, "length below which shape comes from the normals", "centimetres", source="set by hand", above=0, most=100
    )


@settings
class ResidualConfig:
    """What the images of each timestep show beyond the model (``stages.find_residual``)."""

    enabled: bool = flag(
        True, "keep what images show beyond the model, for views of fitted timesteps in the capture's own light"
    )
    prior: float = number(
        0.5,
        "views without any residual that count against those of a timestep",
        source="set by hand",
        above=0,
        most=1000,
    )


@settings
class FitConfig:
    """All settings of ``mifit.fit``.

    Each part has its values, units and bounds in ``docs/settings.md``; InputError for a value out of bounds.

    Examples
    --------
    >>> FitConfig(reflectance=ReflectanceConfig(texture_size=256)).reflectance.bands
    10
    """

    geometry: GeometryConfig = part(GeometryConfig)
    surface: SurfaceConfig = part(SurfaceConfig)
    photometry: PhotometryConfig = part(PhotometryConfig)
    reflectance: ReflectanceConfig = part(ReflectanceConfig)
    normals: NormalsConfig = part(NormalsConfig)
    mesh: MeshConfig = part(MeshConfig)
    residual: ResidualConfig = part(ResidualConfig)

    @classmethod
    def load(cls, path: str | Path) -> FitConfig:
        """Read a TOML file with one table per stage; raises InputError that names file, key and value."""
        return from_mapping(cls, read_toml(path), str(path))

    @classmethod
    def paper(cls) -> FitConfig:
        """The paper as it is written: its terms, weights, units, starts and order, and nothing added (docs/paper.md).

        Its smoothness weight 0.001 is for colours and maps of 0..255: E_O grows with their square, E_H with them, so
        that with values of 0..1 it is 0.001 / 255.
        """
        return cls(
            geometry=GeometryConfig(objective="paper", eyes=False),
            surface=SurfaceConfig(enabled=False),
            photometry=PhotometryConfig(enabled=False),
            reflectance=ReflectanceConfig(
                shading="printed", robust=False, smoothness_weight=0.001 / 255.0, specular_smoothness=1.0
            ),
            normals=NormalsConfig(magnitude_weight=0.3),
            residual=ResidualConfig(enabled=False),
        )


PRESETS = {"default": FitConfig, "paper": FitConfig.paper}
"""What ``mifit fit --preset`` knows."""


def list_settings(cls: type, prefix: str = "") -> Iterator[tuple[str, object, str, str]]:
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
    bounds: dict = {
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
    found = [_line(cls, e, [table] if table else []) for e in error.errors(include_url=False)[:3]]
    return (f"{where}: " if where else "") + "; ".join(dict.fromkeys(found))


def _line(cls: type, error: ErrorDetails, before: list[str]) -> str:
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


def _settings_in(annotation: object) -> type | None:
    """The settings class in a type such as ``FitRun | None``."""
    options = typing.get_args(annotation) if _is_union(annotation) else (annotation,)
    return next((o for o in options if isinstance(o, type) and _fields(o)), None)


def _is_union(annotation: object) -> bool:
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)


def _kind(annotation: object) -> str:
    """A type in words."""
    origin, options = typing.get_origin(annotation), typing.get_args(annotation)
    if _is_union(annotation):
        return " or ".join(_kind(o) for o in options if o is not type(None))
    if origin is typing.Literal:
        return f"one of {', '.join(map(repr, options))}"
    if origin is tuple:
        return {Index: "a list of whole numbers not below 0", Name: "a list of names"}.get(options[0], "a list")
    if isinstance(annotation, type) and _fields(annotation):
        return f"a table of settings for {annotation.__name__}"
    names: dict[object, str] = {int: "a whole number", float: "a finite number", bool: "true or false", str: "text"}
    return names.get(annotation, "a table")


def _plain(value: float) -> str:
    return f"{value:g}" if abs(value) < 1e5 or isinstance(value, float) else str(value)


def _shown(value: object) -> str:
    return _shorter(repr(value)) if not isinstance(value, int) or abs(value) < 1 << 200 else "a number of many digits"


def _shorter(text: str) -> str:
    return text if len(text) <= 60 else text[:60] + "..."
