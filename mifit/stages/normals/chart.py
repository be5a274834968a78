"""Algebra on the two unknowns of a texel: the chart of bent normals, 2 x 2 blocks, conjugate gradients (Dr.Jit)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any


def bent_normal(frame: tuple[Any, Any, Any], a: Any, b: Any) -> Any:
    """The chart of `core.uv.bend`."""
    n, t1, t2 = frame
    p, q = 0.5 * a, 0.5 * b
    square = p * p + q * q
    return (t1 * (2.0 * p) + t2 * (2.0 * q) + n * (1.0 - square)) / (1.0 + square)


def bent_normal_jacobian(frame: tuple[Any, Any, Any], a: Any, b: Any) -> tuple[Any, Any]:
    """Derivatives of `bent_normal` by a and b."""
    n, t1, t2 = frame
    p, q = 0.5 * a, 0.5 * b
    scale = 1.0 / (1.0 + p * p + q * q)
    total = n + bent_normal(frame, a, b)
    return (t1 - total * p) * scale, (t2 - total * q) * scale


def solve_blocks(block: Sequence[Any], ra: Any, rb: Any) -> tuple[Any, Any]:
    """Solve symmetric 2 x 2 systems (aa, ab, bb)."""
    import drjit as dr

    scale = 1.0 / dr.maximum(block[0] * block[2] - block[1] * block[1], 1e-30)
    return (block[2] * ra - block[1] * rb) * scale, (block[0] * rb - block[1] * ra) * scale


def conjugate_gradients(
    apply: Callable[..., tuple[Any, Any]],
    right: tuple[Any, Any],
    precondition: Callable[[tuple[Any, Any]], tuple[Any, Any]],
    tolerance: float = 0.03,
    max_iterations: int = 60,
) -> tuple[Any, Any]:
    """Preconditioned conjugate gradients to a relative residual."""
    import drjit as dr

    def inner(p: tuple[Any, Any], q: tuple[Any, Any]) -> Any:
        return dr.sum(p[0] * q[0] + p[1] * q[1])

    x = (dr.zeros(type(right[0]), len(right[0])), dr.zeros(type(right[0]), len(right[0])))
    r, z = right, precondition(right)
    p, rz = z, inner(right, z)
    dr.eval(p, rz)
    goal = tolerance**2 * float(rz[0])
    for _ in range(max_iterations):
        q = apply(*p)
        alpha = rz / dr.maximum(inner(p, q), 1e-30)
        x = (x[0] + alpha * p[0], x[1] + alpha * p[1])
        r = (r[0] - alpha * q[0], r[1] - alpha * q[1])
        z = precondition(r)
        before, rz = rz, inner(r, z)
        beta = rz / dr.maximum(before, 1e-30)
        p = (z[0] + beta * p[0], z[1] + beta * p[1])
        dr.eval(x, r, p, rz)
        if float(rz[0]) <= goal:
            break
    return x
