"""Loading of Mitsuba scenes that use the plugins, scenes as XML, and calibrated cameras as Mitsuba's sensors.

A description is a nested dictionary as ``mi.load_dict`` takes it, of plain values: text, numbers, lists of numbers
(vectors), NumPy arrays of shape (4, 4) (transforms) and further dictionaries. ``{"type": "ref", "id": X}`` refers to an
object of the scene's top level, whose id is its key there.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.appearance.arrays import mi
from mifit.core.camera import Camera
from mifit.core.files import Document
from mifit.errors import InputError
from mifit.render.plugins import register_plugins

OWN = {"blinnphong": "BSDF", "pinhole": "Sensor", "shenv": "Emitter"}
"""What mifit's plugins are, by the names of ``mi.ObjectType``: they are registered with one variant, or with none."""


def load_scene(source: str | Path | Mapping[str, object], **parameters: object) -> mi.Scene:
    """A Mitsuba scene from an XML file or a dictionary, with mifit's plugins registered.

    Equal objects are not merged, so parameters keep the names that the scene gives them. The ``radius`` of each
    ``shenv`` is set to hold the scene. ``parameters`` are values for the ``$name`` parameters of an XML file.
    InputError where the file is missing or isn't a scene, or a plugin refuses its parameters.
    """
    register_plugins()
    if isinstance(source, Mapping):
        where, load = "scene dictionary", partial(mi.load_dict, dict(source))
    else:
        where, suffix = str(source), Path(source).suffix
        if not Path(source).is_file():
            raise InputError(f"{where}: no such scene file")
        if suffix.lower() != ".xml":
            raise InputError(f"{where}: found a file of the kind '{suffix}', expected a scene in XML")
        load = partial(mi.load_file, where, **{name: str(value) for name, value in parameters.items()})
    try:
        # Not in parallel: plugins written in Python are built one at a time in any case.
        scene = load(parallel=False, optimize=False)
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"{where}: {_one_line(str(error))}") from error
    if not isinstance(scene, mi.Scene):
        raise InputError(f"{where}: found {type(scene).__name__}, expected a scene")
    fit_environment(scene)
    return scene


def fit_environment(scene: mi.Scene) -> None:
    """Give each ``shenv`` a radius about the origin that holds the scene and its sensors."""
    box = scene.bbox()
    corners = [np.array(box.corner(i)).ravel() for i in range(8)] if box.valid() else []
    reach = max((float(np.linalg.norm(corner)) for corner in corners), default=1.0)
    for emitter in scene.emitters():
        if type(emitter).__name__ == "SHEnvironment":
            emitter.radius = mi.Float(max(1.1 * reach, 1e-3))


def _one_line(message: str) -> str:
    """The parts of Mitsuba's message that say what is wrong, without the traceback of a Python plugin."""
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    kept = [line for line in lines if not line.startswith(("File ", "Traceback", "raise ", "^", "~"))]
    causes = [line.split("Error: ", 1)[1] for line in kept if "Error: " in line]
    return causes[-1] if causes else "; ".join(kept)


def render_scene(
    path: str | Path, parameters: Mapping[str, object], spp: int, seed: int = 0, sensor: int = 0
) -> NDArray[np.float32]:
    """What a scene file's film holds, (H, W, C): linear radiance on black, and coverage where it has alpha.

    ``parameters`` are values of the file's ``<default>`` names, ``sensor`` says which of the scene's sensors.
    """
    scene = load_scene(path, **parameters)
    image = mi.render(scene, sensor=sensor, spp=spp, seed=seed)  # type: ignore[arg-type]
    return np.array(image, dtype=np.float32)


def sensor_description(camera: Camera, spp: int = 16) -> Document:
    """The sensor of an undistorted camera, as a description.

    Square pixels give Mitsuba's ``perspective``, others mifit's ``pinhole``. ``spp`` samples are drawn per pixel.
    InputError for a camera with lens distortion.
    """
    if any(camera.distortion):
        raise InputError(f"camera {camera.name}: found lens distortion, expected an undistorted camera")
    if abs(camera.fx / camera.fy - 1.0) <= 1e-6:  # a thousandth of a pixel in 1000
        lens: Document = {
            "type": "perspective",
            "fov": math.degrees(2.0 * math.atan(0.5 * camera.width / camera.fx)),
            "fov_axis": "x",
            # Mitsuba moves the film, not the point.
            "principal_point_offset_x": 0.5 - camera.cx / camera.width,
            "principal_point_offset_y": 0.5 - camera.cy / camera.height,
        }
    else:
        lens = {"type": "pinhole"} | {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    pose = np.linalg.inv(camera.world_to_camera)
    pose[:, :2] = 0.0 - pose[:, :2]  # Mitsuba's axes are x left, y up, z forward; no zero gets a sign
    return lens | {
        "near_clip": 1e-2,
        "far_clip": 1e4,
        "to_world": pose,
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgba",
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter", "sample_count": spp},
    }


def make_sensor(camera: Camera, spp: int = 16) -> mi.Sensor:
    """The loaded ``mi.Sensor`` of `sensor_description`; InputError as there."""
    register_plugins()
    return mi.load_dict(to_mitsuba(sensor_description(camera, spp)))


def to_mitsuba(description: Mapping[str, object], transform: Callable[[np.ndarray], object] | None = None) -> Document:
    """The description for ``mi.load_dict``: its transforms are Mitsuba's, by default of the active variant."""
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
