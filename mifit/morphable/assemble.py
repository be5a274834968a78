"""From what a file holds to a whole model: whatever is missing is made here.

Landmarks come from registering the built-in head, the face area from the landmarks, texture coordinates from an
unwrapping of the face area, the albedo from the pigment model.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from mifit.core.arrays import content_key
from mifit.core.image import srgb_to_linear
from mifit.core.mesh import edges, vertex_normals
from mifit.errors import InputError
from mifit.morphable.model import VERSION, MorphableModel
from mifit.morphable.pigment import skin_model
from mifit.morphable.topology import adjacency, closed_borders, mirror_map, opening_faces, read_landmark_file

N_ALBEDO = 60
"""Albedo modes of the pigment model where a file has no albedo."""


@dataclass(frozen=True)
class ModelData:
    """What a model's file holds of a `MorphableModel`; what is None is made by `complete`.

    ``albedo`` ((V, 3), (V, 3, Ka)) are mean and modes, linear; ``uv`` ((T, 2), (F, 3)) texture vertices and their
    indices. ``source`` is the model's file: ``<name>.landmarks.json`` beside it (68 vertex indices) takes precedence
    over landmarks found or given.
    """

    name: str
    mean: NDArray
    faces: NDArray
    identity: NDArray
    expression: NDArray
    unit_mm: float
    albedo: tuple[NDArray, NDArray] | None = None
    uv: tuple[NDArray, NDArray] | None = None
    landmarks: NDArray | None = None
    face_mask: NDArray | None = None
    expression_names: tuple[str, ...] = ()
    expression_bounds: NDArray | None = None
    source: Path | None = None

    def complete(self) -> MorphableModel:
        """The model, with what the file lacks; InputError for a mesh that can't be computed with."""
        name, unit_mm, source = self.name, self.unit_mm, self.source
        mean, faces, landmarks = np.asarray(self.mean), np.asarray(self.faces), self.landmarks
        albedo, uv, face_mask = self.albedo, self.uv, self.face_mask
        computed = albedo is None or uv is None or landmarks is None
        given = [np.asarray(array) for pair in (albedo, uv) if pair is not None for array in pair]
        if source is not None:
            beside = source.parent / f"{source.name}.landmarks.json"
            if beside.is_file():
                landmarks = read_landmark_file(beside)
        landmarks = None if landmarks is None else np.asarray(landmarks)
        check_mesh(name, mean, faces, landmarks)
        if landmarks is None:
            landmarks = transfer_landmarks(mean.astype(np.float64) * unit_mm, faces)
            check_mesh(name, mean, faces, landmarks)
        if face_mask is None:
            face_mask = find_face_mask(mean.astype(np.float64), faces, landmarks)
        if not np.any(face_mask):
            raise InputError(f"{name}: no face lies in the face area that the landmarks span; expected a face mesh")
        if albedo is None:
            albedo = skin_model(mean, faces[face_mask], landmarks, unit_mm, N_ALBEDO)
        if uv is None:
            uv = unwrap(mean.astype(np.float64), faces, face_mask)
        read = mean, faces, self.identity, self.expression, landmarks, *given
        return MorphableModel(
            name=name,
            mean=mean,
            faces=faces,
            identity=self.identity,
            expression=self.expression,
            mean_albedo=albedo[0],
            albedo_modes=albedo[1],
            uv=uv[0],
            faces_uv=uv[1],
            landmarks=landmarks.astype(np.int32),
            face_mask=face_mask,
            symmetry=mirror_map(mean, 0.1 / unit_mm),
            unit_mm=unit_mm,
            expression_names=self.expression_names,
            expression_bounds=self.expression_bounds,  # type: ignore[arg-type]
            fingerprint=content_key(VERSION, *read).hex()[:32] if computed else "",  # the rest is computed from it
        )


def check_mesh(name: str, mean: NDArray, faces: NDArray, landmarks: NDArray | None) -> None:
    """Raise InputError for a mesh that can't be computed with; the model checks the rest once it is whole."""
    if mean.ndim != 2 or mean.shape[1] != 3 or not np.isfinite(mean).all():
        raise InputError(f"{name}: mean of shape {mean.shape} must be (vertices, 3) and finite")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.min() < 0 or faces.max() >= len(mean):
        raise InputError(f"{name}: faces of shape {faces.shape} must be (faces, 3) with indices in 0..{len(mean) - 1}")
    if landmarks is not None and (
        landmarks.shape != (68,)
        or landmarks.dtype.kind not in "iu"
        or landmarks.min() < 0
        or landmarks.max() >= len(mean)
    ):
        raise InputError(f"{name}: landmarks of shape {landmarks.shape} must be 68 indices in 0..{len(mean) - 1}")


def transfer_landmarks(vertices: NDArray, faces: NDArray) -> NDArray[np.int64]:
    """Find the 68 points on a head (V, 3) in mm, upright and facing +z, by registering the built-in head to it."""
    from mifit.morphable.builtin import builtin_model
    from mifit.morphable.register import register

    model = builtin_model(coarse=True)
    fit = register(model, vertices, faces)
    normals = vertex_normals(vertices, faces)
    target = fit.vertices[model.landmarks]
    target_normals = vertex_normals(fit.vertices, model.faces)[model.landmarks]
    _, near = cKDTree(vertices).query(target, k=min(12, len(vertices)))
    distance = np.linalg.norm(vertices[near] - target[:, None], axis=2)
    away = 1.0 - (normals[near] * target_normals[:, None]).sum(2)  # not the inside of a lip or lid
    best = (distance + 3.0 * away).argmin(1)
    return near[np.arange(68), best]


def find_face_mask(mean: NDArray, faces: NDArray, landmarks: NDArray) -> NDArray[np.bool_]:
    """(F,) faces of the skin between ears, hairline and throat, of the piece that has the nose, openings left out."""
    p = mean[landmarks]
    height = p[17:27, 1].max() - p[8, 1]
    low, high = p[8, 1] - 0.08 * height, p[17:27, 1].max() + 0.42 * height
    side = p[[0, 16], 2].mean() - 0.05 * height
    inside = (mean[:, 1] > low) & (mean[:, 1] < high) & (mean[:, 2] > side)
    out = inside[faces].all(1) & ~opening_faces(mean, faces, landmarks)
    label = connected_components(adjacency(faces[out], len(mean)), directed=False)[1] if out.any() else None
    return out if label is None else out & (label[faces[:, 0]] == label[landmarks[30]])


def unwrap(mean: NDArray, faces: NDArray, mask: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Texture vertices (T, 2) and indices (F, 3) that lay the masked faces out without overlap.

    A face area that is a disc (holes allowed) becomes one chart: its outer border goes around the unit square and
    every other vertex to the mean of its neighbours (Tutte's embedding, which cannot fold). Anything else is cut
    into charts by xatlas. Faces outside the mask get one spare texture vertex in the corner.
    """
    used = faces[mask]
    uv, corners = _disc(mean, used, closed_borders(used)) or _xatlas(mean, used)
    faces_uv = np.full(faces.shape, len(uv), dtype=np.int32)
    faces_uv[mask] = corners
    return np.vstack([uv, [[0.0, 0.0]]]).astype(np.float32), faces_uv


def _disc(mean: NDArray, faces: NDArray, loops: list[NDArray]) -> tuple[NDArray, NDArray] | None:
    """Tutte's embedding of a disc with holes; None where the faces are no such disc."""
    vertices, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    e, count = edges(local)
    pieces = connected_components(adjacency(local, len(vertices)), directed=False)[0]
    if not loops or count.max() > 2 or pieces != 1 or len(vertices) - len(e) + len(faces) != 2 - len(loops):
        return None
    index = {int(v): k for k, v in enumerate(vertices)}
    order = [np.array([index[int(v)] for v in loop]) for loop in loops]
    p = mean[vertices]
    length = [np.linalg.norm(p[o] - np.roll(p[o], 1, axis=0), axis=1).sum() for o in order]
    outer = order.pop(int(np.argmax(length)))
    n = len(vertices)
    extra = [np.stack([np.full(len(o), n + k), o], axis=1) for k, o in enumerate(order)]  # a hub in each hole
    e = np.concatenate([e, *extra])
    total = n + len(order)
    graph = sp.coo_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), shape=(total, total))
    graph = (graph + graph.T).tocsr()
    laplacian = sp.diags(np.asarray(graph.sum(1)).ravel()) - graph
    corner = np.argmin((p[outer, :2] - p[:, :2].min(0)).sum(1))  # start at the lower left
    outer = np.roll(outer, -corner)
    step = np.linalg.norm(np.roll(p[outer], -1, axis=0) - p[outer], axis=1)
    t = np.concatenate([[0.0], np.cumsum(step)[:-1]]) / step.sum()
    uv = np.zeros((total, 2))
    uv[outer] = _square(t)
    free = np.setdiff1d(np.arange(total), outer)
    system = laplacian.tocsc()[free]
    uv[free] = spsolve(system[:, free].tocsc(), -(system[:, outer] @ uv[outer]))
    return 0.01 + 0.98 * uv[:n], local


def _square(t: NDArray) -> NDArray:
    """Points of the unit square's border at fractions of its length, counter-clockwise from the lower left."""
    return np.stack([np.interp(4.0 * t, range(5), corners) for corners in ([0, 1, 1, 0, 0], [0, 0, 1, 1, 0])], axis=1)


def _xatlas(mean: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    try:
        import xatlas
    except ImportError:
        raise InputError(
            "found a face area that is no disc and has no texture coordinates; give it some, or pip install xatlas"
        ) from None

    _, corners, uv = xatlas.parametrize(np.ascontiguousarray(mean, dtype=np.float32), faces.astype(np.uint32))
    return np.clip(uv, 0.0, 1.0), corners


def srgb_albedo(mean: NDArray, modes: NDArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Linear mean and modes from sRGB-encoded ones in 0..1: modes by the derivative at the mean."""
    m = np.clip(np.asarray(mean, dtype=np.float64), 0.0, 1.0)
    slope = np.where(m <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((m + 0.055) / 1.055) ** 1.4)
    return srgb_to_linear(m).astype(np.float32), (
        slope[..., None].astype(np.float32) * modes.astype(np.float32, copy=False)
    )


def single(values: NDArray) -> NDArray[np.float32]:
    """Contiguous float32 array; what overflows becomes infinite, which the model refuses."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.ascontiguousarray(values, dtype=np.float32)


def interleaved(values: NDArray) -> NDArray[np.float32]:
    """(3V, K) with x, y, z interleaved -> (V, 3, K) in C order."""
    return single(values).reshape(len(values) // 3, 3, -1)
