"""Scenes as plain dictionaries: the same one is loaded and written as XML.

A description is a nested dictionary as ``mi.load_dict`` takes it, of plain values: text, numbers, lists of numbers
(vectors), NumPy arrays of shape (4, 4) (transforms), `Parameter` and further dictionaries. ``{"type": "ref", "id": X}``
refers to an object of the scene's top level, whose id is its key there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from mifit.core.files import Document

KINDS = {
    "blendbsdf": "bsdf",
    "blinnphong": "bsdf",
    "diffuse": "bsdf",
    "normalmap": "bsdf",
    "roughconductor": "bsdf",
    "directional": "emitter",
    "point": "emitter",
    "envmap": "emitter",
    "shenv": "emitter",
    "hdrfilm": "film",
    "box": "rfilter",
    "independent": "sampler",
    "multijitter": "sampler",
    "scene": "scene",
    "perspective": "sensor",
    "pinhole": "sensor",
    "ply": "shape",
    "bitmap": "texture",
    "mesh_attribute": "texture",
}
"""What each plugin is: the name of its XML element. An ``integrator`` may be any."""


@dataclass(frozen=True)
class Parameter:
    """A value that a scene file names ``$name`` and gives a default."""

    name: str
    default: int | float | str


def to_mitsuba(description: Mapping[str, Any]) -> Document:
    """The description for ``mi.load_dict``: transforms as Mitsuba's, parameters as their defaults."""
    import mitsuba as mi

    def convert(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: convert(item) for key, item in value.items()}
        if isinstance(value, Parameter):
            return value.default
        if isinstance(value, np.ndarray) and value.shape == (4, 4):
            return mi.ScalarTransform4f(value)
        return value

    return convert(description)


def to_xml(description: Mapping[str, Any], comment: str = "") -> str:
    """The description of a whole scene as Mitsuba XML; files are named as they are.

    Raises
    ------
    KeyError
        A plugin that `KINDS` doesn't list.
    """
    lines = ['<scene version="3.0.0">']
    if comment:
        lines.append(f"    <!-- {comment} -->")
    for parameter in _parameters(description).values():
        lines.append(f'    <default name="{parameter.name}" value={quoteattr(str(parameter.default))}/>')
    for key, value in description.items():
        if key != "type":
            lines += _element(key, value, "    ", top=True)
    return "\n".join([*lines, "</scene>", ""])


def _parameters(description: Mapping[str, Any]) -> dict[str, Parameter]:
    found: dict[str, Parameter] = {}
    for value in description.values():
        if isinstance(value, Parameter):
            found[value.name] = value
        elif isinstance(value, Mapping):
            found |= _parameters(value)
    return found


def _element(name: str, value: Any, indent: str, top: bool = False) -> list[str]:
    """Lines of one property or object; floats with all their digits, so that the file says what was described."""
    label = f"name={quoteattr(name)}"
    if isinstance(value, Parameter):
        return [f'{indent}<{_tag(value.default)} {label} value="${value.name}"/>']
    if isinstance(value, np.ndarray):
        numbers = " ".join(repr(float(x)) for x in value.ravel())
        return [f'{indent}<transform {label}><matrix value="{numbers}"/></transform>']
    if isinstance(value, (list, tuple)):
        return [f'{indent}<vector {label} value="{", ".join(repr(float(x)) for x in value)}"/>']
    if not isinstance(value, Mapping):
        return [f"{indent}<{_tag(value)} {label} value={quoteattr(_text(value))}/>"]
    if value["type"] == "ref":
        return [f"{indent}<ref id={quoteattr(value['id'])} {label}/>"]
    if value["type"] == "rgb":
        return [f'{indent}<rgb {label} value="{", ".join(repr(float(x)) for x in value["value"])}"/>']
    tag = name if name == "integrator" else KINDS[value["type"]]
    inner = [line for key, item in value.items() if key != "type" for line in _element(key, item, indent + "    ")]
    start = f'{indent}<{tag} type="{value["type"]}" {f"id={quoteattr(name)}" if top else label}'
    return [start + ">", *inner, f"{indent}</{tag}>"] if inner else [start + "/>"]


def _tag(value: Any) -> str:
    for kind, tag in ((bool, "boolean"), (int, "integer"), (float, "float"), (str, "string")):
        if isinstance(value, kind):
            return tag
    raise TypeError(f"scene description: found a value of type {type(value).__name__}")


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(float(value)) if isinstance(value, float) else str(value)  # NumPy's floats call themselves so
