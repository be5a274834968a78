"""A refined normal map in MikkTSpace tangent space shades the same in Mitsuba's own ``normalmap``."""

import numpy as np

from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.uv import sample_map

LIGHT = normalize(np.array([[0.4, 0.3, -1.0]]))[0]  # where it travels


def test_stock_normalmap_shows_the_refined_normals(variant):
    import mitsuba as mi
    from normal_scene import build

    from mifit.core.mesh import split_at_seams, tangent_space_map
    from mifit.render.gbuffer import SurfaceScene, make_mesh

    scene = build(tilt=0.3)
    model, camera = scene.model, scene.cameras["third"]
    vertices = scene.geometry.vertices[0]
    normals = vertex_normals(vertices, model.faces)
    mesh = split_at_seams(model.faces, model.faces_uv, model.uv)
    tangent = tangent_space_map(scene.normal_map, vertices[mesh.origin], normals[mesh.origin], mesh, model.face_mask)
    # bitmap rows of a texture made from an array run with v, maps have row 0 at v = 1
    texture = mi.load_dict(
        {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(0.5 + 0.5 * tangent[::-1])), "raw": True}
    )
    skin = {"type": "normalmap", "normalmap": texture, "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    shape = make_mesh(vertices[mesh.origin], mesh.faces, mesh.uv, normals[mesh.origin], mi.load_dict(skin))
    rays = {
        "type": "scene",
        "shape": shape,
        "sun": {"type": "directional", "direction": LIGHT.tolist(), "irradiance": 1.0},
    }
    buffer = SurfaceScene(vertices, model.faces).gbuffer(camera)
    hit = buffer.face.ravel() >= 0
    face, weights = buffer.face.ravel()[hit], buffer.weights.reshape(-1, 3)[hit]
    at = interpolate(model.uv, model.faces_uv, face, weights)
    inside = np.all(np.abs(at - 0.5) < 0.42, axis=1)  # texels at the chart's border mix with empty ones
    directions = camera.pixel_rays(camera.pixel_centres()).reshape(-1, 3)[hit]
    ray = mi.RayDifferential3f(
        mi.Point3f(*camera.position.tolist()), mi.Vector3f(np.ascontiguousarray(directions.T.astype(np.float32)))
    )
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(directions))
    radiance = mi.load_dict({"type": "direct"}).sample(mi.load_dict(rays), sampler, ray)[0]
    shown = np.array(radiance)[0]
    wanted = 0.5 / np.pi * np.clip(normalize(sample_map(scene.normal_map, at)) @ -LIGHT, 0, None)
    plain = 0.5 / np.pi * np.clip(normalize(interpolate(normals, model.faces, face, weights)) @ -LIGHT, 0, None)
    error, change = np.abs(shown - wanted)[inside], np.abs(plain - wanted)[inside]
    assert change.mean() > 0.005
    assert error.mean() < 0.05 * change.mean()
