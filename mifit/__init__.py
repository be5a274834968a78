"""Facial reflectance and geometry from two views, on Mitsuba 3 and Dr.Jit.

Importing this package doesn't import Mitsuba; the names below load what they need when first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

_NAMES = {
    "mifit.capture": "Capture",
    "mifit.morphable": "MorphableModel",
    "mifit.core.camera": "Camera",
    "mifit.core.sh": "SHLighting",
    "mifit.appearance.illumination": "Illumination DistantLight",
    "mifit.config": "FitConfig GeometryConfig ReflectanceConfig NormalsConfig MeshConfig ResidualConfig SurfaceConfig",
    "mifit.errors": "InputError MifitError VariantError ConvergenceError",
    "mifit.render.variant": "set_variant",
    "mifit.render.plugins": "register_plugins",
    "mifit.render.scene": "load_scene",
    "mifit.fitting": "fit",
    "mifit.tracking": "track",
    "mifit.extras.refine": "refine",
    "mifit.capture.choose_frames": "choose_frames",
    "mifit.stages.fit_geometry": "fit_geometry",
    "mifit.stages.find_surface": "find_surface",
    "mifit.stages.refine_surface": "refine_surface",
    "mifit.stages.infer_reflectance": "infer_reflectance",
    "mifit.stages.normals.refine_normals": "refine_normals",
    "mifit.stages.find_residual": "find_residual",
    "mifit.stages.normals.refine_mesh": "refine_mesh",
    "mifit.result": "Reconstruction",
    "mifit.output.evaluate": "evaluate",
    "mifit.output.export": "export",
    "mifit.synth": "synthesize",
    "mifit.core.image": "linear_to_srgb srgb_to_linear",
}
_EXPORTS = {name: module for module, names in _NAMES.items() for name in names.split()}

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
