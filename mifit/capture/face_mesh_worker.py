"""MediaPipe Face Mesh behind a pipe; runs in an environment of its own and imports nothing of mifit.

Protocol: one line ``ready`` first; then, per image, a line ``WIDTH HEIGHT`` and the RGB bytes come in, and one line of
JSON goes out: ``null`` when no face is found, else 478 points [x, y] in pixels, the first pixel's centre at (0.5, 0.5).
"""

from __future__ import annotations

import json
import sys


def main() -> None:
    """Answer images until standard input ends."""
    import mediapipe
    import numpy as np

    mesh = mediapipe.solutions.face_mesh.FaceMesh(
        static_image_mode=True, max_num_faces=1, refine_landmarks=True, min_detection_confidence=0.2
    )
    answers, images = sys.stdout, sys.stdin.buffer
    print("ready", file=answers, flush=True)
    while line := images.readline():
        width, height = (int(word) for word in line.split())
        pixels = np.frombuffer(images.read(width * height * 3), dtype=np.uint8).reshape(height, width, 3)
        found = mesh.process(pixels).multi_face_landmarks
        points = [[p.x * width, p.y * height] for p in found[0].landmark] if found else None
        print(json.dumps(points), file=answers, flush=True)


if __name__ == "__main__":
    main()
