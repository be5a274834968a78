"""The code of docs/experiment.md runs from top to bottom, and does what the page says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import mifit
from tests.variant import VARIANT

PAGE = Path(mifit.__file__).resolve().parents[1] / "docs" / "experiment.md"


def run_page(folder: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, str]) -> dict:
    """Execute the page's blocks in one namespace, and return it."""
    monkeypatch.chdir(folder)
    names: dict = {}
    for block in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), flags=re.S | re.M):
        for before, after in changes.items():
            block = block.replace(before, after)
        exec(compile(block, str(PAGE), "exec"), names)
    return names


def check(names: dict) -> None:
    result, losses = names["result"], names["losses"]
    assert mifit.Reconstruction.load("out/gloss") == result
    assert names["tanned"] != result and names["image"].shape[2] == 4
    assert len(names["frames"]) == 36
    assert len({frame[frame[..., 3] == 1][:, 0].mean().round(5) for frame in names["frames"]}) > 28
    assert len(losses) == 30 and losses[-1] < losses[0]
    assert names["better"] != result
    fitted, tanned, found = (names[n].reflectance.diffuse for n in ("result", "tanned", "better"))
    touched = np.abs(found - tanned).max(axis=-1) > 1e-4  # texels that a camera sees, and sees well
    touched &= names["result"].reflectance.confidence > 0.9
    away, again = (np.abs((x - fitted)[touched].mean(axis=0)).max() for x in (tanned, found))
    assert touched.any() and again < 0.3 * away  # the colour of the photographs is found again
    height, width = names["camera"].height, names["camera"].width
    assert names["picture"].shape == (height, width, 4) and names["picture"][..., :3].max() > 0.1


def page_loss(names: dict, result: mifit.Reconstruction) -> float:
    """Return the page's loss of a face, without its prior."""
    import drjit as dr
    import mitsuba as mi

    scene = result.scene("shdirect", cameras=[names["capture"].camera(name) for name in names["names"]])
    total = 0.0
    for number, (photograph, count) in enumerate(zip(names["photographs"], names["counts"], strict=True)):
        difference = dr.square(mi.render(scene, sensor=number, spp=1)[..., :3] - photograph)
        loss = dr.sum(count * dr.sqrt(difference + 1e-4), axis=None) / dr.sum(count, axis=None)
        total += float(loss.array[0])
    return total


@pytest.mark.slow
def test_the_page_runs(variant, tiny_capture, tmp_path, monkeypatch):
    (tmp_path / "captures").mkdir()
    (tmp_path / "captures" / "gloss").symlink_to(tiny_capture)
    small = {
        '"builtin"': '"builtin:coarse"', '"auto"': f'"{VARIANT}"',
        "texture_size=256": "texture_size=64, bands=4, exponent=100",
    }  # fmt: skip
    names = run_page(tmp_path, monkeypatch, small)
    check(names)
    tanned, found, fitted = names["losses"][0], names["losses"][-1], page_loss(names, names["result"])
    assert found - fitted < 0.25 * (tanned - fitted)  # 0.18; what the fitted face leaves is the pictures' noise
