"""Settings: one frozen dataclass per stage, read from TOML or dictionaries with unknown keys refused."""

from __future__ import annotations

import dataclasses
import difflib
import sys
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from mifit.errors import InputError


@dataclass(frozen=True)
class GeometryConfig:
    """Stage 1, morphable-model fitting (paper, section 4).

    ``objective = "consistency"`` weights its terms by their noise and lets every surface point have its own albedo;
    ``"paper"`` is the paper's objective, whose weights and units (0..255, pixels) the next group gives.
    """

    objective: Literal["consistency", "paper"] = "consistency"
    rounds: int = 2  # outer steps: visibility is found anew in each
    landmark_noise: float = 1.0  # least standard deviation of a landmark coordinate, pixels; residuals may raise it
    scale_deviation: float = 0.0  # standard deviation of the model's log scale; 0: the units are trusted
    camera_gains: bool = False  # find each camera's exposure and white balance relative to the first one's
    # objective "paper"
    landmark_weight: float = 10.0
    prior_weight: float = 5e-5
    pixels: int = 2000  # facial pixels per image, chosen at random
    robust_colour: float = 30.0  # residual (0..255) from which a pixel counts as an outlier
    albedo_prior: float = 1.0
    # objective "consistency"
    surface_points: int = 3000
    texture_weight: float = 0.03  # independent measurements per surface point and image: neighbours share pixels
    texture_sigma: float = 1.0  # fine and wide blur whose difference is the texture, pixels
    texture_window: float = 6.0
    max_iterations: int = 30

    def __post_init__(self) -> None:
        for name in ("landmark_noise", "robust_colour", "texture_weight", "texture_window"):
            if not getattr(self, name) > 0:
                raise ValueError(f"geometry.{name}: found {getattr(self, name)}, expected a number above 0")
        for name in ("scale_deviation", "landmark_weight", "prior_weight", "albedo_prior", "rounds"):
            if getattr(self, name) < 0:
                raise ValueError(f"geometry.{name}: found {getattr(self, name)}, expected a number not below 0")
        for name in ("pixels", "surface_points", "max_iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"geometry.{name}: found {getattr(self, name)}, expected 1 or more")
        if not 0 <= self.texture_sigma < self.texture_window:
            raise ValueError(
                f"geometry.texture_sigma: found {self.texture_sigma}, expected 0 or more and below texture_window, "
                f"{self.texture_window}"
            )


@dataclass(frozen=True)
class ShapeConfig:
    """Stage 1 once more with stage 2's light (``stages.refine_shape``), then stage 2 again.

    Attributes
    ----------
    rounds : int
        How often; 0 leaves it out. A round takes about as long as stage 2.
    shading_weight : float
        Independent measurements per pixel of shading, whose errors neighbours share.
    """

    rounds: int = 0
    shading_weight: float = 0.015

    def __post_init__(self) -> None:
        if not 0 <= self.rounds <= 10:
            raise ValueError(f"shape.rounds: found {self.rounds}, expected 0 to 10")
        if not self.shading_weight > 0:
            raise ValueError(f"shape.shading_weight: found {self.shading_weight}, expected a number above 0")


@dataclass(frozen=True)
class ReflectanceConfig:
    """Stage 2, reflectance inference (paper, section 5).

    Attributes
    ----------
    texture_size : int
        Side of the maps in texels.
    solver : {"als", "adam"}
        ``als``: lighting with the texels eliminated, then the maps by ADMM; ``adam``: the paper's gradient descent.
    shading : {"auto", "paper", "prefiltered", "shadowed", "keyed"}
        Image-formation model; ``auto`` takes the cheapest that explains the images.
    bands : int
        Bands of the lighting of ``prefiltered`` and ``shadowed``, 3 to 10; ``paper`` has 3.
    exponent : float or None
        Blinn-Phong exponent; without one it is 5 for ``paper``, as in the paper, and estimated otherwise.
    specular_difference_weight, smoothness_weight : float
        The paper's lambda_S and lambda_H.
    specular_smoothness : float
        Factor on lambda_H for the specular map: one channel, seen only where there is a highlight.
    robust : bool
        Give outliers less weight, and weight by a noise model (``als``); without it ``als`` minimises the paper's
        objective as it stands.
    symmetric_fill : bool
        Fill what no image shows from the opposite half of the face, where that was seen.
    max_iterations : int
        Gauss-Newton iterations (``als``), or tens of gradient steps (``adam``).
    """

    texture_size: int = 512
    solver: Literal["als", "adam"] = "als"
    shading: Literal["auto", "paper", "prefiltered", "shadowed", "keyed"] = "auto"
    bands: int = 10
    exponent: float | None = None
    specular_difference_weight: float = 0.1
    smoothness_weight: float = 0.001
    specular_smoothness: float = 1000.0
    robust: bool = True
    symmetric_fill: bool = False
    max_iterations: int = 30


@dataclass(frozen=True)
class NormalsConfig:
    """Stage 3, normal refinement (paper, section 6).

    Attributes
    ----------
    solver : {"gauss_newton", "adam"}
        ``adam`` is the paper's; both minimise the same energy.
    laplacian_weight, magnitude_weight : float
        The paper's w1 and w2, for images and normal maps in 8-bit steps (``stages.refine_normals``). The paper has
        w2 = 0.3; with ten times that, path-traced captures keep the accuracy of the model's normals.
    max_iterations : int
    """

    solver: Literal["gauss_newton", "adam"] = "gauss_newton"
    laplacian_weight: float = 1e-3
    magnitude_weight: float = 3.0
    max_iterations: int = 100

    def __post_init__(self) -> None:
        for name in ("laplacian_weight", "magnitude_weight"):
            if getattr(self, name) < 0:
                raise ValueError(f"normals.{name}: found {getattr(self, name)}, expected a number not below 0")
        if self.max_iterations < 1:
            raise ValueError(f"normals.max_iterations: found {self.max_iterations}, expected 1 or more")


@dataclass(frozen=True)
class MeshConfig:
    """Vertices from refined normals (``stages.refine_mesh``).

    Attributes
    ----------
    subdivisions : int
        Times that every face is split into four first: a mesh holds no detail finer than its edges.
    detail : float
        Length in centimetres below which shape comes from the normals and above which it comes from the positions.
    """

    subdivisions: int = 0
    detail: float = 0.3

    def __post_init__(self) -> None:
        if not 0 <= self.subdivisions <= 3:
            raise ValueError(f"mesh.subdivisions: found {self.subdivisions}, expected 0 to 3")
        if not self.detail > 0:
            raise ValueError(f"mesh.detail: found {self.detail}, expected a number above 0")


@dataclass(frozen=True)
class FitConfig:
    """All settings of ``mifit.fit``."""

    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    reflectance: ReflectanceConfig = field(default_factory=ReflectanceConfig)
    normals: NormalsConfig = field(default_factory=NormalsConfig)
    mesh: MeshConfig = field(default_factory=MeshConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)

    @classmethod
    def load(cls, path: str | Path) -> FitConfig:
        """Read a TOML file with one table per stage; raises InputError that names file, key and value."""
        return from_mapping(cls, read_toml(path), str(path))


def read_toml(path: str | Path) -> dict[str, Any]:
    """Parse a TOML file; raises InputError when it is missing or malformed."""
    try:
        import tomllib
    except ModuleNotFoundError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef]
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such configuration file") from None
    except (OSError, ValueError, RecursionError) as error:  # ValueError: also whole numbers of thousands of digits
        raise InputError(f"{path}: not a readable TOML file: {error}") from None


def from_mapping(cls: type, values: Any, where: str) -> Any:
    """Build a config dataclass from nested dictionaries.

    Parameters
    ----------
    cls : type
        A config dataclass.
    values : dict
        Its settings; missing keys keep their defaults.
    where : str
        File or option that the values come from, for messages.

    Raises
    ------
    InputError
        Unknown key (the nearest known one is named) or a value of the wrong type.
    """
    if not isinstance(values, dict):
        raise InputError(f"{where}: found {values!r}, expected a table of settings for {cls.__name__}")
    hints = typing.get_type_hints(cls)
    known = [f.name for f in dataclasses.fields(cls)]
    arguments = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"known keys: {', '.join(known)}"
            raise InputError(f"{where}: unknown key '{key}'; {hint}")
        arguments[key] = _convert(hints[key], value, f"{where}: {key}")
    missing = dataclasses.MISSING
    for f in dataclasses.fields(cls):
        if f.name not in arguments and f.default is missing and f.default_factory is missing:
            raise InputError(f"{where}: key '{f.name}' is missing")
    try:
        return cls(**arguments)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def _convert(hint: Any, value: Any, where: str) -> Any:
    """Check one value against its type hint and return it as that type."""
    origin, options = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return from_mapping(typing.cast(type, hint), value, where)
    if origin is Literal:
        if value not in options:
            raise InputError(f"{where}: found {value!r}, expected one of {', '.join(map(repr, options))}")
        return value
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in options:
            return None
        return _convert(next(o for o in options if o is not type(None)), value, where)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise InputError(f"{where}: found {value!r}, expected a list")
        return tuple(_convert(options[0], v, where) for v in value)
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not abs(value) <= sys.float_info.max:  # neither NaN, nor infinite, nor an integer of hundreds of digits
            raise InputError(f"{where}: found {str(value)[:40]}, expected a finite number")
        return float(value)
    if isinstance(value, bool) != (hint is bool) or not isinstance(value, hint):
        raise InputError(f"{where}: found {value!r}, expected a value of type {hint.__name__}")
    return value
