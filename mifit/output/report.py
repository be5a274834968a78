"""``report.html``: one self-contained page about a result."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import mifit
from mifit.capture import Capture
from mifit.core.files import Document, write_text
from mifit.core.image import to_8_bit
from mifit.core.sh import SHLighting, bands, cosine_coefficients
from mifit.output import figures as draw
from mifit.output.evaluate import Comparison, compare, face_area, rgba_8_bit
from mifit.output.scene import render_view
from mifit.output.surface import shape_of, surface_maps, vertex_materials
from mifit.result import Reconstruction

NAMES = {"pca": "Stage 1 (PCA)", "diffuse": "Diffuse only", "full": "Full"}
STAGES = {
    "geometry": "1 Geometry",
    "reflectance": "2 Reflectance",
    "normals": "3 Normals",
    "mesh": "3 Mesh",
    "residual": "3 Residual",
}
SHOWN_TIMESTEPS = 4
"""Timesteps whose pictures a report holds, so that it stays small enough for a phone."""
LAID_OVER = 640
"""Pixels along the longer side of the renders that are laid over photographs."""


def write_report(
    folder: str | Path,
    result: Reconstruction,
    capture: Capture,
    evaluation: Document | None = None,
    comparisons: Sequence[Comparison] = (),
) -> Path:
    """Write ``report.html`` into a folder, whole or not at all; returns the file.

    ``evaluation``, what `evaluate` returned, adds the comparison of that view; ``comparisons`` are those of it that are
    at hand, others are rendered. Only the fitted cameras are read, and the evaluated one.
    """
    capture = result.seen(capture)
    shown = result.timesteps[:SHOWN_TIMESTEPS]
    comparison = "" if evaluation is None else _comparison(result, capture, evaluation, comparisons)
    titled = {
        "Result": _summary(result, evaluation),
        "3D view": _view3d(result, shown[0]),
        "Comparison": comparison,
        "Inputs and fit": _inputs(result, capture, shown),
        "Frames": _frames(result),
        "Maps": picture_maps(result, shown[0]),
        "Lighting": _lighting(result),
        "Convergence": _convergence(result),
        "Settings": _settings(result),
    }
    sections = [(title, body) for title, body in titled.items() if body]
    links = "".join(f'<a href="#s{i}">{title}</a>' for i, (title, _) in enumerate(sections))
    body = "".join(f'<section><h2 id="s{i}">{title}</h2>{text}</section>' for i, (title, text) in enumerate(sections))
    cameras = " and ".join(c.name for c in result.cameras)
    steps = ", ".join(map(str, result.timesteps[:12])) + ", ..." * (len(result.timesteps) > 12)
    subtitle = f"Model {result.model.name}; fitted to cameras {cameras} at timesteps {steps}."
    page = f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>mifit report</title>
<style>{_asset("report.css")}</style>
</head>
<body><main>
<h1>Face reconstruction</h1>
<p class="soft">{html.escape(subtitle)}</p>
<nav aria-label="Sections">{links}</nav>
{body}
<footer>Written by mifit {mifit.__version__}. Everything on this page is in the file itself.</footer>
</main>
<script>{_asset("report.js")}</script>
<script>{_asset("viewer.js")}</script>
</body></html>
"""
    path = Path(folder) / "report.html"
    write_text(path, page)
    return path


def _asset(name: str) -> str:
    return resources.files("mifit.output").joinpath("assets", name).read_text(encoding="utf-8")


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = "".join(f"<th>{text}</th>" for text in heads)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def _figure(picture: NDArray | str, caption: str, alt: str) -> str:
    """A picture, as an array or a data URI, with its caption."""
    uri = picture if isinstance(picture, str) else draw.jpeg_uri(picture)
    return f'<figure><img src="{uri}" alt="{html.escape(alt)}"><figcaption>{html.escape(caption)}</figcaption></figure>'


def _grid(figures: Iterable[str]) -> str:
    return f'<div class="grid">{"".join(figures)}</div>'


def _summary(result: Reconstruction, evaluation: Document | None) -> str:
    parts = []
    if evaluation is None:
        parts.append("<p>No held-out view was evaluated; <code>mifit evaluate</code> adds one to this page.</p>")
    else:
        fitted = evaluation["camera"] in [camera.name for camera in result.cameras]
        kind = "this camera was fitted, so it is no test" if fitted else "held out, never fitted"
        area = {"face": "the fitted model's face area", "skin": "skin"}.get(evaluation["region"], "the true face area")
        parts.append(
            f"<p>Error on camera <b>{html.escape(evaluation['camera'])}</b> ({kind}), over "
            f"{evaluation['region_pixels']:,} pixels of {area}.</p>{_measures(evaluation['methods'])}"
        )
        if "baseline" in evaluation:
            found = evaluation["baseline"]
            parts.append(
                f"<p>Beside image-based rendering on the same mesh, over {found['region_pixels']:,} pixels that a "
                f"fitted view sees.</p>{_measures(found['methods'])}"
            )
    found = result.diagnostics
    parts += [f'<p class="warning">{one.severity.capitalize()}: {html.escape(one.text)}</p>' for one in found]
    return "".join(parts) + ("" if found else '<p class="soft">No warnings.</p>')


def _measures(methods: Mapping[str, Mapping[str, float]]) -> str:
    """Table of errors."""
    measures = {"psnr": ".2f", "rmse": ".2f", "ssim": ".4f", "flip": ".4f"}
    rows = (
        (NAMES.get(m, m.replace("_", " ")), *(format(f[key], digits) for key, digits in measures.items()))
        for m, f in methods.items()
    )
    return _table(("Method", "PSNR, dB", "RMSE of 255", "SSIM", "FLIP"), rows)


def _view3d(result: Reconstruction, timestep: int) -> str:
    modes = ["Full", "Diffuse only", "Diffuse albedo", "Specular albedo", "Normals", "Grey surface"]
    shown = (0, 1, 2, 3, 4, 5) if result.reflectance is not None else (0, 2, 4, 5)
    options = "".join(f'<option value="{k}">{modes[k]}</option>' for k in shown)
    data = viewer_data(result, timestep).replace("</", "<\\/")
    lights = '<option value="0">as recovered</option><option value="1">one lamp</option>'
    label = "3D view of the face; drag or use the arrow keys to turn it"
    return f"""<canvas id="view3d" tabindex="0" aria-label="{label}"></canvas>
<div class="controls">
<label>Light <select id="view3d-light">{lights}</select></label>
<label>Turn light <input id="view3d-turn" type="range" min="-180" max="180" value="0" step="1"></label>
<label>Show <select id="view3d-mode">{options}</select></label>
</div>
<p class="soft" id="view3d-note">Drag to turn, pinch or scroll to zoom. Shaded in the browser without cast shadows.</p>
<script type="application/json" id="view3d-data">{data}</script>"""


def viewer_data(result: Reconstruction, timestep: int) -> str:
    """JSON for the 3D view of one timestep (`assets/viewer.js`); quantised, for looking at only.

    Positions have 16 bits of the bounding sphere, normals 8, texture coordinates 16; the alpha of the vertex
    colour tells whether a face has maps (1) or none (0).
    """
    model, shape = result.model, shape_of(result, timestep, world=False)
    vertices, rotation = shape.vertices / result.geometry.scale, result.geometry.rotation[result.index(timestep)]
    named = shape.parts()
    parts = list(named.values())  # they share no vertex
    origin = np.concatenate([p.origin for p in parts])
    uv = np.concatenate([p.uv for p in parts])
    starts = np.cumsum([0, *(len(p.origin) for p in parts)])
    kind = np.repeat([255 if name == "face" else 0 for name in named], np.diff(starts))
    faces = np.concatenate([p.faces + start for p, start in zip(parts, starts, strict=False)])
    position = vertices[origin]
    normals = shape.normals[origin]
    centre = (position.min(0) + position.max(0)) / 2
    radius = float(np.abs(position - centre).max())
    face_centre = vertices[np.unique(model.faces[model.face_mask])]
    colour = np.column_stack([to_8_bit(vertex_materials(result, skin=True)[origin, :3]), kind]).astype(np.uint8)
    wide = len(origin) > 65535
    maps = surface_maps(result, timestep, skin=True)
    peak = max(float(maps.specular.max()), 1e-3)
    data: Document = {
        "vertices": len(origin),
        "position": _base64(np.round((position - centre) / radius * 32767), "<i2"),
        "uv": _base64(np.round(np.clip(uv, 0, 1) * 65535), "<u2"),
        "normal": _base64(np.round(normals * 127), "i1"),
        "colour": _base64(colour, "u1"),
        "index": _base64(faces, "<u4" if wide else "<u2"),
        "index_bits": 32 if wide else 16,
        "centre": centre.tolist(),
        "radius": radius,
        "focus": ((face_centre.min(0) + face_centre.max(0)) / 2).tolist(),
        "rotation": rotation.ravel().tolist(),
        "specular_scale": peak,
        "maps": {
            "diffuse": draw.jpeg_uri(to_8_bit(maps.diffuse), 90),
            "specular": draw.jpeg_uri(np.round(255 * np.clip(maps.specular / peak, 0, 1)).astype(np.uint8), 90),
            "normal": draw.png_uri(np.round(127.5 * (maps.normal + 1)).astype(np.uint8)),
        },
        **_view_lighting(result),
    }
    return json.dumps(data)


def _view_lighting(result: Reconstruction) -> Document:
    """Recovered lighting for the view's shader: of the lobe a lat-long picture, and polynomials in the cosine."""
    irradiance = result.lighting.truncate(3).coefficients * (cosine_coefficients(3)[bands(3)] / np.pi)[:, None]
    order = result.lighting.order
    cosines = np.linspace(0.05, 1.0, 40)
    albedo, tilt, factors = result.lobe.zonal(order, cosines)
    blurred = SHLighting(factors[bands(order), None] * result.lighting.coefficients).to_latlong(64, 128)
    peak = max(float(blurred.max()), 1e-6)
    return {
        "irradiance": irradiance.ravel().tolist(),
        "glossy": draw.png_uri(np.round(255 * np.sqrt(np.clip(blurred / peak, 0, 1))).astype(np.uint8)),
        "glossy_scale": peak,
        "lobe_albedo": np.polynomial.polynomial.polyfit(cosines, albedo, 5).tolist(),
        "lobe_tilt": np.polynomial.polynomial.polyfit(cosines, tilt, 5).tolist(),
        "ambient": float(result.illumination.ambient),
        "exponent": result.lobe.exponent,
    }


def _base64(values: NDArray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()


def _comparison(
    result: Reconstruction, capture: Capture, evaluation: Document, comparisons: Sequence[Comparison]
) -> str:
    known = {found.timestep: found for found in comparisons}
    parts = [
        f'<p class="scale">Error maps: 0 <img src="{draw.jpeg_uri(draw.heat_scale())}" alt="black to yellow"> '
        f"{draw.HEAT_LIMIT:.0f} of 255 or more</p>"
    ]
    for entry in evaluation["per_timestep"][:SHOWN_TIMESTEPS]:
        timestep, figures = entry["timestep"], entry["methods"]
        found = known.get(timestep) or compare(result, capture, evaluation["camera"], timestep, evaluation["region"])
        box = draw.bounding_box(found.region)
        maps = _grid(
            _figure(
                draw.heat_map(found.photograph, render, found.region)[box],
                f"{NAMES[m]}: {figures[m]['psnr']:.2f} dB",
                f"error map of {NAMES[m]}",
            )
            for m, render in found.renders.items()
        )
        parts.append(f'<h3>Timestep {timestep}</h3><div class="compare">{_slider(found)}{maps}</div>')
    return "".join(parts)


def _slider(found: Comparison) -> str:
    """Photograph and render under one draggable divider, with a choice of methods."""
    box = draw.bounding_box(found.region)
    methods = list(found.renders)[::-1]
    name = f"slider{found.timestep}"
    tops, buttons = "", ""
    for m in methods:
        uri = draw.jpeg_uri(draw.overlay(found.photograph, found.renders[m])[box], 90)
        hidden, pressed = ("", "true") if m == methods[0] else (" hidden", "false")
        tops += f'<img class="top" data-for="{m}" alt="render by {NAMES[m]}" src="{uri}"{hidden}>'
        buttons += f'<button type="button" value="{m}" aria-pressed="{pressed}">{NAMES[m]}</button>'
    return f"""<div><div class="slider" id="{name}">
<img alt="photograph" src="{draw.jpeg_uri(found.photograph[box], 90)}">{tops}<span class="bar"></span>
<span class="tag" style="left:6px">Photograph</span>
<span class="tag" data-name style="right:6px">{NAMES[methods[0]]}</span>
<input type="range" min="0" max="100" value="50" aria-label="divider between photograph and render"></div>
<div class="controls" data-choice="{name}">{buttons}</div></div>"""


def _inputs(result: Reconstruction, capture: Capture, timesteps: tuple[int, ...]) -> str:
    """Photographs with landmarks, under the fit, and with what was not used of them."""
    swatches = "".join(
        f'<span><i style="background:rgb{colour};height:12px"></i>{name}</span>' for _, colour, name in draw.TINTS
    )
    parts = [
        '<p class="soft">Cyan rings: detected landmarks. Orange dots: the fitted model\'s.</p>'
        f'<p class="legend"><span>Not used:</span>{swatches}<span>Percentages are of the face area.</span></p>'
    ]
    model = result.model
    for timestep in timesteps:
        figures, vertices = [], result.geometry.vertices[result.index(timestep)]
        for camera in (c.name for c in result.cameras):
            view, frame, label = capture.camera(camera), capture.frame(camera, timestep), html.escape(camera)
            photograph, size = to_8_bit(frame.image), (view.width, view.height)
            small = view.resized(min(1.0, LAID_OVER / max(size)))
            shown = rgba_8_bit(render_view(result, small, timestep, result.methods[-1], samples=1))
            render = cv2.resize(shown, size).astype(np.uint8)
            box = draw.bounding_box(render[..., 3] > 0)
            marked = draw.draw_landmarks(photograph, view, frame.landmarks, frame.visible, vertices[model.landmarks])
            face = face_area(vertices, model.faces, model.face_mask, small).astype(np.uint8)
            area = (cv2.resize(face, size, interpolation=cv2.INTER_NEAREST) > 0) & frame.valid
            clipped = frame.clipped & area
            labels = None if result.reflectance is None else result.reflectance.label(camera, timestep)
            areas = [(clipped, draw.TINTS[0][1])]
            if labels is not None:
                areas += [(np.asarray(labels == kind), colour) for kind, colour, _ in draw.TINTS[1:]]
            tinted = draw.tint(photograph, *areas)
            share = clipped.sum() / max(int(area.sum()), 1)
            figures += [
                _figure(marked[box], f"{label}: input with landmarks", f"input from {label}"),
                _figure(draw.overlay(photograph, render)[box], f"{label}: fit laid over", f"fit over {label}"),
                _figure(tinted[box], f"{label}: {share:.1%} clipped", f"face mask of {label}"),
            ]
        parts.append(f"<h3>Timestep {timestep}</h3>{_grid(figures)}")
    rest = len(result.timesteps) - len(timesteps)
    more = f'<p class="soft">{rest} more timesteps are in the result but not on this page.</p>' if rest else ""
    return "".join(parts) + more


def _frames(result: Reconstruction) -> str:
    """Frames that were chosen, added or left out, and why; nothing where all was as asked for."""
    chosen = result.geometry.report.detail("frames")
    refined = {} if result.reflectance is None else result.reflectance.report.detail("refined")
    lines = [f"Timestep {t} was fitted: {why}." for t, why in chosen.get("why", {}).items()]
    lines += [f"Timestep {t} was not to be chosen: {why}." for t, why in chosen.get("left_out", {}).items()]
    if refined:
        lines.append(f"Maps and lighting are from {len(refined['timesteps'])} frames.")
        lines += [f"Timestep {t} was left out of them: {why}." for t, why in refined["left_out"].items()]
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def picture_maps(result: Reconstruction, timestep: int) -> str:
    """Figures of all maps of a result, as HTML; those of a moment at one timestep."""
    reflectance, refined = result.reflectance, result.refined_normal(timestep)
    if reflectance is None:
        return ""
    grey: list[tuple[str, NDArray | None, float | None]] = [
        ("Specular albedo", reflectance.specular, None),
        ("Confidence: how often and how well each texel was seen", reflectance.confidence, 1.0),
        ("Confidence of the specular albedo: how far images determine it", reflectance.specular_confidence, 1.0),
        ("Light that mesh and lighting don't explain, parted from the albedo", reflectance.residual_shading, 2.0),
    ]
    figures = [_figure(to_8_bit(reflectance.diffuse), "Diffuse albedo", "diffuse albedo map")]
    for caption, values, peak in grey:
        if values is not None:
            white = peak or _largest(values)
            codes = np.round(255 * np.clip(values / white, 0, 1)).astype(np.uint8)
            figures.append(_figure(codes, f"{caption} (white = {white:.3g})", caption.lower()))
    if refined is not None:
        colours = np.round(np.where(np.any(refined != 0, axis=-1, keepdims=True), 127.5 * (refined + 1), 0))
        caption = f"Refined normals in object space, timestep {timestep}"
        figures.append(_figure(colours.astype(np.uint8), caption, "normal map"))
    residual = None if result.residual is None else result.residual.at(timestep)
    if residual is not None:
        white = _largest(np.abs(residual))
        codes = np.round(127.5 * (1 + np.clip(residual / white, -1, 1))).astype(np.uint8)
        caption = f"What images show beyond the model, timestep {timestep} (mid-grey: nothing, white = {white:.2g})"
        figures.append(_figure(codes, caption, "residual"))
    return _grid(figures)


def _largest(values: NDArray) -> float:
    return max(float(np.quantile(values, 0.999)), 1e-6)


def _lighting(result: Reconstruction) -> str:
    lighting = result.lighting
    ball, mirror = draw.lighting_balls(lighting)
    panorama = np.maximum(lighting.to_latlong(), 0)
    codes = to_8_bit(panorama / max(float(panorama.max()), 1e-12))
    lights = [light.describe() for light in result.illumination.lights]
    compact = "".join(f"; the sharp light {light}, was found apart from them" for light in lights)
    return f"""<div class="balls">{_figure(draw.png_uri(ball), "White matt ball", "lighting on a matt ball")}
{_figure(draw.png_uri(mirror), "Mirror ball", "lighting in a mirror ball")}
{_figure(codes, "All directions, latitude by longitude", "lighting panorama")}</div>
<p class="soft">Recovered as spherical harmonics of {lighting.order} bands, so only broad light shows{compact}.
Ambient term {result.illumination.ambient:.4f}.</p>"""


def _convergence(result: Reconstruction) -> str:
    rows = (
        (
            STAGES[name],
            html.escape(report.outcome.replace("_", " ")),
            str(max((len(v) for v in report.energies.values()), default=0)),
            f"{report.seconds:.1f}",
        )
        for name, report in result.reports.items()
    )
    memory = f", peak memory {result.peak_memory / 2**20:.0f} MB" if result.peak_memory else ""
    plots = [(STAGES[name], draw.energy_plot(report.energies)) for name, report in result.reports.items()]
    return (
        f"{_table(('Stage', 'Ended', 'Iterations', 'Seconds'), rows)}<p>Whole fit {result.seconds:.1f} s{memory}.</p>"
        + "".join(f"<h3>{name}: energy by iteration</h3>{plot}" for name, plot in plots if plot)
    )


def _settings(result: Reconstruction) -> str:
    text = html.escape(json.dumps(result.config, indent=1, default=str))
    return f"<details><summary>Settings of this fit</summary><pre>{text}</pre></details>"
