"""A hand, glasses and a fringe painted over images of a shared capture: what is found, and what it does to the albedo.

    python -m benchmarks.hidden [--capture soft] [--size 128] [--result RESULT] [--pictures DIR]

Stage 2 runs on the clean images and on painted ones with the same geometry (of RESULT, else of a fit to the clean
images): each object over one image, and the fringe over all. Prints the intersection over union of what was marked
and what was painted, within the face area, and by how much the diffuse albedo moves away from everything painted.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

import mifit
from benchmarks.foreign import ICT
from benchmarks.record import SHARED
from mifit import Capture, MorphableModel, Reconstruction
from mifit.core.estimate import hidden
from mifit.core.image import srgb_to_linear, to_8_bit, write_image
from mifit.stages.observations import Surface

CAMERAS, TIMESTEPS = ("left", "right"), (0, 1, 2, 3)
COLOURS = {"hand": (170, 120, 92), "glasses": (20, 22, 25), "fringe": (60, 45, 30)}
"""Of 8-bit sRGB."""
SINGLE = {("left", 0): "hand", ("left", 1): "glasses", ("right", 2): "fringe"}
EVERYWHERE = {(camera, timestep): "fringe" for camera in CAMERAS for timestep in TIMESTEPS}
SEEN = 0.2
"""Confidence of texels that are compared."""


@dataclass(frozen=True)
class Painted:
    """A capture with objects painted over some of its images."""

    capture: Capture
    areas: dict[tuple[str, int], np.ndarray]
    kinds: dict[tuple[str, int], str]

    def __getattr__(self, name: str):
        return getattr(self.capture, name)

    def frame(self, camera: str, timestep: int):
        """The painted image."""
        frame = self.capture.frame(camera, timestep)
        area = self.areas.get((camera, timestep))
        if area is None:
            return frame
        rng = np.random.default_rng(timestep)
        noise = cv2.GaussianBlur(rng.normal(size=area.shape).astype(np.float32), (0, 0), 2) * 30
        colour = np.array(COLOURS[self.kinds[camera, timestep]]) + noise[..., None] * (1.0, 0.7, 0.5)
        paint = srgb_to_linear(np.clip(colour / 255.0, 0, 1).astype(np.float32))
        return replace(frame, image=np.where(area[..., None], paint, frame.image), clipped=frame.clipped & ~area)


def object_area(kind: str, shape: tuple[int, int], marks: np.ndarray) -> np.ndarray:
    """(H, W) bool: where an object is, by iBUG points in pixels."""
    out = np.zeros(shape, np.uint8)
    unit = float(np.linalg.norm(marks[45] - marks[36]))

    def at(point: np.ndarray) -> tuple[int, int]:
        return round(float(point[0])), round(float(point[1]))

    if kind == "hand":
        centre = 0.45 * marks[2] + 0.55 * marks[48]
        cv2.ellipse(out, at(centre), (round(0.33 * unit), round(0.4 * unit)), 20, 0, 360, 1, -1)
        for k in range(4):
            foot = centre + unit * np.array([0.14 * k - 0.23, -0.23])
            cv2.line(out, at(foot), at(foot + unit * np.array([0.06, -0.5])), 1, round(0.11 * unit))
    elif kind == "glasses":
        for eye in (slice(36, 42), slice(42, 48)):
            radius = 0.75 * float(np.ptp(marks[eye][:, 0]))
            cv2.circle(out, at(marks[eye].mean(axis=0)), round(radius), 1, max(3, round(0.055 * unit)))
        cv2.line(out, at(marks[39]), at(marks[42]), 1, max(3, round(0.055 * unit)))
    else:
        low = np.stack([marks[17], marks[26]]) - (0.0, 0.05 * unit)
        cv2.fillConvexPoly(out, np.int32(np.round([*low, *(low[::-1] - (0.0, 0.45 * unit))])), 1)
    return out > 0


def paint(capture: Capture, kinds: dict[tuple[str, int], str]) -> Painted:
    """The capture with the objects at its landmarks."""
    areas = {}
    for (camera, timestep), kind in kinds.items():
        frame = capture.frame(camera, timestep)
        areas[camera, timestep] = object_area(kind, frame.valid.shape, frame.landmarks)
    return Painted(capture, areas, kinds)


def touched(surface: Surface, model: MorphableModel, painted: Painted, size: int) -> np.ndarray:
    """(S, S) bool: texels under or beside what was painted."""
    out = np.zeros((size, size), np.uint8)
    for view in surface.views():
        area = painted.areas.get((view.camera.name, view.timestep))
        if area is not None:
            near = cv2.dilate(area.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool) & (view.face >= 0)
            uv = np.einsum("nk,nkc->nc", view.weights[near], model.uv[model.faces_uv[view.face[near]]])
            row, column = ((1 - uv[:, 1]) * size).astype(int), (uv[:, 0] * size).astype(int)
            out[np.clip(row, 0, size - 1), np.clip(column, 0, size - 1)] = 1
    return cv2.dilate(out, np.ones((5, 5), np.uint8)) > 0


def main() -> None:
    """Run the comparison and print it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", default="soft")
    parser.add_argument("--model", default=ICT)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--result", type=Path)
    parser.add_argument("--pictures", type=Path)
    arguments = parser.parse_args()
    mifit.set_variant("auto")
    capture, model = Capture.load(SHARED / "captures" / arguments.capture), MorphableModel.load(arguments.model)
    if arguments.result is None:
        fitted = mifit.fit(capture, model, CAMERAS, TIMESTEPS, until="geometry")
    else:
        fitted = Reconstruction.load(arguments.result, model=model)
    model, geometry = fitted.model, fitted.geometry  # with eyes, if it had none
    config = mifit.ReflectanceConfig(texture_size=arguments.size)
    clean = mifit.infer_reflectance(capture, model, geometry, CAMERAS, config)
    surface = Surface(capture, model, geometry, CAMERAS, arguments.size)
    facial = {
        (view.camera.name, view.timestep): (view.face >= 0) & model.face_mask[np.maximum(view.face, 0)]
        for view in surface.views()
    }
    found = {}
    for name, kinds in (("single", SINGLE), ("everywhere", EVERYWHERE)):
        painted = paint(capture, kinds)
        for segment in (True, False):
            moved = mifit.infer_reflectance(painted, model, geometry, CAMERAS, replace(config, segment=segment))
            elsewhere = (clean.confidence > SEEN) & ~touched(surface, model, painted, arguments.size)
            change = np.abs(moved.diffuse - clean.diffuse)[elsewhere]
            row = {"moved_mean": float(change.mean()), "moved_p95": float(np.quantile(change, 0.95))}
            for key, labels in zip(moved.labelled, moved.labels, strict=True):
                marked = hidden(labels) & facial[key]
                true = painted.areas.get(key, np.zeros_like(marked)) & facial[key]
                label = "/".join(map(str, key))
                if true.any():
                    row[f"iou {kinds[key]} {label}"] = float((marked & true).sum() / (marked | true).sum())
                else:
                    row[f"marked {label}"] = float(marked.sum() / facial[key].sum())
                if arguments.pictures is not None:
                    picture = to_8_bit(painted.frame(*key).image) / 255.0
                    picture[marked] = 0.4 * picture[marked] + 0.6 * np.array([0.9, 0.1, 0.1])
                    write_image(arguments.pictures / f"{name}_{key[0]}_{key[1]}.png", srgb_to_linear(picture))
            found[f"{name}, {'found' if segment else 'not looked for'}"] = row
            print(json.dumps({name: row, "segment": segment}), flush=True)


if __name__ == "__main__":
    main()
