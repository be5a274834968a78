"""Shading of a surface whose normals are bent away from the mesh's: for renders and for the solver that bends them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mifit.core.estimate import ReflectanceEstimate
from mifit.errors import InputError
from mifit.render import shading
from mifit.render.arrays import aligned

Shade = Callable[[Any, Any, int], Any]
"""Normals, view directions (Dr.Jit vectors), number of the view -> radiance (Color3f) of the texels."""


@dataclass(frozen=True)
class NormalView:
    """What one image says about N texels.

    Attributes
    ----------
    colour : (N, 3)
        Linear image colour.
    weight : (N,)
        Weight of the squared residual; 0 where the image doesn't measure the texel.
    direction : (N, 3)
        Unit vectors towards the camera.
    normal : (N, 3), tangents : (N, 2, 3)
        Base normals and tangents when the image was taken, world space.
    """

    colour: NDArray
    weight: NDArray
    direction: NDArray
    normal: NDArray
    tangents: NDArray


def material_shade(
    reflectance: ReflectanceEstimate,
    diffuse: NDArray,
    specular: NDArray,
    views: Sequence[NormalView],
    traced: Sequence[NDArray] | None = None,
    lit: Sequence[NDArray] | None = None,
) -> Shade:
    """Shading of texels by the model that stage 2 estimated them with.

    Parameters
    ----------
    reflectance : ReflectanceEstimate
        Lighting, exponent and shading model; its maps aren't used.
    diffuse : (N, 3), specular : (N,)
        Albedos of the texels.
    views : sequence of NormalView
    traced : sequence of (N, B*B), optional
        Per view the shadowed diffuse transfer at the base normal, for the ``shadowed`` model.
    lit : sequence of (N,) uint32, optional
        Per view which directions of the key light each texel sees (``SurfaceScene.open_towards``), where there is one.

    Notes
    -----
    Shadows are traced for the base normal. For a bent one the unshadowed change is added, dimmed by the part of the
    light that reaches the point, and the lobe keeps its dimming.
    """
    import drjit as dr
    import mitsuba as mi

    albedo = vector(mi.Color3f, diffuse)
    gloss = mi.Float(aligned(specular))
    coefficients = [mi.Color3f(*map(float, row)) for row in reflectance.radiance]
    ambient = mi.Float(float(reflectance.ambient))
    dr.make_opaque(coefficients, ambient)
    order = round(len(coefficients) ** 0.5)
    model = reflectance.shading_model
    exponent: Any = float(reflectance.exponent)
    if model != "paper":
        exponent = shading.lobe(exponent, order, fresnel=reflectance.fresnel)
    shadows: list[tuple[Any, Any, Any]] = []
    if model == "shadowed":
        if traced is None:
            raise InputError("shading model 'shadowed': found no transfer vectors, expected those of trace_transfer")
        for view, rows in zip(views, traced, strict=True):
            columns = [mi.Float(aligned(c)) for c in np.asarray(rows).T]
            shadowed = shading.radiance(columns, coefficients)
            n, v = vector(mi.Vector3f, view.normal), vector(mi.Vector3f, view.direction)
            open_sky = shading.radiance(shading.diffuse_transfer(n, order), coefficients)
            open_light = dr.maximum(mi.luminance(open_sky), 1e-6)
            passed = dr.clip(mi.luminance(shadowed) / open_light, 0.0, 1.0)
            axis, _ = shading.lobe_axis(n, v, exponent)
            glint = shading.unoccluded(n, axis, columns, order)
            base = shadowed - passed * open_sky
            dr.eval(base, passed, glint)
            shadows.append((base, passed, glint))

    key = reflectance.key
    if key is not None:
        if lit is None:
            raise InputError("key light: found no visibility, expected that of SurfaceScene.open_towards")
        irradiance = mi.Color3f(*map(float, key.irradiance))
        directions = [mi.Vector3f(*map(float, d)) for d in key.samples()]
        dr.make_opaque(irradiance, directions)
        seen = [mi.UInt(bits) for bits in lit]

    def shade(n: Any, v: Any, view: int) -> Any:
        colour = smooth(n, v, view)
        if key is None:
            return colour
        matt, glossy = shading.key_transfer(n, v, exponent, directions, seen[view])
        return colour + (albedo * matt + gloss * glossy) * irradiance

    def smooth(n: Any, v: Any, view: int) -> Any:
        if model != "shadowed":
            body, glint = shading.shade(n, v, coefficients, exponent, model)
            return ambient + albedo * body + gloss * glint
        base, passed, dimmed = shadows[view]
        body, glint = shading.shade(n, v, coefficients, exponent, "prefiltered")
        return ambient + albedo * (base + passed * body) + gloss * dimmed * glint

    return shade


def shade_bent(
    normals: NDArray,
    base: NDArray,
    view: NDArray,
    diffuse: NDArray,
    specular: NDArray,
    reflectance: ReflectanceEstimate,
    traced: NDArray | None = None,
    lit: NDArray | None = None,
) -> NDArray[np.float32]:
    """Radiance (N, 3) of points, ambient included.

    Parameters
    ----------
    normals, base : (N, 3)
        Refined normals, and the mesh's, for which shadows were traced; unit, world axes.
    view : (N, 3)
        Unit directions towards the camera.
    diffuse : (N, 3), specular : (N,)
        Albedos, 0..1.
    reflectance : ReflectanceEstimate
        Lighting, ambient term, exponent and shading model; its maps aren't used.
    traced : (N, B*B), optional
        Shadowed diffuse transfer at the mesh's normals; ``shadowed`` needs it.
    lit : (N,) uint32, optional
        Which directions of the key light the points see; needed where there is one.
    """
    import drjit as dr
    import mitsuba as mi

    count = len(normals)
    if not count:
        return np.zeros((0, 3), np.float32)
    nothing = np.zeros(count, np.float32)
    points = NormalView(nothing, nothing, view, base, nothing)
    n, v = vector(mi.Vector3f, normals), vector(mi.Vector3f, view)
    shadows = [traced] if traced is not None else None
    shade = material_shade(reflectance, diffuse, specular, [points], shadows, [lit] if lit is not None else None)
    colour = mi.Color3f(shade(n, v, 0))
    dr.eval(colour)
    return np.stack([np.array(c, dtype=np.float32) for c in (colour.x, colour.y, colour.z)], axis=1)


def vector(kind: Any, values: NDArray) -> Any:
    """(N, 3) array -> Dr.Jit vector."""
    return kind(*map(aligned, np.asarray(values).T))
