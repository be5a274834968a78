from __future__ import annotations

import numpy as np
import pytest

import mifit
from mifit.errors import InputError, VariantError

XML = """<scene version="3.0.0">
  <default name="spp" value="4"/>
  <integrator type="shdirect"/>
  <emitter type="shenv"><string name="coefficients" value="1 1 1"/></emitter>
  <shape type="sphere"><bsdf type="blinnphong"/></shape>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,5" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>
</scene>"""


def test_a_file_is_loaded(variant: str, tmp_path) -> None:
    import mitsuba as mi

    (tmp_path / "scene.xml").write_text(XML)
    scene = mifit.load_scene(tmp_path / "scene.xml", spp=9)
    assert scene.sensors()[0].sampler().sample_count() == 9
    assert np.isfinite(np.array(mi.render(scene))).all()
    assert 1.0 < float(np.array(scene.emitters()[0].radius)[0]) < 5.0


def test_a_dictionary_is_loaded(variant: str) -> None:
    import mitsuba as mi

    same = {"type": "blinnphong", "exponent": 3.0}
    scene = mifit.load_scene(
        {"type": "scene", "a": {"type": "sphere", "b": same}, "b": {"type": "rectangle", "b": same}}
    )
    assert {"a.bsdf.exponent.value", "b.bsdf.exponent.value"} <= set(mi.traverse(scene).keys())  # not merged


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such scene file"),
        ("<scene", r"scene\.xml: "),
        ('<scene version="3.0.0"><bsdf type="nothing"/></scene>', "nothing"),
        ('<bsdf version="3.0.0" type="blinnphong"/>', "expected a scene"),
        (XML.replace("1 1 1", "1 1"), "found 2 numbers, expected three per function"),
        (XML.replace('"shdirect"/>', '"shdirect"><string name="model" value="x"/></integrator>'), "found 'x'"),
    ],
)  # fmt: skip
def test_bad_files_are_named(variant: str, tmp_path, text: str | None, message: str) -> None:
    path = tmp_path / "scene.xml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        mifit.load_scene(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_other_kinds_of_files_are_refused(variant: str, tmp_path) -> None:
    (tmp_path / "scene.json").write_text("{}")
    with pytest.raises(InputError, match=r"found a file of the kind '\.json', expected a scene in XML"):
        mifit.load_scene(tmp_path / "scene.json")


def test_plugins_need_a_variant(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import mitsuba as mi

    monkeypatch.setattr(mi, "variant", lambda: None)
    with pytest.raises(VariantError, match="set_variant"):
        mifit.register_plugins()
