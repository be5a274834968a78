"""The plugins' pages and example scenes."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

import mifit

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("blinnphong", "shenv", "shdirect", "pinhole")


@pytest.fixture(scope="module")
def builder():
    spec = importlib.util.spec_from_file_location("build_plugin_pages", ROOT / "docs" / "build_plugin_pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NAMES)
def test_the_page_is_that_of_the_docstring(variant: str, builder, name: str) -> None:
    written = (ROOT / "docs" / "plugins" / f"{name}.md").read_text(encoding="utf-8")
    assert written == builder.page(name, mifit.register_plugins()[name]), "run: python docs/build_plugin_pages.py"
    assert (ROOT / "docs" / "plugins" / f"{name}.png").stat().st_size < 200_000


@pytest.mark.parametrize("name", NAMES)
def test_the_scene_renders(variant: str, name: str) -> None:
    import mitsuba as mi

    scene = mifit.load_scene(ROOT / "scenes" / "plugins" / f"{name}.xml", spp=1, width=32, height=12)
    image = np.array(mi.render(scene, seed=0))
    assert image.shape == (12, 32, 3) and np.isfinite(image).all() and image.max() > 0.1


@pytest.mark.parametrize("name", NAMES)
def test_the_dictionary_loads(variant: str, builder, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import mitsuba as mi

    monkeypatch.chdir(ROOT)
    mifit.register_plugins()
    dictionary = eval(builder.DICTIONARIES[name].strip(), {"mi": mi, "mifit": mifit})
    assert type(mi.load_dict(dictionary)).__name__ in ("BlinnPhong", "SHEnvironment", "SHDirect", "Pinhole")
