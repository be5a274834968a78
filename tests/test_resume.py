"""A fit or a tracking run that is killed goes on, and ends with what an uninterrupted one gives."""

import json
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from mifit.core.image import read_image

CONFIG = """
[geometry]
rounds = 1
[surface]
finest = 2
[reflectance]
texture_size = 32
shading = "prefiltered"
bands = 4
exponent = 100
"""


def mifit(*arguments):
    return [sys.executable, "-m", "mifit", *map(str, arguments), "--quiet"]


def timed(command):
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - started


def kill_and_resume(command, seconds, seed, start_over):
    """Kill -9 up to two runs at random moments of their expected time, then let one end.

    Each kill leaves the next run less to do, so a later one may end before its moment. When the first one does, the
    expected time was too long (a cold start, a busy machine): start over with half of it.
    """
    kills, chance = 0, random.Random(seed)
    while kills < 2:
        process = subprocess.Popen(command)
        try:
            process.wait(chance.uniform(0.3, 0.95) * seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
            continue
        assert process.returncode == 0
        if kills:
            break
        start_over()
        seconds /= 2
    subprocess.run(command, check=True, capture_output=True)


def assert_equal_results(one: Path, other: Path, timesteps):
    a, b = (json.loads((folder / "result.json").read_text()) for folder in (one, other))
    assert [t["timestep"] for t in a["timesteps"]] == [t["timestep"] for t in b["timesteps"]] == timesteps
    np.testing.assert_allclose(a["lighting"]["radiance"], b["lighting"]["radiance"], atol=1e-3)
    for s, t in zip(a["timesteps"], b["timesteps"], strict=True):
        np.testing.assert_allclose(s["translation"], t["translation"], atol=1e-3)
    for name in ("diffuse", "specular", *(f"normal_object_{t:04d}" for t in timesteps)):
        x, y = (np.asarray(read_image(folder / "maps" / f"{name}.exr")) for folder in (one, other))
        assert np.abs(x - y).max() < 5e-3, name
    assert not list(other.glob("**/.*.part*"))


@pytest.mark.slow
def test_killed_at_random_moments_and_resumed(tiny_capture, tmp_path):
    config, whole, killed = tmp_path / "c.toml", tmp_path / "whole", tmp_path / "killed"
    config.write_text(CONFIG)

    def fit(out, *more):
        options = ("--model", "builtin:coarse", "--timesteps", "0", "--config", config)
        return mifit("fit", tiny_capture, "--out", out, *options, *more)

    def track(result, *more):
        return mifit("track", tiny_capture, "--result", result, "--timesteps", "1,2", *more)

    seconds = timed(fit(whole))
    kill_and_resume(fit(killed, "--resume"), seconds, 4, lambda: shutil.rmtree(killed))
    assert_equal_results(whole, killed, [0])

    def untracked():
        shutil.rmtree(killed)
        shutil.copytree(fitted, killed)

    fitted = shutil.copytree(whole, tmp_path / "fitted")
    untracked()
    seconds = timed(track(whole))
    kill_and_resume(track(killed, "--resume"), seconds, 5, untracked)
    assert_equal_results(whole, killed, [0, 1, 2])
