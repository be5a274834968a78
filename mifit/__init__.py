"""Facial reflectance and geometry from two views, on Mitsuba 3 and Dr.Jit.

Importing this package doesn't import Mitsuba; the names below load what they need when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

_EXPORTS = {
    "Capture": "mifit.capture",
    "MorphableModel": "mifit.morphable",
    "Camera": "mifit.core.camera",
    "SHLighting": "mifit.core.sh",
    "Illumination": "mifit.appearance.illumination",
    "DistantLight": "mifit.appearance.illumination",
    "FitConfig": "mifit.config",
    "GeometryConfig": "mifit.config",
    "ReflectanceConfig": "mifit.config",
    "NormalsConfig": "mifit.config",
    "MeshConfig": "mifit.config",
    "ResidualConfig": "mifit.config",
    "SurfaceConfig": "mifit.config",
    "InputError": "mifit.errors",
    "MifitError": "mifit.errors",
    "VariantError": "mifit.errors",
    "ConvergenceError": "mifit.errors",
    "set_variant": "mifit.render.variant",
    "register_plugins": "mifit.render.plugins",
    "load_scene": "mifit.render.scene",
    "fit": "mifit.fitting",
    "track": "mifit.tracking",
    "refine": "mifit.extras.refine",
    "choose_frames": "mifit.capture.choose_frames",
    "fit_geometry": "mifit.stages.fit_geometry",
    "find_surface": "mifit.stages.find_surface",
    "infer_reflectance": "mifit.stages.infer_reflectance",
    "refine_normals": "mifit.stages.normals.refine_normals",
    "find_residual": "mifit.stages.find_residual",
    "refine_mesh": "mifit.stages.normals.refine_mesh",
    "Reconstruction": "mifit.result",
    "evaluate": "mifit.output.evaluate",
    "export": "mifit.output.export",
    "synthesize": "mifit.synth",
    "linear_to_srgb": "mifit.core.image",
    "srgb_to_linear": "mifit.core.image",
}

__all__ = ["__version__", *_EXPORTS]


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        value = getattr(importlib.import_module(_EXPORTS[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'mifit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)


if TYPE_CHECKING:
    from mifit.capture import Capture as Capture
    from mifit.morphable import MorphableModel as MorphableModel
