"""Facial pixels of the images, and images as smooth functions of position with exact gradients.

An image's pixel values are taken as the spline's coefficients. The function is then the image blurred by the cubic
B-spline (about 0.58 pixels), twice differentiable everywhere, which Gauss-Newton and finite differences both need.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mifit.capture import Capture
from mifit.core.camera import Camera
from mifit.core.diagnostics import Diagnostic
from mifit.morphable import MorphableModel
from mifit.render.gbuffer import SurfaceScene
from mifit.sampling.visibility import DARKEST, EDGE_PIXELS


@dataclass(frozen=True)
class SmoothImage:
    """An image that can be looked up between pixels.

    Attributes
    ----------
    values : (H, W, C) float32
    valid : (H, W) float32
        1 where the value may be used.
    """

    values: NDArray[np.float32]
    valid: NDArray[np.float32]

    def sample(self, pixels: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Look up values at pixel coordinates.

        Parameters
        ----------
        pixels : (N, 2)
            Centre of the top-left pixel at (0.5, 0.5).

        Returns
        -------
        values : (N, C)
        gradient : (N, C, 2)
            Derivative by the pixel coordinate.
        inside : (N,) bool
            Whether all pixels that the spline touches exist and are valid.
        """
        h, w = self.valid.shape
        dtype = self.values.dtype
        position = np.asarray(pixels, dtype=np.float64) - 0.5
        finite = np.asarray(np.isfinite(position).all(1))
        position = np.clip(np.where(finite[:, None], position, -10.0), -10.0, max(h, w) + 10.0)
        corner = np.floor(position).astype(np.int64)
        f = position - corner
        wx, dx = _bspline(f[:, 0])
        wy, dy = _bspline(f[:, 1])
        column = corner[:, :1] + np.arange(-1, 3)
        row = corner[:, 1:] + np.arange(-1, 3)
        inside = finite & (column[:, 0] >= 0) & (column[:, 3] < w) & (row[:, 0] >= 0) & (row[:, 3] < h)
        flat = np.clip(row, 0, h - 1)[:, :, None] * w + np.clip(column, 0, w - 1)[:, None, :]
        inside &= np.take(self.valid.reshape(-1), flat).reshape(len(flat), -1).min(1) > 0.5 if len(flat) else inside
        patch = np.take(self.values.reshape(h * w, -1), flat.reshape(len(flat), 16), axis=0)  # (N, 16, C)

        def blend(a: NDArray, b: NDArray) -> NDArray:
            weights = (a[:, :, None] * b[:, None, :]).reshape(-1, 1, 16).astype(dtype)
            return (weights @ patch)[:, 0]

        return blend(wy, wx), np.stack([blend(wy, dx), blend(dy, wx)], axis=-1), inside


def _bspline(f: NDArray) -> tuple[NDArray, NDArray]:
    """Weights of the four taps and their derivatives at fractions f (N,) -> (N, 4) each."""
    g = 1.0 - f
    value = np.stack([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], axis=1) / 6.0
    slope = np.stack([-(g**2), 3 * f**2 - 4 * f, -3 * g**2 + 4 * g, f**2], axis=1) / 2.0
    return value, slope


@dataclass(frozen=True)
class PixelView:
    """Facial pixels of one image.

    Attributes
    ----------
    step : int
    camera : Camera
    image : SmoothImage
        Linear colours.
    face : (n,) int, weights : (n, 3)
        Surface point under each pixel.
    """

    step: int
    camera: Camera
    image: SmoothImage
    face: NDArray
    weights: NDArray


def facial_pixels(
    capture: Capture,
    model: MorphableModel,
    cameras: Sequence[str],
    timesteps: Sequence[int],
    world: NDArray,
    count: int,
    seed: int,
) -> tuple[PixelView, ...]:
    """Up to ``count`` facial pixels of every image, chosen evenly at random; images without any are left out.

    Parameters
    ----------
    world : (T, V, 3)
        The surface that is looked at.
    """
    rng, around = np.random.default_rng(seed), np.ones((2 * round(EDGE_PIXELS) + 1,) * 2, np.uint8)
    out = []
    for step, (timestep, vertices) in enumerate(zip(timesteps, world, strict=True)):
        scene = SurfaceScene(vertices, model.faces)
        for name in cameras:
            camera, frame = capture.camera(name), capture.frame(name, timestep)
            buffer = scene.gbuffer(camera)
            on = cv2.erode((buffer.face >= 0).astype(np.uint8), around, borderValue=0)
            usable = (on > 0) & frame.valid & ~frame.clipped & (frame.image.max(axis=2) > DARKEST)
            facial = np.flatnonzero(usable & model.face_mask[np.maximum(buffer.face, 0)])
            if len(facial) > count:
                facial = np.sort(rng.choice(facial, count, replace=False))
            if len(facial):
                face, weights = buffer.face.reshape(-1)[facial], buffer.weights.reshape(-1, 3)[facial]
                image = SmoothImage(np.asarray(frame.image, np.float32), frame.valid.astype(np.float32))
                out.append(PixelView(step, camera, image, face, weights))
    return tuple(out)


def blind_warnings(
    views: Sequence[PixelView], cameras: Sequence[str], timesteps: Sequence[int], unit_mm: float
) -> list[Diagnostic]:
    """What to say of images that show no usable pixel of the face, and of cameras that show none at any timestep.

    ``views`` are of the images that do, among all ``cameras`` and ``timesteps`` that were fitted.
    """
    shown = {(view.camera.name, timesteps[view.step]) for view in views}
    blind = [(name, t) for t in timesteps for name in cameras if (name, t) not in shown]
    unusable = "no pixel of the face can be used (out of view, masked, clipped or black); only landmarks count there"
    found = [
        Diagnostic("no-usable-pixels", f"camera {name}, timestep {t}: {unusable}", camera=name) for name, t in blind
    ]
    return found + [
        Diagnostic(
            "face-unseen",
            f"camera {name} shows the front of the fitted face at no timestep. If its images do show the face: is the "
            f"unit of length right (found one of {unit_mm:g} mm), is the order of the landmarks (left taken for right "
            "turns a head around), are the cameras' poses?",
            camera=name,
        )
        for name in cameras
        if all((name, t) in blind for t in timesteps)
    ]
