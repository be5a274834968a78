"""Stage 3: normals per timestep that explain the images better than the mesh's (paper, section 6).

    E(x) = sum_images sum_texels w |I - L(n(x))|^2 + w1 |Laplacian (n(x) - n0)|_1 + w2 |n(x) - n0 - prior|^2

over two tangent-plane offsets x per texel (`core.uv.bend`), reflectance and lighting held. The weight w of a texel in
an image are the pixels that it covers. Gauss-Newton (`optim.minimize`; the paper takes Adam) with the L1 norm's
quadratic majorant at the current point; its equations are solved by conjugate gradients.

Units of the weights. The paper's images and normal maps are 8-bit: a colour of 1 is 255 steps, a unit normal spans
127.5 steps to either side. With linear images 0..1 and unit normals its weights become

    w1 * 127.5 / 255^2 = w1 / 510,    w2 * 127.5^2 / 255^2 = w2 / 4.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as ssl
from numpy.typing import NDArray

from mifit.appearance import models
from mifit.appearance.formation import Appearance, BentImage
from mifit.appearance.occlusion import MeshPoints
from mifit.config import NormalsConfig
from mifit.core.calls import checked
from mifit.core.diagnostics import Diagnostic
from mifit.core.estimate import GeometryEstimate, NormalsEstimate, ReflectanceEstimate, Report
from mifit.core.mesh import dot, interpolate, normalize
from mifit.core.process import one_blas_thread
from mifit.core.uv import TexelMap, bend, bend_jacobian, rasterize_uv, tangent_plane, texel_neighbours
from mifit.errors import InputError
from mifit.optim import Outcome, Solution, minimize
from mifit.progress import Progress, silent
from mifit.sampling.observations import Observations, Surface
from mifit.stages.geometry.rendering import WHITE

if TYPE_CHECKING:
    from mifit.capture import Capture
    from mifit.morphable import MorphableModel

L1_FLOOR = 1e-4
"""Radians below which the L1 norm is rounded off: sqrt(c^2 + floor^2); its reweighting stays finite."""
MOST = 1.0
"""Offset along either tangent at the most: 53 degrees, where a mesh of the face is never off by as much."""
SETTLED, SOLVED = 1e-3, 0.03
"""Part of the energy that the last step may promise, and of the residual that conjugate gradients leave."""
DAMPING = 0.1
"""Of the first step: highlights bend more than a linearisation says. Chosen on gloss, for speed."""

TexelImage = Callable[..., tuple[NDArray, list[NDArray]]]
"""Image colours (N, 3) of texels with normals (N, 3), and their derivatives along changes of the normals."""


@checked
@one_blas_thread()
def refine_normals(
    capture: Capture,
    model: MorphableModel,
    geometry: GeometryEstimate,
    reflectance: ReflectanceEstimate,
    cameras: Sequence[str],
    config: NormalsConfig,
    seed: int = 0,
    progress: Progress = silent,
) -> NormalsEstimate:
    """Refined normals of every timestep of a fit, with reflectance and lighting held.

    Parameters
    ----------
    capture, model, geometry, reflectance
        The inputs and results of stages 1 and 2. Shading is the model that stage 2 used.
    cameras : sequence of str
        Cameras to read; no other camera of the capture is touched.
    config : NormalsConfig
    seed : int
        Seed of the tracing of shadows, which only the ``shadowed`` shading model needs.
    progress : Progress

    Returns
    -------
    NormalsEstimate
        Unit normals in object space. Texels without a measurement keep the mesh's normal.

    Raises
    ------
    InputError
        No camera or timestep, or maps that aren't square and of one size.
    """
    began = time.perf_counter()
    texels = rasterize_uv(model.uv, model.faces_uv, check_maps(reflectance), model.face_mask)
    frames, warnings = [], []
    for i, timestep in enumerate(geometry.timesteps):
        progress("refine normals", i, len(geometry.timesteps))
        surface = Surface(capture, model, geometry.at((timestep,)), cameras, texels.size, texels=texels)
        frames.append(refine_frame(surface, reflectance, config, seed=seed))
        if frames[-1].measured == 0.0:
            text = f"timestep {timestep}: no camera measures the face; normals are the model's"
            warnings.append(Diagnostic("face-unseen", text))
    progress("refine normals", len(geometry.timesteps), len(geometry.timesteps))
    solutions = [frame.solution for frame in frames]
    energies = {
        f"{name} {timestep}": values
        for timestep, solution in zip(geometry.timesteps, solutions, strict=True)
        for name, values in (solution.energies if solution else {}).items()
    }
    longest = max((len(values) for values in energies.values()), default=0)
    report = Report(
        Outcome.worst(solution.outcome for solution in solutions if solution).value,
        {name: values + values[-1:] * (longest - len(values)) for name, values in energies.items()},
        time.perf_counter() - began,
        tuple(warnings),
        {"seconds_per_timestep": [solution.seconds if solution else 0.0 for solution in solutions]},
    )
    normals = [texels.to_map(frame.normal_object) for frame in frames]
    return NormalsEstimate(geometry.timesteps, np.stack(normals), report)


@dataclass(frozen=True)
class FrameNormals:
    """Refined normals of one timestep.

    Attributes
    ----------
    normal_object : (N, 3) float32
        Unit normals per covered texel, object space.
    measured : float
        Part of the texels that some camera measures.
    solution : Solution or None
        None where no texel is measured.
    """

    normal_object: NDArray[np.float32]
    measured: float
    solution: Solution | None


@one_blas_thread()
def refine_frame(
    surface: Surface,
    reflectance: ReflectanceEstimate,
    config: NormalsConfig,
    prior: NDArray | None = None,
    seed: int = 0,
) -> FrameNormals:
    """Refine the normals of a surface of one timestep.

    ``prior`` (N, 2) are offsets in the base normal's tangent plane (`core.uv`) that the correction is drawn
    to instead of to zero, and from which it starts.
    """
    problem, rows, base = frame_problem(surface, reflectance, config, prior, seed)
    offsets = np.zeros((len(base), 2)) if prior is None else prior.copy()
    solution = None
    if problem is not None:
        solution = solve_normals(problem, config.max_iterations, offsets[rows])
        offsets[rows] = solution.value.reshape(-1, 2)
    found = normalize(bend(base, tangent_plane(base), offsets))
    return FrameNormals(found.astype(np.float32), len(rows) / max(len(base), 1), solution)


def solve_normals(problem: NormalProblem, max_iterations: int, start: NDArray, tolerance: float = SETTLED) -> Solution:
    """Minimise from offsets (N, 2)."""
    flat = np.clip(start, -MOST, MOST).ravel()
    most = np.full(len(flat), MOST)
    return minimize(
        problem,
        flat,
        lower=-most,
        upper=most,
        max_iterations=max_iterations,
        damping=DAMPING,
        energy_tolerance=tolerance,
    )


def texel_images(
    surface: Surface, reflectance: ReflectanceEstimate, seed: int = 0
) -> tuple[NDArray[np.intp], Observations, list[tuple[NDArray[np.intp], TexelImage]]]:
    """Texels (n,) that images of a surface's one timestep measure, what these show, and the model's image for each.

    An image is that of the texels that it measures, places in n, by their normals in object space. What stage 2 found
    in front of the face is left out.
    """
    surface, texels = surface.without_hidden(reflectance), surface.texels
    every = surface.observe(np.arange(len(texels.index)))
    rows = np.flatnonzero((every.measured > 0).any(1))
    seen = every.take(rows)
    albedos = [texels.from_map(each)[rows] for each in (reflectance.lit_diffuse, reflectance.specular)]
    appearance = Appearance(models.get(reflectance.shading_model), reflectance.illumination, reflectance.lobe)
    base = seen.normal[:, 0]
    points = MeshPoints(seen.point[:, 0], base, seen.face, seen.barycentric)
    occlusion = appearance.trace(surface.meshes[0], points, seed)
    images: list[tuple[NDArray[np.intp], TexelImage]] = []
    for j in range(len(seen.step)):
        at = np.flatnonzero(seen.measured[:, j] > 0)
        fixed = seen.view[at, j], occlusion.take(at), (albedos[0][at], albedos[1][at]), surface.geometry.rotation[0]
        images.append((at, BentImage(appearance, base[at], *fixed)))
    return rows, seen, images


def frame_problem(
    surface: Surface,
    reflectance: ReflectanceEstimate,
    config: NormalsConfig,
    prior: NDArray | None = None,
    seed: int = 0,
) -> tuple[NormalProblem | None, NDArray, NDArray]:
    """The optimisation of one timestep, the texels of the surface that it solves for, and all base normals.

    Normals are those of object space. Without a measured texel there is no optimisation: None.
    """
    rotation, texels = surface.geometry.rotation[0], surface.texels
    rows, seen, images = texel_images(surface, reflectance, seed)
    corners = surface.faces, texels.face, texels.weights
    base = normalize(interpolate(surface.normals[0], *corners)).astype(np.float64) @ rotation
    if not len(rows):
        return None, rows, base

    views = [NormalView(at, seen.colour[at, j], seen.measured[at, j], image) for j, (at, image) in enumerate(images)]
    patch = TexelMap(texels.size, texels.index[rows], texels.face[rows], texels.weights[rows])
    # Single precision: it is that of the images.
    problem = NormalProblem(
        base[rows].astype(np.float32),
        tangent_plane(base[rows]).astype(np.float32),
        texel_neighbours(patch),
        views,
        0.5 * config.laplacian_weight / WHITE,
        0.25 * config.magnitude_weight,
        None if prior is None else prior[rows],
    )
    return problem, rows, base


@dataclass(frozen=True)
class NormalView:
    """One image of n of the texels.

    Attributes
    ----------
    texel : (n,) int
        Which they are.
    colour : (n, 3), weight : (n,)
        Linear image colour, and weight of its squared residual.
    shade : TexelImage
    """

    texel: NDArray[np.intp]
    colour: NDArray
    weight: NDArray
    shade: TexelImage

    def rows(self, values: NDArray) -> NDArray:
        """Those of the texels of values (N, 3), column by column."""
        return values.T[:, self.texel].T


class NormalProblem:
    """Normals of N texels, a `mifit.optim.minimize.Problem` over their offsets (2 N,).

    Parameters
    ----------
    normals : (N, 3), tangents : (N, 2, 3)
        Base normals and tangents in which corrections are smoothed and measured.
    neighbours : (N, 4)
        `core.uv.texel_neighbours`.
    views : sequence of NormalView
    laplacian_weight, magnitude_weight : float
        w1, w2, for images in linear 0..1 and unit normals.
    prior : (N, 2), optional
        Offsets of the correction that the magnitude term pulls to; zero by default.
    """

    def __init__(
        self,
        normals: NDArray,
        tangents: NDArray,
        neighbours: NDArray,
        views: Sequence[NormalView],
        laplacian_weight: float,
        magnitude_weight: float,
        prior: NDArray | None = None,
    ) -> None:
        # Columns are contiguous: all that follows goes through them one by one.
        self.normals, self.tangents = np.asfortranarray(normals), np.asfortranarray(tangents)
        self.views = [replace(view, colour=np.asfortranarray(view.colour)) for view in views]
        self.laplacian = graph_laplacian(neighbours).astype(self.normals.dtype)
        self.w1, self.w2 = laplacian_weight, magnitude_weight
        self.prior = 0.0 if prior is None else bend(self.normals, self.tangents, prior) - self.normals

    def _offsets(self, x: NDArray) -> NDArray:
        return x.reshape(-1, 2).astype(self.normals.dtype, "F")

    def energies(self, x: NDArray) -> dict[str, float]:
        """Energy per term."""
        n = bend(self.normals, self.tangents, self._offsets(x))
        data = 0.0
        for view in self.views:
            residual = view.colour - view.shade(view.rows(n))[0]
            data += float(np.sum(view.weight * dot(residual, residual), dtype=np.float64))
        delta = n - self.normals
        rough = magnitude = 0.0
        if self.w1:
            rough = float(np.sqrt((self.laplacian @ delta) ** 2 + L1_FLOOR**2).sum(dtype=np.float64))
        if self.w2:
            magnitude = float(((delta - self.prior) ** 2).sum(dtype=np.float64))
        return {"data": data, "laplacian": self.w1 * rough, "magnitude": self.w2 * magnitude}

    def linearize(self, x: NDArray) -> NormalSystem:
        """Gradient and blocks at x."""
        offsets = self._offsets(x)
        n = bend(self.normals, self.tangents, offsets)
        turns = bend_jacobian(self.normals, self.tangents, offsets)
        first, second = turns[:, 0], turns[:, 1]
        delta = n - self.normals
        pull, stiffness = self.w2 * (delta - self.prior), np.zeros_like(delta)
        if self.w1:
            # w |c| <= w / 2 (c^2 / |c0| + |c0|): the majorant's Hessian is w / |c0|.
            curvature = self.laplacian @ delta
            stiffness = 0.5 * self.w1 / np.sqrt(curvature**2 + L1_FLOOR**2)
            pull = pull + self.laplacian @ (stiffness * curvature)
        gradient = [dot(first, pull), dot(second, pull)]
        blocks = [self.w2 * dot(first, first), self.w2 * dot(first, second), self.w2 * dot(second, second)]
        for view in self.views:
            image, (along, across) = view.shade(view.rows(n), [view.rows(first), view.rows(second)])
            residual = view.colour - image
            for i, slope in enumerate((along, across)):
                gradient[i][view.texel] -= view.weight * dot(slope, residual)
            for i, product in enumerate((dot(along, along), dot(along, across), dot(across, across))):
                blocks[i][view.texel] += view.weight * product
        flat = np.stack(gradient, axis=1, dtype=np.float64).ravel()
        return NormalSystem(flat, np.stack(blocks), turns, stiffness, self.laplacian)


@dataclass
class NormalSystem:
    """Normal equations: a symmetric 2 x 2 block per texel, and the Laplacian that ties neighbours.

    Attributes
    ----------
    gradient : (2 N,)
    blocks : (3, N)
        First, mixed and second entry of each block.
    turns : (N, 2, 3)
        Derivatives of the normals by the offsets.
    stiffness : (N, 3)
        Weight of each component of the Laplacian.
    laplacian : (N, N) sparse
        `graph_laplacian`.
    """

    gradient: NDArray[np.float64]
    blocks: NDArray
    turns: NDArray
    stiffness: NDArray
    laplacian: sp.csr_matrix

    def product(self, step: NDArray) -> NDArray:
        """H times a vector (2 N,)."""
        p, q = step.astype(self.turns.dtype).reshape(-1, 2).T
        (a, b, c), first, second = self.blocks, self.turns[:, 0], self.turns[:, 1]
        along, across = a * p + b * q, b * p + c * q
        if self.stiffness.any():
            bent = self.laplacian @ (first * p[:, None] + second * q[:, None])
            pull = self.laplacian @ (self.stiffness * bent)
            along, across = along + dot(first, pull), across + dot(second, pull)
        return np.stack([along, across], axis=1).ravel()

    def solve(self, damping: float, frozen: NDArray[np.bool_], gradient: NDArray | None = None) -> NDArray[np.float64]:
        """Damped step by conjugate gradients, preconditioned by the diagonal blocks of the whole matrix."""
        around = self.laplacian.power(2) @ self.stiffness  # the diagonal of L S L
        first, second = self.turns[:, 0], self.turns[:, 1]
        lift = damping * self.blocks[[0, 2]] + 1e-12
        a = self.blocks[0] + lift[0] + dot(around * first, first)
        b = self.blocks[1] + dot(around * first, second)
        c = self.blocks[2] + lift[1] + dot(around * second, second)
        determinant = a * c - b * b
        lifts, free, size = lift.T.ravel(), ~frozen, len(frozen)

        def apply(step: NDArray) -> NDArray:
            moved = np.where(free, step, 0.0)
            return np.where(free, self.product(moved) + lifts * moved, step)

        def precondition(right: NDArray) -> NDArray:
            p, q = right.reshape(-1, 2).T
            solved = np.stack([c * p - b * q, a * q - b * p], axis=1) / determinant[:, None]
            return np.where(free, solved.ravel(), right)

        right = np.where(free, -(self.gradient if gradient is None else gradient), 0.0).astype(self.turns.dtype)
        matrix, near = (ssl.LinearOperator((size, size), each, dtype=right.dtype) for each in (apply, precondition))
        return np.asarray(ssl.cg(matrix, right, rtol=SOLVED, maxiter=60, M=near)[0], np.float64)


def graph_laplacian(neighbours: NDArray) -> sp.csr_matrix:
    """(N, N) four times each value less the neighbours' (N, 4): symmetric."""
    count = len(neighbours)
    around = sp.csr_matrix((np.ones(4 * count), neighbours.ravel(), np.arange(0, 4 * count + 1, 4)), (count, count))
    return (4.0 * sp.identity(count, format="csr") - around).tocsr()


def check_maps(reflectance: ReflectanceEstimate) -> int:
    """Side of the maps; raises InputError when they don't belong together."""
    size = reflectance.diffuse.shape[0]
    if reflectance.diffuse.shape != (size, size, 3) or reflectance.specular.shape != (size, size):
        raise InputError(
            f"reflectance maps: found shapes {reflectance.diffuse.shape} and {reflectance.specular.shape}, expected "
            "(S, S, 3) and (S, S)"
        )
    return size
