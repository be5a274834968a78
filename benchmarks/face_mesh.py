"""The table that turns MediaPipe's 478 Face Mesh points into 68 iBUG landmarks.

    python -m benchmarks.face_mesh --out mifit/capture/face_mesh_68.json [--subjects 40]

Heads with known landmarks are synthesised, MediaPipe looks at them, and every landmark becomes the affine combination
of its nearest mesh points that predicts it best.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import mifit
from benchmarks.heads import ICT
from mifit.capture import Capture
from mifit.core.files import write_text
from mifit.core.image import load_image, to_8_bit
from mifit.morphable import MorphableModel
from mifit.synth import synthesize

POINTS = 64
"""Mesh points that a landmark is combined of."""
RIDGE = 1e-3
"""Penalty on the weights, relative to squared eye distances."""


def fit_table(seen: list[tuple[NDArray, NDArray, NDArray]]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices and weights (68, POINTS) of the affine combinations; weights sum to 1.

    ``seen``: mesh points (478, 2), true landmarks (68, 2) and their visibility (68,) of every image.
    """
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


def fit_face_mesh(name: str, subjects: int, seed: int, out: Path) -> None:
    """Synthesise, detect, fit, write."""
    from mifit.capture.face_mesh import FaceMesh, mirrored_points

    mifit.set_variant("auto")
    model, detector, seen = MorphableModel.load(name), FaceMesh(), []
    with tempfile.TemporaryDirectory() as work:
        for i in range(subjects):
            folder = Path(work) / str(i)
            synthesize(folder, timesteps=2, model=name, seed=seed + i, width=340, height=240, spp=9)
            capture = Capture.load(folder)
            for (camera, timestep), shot in capture.shots.items():
                face = detector.face(to_8_bit(load_image(shot.image).pixels))
                marks = capture.landmarks(camera, timestep)
                if face is not None and marks is not None:
                    vertices = np.load(folder / "truth" / f"{timestep:04d}.npz")["vertices"]
                    true = capture.camera(camera).project(vertices[model.landmarks])
                    seen.append((face.points[:, :2], true, marks.visible))
            print(f"{i + 1} of {subjects} subjects, {len(seen)} images", flush=True)
    index, weight = fit_table(seen)
    table = {"index": index.tolist(), "weight": np.round(weight, 5).tolist(), "mirror": mirrored_points().tolist()}
    write_text(out, json.dumps(table) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default=ICT)
    parser.add_argument("--subjects", type=int, default=40)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--out", type=Path, default=Path("face_mesh_68.json"))
    a = parser.parse_args()
    fit_face_mesh(a.model, a.subjects, a.seed, a.out)


if __name__ == "__main__":
    main()
