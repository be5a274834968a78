"""What a fit of a foreign face is worth: views, relit views and the surface itself, against photographs and a scan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from benchmarks import scan
from benchmarks.truth import angle
from mifit import Capture, Reconstruction
from mifit.core.camera import Camera
from mifit.core.image import srgb_to_linear, to_8_bit
from mifit.core.mesh import interpolate, normalize, vertex_normals
from mifit.core.metrics import flip, psnr_from_rmse, ssim
from mifit.core.uv import sample_map
from mifit.render.image_based import image_based

MARGIN = 48
"""Pixels around the landmarks that are rendered: more than any window of a measure reaches beyond the face."""
TRACED = ("full", "refit")
"""Rows whose relit views are path traced as well."""
Image = NDArray[np.uint8]


@dataclass(frozen=True)
class View:
    """One photograph and the pixels that count in it, cut down to the surroundings of the face.

    Attributes
    ----------
    camera : Camera
        Of the cut image.
    box : (slice, slice)
        Rows and columns of the cut in the whole image.
    photograph : (H, W, 3) uint8
        sRGB.
    face, skin, relit : (H, W) bool
        Hull of the landmarks; the same without eyes and inner mouth; the same without a wider surrounding of them.
    """

    name: str
    timestep: int
    camera: Camera
    box: tuple[slice, slice]
    photograph: Image
    face: NDArray[np.bool_]
    skin: NDArray[np.bool_]
    relit: NDArray[np.bool_]


def view(capture: Capture, name: str, timestep: int) -> View:
    """Cut one photograph of a capture down to its face."""
    camera, points = capture.camera(name), scan.landmarks(capture, name, timestep)
    low = np.maximum(np.floor(points.min(0)).astype(int) - MARGIN, 0)
    high = np.minimum(np.ceil(points.max(0)).astype(int) + MARGIN, (camera.width, camera.height))
    width, height = (high - low).tolist()
    cut = replace(camera, width=width, height=height, cx=camera.cx - float(low[0]), cy=camera.cy - float(low[1]))
    box = slice(low[1], high[1]), slice(low[0], high[0])
    frame = capture.frame(name, timestep)
    regions = (
        r(points, camera)[box] & frame.valid[box] for r in (scan.face_region, scan.skin_region, scan.relit_region)
    )
    return View(name, timestep, cut, box, to_8_bit(frame.image)[box], *regions)


def rendered(result: Reconstruction, at: View, method: str) -> Image:
    """A render as 8-bit sRGB; black where the model covers less than half of a pixel."""
    linear = result.render(at.camera, at.timestep, method)  # type: ignore[arg-type]
    image = to_8_bit(linear[..., :3])
    return image * (np.round(255 * linear[..., 3:]) > 127).astype(np.uint8)


@dataclass
class Tally:
    """Sums of a measure's errors over the pixels of several images."""

    squared: float = 0.0
    matched: float = 0.0
    likeness: float = 0.0
    flipped: float = 0.0
    pixels: int = 0

    def add(self, image: Image, photograph: Image, region: NDArray[np.bool_], perceptual: bool = True) -> None:
        """Add one image's pixels."""
        count = int(region.sum())
        if not count:
            return
        difference = image[region].astype(np.float64) - photograph[region]
        self.squared += float((difference**2).mean()) * count
        self.matched += float((_in_its_exposure(image[region], photograph[region]) ** 2).mean()) * count
        if perceptual:
            self.likeness += ssim(image, photograph, region) * count
            self.flipped += flip(image, photograph, region) * count
        self.pixels += count

    def figures(self) -> dict[str, float]:
        """PSNR (dB), the same in each photograph's own exposure and white balance, SSIM, FLIP, number of pixels."""
        plain, matched = (round(psnr_from_rmse((x / self.pixels) ** 0.5), 2) for x in (self.squared, self.matched))
        found = {"psnr": plain, "psnr_matched": matched, "pixels": self.pixels}
        if self.likeness:
            found |= {"ssim": round(self.likeness / self.pixels, 4), "flip": round(self.flipped / self.pixels, 4)}
        return found


def _in_its_exposure(codes: Image, photograph: Image) -> NDArray[np.float64]:
    """(N, 3) what sRGB codes differ by once each channel's light is scaled to fit best.

    Nothing that a fit reads says how a camera that it doesn't read is exposed.
    """
    a, b = (srgb_to_linear(x / 255.0) for x in (codes, photograph))
    gain = (a * b).sum(0) / np.maximum((a * a).sum(0), 1e-9)
    return 255.0 * _coded(gain * a) - photograph


Methods = Mapping[str, tuple[Reconstruction, str]]
"""Rows of the table: a reconstruction and the method to render it by."""


def judge_views(
    rows: Methods,
    capture: Capture,
    names: Sequence[str],
    timesteps: Sequence[int],
    fitted: Sequence[str],
    perceptual: bool = True,
) -> dict[str, dict[str, Any]]:
    """Errors of every row, and of image-based rendering on its mesh and on the scan, in some views.

    Three sets of pixels per row: ``face``, the hull of the landmarks; ``skin``, the face without eyes and inner mouth
    where a fitted view sees the scan (without a scan: sees the first row's mesh), the same pixels for all rows; and
    ``seen``, skin where a fitted view sees the row's own mesh.
    """
    tallies: dict[str, dict[str, Tally]] = {}

    def add(row: str, image: Image, at: View, regions: dict[str, NDArray[np.bool_]]) -> None:
        for region, pixels in regions.items():
            tally = tallies.setdefault(row, {}).setdefault(region, Tally())
            tally.add(image, at.photograph, pixels, perceptual=perceptual and region == "skin")

    for timestep in timesteps:
        truth = scan.read_scan(capture, timestep)
        for name in names:
            at = view(capture, name, timestep)
            bases = {}
            for result, _ in rows.values():
                if id(result.geometry) not in bases:
                    bases[id(result.geometry)] = _on_mesh(result, capture, at, timestep, fitted)
            skin = at.skin
            if truth is not None:
                cameras = [capture.camera(c) for c in fitted]
                found = image_based(capture, cameras, at.camera, timestep, truth.vertices, truth.faces)
                skin = at.skin & found.seen
                add("image-based, scan", to_8_bit(found.colour), at, {"face": at.face & found.seen, "skin": skin})
            else:
                skin = at.skin & next(iter(bases.values())).seen
            for label, (result, method) in rows.items():
                own = bases[id(result.geometry)]
                regions = {"face": at.face, "skin": skin, "seen": at.skin & own.seen}
                add(label, rendered(result, at, method), at, regions)
            done = set()
            for label, (result, _) in rows.items():
                if id(result.geometry) not in done:
                    done.add(id(result.geometry))
                    own = bases[id(result.geometry)]
                    regions = {"face": at.face & own.seen, "skin": skin, "seen": at.skin & own.seen}
                    add(f"image-based, mesh of {label.split(':')[0]}", to_8_bit(own.colour), at, regions)
    return {row: {region: t.figures() for region, t in found.items() if t.pixels} for row, found in tallies.items()}


def _on_mesh(result: Reconstruction, capture: Capture, at: View, timestep: int, fitted: Sequence[str]) -> Any:
    """Image-based rendering on the fitted mesh."""
    vertices = result.geometry.vertices[result.index(timestep)]
    cameras = [capture.camera(c) for c in fitted]
    return image_based(capture, cameras, at.camera, timestep, vertices, result.model.faces)


def judge_mesh(result: Reconstruction, capture: Capture, fitted: Sequence[str]) -> dict[str, float]:
    """Distances (mm) from the scan's points that all fitted views see to the fitted mesh, without any alignment."""
    found = []
    for i, timestep in enumerate(result.timesteps):
        truth = scan.read_scan(capture, timestep)
        assert truth is not None
        points = scan.points_seen(truth, capture, fitted, timestep)
        found.append(scan.nearest(points.position, result.geometry.vertices[i], result.model.faces)[0])
    distance = np.concatenate(found) * capture.unit_mm
    return {
        "median_mm": round(float(np.median(distance)), 3),
        "mean_mm": round(float(distance.mean()), 3),
        "p90_mm": round(float(np.percentile(distance, 90)), 3),
        "points": len(distance),
    }


def judge_surface(result: Reconstruction, capture: Capture, fitted: Sequence[str]) -> dict[str, float]:
    """Normals, albedo and specular map at the scan's points that all fitted views see, each at the nearest point of
    the fitted mesh.

    Normals are compared with the scan's smooth ones (mean angle in degrees), the diffuse albedo after one scale per
    channel, the specular map after one scale and by its correlation with the true lobe's weight.
    """
    angles: dict[str, list[float]] = {"normal_degrees": [], "normal_degrees_stage1": []}
    albedo, specular = [], []
    for i, timestep in enumerate(result.timesteps):
        truth = scan.read_scan(capture, timestep)
        assert truth is not None
        points = scan.points_seen(truth, capture, fitted, timestep)
        vertices, faces = result.geometry.vertices[i], result.model.faces
        _, face, weights = scan.nearest(points.position, vertices, faces)
        inside = result.model.face_mask[face]
        smooth = normalize(interpolate(vertex_normals(vertices, faces), faces, face, weights))
        uv = interpolate(result.model.uv, result.model.faces_uv, face, weights)
        angles["normal_degrees_stage1"].append(angle(smooth[inside], points.normal[inside]))
        refined = result.refined_normal(timestep)
        if refined is not None:
            bent = sample_map(refined, uv)
            known = np.linalg.norm(bent, axis=1) > 0.5
            bent = np.where(known[:, None], normalize(bent) @ result.geometry.rotation[i].T, smooth)
            angles["normal_degrees"].append(angle(bent[inside], points.normal[inside]))
        if result.reflectance is not None and truth.uv is not None and "albedo" in truth.maps:
            albedo.append((sample_map(result.reflectance.diffuse, uv)[inside], points.look_up(truth, "albedo")[inside]))
            lobe = points.look_up(truth, "specular")[inside]
            specular.append((sample_map(result.reflectance.specular, uv)[inside], lobe))
    found = {key: round(float(np.mean(values)), 2) for key, values in angles.items() if values}
    if albedo:
        estimate, true = (np.concatenate(part).astype(np.float64) for part in zip(*albedo, strict=True))
        found["albedo_rmse"] = round(_scaled_rmse(estimate, true), 4)
        estimate, true = (np.concatenate(part).astype(np.float64) for part in zip(*specular, strict=True))
        found["specular_rmse"] = round(_scaled_rmse(estimate[:, None], true[:, None]), 4)
        flat = np.ptp(estimate) == 0
        found["specular_correlation"] = 0.0 if flat else round(float(np.corrcoef(estimate, true)[0, 1]), 3)
    return found


def _scaled_rmse(estimate: NDArray, true: NDArray) -> float:
    """Root mean square difference after the least-squares scale of each channel."""
    scale = (estimate * true).sum(0) / np.maximum((estimate**2).sum(0), 1e-12)
    return float(np.sqrt(np.mean((scale * estimate - true) ** 2)))


def judge_relit(
    rows: Methods, capture: Capture, name: str, timestep: int, integrators: Sequence[str], samples: int
) -> dict[str, dict[str, float]]:
    """PSNR (dB) of relit views against path-traced ones, one factor per channel, per row and integrator and light."""
    at = view(capture, name, timestep)
    found: dict[str, dict[str, float]] = {}
    for environment, (path, light, exposure) in scan.relit_truths(capture).items():
        truth = np.array(mi.Bitmap(str(path)), np.float64)[..., :3][at.box] * exposure
        for label, (result, method) in rows.items():
            lit = result.relight(str(light))
            for integrator in integrators if label in TRACED else ("local",):
                count = samples if integrator == "path" else None
                image = lit.render(at.camera, timestep, method, integrator, count)  # type: ignore[arg-type]
                key = f"{label}, {integrator}"
                found.setdefault(key, {})[environment] = round(scaled_psnr(image[..., :3], truth, at.relit), 2)
    for figures in found.values():
        figures["mean"] = round(float(np.mean(list(figures.values()))), 2)
    return found


def scaled_psnr(image: NDArray, truth: NDArray, region: NDArray[np.bool_]) -> float:
    """PSNR (dB) of sRGB values over a region, after the linear least-squares factor of each channel."""
    a, b = image[region].astype(np.float64), truth[region]
    a = a * (a * b).sum(0) / np.maximum((a * a).sum(0), 1e-9)
    codes = [255.0 * _coded(x) for x in (a, b)]
    return psnr_from_rmse(float(np.sqrt(np.mean((codes[0] - codes[1]) ** 2))))


def _coded(linear: NDArray) -> NDArray:
    """Linear -> sRGB, 0..1, not rounded."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
