"""Cameras that Agisoft Metashape exports (File > Export > Export Cameras, Agisoft XML).

A camera's ``transform`` goes from its OpenCV axes to the chunk, the chunk's or component's ``transform`` (rotation,
translation and scale) from there to the reference coordinates. Metashape's pixels are ours (the first centre at 0.5,
0.5), its principal point is an offset from the image's centre, ``b1`` is the focal length's excess along x, and its
tangential coefficients come in Brown's order (Metashape's manual, appendix on camera models).
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from mifit.capture.opencv_nodes import parse_xml
from mifit.capture.transforms import View, invert_pose
from mifit.core.files import read_text
from mifit.core.limits import MAX_PIXELS, MAX_XML_BYTES
from mifit.errors import InputError
from mifit.extras.photos import Photo, local, opencv_lens, parse_numbers, view_name

COEFFICIENTS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")

_Sensor = tuple[int, int, tuple[float, float, float, float], tuple[float, ...]]


def read_metashape(path: str | Path) -> tuple[Photo, ...]:
    """Read the aligned, enabled cameras of a file; cameras without a pose are left out.

    Each photograph is named by its label, which Metashape takes from the file's name.

    Raises
    ------
    InputError
        A missing, malformed or too large file, no frame camera, a lens that OpenCV's model lacks, or a pose that isn't
        one.
    """
    path = Path(path)
    root = parse_xml(read_text(path, MAX_XML_BYTES, "XML file"), f"{path}: not a readable Metashape XML file")
    chunk = root.find("chunk")
    if root.tag != "document" or chunk is None:
        raise InputError(f"{path}: found no chunk of a document, expected cameras exported as Agisoft XML")
    sensors: dict[str, _Sensor | None] = {}
    for node in chunk.iterfind("sensors/sensor"):
        sensors[node.get("id", "")] = _sensor(node, f"{path}: sensor {node.get('label') or node.get('id')!r}")
    frames = {"": _similarity(chunk.find("transform"), f"{path}: chunk")}
    for node in chunk.iterfind("components/component"):
        found = node.find("transform")
        if found is not None:
            frames[node.get("id", "")] = _similarity(found, f"{path}: component {node.get('id')}")
    photos = []
    for node in chunk.iterfind("cameras//camera"):
        label, where = node.get("label", ""), f"{path}: camera {node.get('label')!r}"
        pose = node.find("transform")
        if pose is None or node.get("enabled", "true") in ("false", "0"):
            continue
        if not label:
            raise InputError(f"{path}: camera {node.get('id')} has no label, expected the photograph's name")
        sensor = sensors.get(node.get("sensor_id", ""))
        if sensor is None:
            raise InputError(
                f"{where}: its sensor {node.get('sensor_id')} has no calibration, expected an adjusted one"
            )
        turn, shift, scale = frames.get(node.get("component_id", ""), frames[""])
        inner = _numbers(pose, 16, where).reshape(4, 4)
        matrix = np.eye(4)
        matrix[:3, :3] = turn @ inner[:3, :3]
        matrix[:3, 3] = scale * turn @ inner[:3, 3] + shift
        width, height, intrinsics, distortion = sensor
        photos.append(
            Photo(label, View(view_name(label), width, height, intrinsics, distortion, invert_pose(matrix, where)))
        )
    return local(photos, str(path))


def _sensor(node: Element, where: str) -> _Sensor | None:
    """Size, intrinsics and distortion; None without a calibration."""
    found = list(node.iterfind("calibration"))
    if not found:
        return None
    calibration = next((c for c in found if c.get("class") == "adjusted"), found[-1])
    kind = calibration.get("type", node.get("type", "frame"))
    if kind != "frame":
        raise InputError(f"{where}: found camera type {kind!r}, expected 'frame'")
    resolution = calibration.find("resolution")
    resolution = node.find("resolution") if resolution is None else resolution
    sides = ("", "") if resolution is None else (resolution.get("width", ""), resolution.get("height", ""))
    if (
        not all(side.isdecimal() and len(side) < 7 for side in sides)
        or not 0 < int(sides[0]) * int(sides[1]) <= MAX_PIXELS
    ):
        raise InputError(f"{where}: found resolution {' x '.join(sides)}, expected up to {MAX_PIXELS} pixels")
    width, height = int(sides[0]), int(sides[1])
    values = dict.fromkeys(COEFFICIENTS, 0.0)
    for name in COEFFICIENTS:
        child = calibration.find(name)
        if child is not None:
            values[name] = float(_numbers(child, 1, f"{where}: {name}")[0])
    v = values
    if not v["f"] > 0 or not v["f"] + v["b1"] > 0:
        raise InputError(f"{where}: found focal length {v['f']:g} (b1 {v['b1']:g}), expected a positive one")
    corner = 0.5 * float(np.hypot(width, height)) / v["f"]
    tangent = (abs(v["p1"]) + abs(v["p2"])) * 3 * corner**2 * v["f"]
    others = {
        "b2": abs(v["b2"]) * 0.5 * height / v["f"],
        "p3": abs(v["p3"]) * corner**2 * tangent,
        "p4": abs(v["p4"]) * corner**4 * tangent,
    }
    radial = (v["k1"], v["k2"], v["k3"], v["k4"])
    distortion = opencv_lens(where, (width, height), v["f"], radial, (v["p2"], v["p1"]), others)
    intrinsics = (v["f"] + v["b1"], v["f"], 0.5 * width + v["cx"], 0.5 * height + v["cy"])
    return width, height, intrinsics, distortion


def _similarity(node: Element | None, where: str) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Rotation, translation and scale of a ``transform``; what it lacks changes nothing."""
    turn, shift, scale = np.eye(3), np.zeros(3), 1.0
    for child in () if node is None else node:
        if child.tag == "rotation":
            turn = _numbers(child, 9, f"{where}: rotation").reshape(3, 3)
        elif child.tag == "translation":
            shift = _numbers(child, 3, f"{where}: translation")
        elif child.tag == "scale":
            scale = float(_numbers(child, 1, f"{where}: scale")[0])
    if not scale > 0:
        raise InputError(f"{where}: found scale {scale:g}, expected a positive one")
    return turn, shift, scale


def _numbers(node: Element, count: int, where: str) -> NDArray[np.float64]:
    return parse_numbers((node.text or "").split(), count, where)
