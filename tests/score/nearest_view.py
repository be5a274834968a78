"""A stranger's program: the nearest photograph, carried to the view asked for by triangles between landmarks.

Landmarks of the given views are triangulated, projected into the wanted view, joined by Delaunay triangles, and every
pixel takes the colour that the view nearest in angle has at the same place of its triangle.

usage: nearest_view.py CAPTURE OUT CAMERA,CAMERA HELD_OUT TIMESTEP ...   (NumPy, SciPy and OpenCV; no mifit)
"""

import json
import pathlib
import sys

import cv2
import numpy as np
from scipy.spatial import Delaunay


def projection(frame):
    """(3, 4) matrix from the world to pixels, and the camera's place."""
    pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    turn, place = pose[:3, :3], pose[:3, 3]
    intrinsics = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1.0]])
    return intrinsics @ np.column_stack([turn.T, -turn.T @ place]), place


def marks(frame, folder):
    """(68, 2) landmarks."""
    return np.array(json.loads((folder / frame["landmark_path"]).read_text())["points"])


def triangulate(matrices, points):
    """(68, 3) places in the world of points seen by several cameras."""
    found = []
    for seen in zip(*points, strict=True):
        rows = [x * m[2] - m[0] for m, (x, _) in zip(matrices, seen, strict=True)]
        rows += [y * m[2] - m[1] for m, (_, y) in zip(matrices, seen, strict=True)]
        point = np.linalg.svd(np.array(rows))[2][-1]
        found.append(point[:3] / point[3])
    return np.array(found)


folder, out = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
given, wanted, steps = sys.argv[3].split(","), sys.argv[4], [int(t) for t in sys.argv[5:]]
frames = {
    (f["camera_id"], f["timestep_index"]): f for f in json.loads((folder / "transforms.json").read_text())["frames"]
}
out.mkdir(parents=True, exist_ok=True)
for step in steps:
    views = [frames[name, step] for name in given]
    matrices, places = zip(*map(projection, views), strict=True)
    world = triangulate(matrices, [marks(f, folder) for f in views])
    target, place = projection(frames[wanted, step])
    towards = [(p - world.mean(0)) / np.linalg.norm(p - world.mean(0)) for p in (*places, place)]
    best = int(np.argmax([t @ towards[-1] for t in towards[:-1]]))
    flat = {}
    for name, matrix in (("there", matrices[best]), ("here", target)):
        p = np.column_stack([world, np.ones(68)]) @ matrix.T
        flat[name] = p[:, :2] / p[:, 2:]
    mesh = Delaunay(flat["here"])
    height, width = frames[wanted, step]["h"], frames[wanted, step]["w"]
    pixel = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    face = mesh.find_simplex(pixel)
    to_weights = mesh.transform[face]
    first = np.einsum("nij,nj->ni", to_weights[:, :2], pixel - to_weights[:, 2])
    weights = np.column_stack([first, 1 - first.sum(1)])
    source = np.einsum("ni,nij->nj", weights, flat["there"][mesh.simplices[face]])
    source[face < 0] = -1000.0
    photograph = cv2.imread(str(folder / views[best]["file_path"]))
    x, y = (source - 0.5).T.reshape(2, height, width).astype(np.float32)
    cv2.imwrite(str(out / f"{wanted}_{step:04d}.png"), cv2.remap(photograph, x, y, cv2.INTER_LINEAR))
