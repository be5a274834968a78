"""Scenes as plain dictionaries: the same one is loaded and written as XML.

A description is a nested dictionary as ``mi.load_dict`` takes it, of plain values: text, numbers, lists of numbers
(vectors), NumPy arrays of shape (4, 4) (transforms) and further dictionaries. ``{"type": "ref", "id": X}`` refers to an
object of the scene's top level, whose id is its key there.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import numpy as np

from mifit.core.files import Document

OWN = {"blinnphong": "BSDF", "pinhole": "Sensor", "shenv": "Emitter"}
"""What mifit's plugins are, by the names of ``mi.ObjectType``: they are registered with one variant, or with none."""


def to_mitsuba(description: Mapping[str, object], transform: Callable[[np.ndarray], object] | None = None) -> Document:
    """The description for ``mi.load_dict``: its transforms are Mitsuba's, by default of the active variant."""
    import mitsuba as mi

    made = transform or mi.ScalarTransform4f

    def convert(value: object) -> object:
        if isinstance(value, Mapping):
            return {key: convert(item) for key, item in value.items()}
        return made(value) if isinstance(value, np.ndarray) else value

    return {key: convert(item) for key, item in description.items()}


def to_xml(description: Mapping[str, object], comment: str = "") -> str:
    """The description of a whole scene as Mitsuba XML, whatever variant is active, or none.

    ``$spp``, ``$resx`` and ``$resy`` are parameters of the file, and ``$max_depth`` where the integrator has one.
    """
    import mitsuba as mi
    from mitsuba import scalar_rgb

    content = to_mitsuba(description, scalar_rgb.ScalarTransform4d)
    state = mi.parser.parse_dict(mi.parser.ParserConfig("scalar_rgb"), content)
    for node in state.nodes:
        if (name := node.props.plugin_name()) in OWN:
            node.type = getattr(mi.ObjectType, OWN[name])
    text = mi.parser.write_string(state)
    text = re.sub(r'^(    <\w+ type="\w+") name=', r"\1 id=", text, flags=re.MULTILINE)  # of the scene's own objects
    depth = re.search(r'(?<=name="max_depth" value=")\d+(?=")', text)
    head = f"    <!-- {comment} -->\n" if comment else ""
    if depth:
        text = f"{text[: depth.start()]}$max_depth{text[depth.end() :]}"
        head += f'    <default name="max_depth" value="{depth[0]}"/>\n'
    first, rest = text.split("\n", 1)
    return f"{first}\n{head}{rest}"
