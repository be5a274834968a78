"""MediaPipe Face Mesh as a landmark detector, in an environment of its own.

MediaPipe 0.10.21 carries its models in its wheel, but needs NumPy below 2, so it can't share mifit's environment. One
is made in the user's cache folder on first use (`make_environment`) and spoken to through a pipe.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from importlib import resources
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import cache_folder
from mifit.errors import MifitError

REQUIREMENTS = ("mediapipe==0.10.21", "numpy<2")
SCATTER = 0.045
"""Standard deviation that stage 1 gives the points, as a part of the face's width. Chosen among four values by the fits
of three captures. Their median error is 1.5 per cent, but neighbours share it and all images of a head repeat it, so
that a sum over all points must weigh less than if they were independent."""
PYTHONS = ((3, 9), (3, 12))
"""First and last Python that the wheel of REQUIREMENTS exists for."""


def environment_python() -> Path:
    """The interpreter of MediaPipe's environment, whether it has been made yet or not."""
    folder = cache_folder() / "mediapipe-0.10.21"
    return folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def make_environment() -> Path:
    """Make MediaPipe's environment unless it is there; returns its interpreter.

    Raises
    ------
    MifitError
        No suitable Python, or the packages can't be installed; the message holds pip's last line.
    """
    python = environment_python()
    if python.exists():
        return python
    folder = python.parents[1]
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=".mediapipe-", dir=folder.parent))
    try:
        _run([_base_python(), "-m", "venv", str(part)])
        inside = part / python.relative_to(folder)
        _run([str(inside), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *REQUIREMENTS])
        if not folder.exists():  # another process may have been faster
            os.replace(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return python


def _base_python() -> str:
    if PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]:
        return sys.executable
    for minor in range(PYTHONS[1][1], PYTHONS[0][1] - 1, -1):
        found = shutil.which(f"python3.{minor}")
        if found:
            return found
    raise MifitError(
        f"mediapipe: found Python {sys.version_info[0]}.{sys.version_info[1]} only, expected 3.9 to 3.12; "
        "install one of those (for example python3.12), or name another --detector"
    )


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()]
        raise MifitError(
            f"mediapipe: '{' '.join(command[1:4])} ...' failed: {lines[-1] if lines else 'no output'}; "
            f"install {' and '.join(REQUIREMENTS)} into a virtual environment at {environment_python().parents[1]}"
        )


@cache
def landmark_map() -> NDArray[np.float64]:
    """(68, 478) weights, rows summing to 1: iBUG points as affine combinations of Face Mesh points.

    Fitted on rendered heads with known landmarks by ``benchmarks/face_mesh_map.py``.
    """
    text = (resources.files("mifit.capture") / "face_mesh_68.json").read_text(encoding="utf-8")
    table = json.loads(text)
    weights = np.zeros((68, 478))
    for row, (index, weight) in enumerate(zip(table["index"], table["weight"], strict=True)):
        weights[row, index] = weight
    return weights


class MediaPipe:
    """Face Mesh in a process of its own; a context manager.

    Raises
    ------
    MifitError
        The environment can't be made or the process ends early.
    """

    name, scatter = "mediapipe", SCATTER

    def __init__(self) -> None:
        worker = Path(__file__).with_name("face_mesh_worker.py")
        self._errors = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [str(make_environment()), "-I", str(worker)],  # -I: nothing of this environment or folder is imported
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
        )
        if self._answer() != b"ready\n":
            self.close()
            raise self._failure()

    def __enter__(self) -> MediaPipe:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except BrokenPipeError:
            pass
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def mesh(self, image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """(478, 2) Face Mesh points in pixels of an RGB image (H, W, 3), or None when no face is found."""
        assert self._process.stdin is not None
        height, width = image.shape[:2]
        try:
            self._process.stdin.write(f"{width} {height}\n".encode() + np.ascontiguousarray(image).tobytes())
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._failure() from None
        line = self._answer()
        if not line:
            raise self._failure()
        points = json.loads(line)
        return None if points is None else np.array(points, dtype=np.float64)

    def detect(self, image: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """(68, 2) iBUG points in pixels, the first pixel's centre at (0.5, 0.5), or None when no face is found."""
        mesh = self.mesh(image)
        return None if mesh is None else landmark_map() @ mesh

    def _answer(self) -> bytes:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def _failure(self) -> MifitError:
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        folder = environment_python().parents[1]
        return MifitError(
            f"mediapipe: its process ended early ({lines[-1] if lines else 'no message'}); remove {folder}, "
            "and it is made anew"
        )
