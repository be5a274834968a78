"""Pictures of the report: overlays, heat maps, lighting and curves, as arrays and inline markup."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.core.camera import Camera
from mifit.core.estimate import Label
from mifit.core.image import box, encode_png, to_8_bit
from mifit.core.sh import SHLighting

HEAT_LIMIT = 40.0
"""Error, in 8-bit steps, at which the heat map's colours end."""

TINTS = (
    (None, (214, 39, 160), "clipped"),
    (Label.OCCLUDER, (230, 30, 30), "something in front of the face"),
    (Label.EYES, (0, 215, 215), "eyes"),
    (Label.MOUTH, (150, 60, 220), "mouth"),
)
"""What the report colours in a photograph, clipped pixels and labels: apart in hue and lightness, and from skin."""

_CURVES = ("#0f6cbd", "#b3470a", "#2b7a3d", "#8a3ab9", "#a3262e", "#5b5f66", "#96750b", "#0b7a75")


def jpeg_uri(image: NDArray[np.uint8], quality: int = 85) -> str:
    """8-bit RGB or grey image -> JPEG data URI."""
    bgr = image if image.ndim == 2 else image[..., ::-1]
    data = cv2.imencode(".jpg", np.ascontiguousarray(bgr), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def png_uri(image: NDArray[np.uint8]) -> str:
    """8-bit image -> PNG data URI."""
    return "data:image/png;base64," + base64.b64encode(encode_png(image)).decode()


def bounding_box(mask: NDArray[np.bool_], margin: float = 0.12) -> tuple[slice, slice]:
    """Rows and columns around the pixels of a mask, with a margin relative to its size."""
    out = []
    for side, size in zip(box(mask), mask.shape, strict=True):
        pad = round(margin * (side.stop - 1 - side.start))
        out.append(slice(max(side.start - pad, 0), min(side.stop + pad, size)))
    return out[0], out[1]


def overlay(photograph: NDArray[np.uint8], render: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Lay a render (RGBA) over a photograph."""
    alpha = render[..., 3:].astype(np.float32) / 255
    return np.round(render[..., :3] * alpha + photograph * (1 - alpha)).astype(np.uint8)


def tint(
    photograph: NDArray[np.uint8], *areas: tuple[NDArray[np.bool_], tuple[int, int, int]], strength: float = 0.65
) -> NDArray[np.uint8]:
    """Colour areas (mask, RGB) of a picture so that what they cover stays visible."""
    out = photograph.astype(np.float32)
    for mask, colour in areas:
        out[mask] = (1.0 - strength) * out[mask] + strength * np.asarray(colour, dtype=np.float32)
    return np.round(out).astype(np.uint8)


def draw_landmarks(
    photograph: NDArray[np.uint8], camera: Camera, detected: NDArray | None, visible: NDArray, fitted: NDArray
) -> NDArray[np.uint8]:
    """Mark detected landmarks (rings) and the fitted model's (dots), joined by a line where both are visible.

    ``detected`` (68, 2) are pixels with the first pixel's centre at 0.5; ``fitted`` (68, 3) are world positions.
    """
    out = np.ascontiguousarray(photograph)
    shift = 4
    scale = 1 << shift

    def fixed(point: NDArray) -> tuple[int, int]:
        # OpenCV's pixel centres are at whole numbers.
        return round((point[0] - 0.5) * scale), round((point[1] - 0.5) * scale)

    projected = camera.project(fitted)
    for i, model_point in enumerate(projected):
        if detected is not None and visible[i]:
            if np.isfinite(model_point).all():
                cv2.line(out, fixed(detected[i]), fixed(model_point), (255, 255, 255), 1, cv2.LINE_AA, shift)
            cv2.circle(out, fixed(detected[i]), 3 * scale, (0, 220, 255), 1, cv2.LINE_AA, shift)
        if np.isfinite(model_point).all():
            cv2.circle(out, fixed(model_point), 2 * scale - 4, (255, 90, 60), -1, cv2.LINE_AA, shift)
    return out


def heat_map(photograph: NDArray[np.uint8], render: NDArray[np.uint8], region: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Mean absolute difference over the channels as colour, over a grey, darkened photograph.

    Black is no difference; the brightest yellow is `HEAT_LIMIT` steps of 255 or more.
    """
    difference = np.abs(render[..., :3].astype(np.float32) - photograph).mean(-1)
    codes = np.clip(255 * difference / HEAT_LIMIT, 0, 255).astype(np.uint8)
    colour = cv2.applyColorMap(codes, cv2.COLORMAP_INFERNO)[..., ::-1]
    grey = np.repeat((photograph.mean(-1, keepdims=True) * 0.35).astype(np.uint8), 3, axis=-1)
    return np.where(region[..., None], colour, grey)


def heat_scale() -> NDArray[np.uint8]:
    """Colour scale of `heat_map`, 0 at the left."""
    ramp = np.tile(np.arange(256, dtype=np.uint8), (12, 1))
    return np.ascontiguousarray(cv2.applyColorMap(ramp, cv2.COLORMAP_INFERNO)[..., ::-1])


def lighting_balls(lighting: SHLighting, size: int = 160) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Show lighting on two balls seen along -z with y up: a white matt one, and a mirror.

    Both are scaled so that their brightest value is white.
    """
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis, -axis)
    inside = x**2 + y**2 < 1
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)[inside]
    mirrored = 2 * normal[:, 2:] * normal - (0.0, 0.0, 1.0)
    out = []
    for values in (lighting.irradiance(normal) / math.pi, lighting.evaluate(mirrored)):
        ball = np.ones((size, size, 3))
        ball[inside] = np.clip(values / max(float(values.max()), 1e-12), 0, 1)
        out.append(to_8_bit(ball))
    return out[0], out[1]


def energy_plot(energies: Mapping[str, Sequence[float]]) -> str:
    """Curves of named energies over iterations, as inline SVG with a logarithmic axis.

    Values that are not positive and finite leave a gap. An empty string when there is nothing to draw.
    """
    curves = {
        name: [v if math.isfinite(v) and v > 0 else None for v in values]
        for name, values in energies.items()
        if len(values) > 1
    }
    known = [v for values in curves.values() for v in values if v is not None]
    if not known:
        return ""
    low, high = math.floor(math.log10(min(known))), math.ceil(math.log10(max(known)))
    high = max(high, low + 1)
    last = max(len(values) for values in curves.values()) - 1
    width, height, left, right, top, bottom = 640, 260, 52, 12, 12, 30

    def at(i: float, exponent: float) -> tuple[float, float]:
        x = left + (width - left - right) * i / last
        return x, top + (height - top - bottom) * (high - exponent) / (high - low)

    parts = [f'<svg class="plot" viewBox="0 0 {width} {height}" role="img" aria-label="energy by iteration">']
    for exponent in range(low, high + 1, max(1, (high - low) // 6)):
        _, y = at(0, exponent)
        parts.append(f'<line x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}" class="grid"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">1e{exponent}</text>')
    for i in sorted({0, last // 2, last}):
        parts.append(f'<text x="{at(i, low)[0]:.1f}" y="{height - 10}" text-anchor="middle">{i}</text>')
    legend = []
    for k, (name, values) in enumerate(curves.items()):
        colour = _CURVES[k % len(_CURVES)]
        path, pen = [], "M"
        for i, v in enumerate(values):
            if v is None:
                pen = "M"
                continue
            x, y = at(i, math.log10(v))
            path.append(f"{pen}{x:.1f} {y:.1f}")
            pen = "L"
        parts.append(f'<path d="{" ".join(path)}" fill="none" stroke="{colour}" stroke-width="2"/>')
        legend.append(f'<span><i style="background:{colour}"></i>{html.escape(name)}</span>')
    parts.append("</svg>")
    return "".join(parts) + f'<p class="legend">{"".join(legend)}</p>'
