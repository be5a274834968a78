"""Local rendering of a reconstruction: visible surface once, then the shading that the fit used.

Nothing here knows how a surface reflects light: colours come from ``appearance``, which the plugins and the
optimisers share.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.environment import diffuse_light
from mifit.appearance.formation import Appearance, form_image, shade_bent
from mifit.appearance.occlusion import MeshPoints
from mifit.core.camera import Camera
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.sh import basis
from mifit.core.uv import sample_map
from mifit.output.surface import mapped_faces, surface_maps, vertex_materials
from mifit.render.visible import VisibleSurface, occluding_mesh, trace_mesh
from mifit.result import Method, Reconstruction


def visible_surface(result: Reconstruction, camera: Camera, timestep: int, oversampling: int = 2) -> VisibleSurface:
    """Find the front-facing surface under every sample of a camera's pixels.

    Where pixels are no wider than texels the samples of one face in a pixel are one: nothing varies between them.
    """
    model, vertices = result.model, result.geometry.vertices[result.index(timestep)]
    joined = np.ones(len(model.faces), dtype=bool)
    if result.reflectance is not None:
        side = len(result.reflectance.diffuse)
        texels = np.where(mapped_faces(result), _areas(model.uv[model.faces_uv]) * side**2, 0.0)
        joined = texels <= _areas(camera.project(vertices)[model.faces])
    return trace_mesh(vertices, model.faces, camera, oversampling, joined=joined)


def _areas(corners: NDArray) -> NDArray:
    """(F,) twice the areas of triangles (F, 3, 2) in a plane."""
    (ax, ay), (bx, by) = ((corners[:, k] - corners[:, 0]).T for k in (1, 2))
    return np.abs(ax * by - ay * bx)


@dataclass(frozen=True)
class SampledMaterial:
    """Surface properties under every sample of a `VisibleSurface`: what no light changes.

    ``normal`` and ``base`` (N, 3) are unit, world space: the refined ones and the mesh's; ``diffuse`` (N, 3) and
    ``specular`` (N,) are albedo, 0..1.
    """

    normal: NDArray[np.float32]
    base: NDArray[np.float32]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]


def surface_material(result: Reconstruction, surface: VisibleSurface, timestep: int) -> SampledMaterial:
    """Look up maps where there are maps, and vertex albedo that continues them and the mesh's normals elsewhere."""
    model, geometry = result.model, result.geometry
    rotation = geometry.rotation[result.index(timestep)]
    base = _mesh_normals(result, surface, timestep).astype(np.float32)
    normal = base.copy()
    inside = mapped_faces(result)[surface.face]
    diffuse = np.zeros((len(inside), 3), dtype=np.float32)
    specular = np.zeros(len(inside), dtype=np.float32)
    if not inside.all():
        values = interpolate(vertex_materials(result), model.faces, surface.face[~inside], surface.weights[~inside])
        diffuse[~inside], specular[~inside] = values[:, :3], values[:, 3]
    maps = surface_maps(result, timestep)
    uv = interpolate(model.uv, model.faces_uv, surface.face[inside], surface.weights[inside])
    diffuse[inside] = sample_map(maps.diffuse, uv)
    specular[inside] = sample_map(maps.specular, uv)
    normal[inside] = normalize(sample_map(maps.normal, uv)) @ rotation.T
    return SampledMaterial(normal, base, diffuse, specular)


def render_local(
    result: Reconstruction, camera: Camera, timestep: int, method: Method, oversampling: int = 2
) -> NDArray[np.float32]:
    """Render one view by local shading; see `Reconstruction.render`."""
    surface = visible_surface(result, camera, timestep, oversampling)
    return shade_methods(result, surface, timestep, (method,))[method]


def shade_methods(
    result: Reconstruction,
    surface: VisibleSurface,
    timestep: int,
    methods: tuple[Method, ...],
    material: SampledMaterial | None = None,
) -> dict[Method, NDArray[np.float32]]:
    """Images (H, W, 4) of one visible surface by several methods.

    Shadows, where the model has them, are traced at the vertices and interpolated, as in the fit. ``material`` is what
    `surface_material` has found before, for the same face under another light.
    """
    if not len(surface.face):
        return dict.fromkeys(methods, surface.image(np.zeros((0, 3), np.float32)))
    out: dict[Method, NDArray[np.float32]] = {}
    if "pca" in methods:
        out["pca"] = surface.image(_shade_stage_1(result, surface, timestep))
    finer = [m for m in methods if m != "pca"]
    if finer:
        reflectance = result.reflectance
        assert reflectance is not None
        model, vertices = result.model, result.geometry.vertices[result.index(timestep)]
        material = material or surface_material(result, surface, timestep)
        base = material.base
        appearance = Appearance(models.get(reflectance.shading_model), reflectance.illumination, reflectance.lobe)
        points = MeshPoints(surface.points, base, surface.face, surface.weights)
        mesh = occluding_mesh(vertices, model.faces)
        given = base, surface.view, appearance.trace(mesh, points)
        diffuse, specular_light = shade_bent(appearance, *given, material.normal)
        measured = result.environment if appearance.lobe.fresnel is not None else None
        if measured is not None:
            illumination = appearance.illumination
            lamps = replace(illumination, radiance=np.zeros_like(illumination.radiance))
            diffuse = shade_bent(replace(appearance, illumination=lamps), *given, material.normal)[0].copy()
            turn = np.eye(3) if result.environment_rotation is None else result.environment_rotation
            place = mesh.scene, points, material.normal, vertex_materials(result)[:, :3]
            diffuse += diffuse_light(measured, turn, appearance.illumination.lights, *place)
        ambient = np.float32(reflectance.illumination.ambient)
        for method in finer:
            specular = material.specular[:, None] if method == "full" else np.float32(0.0)
            colour = form_image(ambient, material.diffuse, diffuse, specular, specular_light)
            out[method] = surface.image(_with_residual(result, surface, timestep, colour, method))
    return {m: out[m] for m in methods}


def _with_residual(
    result: Reconstruction, surface: VisibleSurface, timestep: int, colour: NDArray, method: Method
) -> NDArray:
    """Colours (N, 3) with what the fitted images of the timestep show beyond the model, which ``full`` alone has."""
    residual = None if result.residual is None else result.residual.at(timestep)
    if residual is None or method != "full":
        return colour
    inside, model = mapped_faces(result)[surface.face, None], result.model
    uv = np.clip(interpolate(model.uv, model.faces_uv, surface.face, surface.weights), 0.0, 1.0)
    return np.where(inside, np.maximum(colour + sample_map(residual, uv), 0), colour)


def _mesh_normals(result: Reconstruction, surface: VisibleSurface, timestep: int) -> NDArray:
    """(N, 3) unit normals of the fitted mesh in world space, interpolated."""
    faces = result.model.faces
    normals = vertex_normals(result.geometry.vertices[result.index(timestep)], faces)
    return normalize(interpolate(normals, faces, surface.face, surface.weights))


def _shade_stage_1(result: Reconstruction, surface: VisibleSurface, timestep: int) -> NDArray:
    """The paper's I_a + I_d (section 4.1) with the fitted model's albedo and normals."""
    geometry = result.geometry
    normal = _mesh_normals(result, surface, timestep)
    albedo = interpolate(geometry.vertex_albedo, result.model.faces, surface.face, surface.weights)
    return geometry.ambient + albedo * (basis(normal, 3) @ geometry.shading)
