"""Writers of what photogrammetry programs export, for cameras that are known."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mifit.core.camera import Camera

XCR = "http://www.capturingreality.com/ns/xcr/1.1#"
Photos = Iterable[tuple[Camera, str]]
"""Cameras with the names of their photographs."""


def numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(list(values)))


def brown(camera: Camera) -> tuple[float, float, float, float, float]:
    """k1, k2, k3 and Brown's P1, P2."""
    k1, k2, p1, p2, k3 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return k1, k2, k3, p2, p1


def write_metashape(path: Path, photos: Photos, similarity: np.ndarray | None = None) -> Path:
    """Agisoft XML; with a ``similarity`` (4, 4) the chunk's own coordinates are others and it leads back."""
    similarity = np.eye(4) if similarity is None else similarity
    scale = float(np.cbrt(np.linalg.det(similarity[:3, :3])))
    sensors, cameras = [], []
    for i, (camera, name) in enumerate(photos):
        k1, k2, k3, p1, p2 = brown(camera)
        terms = {
            "f": camera.fy, "cx": camera.cx - camera.width / 2, "cy": camera.cy - camera.height / 2,
            "b1": camera.fx - camera.fy, "k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2,
        }  # fmt: skip
        inside = "".join(f"<{key}>{value!r}</{key}>" for key, value in terms.items() if value)
        resolution = f'<resolution width="{camera.width}" height="{camera.height}"/>'
        sensors.append(
            f'<sensor id="{i}" label="unknown" type="frame">{resolution}'
            f'<calibration type="frame" class="initial"><f>1</f></calibration>'
            f'<calibration type="frame" class="adjusted">{resolution}{inside}</calibration></sensor>'
        )
        pose = np.linalg.inv(similarity) @ np.linalg.inv(camera.world_to_camera)
        pose[:3, :3] *= scale  # the camera's own axes are of unit length in the chunk
        cameras.append(
            f'<camera id="{i}" sensor_id="{i}" component_id="0" label="{name}"><transform>{numbers(pose.ravel())}'
            "</transform></camera>"
        )
    cameras.insert(1, '<camera id="98" sensor_id="0" component_id="0" label="not aligned"/>')
    middle = f'<group id="0" label="a" type="folder">{cameras.pop()}</group>'
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="9">{"".join(sensors)}</sensors><components next_id="1"><component id="0" active="true">'
        f'<transform><rotation locked="true">{numbers((similarity[:3, :3] / scale).ravel())}</rotation>'
        f"<translation>{numbers(similarity[:3, 3])}</translation><scale>{scale!r}</scale></transform></component>"
        f'</components><cameras next_id="9">{"".join(cameras)}{middle}</cameras></chunk></document>\n'
    )
    return path


def film(camera: Camera) -> tuple[float, float, float]:
    """Focal length for 36 mm and the principal point as parts of the longer side."""
    longer = max(camera.width, camera.height)
    u, v = (camera.cx - camera.width / 2) / longer, (camera.cy - camera.height / 2) / longer
    return camera.fx / longer * 36.0, u, v


def write_xmp(folder: Path, photos: Photos) -> Path:
    for camera, name in photos:
        focal, u, v = film(camera)
        k1, k2, k3, t1, t2 = brown(camera)
        (folder / f"{Path(name).stem}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
            f'  <rdf:Description xmlns:xcr="{XCR}" xcr:Version="3" xcr:PosePrior="exact" xcr:Coordinates="absolute"\n'
            f'   xcr:DistortionModel="brown3t2" xcr:FocalLength35mm="{focal!r}" xcr:Skew="0"'
            f' xcr:AspectRatio="{camera.fy / camera.fx!r}" xcr:PrincipalPointU="{u!r}" xcr:PrincipalPointV="{v!r}">\n'
            f"   <xcr:Rotation>{numbers(camera.rotation.ravel())}</xcr:Rotation>\n"
            f"   <xcr:Position>{numbers(camera.position)}</xcr:Position>\n"
            f"   <xcr:DistortionCoeficients>{numbers((k1, k2, k3, 0, t1, t2))}</xcr:DistortionCoeficients>\n"
            "  </rdf:Description>\n </rdf:RDF>\n</x:xmpmeta>\n"
        )
    return folder


def write_colmap(folder: str | Path, cameras: Photos) -> Path:
    """Write a text model of cameras with the names of their images; one COLMAP camera per image."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics, poses = [], []
    for i, (camera, name) in enumerate(cameras, start=1):
        model = "FULL_OPENCV" if len(camera.distortion) > 4 else "OPENCV" if any(camera.distortion) else "PINHOLE"
        lens = {"PINHOLE": 0, "OPENCV": 4, "FULL_OPENCV": 8}[model]
        coefficients = (*camera.distortion, *(0.0,) * 8)[:lens]
        parameters = (camera.fx, camera.fy, camera.cx, camera.cy, *coefficients)
        intrinsics.append(f"{i} {model} {camera.width} {camera.height} {numbers(parameters)}")
        x, y, z, w = Rotation.from_matrix(camera.rotation).as_quat()
        poses.append(f"{i} {numbers((w, x, y, z, *camera.translation))} {i} {name}\n")
    first = "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    (folder / "cameras.txt").write_text("\n".join([first, *intrinsics]) + "\n")
    header = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
    (folder / "images.txt").write_text(header + "\n".join(poses) + "\n")
    (folder / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n")
    return folder


def write_vhap(folder: Path, capture: Path) -> Path:
    """A capture's images and cameras as VHAP exports them."""
    document = json.loads((capture / "transforms.json").read_text(encoding="utf-8"))
    cameras = list(dict.fromkeys(frame["camera_id"] for frame in document["frames"]))
    frames = []
    for frame in document["frames"]:
        t, c = frame["timestep_index"], cameras.index(frame["camera_id"])
        (folder / "images").mkdir(parents=True, exist_ok=True)
        (folder / "fg_masks").mkdir(exist_ok=True)
        name = f"{t:05d}_{c:02d}.png"
        shutil.copyfile(capture / frame["file_path"], folder / "images" / name)
        from PIL import Image

        mask = np.full((frame["h"], frame["w"]), 255, np.uint8)
        mask[:, : frame["w"] // 3] = 0
        Image.fromarray(mask).save(folder / "fg_masks" / name)
        kept = {key: frame[key] for key in ("cx", "cy", "fl_x", "fl_y", "h", "w", "transform_matrix", "timestep_index")}
        frames.append(
            {
                **kept, "timestep_id": f"frame_{t:05d}", "camera_index": c, "camera_id": frame["camera_id"],
                "timestep_index_original": t, "camera_angle_x": 0.5, "camera_angle_y": 0.5,
                "file_path": f"images/{name}", "fg_mask_path": f"fg_masks/{name}",
                "flame_param_path": f"flame_param/{t:05d}.npz",
            }
        )  # fmt: skip
    shared = {
        key: frames[-1][key] for key in ("cx", "cy", "fl_x", "fl_y", "h", "w", "camera_angle_x", "camera_angle_y")
    }
    document = {"frames": frames, **shared, "timestep_indices": [0, 1], "camera_indices": [0, 1]}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder


def nersemble_parameters(cameras: Iterable[Camera], zoom: float) -> dict:
    """``camera_params.json`` of images ``zoom`` times as large."""
    cameras = list(cameras)
    first = cameras[0]
    matrix = np.diag([zoom, zoom, 1.0]) @ first.matrix
    return {
        "world_2_cam": {camera.name: camera.world_to_camera.tolist() for camera in cameras},
        "intrinsics": matrix.tolist(), "width": round(zoom * first.width), "height": round(zoom * first.height),
    }  # fmt: skip
