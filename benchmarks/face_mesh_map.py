"""Fit the table that turns MediaPipe's 478 Face Mesh points into 68 iBUG landmarks.

Heads with known landmarks are synthesised, MediaPipe looks at them, and every landmark becomes the affine combination
of its nearest mesh points that predicts it best. The result is ``mifit/capture/face_mesh_68.json``.

    python benchmarks/face_mesh_map.py --model MODEL.npz --subjects 40 --out mifit/capture/face_mesh_68.json
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mifit
from mifit.capture import Capture
from mifit.capture.face_mesh import FaceMesh, mirrored_points
from mifit.core.files import write_text
from mifit.core.image import load_image, to_8_bit
from mifit.morphable import MorphableModel
from mifit.synth import synthesize

POINTS = 64
"""Mesh points that a landmark is combined of."""
RIDGE = 1e-3
"""Penalty on the weights, relative to squared eye distances."""


def observe(folder: Path, model: MorphableModel, detector: FaceMesh) -> list[tuple[NDArray, NDArray, NDArray]]:
    """(mesh points (478, 2), true landmarks (68, 2), visible (68,)) of every image in which a face is found."""
    capture, seen = Capture.load(folder), []
    for (camera, timestep), shot in capture.shots.items():
        face = detector.face(to_8_bit(load_image(shot.image).pixels))
        marks = capture.landmarks(camera, timestep)
        if face is not None and marks is not None:
            vertices = np.load(folder / "truth" / f"{timestep:04d}.npz")["vertices"]
            seen.append((face.points[:, :2], capture.camera(camera).project(vertices[model.landmarks]), marks.visible))
    return seen


def fit_table(seen: list[tuple[NDArray, NDArray, NDArray]]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices and weights (68, POINTS) of the affine combinations; weights sum to 1."""
    mesh, truth, visible = (np.stack(values) for values in zip(*seen, strict=True))
    scale = np.linalg.norm(mesh[:, 33] - mesh[:, 263], axis=1)  # outer corners of the eyes
    index, weight = np.zeros((68, POINTS), dtype=np.int64), np.zeros((68, POINTS))
    for j in range(68):
        v = visible[:, j]
        offset = (mesh[v] - truth[v, j][:, None]) / scale[v, None, None]
        index[j] = np.argsort(np.linalg.norm(offset, axis=2).mean(axis=0))[:POINTS]
        chosen = offset[:, index[j]]
        gram = np.einsum("nkc,nlc->kl", chosen, chosen) / v.sum() + RIDGE * np.eye(POINTS)
        weight[j] = np.linalg.solve(gram, np.ones(POINTS))
        weight[j] /= weight[j].sum()
    return index, weight


def main() -> None:
    """Synthesise, observe, fit, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", required=True)
    parser.add_argument("--subjects", type=int, default=40)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    mifit.set_variant("auto")
    model = MorphableModel.load(arguments.model)
    seen = []
    detector = FaceMesh()
    with tempfile.TemporaryDirectory() as folder:
        for i in range(arguments.subjects):
            out = Path(folder) / str(i)
            synthesize(out, timesteps=2, model=arguments.model, seed=arguments.seed + i, width=340, height=240, spp=9)
            seen += observe(out, model, detector)
            print(f"{i + 1} of {arguments.subjects} subjects, {len(seen)} images", flush=True)
    index, weight = fit_table(seen)
    table = {"index": index.tolist(), "weight": np.round(weight, 5).tolist(), "mirror": mirrored_points().tolist()}
    write_text(arguments.out, json.dumps(table) + "\n")


if __name__ == "__main__":
    main()
