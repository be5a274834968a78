"""A stranger's program: the face of the view asked for in one colour, the mean of the other views' faces.

usage: flat_colour.py CAPTURE OUT CAMERA,CAMERA HELD_OUT TIMESTEP ...   (NumPy and OpenCV; no mifit)
"""

import json
import pathlib
import sys

import cv2
import numpy as np


def hull(frame, folder):
    """Pixels of the face: the hull of an image's landmarks."""
    points = np.array(json.loads((folder / frame["landmark_path"]).read_text())["points"], np.float32)
    mask = np.zeros((frame["h"], frame["w"]), np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(points).astype(np.int32), 1)
    return mask > 0


folder, out = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2])
given, wanted, steps = sys.argv[3].split(","), sys.argv[4], [int(t) for t in sys.argv[5:]]
frames = {
    (f["camera_id"], f["timestep_index"]): f for f in json.loads((folder / "transforms.json").read_text())["frames"]
}
out.mkdir(parents=True, exist_ok=True)
for step in steps:
    seen = [frames[name, step] for name in given]
    pixels = [cv2.imread(str(folder / f["file_path"]))[hull(f, folder)] for f in seen]
    size = frames[wanted, step]["h"], frames[wanted, step]["w"]
    image = np.empty((*size, 3), np.uint8)
    image[:] = np.concatenate(pixels).mean(0)
    cv2.imwrite(str(out / f"{wanted}_{step:04d}.png"), image)
