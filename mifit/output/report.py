"""``report.html``: one self-contained page about a reconstruction."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import mifit
from mifit.core.files import write_text
from mifit.core.image import to_8_bit
from mifit.output.evaluate import Comparison, compare, held_out, rgba_8_bit
from mifit.output.face_mask import face_mask
from mifit.output.figures import (
    CLIPPED_TINT,
    HEAT_LIMIT,
    LABEL_TINTS,
    UNEXPLAINED_TINT,
    bounding_box,
    draw_landmarks,
    energy_plot,
    heat_map,
    heat_scale,
    jpeg_uri,
    lighting_balls,
    overlay,
    png_uri,
    tint,
)
from mifit.output.map_figures import figure, picture_maps
from mifit.output.scene import render_view
from mifit.output.viewer import viewer_data

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.result import Result

NAMES = {
    "pca": "Stage 1 (PCA)",
    "diffuse": "Diffuse only",
    "full": "Full",
}
STAGES = {
    "geometry": "1 Geometry",
    "reflectance": "2 Reflectance",
    "normals": "3 Normals",
    "mesh": "3 Mesh",
    "residual": "3 Residual",
}
SHOWN_TIMESTEPS = 4
"""Timesteps whose pictures a report holds, so that it stays small enough for a phone."""


def write_report(
    folder: str | Path,
    reconstruction: Result,
    capture: Capture,
    evaluation: dict[str, Any] | None = None,
    comparisons: Sequence[Comparison] = (),
) -> Path:
    """Write ``report.html`` into a folder, whole or not at all.

    Parameters
    ----------
    folder : path
    reconstruction : Result
    capture : Capture
        Only the fitted cameras are read, and the evaluated one when an evaluation is given.
    evaluation : dict, optional
        What `evaluate` returned; adds the comparison of that view.
    comparisons : sequence of Comparison
        Those of the evaluation, where they are at hand; others are rendered.

    Returns
    -------
    Path
        The file.
    """
    capture = reconstruction.seen(capture)
    shown = reconstruction.timesteps[:SHOWN_TIMESTEPS]
    sections = [
        ("Result", _summary(reconstruction, evaluation)),
        ("3D view", _view3d(reconstruction, shown[0])),
        ("Inputs and fit", _inputs(reconstruction, capture, shown)),
        ("Frames", _frames(reconstruction)),
        ("Maps", picture_maps(reconstruction, shown[0])),
        ("Lighting", _lighting(reconstruction)),
        ("Convergence", _convergence(reconstruction)),
        ("Settings", _settings(reconstruction)),
    ]
    if evaluation is not None:
        sections.insert(2, ("Comparison", _comparison(reconstruction, capture, evaluation, comparisons)))
    sections = [(title, body) for title, body in sections if body]
    links = "".join(f'<a href="#s{i}">{title}</a>' for i, (title, _) in enumerate(sections))
    body = "".join(f'<section><h2 id="s{i}">{title}</h2>{text}</section>' for i, (title, text) in enumerate(sections))
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
<p class="soft">{_subtitle(reconstruction)}</p>
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


def _subtitle(result: Result) -> str:
    cameras = " and ".join(c.name for c in result.cameras)
    steps = ", ".join(map(str, result.timesteps[:12])) + (", ..." if len(result.timesteps) > 12 else "")
    return html.escape(f"Model {result.model.name}; fitted to cameras {cameras} at timesteps {steps}.")


def _summary(result: Result, evaluation: dict[str, Any] | None) -> str:
    parts = []
    if evaluation is not None:
        kind = "held out, never fitted" if held_out(result, evaluation) else "this camera was fitted, so it is no test"
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
    else:
        parts.append("<p>No held-out view was evaluated; <code>mifit evaluate</code> adds one to this page.</p>")
    found = result.diagnostics
    parts += [f'<p class="warning">{one.severity.capitalize()}: {html.escape(one.text)}</p>' for one in found]
    if not found:
        parts.append('<p class="soft">No warnings.</p>')
    return "".join(parts)


def _measures(methods: Mapping[str, Mapping[str, float]]) -> str:
    """Table of errors."""
    heads = "".join(f"<th>{text}</th>" for text in ("Method", "PSNR, dB", "RMSE of 255", "SSIM", "FLIP"))
    rows = "".join(
        f"<tr><td>{NAMES.get(m, m.replace('_', ' '))}</td><td>{f['psnr']:.2f}</td><td>{f['rmse']:.2f}</td>"
        f"<td>{f['ssim']:.4f}</td><td>{f['flip']:.4f}</td></tr>"
        for m, f in methods.items()
    )
    return f'<div class="wide"><table><tr>{heads}</tr>{rows}</table></div>'


def _view3d(result: Result, timestep: int) -> str:
    modes = ["Full", "Diffuse only", "Diffuse albedo", "Specular albedo", "Normals", "Grey surface"]
    if result.reflectance is None:
        modes = ["Full", *modes[2:3], *modes[4:]]
    values = {"Full": 0, "Diffuse only": 1, "Diffuse albedo": 2, "Specular albedo": 3, "Normals": 4, "Grey surface": 5}
    options = "".join(f'<option value="{values[m]}">{m}</option>' for m in modes)
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


def _comparison(result: Result, capture: Capture, evaluation: dict[str, Any], comparisons: Sequence[Comparison]) -> str:
    camera, parts = evaluation["camera"], []
    known = {found.timestep: found for found in comparisons}
    limit = f"{HEAT_LIMIT:.0f} of 255"
    parts.append(
        f'<p class="scale">Error maps: 0 <img src="{jpeg_uri(heat_scale())}" alt="black to yellow"> {limit} or more</p>'
    )
    for entry in evaluation["per_timestep"][:SHOWN_TIMESTEPS]:
        timestep = entry["timestep"]
        found = known.get(timestep) or compare(result, capture, camera, timestep, evaluation["region"])
        maps = "".join(
            figure(
                jpeg_uri(heat_map(found.photograph, render, found.region)[bounding_box(found.region)]),
                f"{NAMES[m]}: {entry['methods'][m]['psnr']:.2f} dB",
                f"error map of {NAMES[m]}",
            )
            for m, render in found.renders.items()
        )
        body = f'{_slider(found)}<div class="grid">{maps}</div>'
        parts.append(f'<h3>Timestep {found.timestep}</h3><div class="compare">{body}</div>')
    return "".join(parts)


def _slider(found: Comparison) -> str:
    """Photograph and render under one draggable divider, with a choice of methods."""
    box = bounding_box(found.region)
    methods = list(found.renders)[::-1]
    name = f"slider{found.timestep}"
    tops = ""
    for m in methods:
        uri = jpeg_uri(overlay(found.photograph, found.renders[m])[box], 90)
        hidden = "" if m == methods[0] else " hidden"
        tops += f'<img class="top" data-for="{m}" alt="render by {NAMES[m]}" src="{uri}"{hidden}>'
    buttons = "".join(
        f'<button type="button" value="{m}" aria-pressed="{str(m == methods[0]).lower()}">{NAMES[m]}</button>'
        for m in methods
    )
    return f"""<div><div class="slider" id="{name}">
<img alt="photograph" src="{jpeg_uri(found.photograph[box], 90)}">{tops}<span class="bar"></span>
<span class="tag" style="left:6px">Photograph</span>
<span class="tag" data-name style="right:6px">{NAMES[methods[0]]}</span>
<input type="range" min="0" max="100" value="50" aria-label="divider between photograph and render"></div>
<div class="controls" data-choice="{name}">{buttons}</div></div>"""


def _inputs(result: Result, capture: Capture, timesteps: tuple[int, ...]) -> str:
    parts = []
    for timestep in timesteps:
        figures = []
        points = result.geometry.vertices[result.index(timestep)][result.model.landmarks]
        for camera in (c.name for c in result.cameras):
            view, frame = capture.camera(camera), capture.frame(camera, timestep)
            photograph = to_8_bit(frame.image)
            linear = render_view(result, view, timestep, result.methods[-1], samples=1)
            render = rgba_8_bit(linear)
            box = bounding_box(render[..., 3] > 0)
            marked = draw_landmarks(photograph, view, frame.landmarks, frame.visible, points)
            label = html.escape(camera)
            figures.append(figure(jpeg_uri(marked[box]), f"{label}: input with landmarks", f"input from {label}"))
            figures.append(
                figure(jpeg_uri(overlay(photograph, render)[box]), f"{label}: fit laid over", f"fit over {label}")
            )
            mask = face_mask(result, capture, camera, timestep, linear)
            caption = f"{label}: {mask.part(mask.clipped):.1%} clipped, {mask.part(mask.unexplained):.1%} unexplained"
            labels = None if result.reflectance is None else result.reflectance.label(camera, timestep)
            kinds = [] if labels is None else [(labels == kind, colour) for kind, colour, _ in LABEL_TINTS]
            tinted = tint(photograph, (mask.clipped, CLIPPED_TINT), (mask.unexplained, UNEXPLAINED_TINT), *kinds)
            figures.append(figure(jpeg_uri(tinted[box]), caption, f"face mask of {label}"))
        parts.append(f'<h3>Timestep {timestep}</h3><div class="grid">{"".join(figures)}</div>')
    rest = len(result.timesteps) - len(timesteps)
    more = f'<p class="soft">{rest} more timesteps are in the result but not on this page.</p>' if rest else ""
    swatches = "".join(
        f'<span><i style="background:rgb{colour};height:12px"></i>{name}</span>'
        for colour, name in (
            (CLIPPED_TINT, "clipped"),
            (UNEXPLAINED_TINT, "explained by no lighting and albedo"),
            *((colour, name) for _, colour, name in LABEL_TINTS),
        )
    )
    key = (
        '<p class="soft">Cyan rings: detected landmarks. Orange dots: the fitted model\'s.</p>'
        f'<p class="legend"><span>Not used, or outvoted by the other images:</span>{swatches}'
        "<span>Percentages are of the face area.</span></p>"
    )
    return key + "".join(parts) + more


def _frames(result: Result) -> str:
    """Frames that were chosen, added or left out, and why; nothing where all was as asked for."""
    chosen = result.geometry.report.details.get("frames", {})
    refined = {} if result.reflectance is None else result.reflectance.report.details.get("refined", {})
    lines = [f"Timestep {t} was fitted: {why}." for t, why in chosen.get("why", {}).items()]
    lines += [f"Timestep {t} was not to be chosen: {why}." for t, why in chosen.get("left_out", {}).items()]
    for camera, offset in chosen.get("camera_offsets_frames", {}).items():
        lines.append(f"Camera {camera} is {offset:+.2f} frames later than the first one, by its epipolar lines.")
    if refined:
        lines.append(f"Maps and lighting are from {len(refined['timesteps'])} frames.")
        lines += [f"Timestep {t} was left out of them: {why}." for t, why in refined["left_out"].items()]
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def _lighting(result: Result) -> str:
    lighting = result.lighting
    matt, mirror = lighting_balls(lighting)
    panorama = np.maximum(lighting.to_latlong(), 0)
    codes = to_8_bit(panorama / max(float(panorama.max()), 1e-12))
    lights = [light.describe(result.unit_mm) for light in result.illumination.lights]
    compact = "".join(f"; the sharp light {light}, was found apart from them" for light in lights)
    return f"""<div class="balls">{figure(png_uri(matt), "White matt ball", "lighting on a matt ball")}
{figure(png_uri(mirror), "Mirror ball", "lighting in a mirror ball")}
{figure(jpeg_uri(codes), "All directions, latitude by longitude", "lighting panorama")}</div>
<p class="soft">Recovered as spherical harmonics of {lighting.order} bands, so only broad light shows{compact}.
Ambient term {result.illumination.ambient:.4f}.</p>"""


def _convergence(result: Result) -> str:
    rows = "".join(
        f"<tr><td>{STAGES[n]}</td><td>{html.escape(r.outcome.replace('_', ' '))}</td>"
        f"<td>{max((len(v) for v in r.energies.values()), default=0)}</td><td>{r.seconds:.1f}</td></tr>"
        for n, r in result.reports.items()
    )
    memory = f", peak memory {result.peak_memory / 2**20:.0f} MB" if result.peak_memory else ""
    plots = ""
    for name, report in result.reports.items():
        plot = energy_plot(report.energies)
        if plot:
            plots += f"<h3>{STAGES[name]}: energy by iteration</h3>{plot}"
    return (
        '<div class="wide"><table><tr><th>Stage</th><th>Ended</th><th>Iterations</th><th>Seconds</th></tr>'
        f"{rows}</table></div><p>Whole fit {result.seconds:.1f} s{memory}.</p>{plots}"
    )


def _settings(result: Result) -> str:
    text = html.escape(json.dumps(result.config, indent=1, default=str))
    return f"<details><summary>Settings of this fit</summary><pre>{text}</pre></details>"
