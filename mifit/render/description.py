"""Scenes as plain dictionaries: the same one is loaded and written as XML.

A description is a nested dictionary as ``mi.load_dict`` takes it, of plain values: text, numbers, lists of numbers
(vectors), NumPy arrays of shape (4, 4) (transforms), `Parameter` and further dictionaries. ``{"type": "ref", "id": X}``
refers to an object of the scene's top level, whose id is its key there.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mifit.core.files import Document

KINDS = {
    "blinnphong": "bsdf",
    "directional": "emitter",
    "envmap": "emitter",
    "shenv": "emitter",
    "hdrfilm": "film",
    "box": "rfilter",
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


def to_mitsuba(description: Mapping[str, object]) -> Document:
    """The description for ``mi.load_dict``: transforms as Mitsuba's, parameters as their defaults."""
    import mitsuba as mi

    def convert(value: object) -> object:
        if isinstance(value, Mapping):
            return {key: convert(item) for key, item in value.items()}
        if isinstance(value, Parameter):
            return value.default
        if isinstance(value, np.ndarray) and value.shape == (4, 4):
            return mi.ScalarTransform4f(value)
        return value

    return {key: convert(item) for key, item in description.items()}


def to_xml(description: Mapping[str, object], comment: str = "") -> str:
    """The description of a whole scene as Mitsuba XML; KeyError for a plugin that `KINDS` doesn't list."""
    root = ET.Element("scene", version="3.0.0")
    if comment:
        root.append(ET.Comment(f" {comment} "))
    for parameter in _parameters(description).values():
        ET.SubElement(root, "default", name=parameter.name, value=str(parameter.default))
    for key, value in description.items():
        if key != "type":
            _add(root, key, value, "id")
    ET.indent(root, "    ")
    return ET.tostring(root, encoding="unicode") + "\n"


def _parameters(description: Mapping[str, object]) -> dict[str, Parameter]:
    found: dict[str, Parameter] = {}
    for value in description.values():
        if isinstance(value, Parameter):
            found[value.name] = value
        elif isinstance(value, Mapping):
            found |= _parameters(value)
    return found


def _add(parent: ET.Element, name: str, value: object, label: str = "name") -> None:
    """Add a property or object; floats with all their digits, so that the file says what was described."""
    if isinstance(value, Parameter):
        ET.SubElement(parent, _tag(value.default), name=name, value=f"${value.name}")
    elif isinstance(value, np.ndarray):
        numbers = " ".join(repr(float(x)) for x in value.ravel())
        ET.SubElement(ET.SubElement(parent, "transform", name=name), "matrix", value=numbers)
    elif isinstance(value, (list, tuple)):
        ET.SubElement(parent, "vector", name=name, value=", ".join(repr(float(x)) for x in value))
    elif not isinstance(value, Mapping):
        ET.SubElement(parent, _tag(value), name=name, value=_text(value))
    elif value["type"] == "ref":
        ET.SubElement(parent, "ref", id=value["id"], name=name)
    elif value["type"] == "rgb":
        ET.SubElement(parent, "rgb", name=name, value=", ".join(repr(float(x)) for x in value["value"]))
    else:
        tag = name if name == "integrator" else KINDS[value["type"]]
        added = ET.SubElement(parent, tag, {"type": value["type"], label: name})
        for key, item in value.items():
            if key != "type":
                _add(added, key, item)


def _tag(value: object) -> str:
    for kind, tag in ((bool, "boolean"), (int, "integer"), (float, "float"), (str, "string")):
        if isinstance(value, kind):
            return tag
    raise TypeError(f"scene description: found a value of type {type(value).__name__}")


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(float(value)) if isinstance(value, float) else str(value)  # NumPy's floats call themselves so
