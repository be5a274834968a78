"""A calibrated camera as a Mitsuba sensor: the only place that turns one into the other."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mifit.core.camera import Camera
from mifit.core.files import Document
from mifit.errors import InputError
from mifit.render.description import Parameter, to_mitsuba

if TYPE_CHECKING:
    import mitsuba as mi


def sensor_description(camera: Camera, spp: int | Parameter = 16) -> Document:
    """The sensor of an undistorted camera, as a plain dictionary (`render.description`).

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
    import mitsuba as mi

    from mifit.render.plugins import register_plugins

    register_plugins()
    return mi.load_dict(to_mitsuba(sensor_description(camera, spp)))
