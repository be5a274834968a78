"""Pictures of a result's maps for its report."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mifit.core.image import to_8_bit
from mifit.output.figures import jpeg_uri

if TYPE_CHECKING:
    from mifit.result import Result


def picture_maps(result: Result, timestep: int) -> str:
    """Figures of all maps of a result, as HTML; those of a moment at one timestep."""
    if result.reflectance is None:
        return ""
    reflectance = result.reflectance
    figures = [
        figure(jpeg_uri(to_8_bit(reflectance.diffuse)), "Diffuse albedo", "diffuse albedo map"),
        _grey("Specular albedo", reflectance.specular),
        _grey("Confidence: how often and how well each texel was seen", reflectance.confidence, 1.0),
    ]
    if reflectance.specular_confidence is not None:
        caption = "Confidence of the specular albedo: how far images tell it"
        figures.append(_grey(caption, reflectance.specular_confidence, 1.0))
    if reflectance.relief is not None:
        figures.append(
            _grey(
                "Light that mesh and lighting don't explain (mid-grey: none), parted from the albedo",
                0.5 * reflectance.relief,
                1.0,
            )
        )
    refined = result.refined_normal(timestep)
    if refined is not None:
        colours = np.where(np.any(refined != 0, axis=-1, keepdims=True), 127.5 * (refined + 1), 0)
        figures.append(
            figure(
                jpeg_uri(np.round(colours).astype(np.uint8)),
                f"Refined normals in object space, timestep {timestep}",
                "normal map",
            )
        )
    residual = None if result.residual is None else result.residual.at(timestep)
    if residual is not None:
        uri, white = _signed(residual)
        caption = f"What images show beyond the model, timestep {timestep} (mid-grey: nothing, white = {white:.2g})"
        figures.append(figure(uri, caption, "residual"))
    if result.mesh is not None and timestep in result.mesh.timesteps:
        uri, white = _signed(result.displacement(timestep) * result.unit_mm)
        caption = f"Displacement of the refined mesh, timestep {timestep} (white = {white:.2g} mm outwards)"
        figures.append(figure(uri, caption, "displacement map"))
    return f'<div class="grid">{"".join(figures)}</div>'


def _grey(caption: str, values: NDArray, peak: float | None = None) -> str:
    """Figure of a scalar map on a linear scale whose white is named."""
    white = peak or max(float(np.quantile(values, 0.999)), 1e-6)
    codes = np.round(255 * np.clip(values / white, 0, 1)).astype(np.uint8)
    return figure(jpeg_uri(codes), f"{caption} (white = {white:.3g})", caption.lower())


def _signed(values: NDArray) -> tuple[str, float]:
    """Picture of a map of both signs, mid-grey at 0, and the value that is white."""
    white = max(float(np.quantile(np.abs(values), 0.999)), 1e-6)
    return jpeg_uri(np.round(127.5 * (1 + np.clip(values / white, -1, 1))).astype(np.uint8)), white


def figure(uri: str, caption: str, alt: str) -> str:
    """A picture with its caption, as HTML."""
    return f'<figure><img src="{uri}" alt="{html.escape(alt)}"><figcaption>{html.escape(caption)}</figcaption></figure>'
