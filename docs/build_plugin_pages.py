"""Write the pages of the Mitsuba plugins, docs/plugins/NAME.md, from the docstrings of the plugin classes.

    python docs/build_plugin_pages.py [--text-only]

Each page has the docstring, the plugin as it stands in scenes/plugins/NAME.xml and as a dictionary, and the picture
that the scene renders to. ``--text-only`` leaves the pictures as they are.
"""

from __future__ import annotations

import argparse
import inspect
import re
import textwrap
from pathlib import Path

import mifit

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "plugins"
SCENES = ROOT / "scenes" / "plugins"

DICTIONARIES = {
    "blinnphong": """
        {
            "type": "blinnphong",
            "diffuse_reflectance": {"type": "rgb", "value": [0.45, 0.22, 0.15]},
            "specular_reflectance": 0.35,
            "exponent": 50.0,
            "normalized": True,
        }
    """,
    "shenv": """
        {
            "type": "shenv",
            "coefficients": mi.TensorXf(mifit.SHLighting.from_envmap("scenes/relighting/studio.hdr").coefficients),
            "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90),
        }
    """,
    "shdirect": """
        {"type": "shdirect", "model": "shadowed", "samples": 256, "bounce_albedo": 0.4}
    """,
    "pinhole": """
        {
            "type": "pinhole",
            "fx": 1010.0,
            "fy": 1000.0,
            "cx": 340.0,
            "cy": 240.0,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 70], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 680, "height": 480},
        }
    """,
}


def page(name: str, plugin: type) -> str:
    """The text of one page."""
    lines = inspect.cleandoc(plugin.__doc__ or "").splitlines()
    title, body = lines[0], "\n".join(lines[2:]).strip()
    scene = (SCENES / f"{name}.xml").read_text(encoding="utf-8")
    *_, last = re.finditer(rf'^ *<(\w+) type="{name}">.*?</\1>', scene, re.DOTALL | re.MULTILINE)
    element = textwrap.dedent(last[0])
    dictionary = inspect.cleandoc("\n" + DICTIONARIES[name])
    return (
        f"# {title}\n\n{body}\n\n"
        f"## Example\n\n![{title}]({name}.png)\n\n"
        f"The picture's scene is `scenes/plugins/{name}.xml`; `mifit.load_scene` loads it. In it:\n\n"
        f"```xml\n{element}\n```\n\n"
        f"As a dictionary, after `mifit.register_plugins()`:\n\n```python\n{dictionary}\n```\n"
    )


def picture(name: str) -> None:
    """Render the scene of a page to docs/plugins/NAME.png."""
    import mitsuba as mi
    import numpy as np

    from mifit.core.image import write_image

    image = np.array(mi.render(mifit.load_scene(SCENES / f"{name}.xml"), seed=0))
    write_image(PAGES / f"{name}.png", image)


def main() -> None:
    """Write all pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--text-only", action="store_true", help="don't render the pictures")
    text_only = parser.parse_args().text_only
    mifit.set_variant("auto")
    PAGES.mkdir(exist_ok=True)
    for name, plugin in mifit.register_plugins().items():
        (PAGES / f"{name}.md").write_text(page(name, plugin), encoding="utf-8")
        if not text_only:
            picture(name)


if __name__ == "__main__":
    main()
