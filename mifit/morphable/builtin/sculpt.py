"""The sculpted surface of the built-in head: a loft of horizontal slices plus facial features.

Millimetres; y = 0 is the pupils' height, z = 0 the plane of the ear canals, y up, nose along +z. The numbers are
anthropometric averages of adults (head length 195, breadth 149, bizygomatic breadth 138, sellion to menton 112,
nose 35 wide and 20 deep, pupils 63 apart, mouth 51 wide ...), the curves between them are drawn by hand.
Everything is a function of |x|, so the head is its own mirror image.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

# Slices from crown to neck: front point (y, z), side point (x, y, z), back point (y, z), roundness of the front
# (2 is an ellipse, more is boxier, less more pointed), and grid lines down to the next slice.
_SLICES = np.array(
    [
        # front          side                 back            round  lines
        [111, 2, 7, 111.3, -8, 111, -18, 2.0, 6],  # crown
        [106, 32, 37, 105, -8, 103, -52, 2.0, 6],
        [90, 61, 58, 87, -8, 82, -82, 2.1, 7],
        [69, 81, 69, 65, -7, 56, -94, 2.25, 7],  # hairline
        [44, 93, 72.5, 42, -5, 34, -98, 2.4, 12],
        [19, 97, 71.5, 19, -1, 16, -97, 2.45, 20],  # brow
        [-1, 95, 70, 0, 2, -3, -92, 2.4, 20],  # eye
        [-24, 96, 69.5, -17, 4, -22, -85, 2.3, 22],  # cheek
        [-46, 99, 67.5, -32, 3, -40, -77, 2.15, 18],  # under the nose
        [-67, 98.5, 64.5, -45, 0, -56, -70, 2.05, 16],  # mouth
        [-85, 95, 61, -55, -3, -68, -65, 2.0, 10],
        [-99, 92, 58, -62.5, -6, -80, -62, 2.05, 8],  # chin
        [-108, 85, 53.5, -70, -9, -90, -60, 2.1, 6],
        [-112.5, 70, 49.5, -79, -12, -100, -59, 1.8, 5],
        [-117.5, 49, 48.5, -92, -13, -112, -58, 1.7, 4],  # throat
        [-138, 42, 50, -126, -11, -138, -60, 1.8, 3],
        [-172, 43, 55, -168, -8, -170, -64, 2.0, 0],  # neck
    ]
)

# Columns: angle about the vertical axis in degrees, and grid lines to the next one.
_COLUMNS = np.array([[0, 15], [13, 11], [22, 20], [42, 9], [60, 8], [82, 19], [112, 6], [180, 0]])

EYE = np.array([31.5, 0.0, 71.8])
LID_RADIUS = 12.2 + 1.9  # of the eyeball, and the thickness of a lid
CANTHI = (15.6, 46.4)
MOUTH_HALF = 25.5


def _knots() -> NDArray:
    """Positions of the slices along the loft."""
    step = np.linalg.norm(np.diff(_SLICES[:, :2], axis=0), axis=1)
    step = 0.6 * step + 0.4 * np.linalg.norm(np.diff(_SLICES[:, 2:5], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(step)])


_KNOTS = _knots()
_SPLINE = CubicSpline(_KNOTS, _SLICES[:, :8])


def _spread(positions: NDArray, lines: NDArray) -> NDArray:
    """Positions of grid lines with smoothly varying spacing, given how many lie between knots."""
    count = np.concatenate([[0], np.cumsum(lines[:-1])])
    return PchipInterpolator(count, positions)(np.arange(int(count[-1]) + 1))


def grid_lines(density: float) -> tuple[NDArray, NDArray, int, int]:
    """Loft positions of the rows, column angles in radians (0 .. pi), and the rows of the eye and mouth slits.

    ``density`` is the part of the lines that are drawn.
    """
    across, around = (np.round(density * lines).astype(int) for lines in (_SLICES[:, 8], _COLUMNS[:, 1]))
    rows, columns = _spread(_KNOTS, across), np.radians(_spread(_COLUMNS[:, 0], around))
    count = np.concatenate([[0], np.cumsum(across)])
    return rows, columns, int(count[6]), int(count[9])  # the slices of eye and mouth


def loft(angle: NDArray, position: NDArray) -> NDArray:
    """Points (..., 3) of the smooth head without features."""
    fy, fz, sx, sy, sz, by, bz, power = np.moveaxis(_SPLINE(position), -1, 0)
    s, c = np.abs(np.sin(angle)), np.cos(angle)
    power = np.where(c > 0, power, 2.2)
    radius = (s**power + np.abs(c) ** power) ** (-1.0 / power)
    front = c > 0
    y = sy + np.where(front, fy - sy, by - sy) * c**2
    z = sz + np.where(front, fz - sz, sz - bz) * radius * c
    return np.stack([sx * radius * s, y, z], axis=-1)


# -- curves of the openings -------------------------------------------------------------------------------------


def lid_curves(x: NDArray) -> tuple[NDArray, NDArray]:
    """Heights of the open upper and lower lid margins at |x|."""
    low, high = CANTHI
    q = np.clip((x - low) / (high - low), 0.0, 1.0)
    line = -1.2 + 2.4 * q  # the outer corner is higher
    upper = line + 5.3 * (4 * q * (1 - q)) ** 0.75 * (1.10 - 0.25 * q)
    lower = line - 3.9 * (4 * q * (1 - q)) ** 0.85 * (0.85 + 0.3 * q)
    return upper, lower


def mouth_line(x: NDArray) -> NDArray:
    """Height of the closed mouth at |x|: a shallow bow with lowered corners."""
    q = np.clip(x / MOUTH_HALF, 0, 1.4)
    return -68.0 - 0.7 * np.exp(-((x / 5.0) ** 2)) + 0.9 * np.exp(-(((x - 11) / 6.0) ** 2)) - 1.2 * q**3


def lip_borders(x: NDArray) -> tuple[NDArray, NDArray]:
    """Heights of the upper and lower vermilion borders at |x|."""
    q = np.clip(x / MOUTH_HALF, 0, 1)
    upper = 8.4 * (1 - q**2) ** 0.8 * (1 - 0.12 * q) + 0.9 * np.exp(-(((x - 5.2) / 3.2) ** 2))
    upper -= 1.0 * np.exp(-((x / 2.6) ** 2))
    lower = 9.6 * (1 - q**2.2) ** 0.85
    return mouth_line(x) + upper, mouth_line(x) - lower


def opening_columns(angle: NDArray, rows: NDArray, eye_row: int, mouth_row: int) -> tuple[int, int, int]:
    """Even columns of inner and outer eye corners and of the mouth's corner."""
    even = np.arange(0, len(angle), 2)
    x_eye, x_mouth = (loft(angle[even], np.full(len(even), rows[r]))[:, 0] for r in (eye_row, mouth_row))
    return (
        int(even[np.abs(x_eye - CANTHI[0]).argmin()]),
        int(even[np.abs(x_eye - CANTHI[1]).argmin()]),
        int(even[np.abs(x_mouth - MOUTH_HALF).argmin()]),
    )


# -- features -----------------------------------------------------------------------------------------------------


def _g(x: NDArray, y: NDArray, cx: float, cy: float, sx: float, sy: float, power: float = 2.0) -> NDArray:
    """Bump of unit height at (cx, cy) and, so that the midline stays smooth, at (-cx, cy)."""
    v = ((y - cy) / sy) ** 2
    bump = np.exp(-0.5 * (((x - cx) / sx) ** 2 + v) ** (power / 2))
    return bump if cx == 0 else bump + np.exp(-0.5 * (((x + cx) / sx) ** 2 + v) ** (power / 2))


def smooth_step(x: NDArray, low: float, high: float) -> NDArray:
    """Smooth step with two continuous derivatives from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * t * (t * (6 * t - 15) + 10)


def _along(x: NDArray, y: NDArray, line: list[tuple[float, float]], width: float) -> NDArray:
    """Gaussian ridge of unit height along a polyline."""
    best = np.full(np.shape(x), np.inf)
    for (ax, ay), (bx, by) in itertools.pairwise(line):
        dx, dy = bx - ax, by - ay
        t = np.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0, 1)
        best = np.minimum(best, (x - ax - t * dx) ** 2 + (y - ay - t * dy) ** 2)
    return np.exp(-0.5 * best / width**2)


# The nose from the chin upwards: y, how far it stands out, and half its width.
_NOSE = np.array(
    [
        [-50, -47.5, -45, -42.5, -39.5, -36, -31, -24, -16, -8, 0, 6, 14],
        [0, 4.2, 10.4, 15.6, 18.0, 18.2, 16.8, 13.6, 9.6, 5.6, 2.0, 0.5, 0],
        [9, 11, 13, 15, 16.5, 17, 17, 16, 14, 12.5, 11, 10, 9],
    ]
)
_nose_z, _nose_w = (PchipInterpolator(_NOSE[0], row) for row in _NOSE[1:])


def features(p: NDArray) -> NDArray:
    """Displace points (..., 3) of the smooth head's front by everything but lids and lips."""
    x, y, z = np.abs(p[..., 0]), p[..., 1], p[..., 2]
    front = smooth_step(z, 5.0, 45.0)
    dz = np.zeros_like(z)
    dx = np.zeros_like(z)
    # forehead, brows, temples, sockets
    dz += 1.6 * _g(x, y, 22, 44, 16, 14)
    dz += 3.0 * _along(x, y, [(0, 15.5), (9, 16), (20, 20), (34, 21.5), (47, 15)], 6.0)
    dz += 1.8 * _g(x, y, 0, 17, 9, 7)
    dx -= 3.0 * _g(z, y, 48, 22, 16, 18) * front
    socket = 8.8 * _g(x, y, 29, 1.5, 15.5, 11.0, 2.4) + 5.0 * _g(x, y, 15.5, 1, 4.5, 7)
    dz -= socket
    # cheekbones, cheeks, jaw
    cheek = 4.2 * _g(x, y, 49, -22, 14, 10)
    dz += 0.8 * cheek + 2.4 * _g(x, y, 33, -38, 14, 13)
    dx += 0.7 * cheek
    dz -= 2.6 * _g(x, y, 46, -56, 12, 13)
    # nose: bridge, wings with their crease, septum, nostrils
    bounded = np.clip(y, _NOSE[0, 0], _NOSE[0, -1])
    height, width = _nose_z(bounded), _nose_w(bounded)
    q = x / width
    bell = np.where(q < 1, (1 - np.minimum(q, 1) ** 2.2) ** 2.0, 0.0)
    ridge = np.exp(-((x / (5.0 + 0.10 * np.clip(-y, 0, 40))) ** 2))
    tip = _g(x, y, 0, -37.0, 9.0, 6.0)
    dz += height * (0.74 * bell + 0.26 * ridge) + 2.2 * tip
    wing = _g(x, y, 13.2, -40.2, 4.6, 5.6, 3.2)
    dz += 7.6 * wing
    dz -= 2.0 * _along(x, y, [(11, -30), (17, -34), (19.5, -40), (18, -46)], 2.0)
    nostril = _g(x, y, 7.2, -44.4, 3.8, 2.5, 2.6)
    dz -= 5.0 * nostril
    # around the mouth
    dz += 2.2 * _g(x, y, 0, -60, 20, 12)
    dz -= 1.5 * _g(x, y, 0, -54, 2.6, 5.5) - 0.8 * _g(x, y, 5.5, -54.5, 2.2, 5.5)
    dz -= 1.0 * _along(x, y, [(20, -40), (26, -52), (31.5, -65)], 4.0)
    dz -= 2.2 * _g(x, y, 27.5, -69, 3.5, 4)
    dz -= 3.0 * _g(x, y, 0, -83.5, 17, 4.5)
    dz += 5.2 * _g(x, y, 0, -98, 15, 9.5) + 1.0 * _g(x, y, 9, -99, 6, 6)
    return p + np.stack([np.where(p[..., 0] < 0, -dx, dx) * front, np.zeros_like(dz), front * dz], axis=-1)


def lids(p: NDArray, upper: NDArray) -> NDArray:
    """Drape points near the eyes over the eyeballs, with a crease above the upper lid."""
    x, y, z = np.abs(p[..., 0]), p[..., 1], p[..., 2]
    r2 = (x - EYE[0]) ** 2 + (y - EYE[1]) ** 2
    ball = EYE[2] + np.sqrt(np.maximum(LID_RADIUS**2 - r2, 1e-3))
    near = 1.0 - smooth_step(np.sqrt(r2), 11.5, 15.5)
    ball = np.where(r2 < LID_RADIUS**2, ball, -1e3)
    draped = 0.5 * (z + ball + np.sqrt((z - ball) ** 2 + 1.5 * 1.5))  # a smooth maximum
    z = np.where(z > 20, z + near * (draped - z), z)
    top = lid_curves(x)[0]
    q = np.clip((x - CANTHI[0]) / (CANTHI[1] - CANTHI[0]), 0, 1)
    crease = np.exp(-0.5 * ((y - top - 3.6 - 1.2 * np.sin(np.pi * q)) / 0.9) ** 2) * _g(x, 0 * x, 31, 0, 12, 1, 4)
    z = z - np.where(upper & (z > 60), 1.3 * crease, 0.0)
    return np.stack([p[..., 0], y, z], axis=-1)


def lips(p: NDArray, upper: NDArray) -> NDArray:
    """Raise the vermilion of both lips."""
    x, y, z = np.abs(p[..., 0]), p[..., 1], p[..., 2]
    line = mouth_line(x)
    top, bottom = lip_borders(x)
    span = np.maximum(np.where(upper, top - line, line - bottom), 0.3)
    h = np.clip(np.where(upper, y - line, line - y) / span, 0.0, 2.0)
    taper = np.clip(1 - (x / (MOUTH_HALF + 1.0)) ** 2, 0, 1) ** 0.7
    body = np.sqrt(np.clip(1 - (h - 0.42) ** 2 / 0.42**2 * np.where(h < 0.42, 0.8, 0.52), 0, 1))
    ridge = 0.35 * np.exp(-0.5 * ((h - 1.05) / 0.17) ** 2)
    height = np.where(upper, 4.4, 5.0)
    fade = 1 - smooth_step(h, 0.65, 1.35)
    dz = taper * (height * body * fade + ridge) * (z > 40)
    tubercle = np.where(upper, 0.8 * np.exp(-((x / 4.0) ** 2)) * np.exp(-0.5 * ((h - 0.3) / 0.25) ** 2), 0.0)
    return np.stack([p[..., 0], y, z + dz + tubercle], axis=-1)


def ears(p: NDArray) -> NDArray:
    """Raise auricles at the sides: a flap that leans back, with helix, antihelix, concha, tragus and lobe."""
    side = np.sign(p[..., 0])
    y, z = p[..., 1], p[..., 2]
    tilt = np.radians(12.0)
    v = (y + 16.0) * np.cos(tilt) + (z + 13.0) * np.sin(tilt)
    u = (y + 16.0) * np.sin(tilt) - (z + 13.0) * np.cos(tilt)  # towards the back
    half_width = 15.5 + 3.0 * np.clip(v / 31.0, -1, 1)
    radius = np.sqrt((u / half_width) ** 2 + (v / 31.0) ** 2)
    back = smooth_step(u / half_width, -0.9, 0.5)
    flap = (1 - smooth_step(radius, 0.82, 1.6)) * (np.abs(p[..., 0]) > 40)
    height = (1.5 + 8.5 * back) * np.sqrt(np.clip(1.0 - (v / 36.0) ** 2, 0.0, 1.0))
    helix = 2.2 * np.exp(-0.5 * ((radius - 0.86) / 0.12) ** 2) * smooth_step(v, -24, -8)
    scapha = -2.2 * np.exp(-0.5 * ((radius - 0.68) / 0.10) ** 2) * smooth_step(v, -18, -2) * back
    concha = -8.0 * np.exp(-0.5 * (((u + 1.0) / 6.5) ** 2 + ((v + 3.0) / 8.5) ** 2) ** 1.3)
    tragus = 3.0 * np.exp(-0.5 * (((u + 9.0) / 2.6) ** 2 + ((v + 4.0) / 3.8) ** 2))
    out = flap * np.maximum(height + helix + scapha + concha + tragus, 0.5)
    dz = -0.55 * flap * back * height
    return p + np.stack([side * out, np.zeros_like(out), dz], axis=-1)
