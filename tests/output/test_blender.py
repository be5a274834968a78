"""Exports as Blender opens and renders them, beside our own render."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mifit.core.camera import Camera
from mifit.core.image import srgb_to_linear
from mifit.core.sh import latlong_directions
from mifit.core.uv import rasterize_uv
from mifit.output.export import export

SIZE, METRES = 96, 1.2
PROGRAM = """
import json, math, sys
import bpy
path, out, size, distance, angle = sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5])
bpy.ops.wm.read_factory_settings(use_empty=True)
if path.endswith(".glb"):
    bpy.ops.import_scene.gltf(filepath=path)
else:
    bpy.ops.wm.obj_import(filepath=path)
scene, (head,) = bpy.context.scene, [o for o in bpy.context.scene.objects if o.type == "MESH"]
points = [head.matrix_world @ v.co for v in head.data.vertices]
skin = next(m for m in head.data.materials if m.name == "skin")
inputs = next(n for n in skin.node_tree.nodes if n.type == "BSDF_PRINCIPLED").inputs
keys = head.data.shape_keys
print("FOUND", json.dumps({
    "name": head.name,
    "height": max(p.z for p in points) - min(p.z for p in points),
    "shapes": [k.name for k in keys.key_blocks][1:] if keys else [],
    "roughness": inputs["Roughness"].default_value,
    "linked": [n for n in ("Base Color", "Normal", "Specular IOR Level") if inputs[n].is_linked],
}))
scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", 64, "CPU"
scene.render.resolution_x = scene.render.resolution_y = size
scene.render.film_transparent, scene.view_settings.view_transform = True, "Standard"
world = scene.world = bpy.data.worlds.new("sky")
world.use_nodes = True
nodes, links = world.node_tree.nodes, world.node_tree.links
# 0.25 + 0.75 max(up, 0), by the direction of the sky
split, clamp, scale = (nodes.new("ShaderNode" + kind) for kind in ("SeparateXYZ", "Math", "Math"))
clamp.operation, clamp.inputs[1].default_value = "MAXIMUM", 0.0
scale.operation, scale.inputs[1].default_value, scale.inputs[2].default_value = "MULTIPLY_ADD", 0.75, 0.25
place = nodes.new("ShaderNodeTexCoord")
links.new(place.outputs["Generated"], split.inputs[0])
links.new(split.outputs["Z"], clamp.inputs[0])
links.new(clamp.outputs[0], scale.inputs[0])
nodes["Background"].inputs["Color"].default_value = (1, 1, 1, 1)
links.new(scale.outputs[0], nodes["Background"].inputs["Strength"])
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(camera)
scene.camera, camera.location, camera.rotation_euler = camera, (0, -distance, 0), (math.pi / 2, 0, 0)
camera.data.angle = angle
scene.render.filepath, scene.render.image_settings.file_format = out, "PNG"
bpy.ops.render.render(write_still=True)
"""


@pytest.fixture(scope="module")
def head(ball):
    """The ball with smooth maps, as broad as a head, whose pose is none."""
    model, reflectance = ball.model, ball.reflectance
    texels = rasterize_uv(model.uv, model.faces_uv, 64, model.mapped)
    red = 0.3 + 0.3 * np.linspace(0, 1, 64)[None, :, None] * np.ones((64, 64, 1))
    diffuse = np.concatenate([red, 0.35 * np.ones((64, 64, 2))], axis=-1).astype(np.float32)
    diffuse[~texels.mask] = 0
    flat = 0.04 * texels.mask.astype(np.float32)
    lobe = replace(reflectance.lobe, exponent=20.0, fresnel=8.0, normalized=True)
    changed = replace(reflectance, diffuse=diffuse, specular=flat, confidence=flat, lobe=lobe)
    return replace(ball, reflectance=changed, normals=None, mesh=None)


@pytest.mark.slow
@pytest.mark.parametrize(("format", "limit"), [("glb", 6.0), ("obj", 6.0)])
def test_blender_shows_what_we_show(head, variant, tmp_path: Path, format: str, limit: float) -> None:
    if importlib.util.find_spec("bpy") is None:
        pytest.skip("Blender's package bpy is not installed")
    path, picture = tmp_path / f"anna.{format}", tmp_path / "blender.png"
    export(head, format, path, 0, units="m" if format == "obj" else None)
    angle = 2 * np.arctan(0.15 / METRES)
    words = [str(path), str(picture), str(SIZE), str(METRES), str(angle)]
    done = subprocess.run([sys.executable, "-c", PROGRAM, *words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.split("FOUND")[1].splitlines()[0])
    vertices = head.geometry.vertices[0]
    assert found["name"] == "anna"
    assert found["height"] == pytest.approx(np.ptp(vertices[:, 1]) / 100, rel=1e-3)
    assert found["linked"] == ["Base Color", "Normal", "Specular IOR Level"]
    assert found["shapes"] == (["jawOpen"] if format == "glb" else [])
    assert found["roughness"] == pytest.approx(np.sqrt(head.lobe.roughness), abs=1e-3)
    up = latlong_directions(64, 128)[..., 1:2]
    sky = (0.25 + 0.75 * np.maximum(up, 0) * np.ones(3)).astype(np.float32)
    pose = Camera.look_at(np.array([0, 0, 100 * METRES]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    focal = 0.5 * SIZE / np.tan(angle / 2)
    view = replace(
        head.cameras[0], width=SIZE, height=SIZE, fx=focal, fy=focal, cx=SIZE / 2, cy=SIZE / 2,
        world_to_camera=pose.world_to_camera, distortion=(),
    )  # fmt: skip
    ours = head.relight(sky).render(view, 0, integrator="path", samples=256)
    theirs = cv2.cvtColor(cv2.imread(str(picture), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA)
    both = (ours[..., 3] == 1) & (theirs[..., 3] == 255)
    assert both.sum() > 0.9 * (ours[..., 3] == 1).sum() > 1000
    a, b = ours[both][:, :3], srgb_to_linear(theirs[both][:, :3] / 255.0)
    factor = (a * b).sum() / (a * a).sum()  # specular light lies under diffuse light there, and beside it here
    codes = 255 * np.clip(factor * a, 0, 1) ** (1 / 2.2), 255 * np.clip(b, 0, 1) ** (1 / 2.2)
    error = np.sqrt(np.mean((codes[0] - codes[1]) ** 2))
    assert 0.85 < factor < 1.15 and error < limit, (factor, error)
