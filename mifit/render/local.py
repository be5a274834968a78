"""Shading of points held in NumPy arrays, through the functions of ``render.shading``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.sh import order_of
from mifit.errors import InputError
from mifit.render import shading
from mifit.render.arrays import aligned


def shade_points(
    normals: ArrayLike,
    view: ArrayLike,
    diffuse: ArrayLike,
    specular: ArrayLike,
    radiance: ArrayLike,
    ambient: float,
    exponent: float,
    model: str,
    diffuse_transfer: ArrayLike | None = None,
    normalized: bool = True,
    fresnel: float | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Radiance of points under SH lighting, as its diffuse and its specular part.

    Parameters
    ----------
    normals, view : (N, 3)
        Unit normals and unit directions towards the camera, world axes.
    diffuse : (N, 3), specular : (N,)
        Albedos, 0..1.
    radiance : (B*B, 3)
        SH coefficients of the incident radiance (``core.sh``).
    ambient : float
        The paper's I_a; part of the diffuse part.
    exponent : float
        Blinn-Phong exponent, 1 to 10000.
    model : {"paper", "prefiltered", "shadowed"}
        See ``render.shading``.
    diffuse_transfer : (N, B*B), optional
        Traced transfer vectors; ``shadowed`` needs them.
    normalized : bool
        Kind of lobe of the prefiltered models.
    fresnel : float, optional
        Rise of their lobe towards grazing views, see ``render.shading.Lobe``.

    Returns
    -------
    diffuse_part, specular_part : (N, 3) float32
        Their sum is the image.

    Raises
    ------
    InputError
        Arrays of unequal lengths or wrong shapes, or an unknown model.
    """
    import mitsuba as mi

    shading.check_model(model)
    n, v, order = _checked(normals, view, radiance)
    albedo = _expect(diffuse, (len(n), 3), "diffuse")
    gloss = _expect(specular, (len(n),), "specular")
    if not len(n):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    traced = None
    if model == "shadowed":
        if diffuse_transfer is None:
            raise InputError("shading model 'shadowed': found no transfer vectors, expected those of trace_transfer")
        rows = _expect(diffuse_transfer, (len(n), order * order), "diffuse_transfer")
        traced = [mi.Float(aligned(column)) for column in rows.T]
    coefficients = [mi.Color3f(*map(float, row)) for row in np.asarray(radiance, dtype=np.float64)]
    normal, toward = _vector(n), _vector(v)
    d, s = shading.shade(normal, toward, _opaque(coefficients), float(exponent), model, normalized, traced, fresnel)
    return (albedo * _rows(d, len(n)) + np.float32(ambient), gloss[:, None] * _rows(s, len(n)))


def diffuse_matrix(normals: ArrayLike, order: int) -> NDArray[np.float32]:
    """(N, B*B) unshadowed transfer: radiance of a white Lambertian point = matrix @ coefficients."""
    n = _expect(normals, (len(np.asarray(normals)), 3), "normals")
    return _columns(shading.diffuse_transfer(_vector(n), order), len(n))


def specular_matrix(
    normals: ArrayLike,
    view: ArrayLike,
    radiance: ArrayLike,
    exponent: float,
    model: str,
    diffuse_transfer: ArrayLike | None = None,
    normalized: bool = True,
    fresnel: float | None = None,
) -> NDArray[np.float32]:
    """(N, B*B) transfer of a point with unit specular albedo: the specular part = C_s * (matrix @ coefficients).

    For the prefiltered models the matrix doesn't depend on the lighting; for ``paper`` it does, through the dominant
    direction of ``radiance``, which a solver holds fixed while it solves for the coefficients. Parameters as in
    ``shade_points``.
    """
    import mitsuba as mi

    shading.check_model(model)
    n, v, order = _checked(normals, view, radiance)
    normal, toward = _vector(n), _vector(v)
    if model == "paper":
        coefficients = [mi.Color3f(*map(float, row)) for row in np.asarray(radiance, dtype=np.float64)]
        direction = shading.dominant_direction(_opaque(coefficients))
        factor = shading.paper_specular(normal, toward, direction, float(exponent))
        return _columns([factor * t for t in shading.diffuse_transfer(normal, order)], len(n))
    lobe = shading.lobe(float(exponent), order, normalized, fresnel)
    matrix = _columns(shading.specular_transfer(normal, toward, lobe), len(n))
    if model == "prefiltered":
        return matrix
    rows = _expect(diffuse_transfer, (len(n), order * order), "diffuse_transfer")
    axis, _ = shading.lobe_axis(normal, toward, lobe)
    traced = [mi.Float(aligned(column)) for column in rows.T]
    return matrix * _columns([shading.unoccluded(normal, axis, traced, order)], len(n))


def key_columns(
    normals: ArrayLike,
    view: ArrayLike,
    seen: NDArray[np.uint32],
    directions: NDArray,
    exponent: float,
    fresnel: float | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Diffuse and specular radiance (N,) at unit albedo per unit of a compact light's irradiance.

    Parameters
    ----------
    normals, view : (N, 3)
    seen : (N,) uint32
        Which of the directions each point sees, see ``SurfaceScene.open_towards``.
    directions : (D, 3)
        The light's disc, see ``core.keylight``.
    exponent, fresnel
        As in ``shade_points``.
    """
    import mitsuba as mi

    count = len(np.asarray(normals))
    n, v = (_vector(_expect(x, (count, 3), name)) for x, name in ((normals, "normals"), (view, "view")))
    toward = _opaque([mi.Vector3f(*map(float, d)) for d in directions])
    lobe = shading.lobe(float(exponent), 1, fresnel=fresnel)
    both = _columns(list(shading.key_transfer(n, v, lobe, toward, mi.UInt(seen))), count)
    return both[:, 0], both[:, 1]


def _checked(normals: ArrayLike, view: ArrayLike, radiance: ArrayLike) -> tuple[NDArray, NDArray, int]:
    count = len(np.asarray(normals))
    n = _expect(normals, (count, 3), "normals")
    v = _expect(view, (count, 3), "view")
    order = order_of(radiance)
    _expect(radiance, (order * order, 3), "radiance")
    return n, v, order


def _expect(values: Any, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    array = np.asarray(values, dtype=np.float32)
    if array.shape != shape:
        raise InputError(f"{name}: found shape {array.shape}, expected {shape}")
    return array


def _opaque(coefficients: list[Any]) -> list[Any]:
    """Make coefficients inputs of the kernel instead of constants in it, so that it is compiled once."""
    import drjit as dr

    dr.make_opaque(coefficients)
    return coefficients


def _vector(values: NDArray) -> Any:
    import mitsuba as mi

    return mi.Vector3f(*map(aligned, values.T))


def _rows(colour: Any, count: int) -> NDArray[np.float32]:
    """Color3f -> (N, 3)."""
    return _columns([colour.x, colour.y, colour.z], count)


def _columns(values: list[Any], count: int) -> NDArray[np.float32]:
    """B*B Floats, of width N or 1 -> (N, B*B), computed in one kernel."""
    import drjit as dr
    import mitsuba as mi

    if not count:
        return np.zeros((0, len(values)), np.float32)
    floats = [mi.Float(value) for value in values]
    dr.eval(floats)
    return np.stack([np.broadcast_to(np.array(f, dtype=np.float32), (count,)) for f in floats], axis=1)
