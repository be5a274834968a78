"""Writers of model files in their documented layouts, from a given model."""

from __future__ import annotations

import json
import pickle
import struct
from pathlib import Path

import h5py
import numpy as np
import scipy.io
import scipy.sparse

from mifit.morphable import MorphableModel


def landmarks_beside(path: Path, model: MorphableModel) -> None:
    path.with_name(path.name + ".landmarks.json").write_text(json.dumps(model.landmarks.tolist()))


def unit_modes(modes: np.ndarray, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """Basis (3V, K) of unit length and deviations (K,)."""
    flat = modes.reshape(-1, modes.shape[2]).astype(np.float64) * factor
    sigma = np.linalg.norm(flat, axis=0)
    return flat / sigma, sigma


def srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055)


def write_bfm2009(path: Path, m: MorphableModel, compress: bool = False, **changes) -> None:
    um = 1000.0 * m.unit_mm
    pc, ev = unit_modes(m.identity, um)
    tpc, tev = unit_modes(m.albedo_modes, 255.0)
    data = {
        "shapeMU": (um * m.mean.astype(np.float64)).reshape(-1, 1),
        "shapePC": pc.astype(np.float32),
        "shapeEV": ev.reshape(-1, 1),
        "texMU": 255 * srgb(m.mean_albedo).reshape(-1, 1),
        "texPC": tpc.astype(np.float32),
        "texEV": tev.reshape(-1, 1),
        "tl": (m.faces[:, [1, 0, 2]] + 1).astype(np.uint32),
        "segbin": np.zeros((m.n_vertices, 4), dtype=np.uint8),
    } | changes
    scipy.io.savemat(path, {k: v for k, v in data.items() if v is not None}, do_compression=compress)
    landmarks_beside(path, m)


def write_facewarehouse(folder: Path, m: MorphableModel, mean: np.ndarray) -> np.ndarray:
    """FaceWarehouse files for all but the last 11 vertices; returns their indices."""
    trim = np.arange(m.n_vertices - 11)
    um = 1000.0 * m.unit_mm
    sigma = np.arange(1, m.n_expression + 1, dtype=np.float64)
    with (folder / "Exp_Pca.bin").open("wb") as f:
        f.write(struct.pack("<i", m.n_expression))
        f.write(mean[trim].astype("<f4").tobytes())
        for k in range(m.n_expression):
            f.write((um * m.expression[trim, :, k] / sigma[k]).astype("<f4").tobytes())
    (folder / "std_exp.txt").write_text(" ".join(str(s) for s in sigma))
    scipy.io.savemat(folder / "BFM_exp_idx.mat", {"trimIndex": (trim + 1).reshape(-1, 1)})
    return trim


def write_3ddfa(folder: Path, m: MorphableModel) -> Path:
    um = 1000.0 * m.unit_mm
    w, sigma = unit_modes(m.identity, um)
    we, sigma_e = unit_modes(m.expression, um)
    half = 0.5 * um * m.mean.reshape(-1, 1).astype(np.float64)
    path = folder / "Model_Shape.mat"
    scipy.io.savemat(
        path,
        {
            "mu_shape": half, "w": w, "sigma": sigma.reshape(-1, 1), "tri": (m.faces.T + 1).astype(np.float64),
            "keypoints": (m.landmarks + 1).reshape(1, -1).astype(np.float64),
        },
    )  # fmt: skip
    scipy.io.savemat(
        folder / "Model_Expression.mat", {"mu_exp": half, "w_exp": we, "sigma_exp": sigma_e.reshape(-1, 1)}
    )
    return path


def write_deep3d(path: Path, m: MorphableModel, **changes) -> None:
    dm = m.unit_mm / 100.0
    data = {
        "meanshape": dm * m.mean.reshape(1, -1),
        "meantex": (255 * srgb(m.mean_albedo)).reshape(1, -1),
        "idBase": dm * m.identity_jacobian,
        "exBase": dm * m.expression_jacobian,
        "texBase": 255.0 * m.albedo_jacobian,
        "tri": (m.faces + 1).astype(np.int32),
        "point_buf": np.full((m.n_vertices, 8), len(m.faces) + 1, dtype=np.int32),
        "keypoints": (m.landmarks + 1).reshape(1, -1).astype(np.int32),
        "frontmask2_idx": np.arange(1, 10).reshape(-1, 1),
        "skinmask": np.ones((1, m.n_vertices), dtype=np.uint8),
    } | changes
    scipy.io.savemat(path, {k: v for k, v in data.items() if v is not None})


def write_bfm_h5(path: Path, m: MorphableModel, version: tuple[int, int] = (0, 9)) -> None:
    half = 0.5 * m.unit_mm * m.mean.astype(np.float64).ravel()
    with h5py.File(path, "w") as f:
        for name, mean, modes, factor in (
            ("shape", half, m.identity, m.unit_mm),
            ("expression", half, m.expression, m.unit_mm),
            ("color", srgb(m.mean_albedo).ravel(), m.albedo_modes, 1.0),
        ):
            basis, sigma = unit_modes(modes, factor)
            f[f"{name}/model/mean"] = mean
            f[f"{name}/model/pcaBasis"] = basis * sigma if version == (0, 8) else basis
            f[f"{name}/model/pcaVariance"] = sigma**2
            f[f"{name}/model/noiseVariance"] = 0.0
            f[f"{name}/representer/points"] = m.unit_mm * m.mean.T
            f[f"{name}/representer/cells"] = m.faces.T.astype(np.int32)
        f["version/majorVersion"], f["version/minorVersion"] = version
        f["metadata/landmarks/json"] = np.bytes_(json.dumps([{"id": "nose", "coordinates": [0, 0, 0]}]))
    landmarks_beside(path, m)


def write_albedomm(path: Path, m: MorphableModel) -> None:
    with h5py.File(path, "w") as f:
        for name in ("diffuseAlbedo", "specularAlbedo"):
            basis, sigma = unit_modes(m.albedo_modes, 1.0)
            f[f"{name}/model/mean"] = m.mean_albedo.ravel().astype(np.float64)
            f[f"{name}/model/pcaBasis"] = basis
            f[f"{name}/model/pcaVariance"] = sigma**2
            f[f"{name}/representer/cells"] = m.faces.T.astype(np.int32)


class _Named:
    """Pickles itself under another module's name."""


def write_flame_pickle(path: Path, m: MorphableModel) -> None:
    """A protocol-2 pickle as Python 2 wrote it: a chumpy array and a scipy.sparse matrix among plain ones."""
    import sys
    import types

    chumpy, ch = types.ModuleType("chumpy"), types.ModuleType("chumpy.ch")
    kind = type("Ch", (), {"__module__": "chumpy.ch"})
    kind.__qualname__ = "Ch"
    ch.Ch = kind  # type: ignore[attr-defined]
    sys.modules["chumpy"], sys.modules["chumpy.ch"] = chumpy, ch
    try:
        shapedirs = kind()
        metres = m.unit_mm / 1000.0
        shapedirs.__dict__.update(
            x=metres * np.concatenate([m.identity, m.expression], 2).astype(np.float64), dterms=()
        )
        data = {
            "v_template": metres * m.mean.astype(np.float64),
            "shapedirs": shapedirs,
            "posedirs": np.zeros((m.n_vertices, 3, 36)),
            "J_regressor": scipy.sparse.csc_matrix(np.ones((5, m.n_vertices))),
            "weights": np.zeros((m.n_vertices, 5)),
            "kintree_table": np.zeros((2, 5), dtype=np.int64),
            "f": m.faces.astype(np.uint32),
            "bs_style": "lbs",
        }
        path.write_bytes(pickle.dumps(data, protocol=2))
    finally:
        del sys.modules["chumpy"], sys.modules["chumpy.ch"]
    landmarks_beside(path, m)


def write_flame_npz(path: Path, m: MorphableModel) -> None:
    metres = m.unit_mm / 1000.0
    directions = metres * np.concatenate([m.identity, m.expression], 2)
    np.savez(path, v_template=metres * m.mean, shapedirs=directions, f=m.faces.astype(np.uint32))
    landmarks_beside(path, m)


def write_flame_texture(path: Path, m: MorphableModel, size: int = 32) -> None:
    rng = np.random.default_rng(0)
    np.savez(
        path,
        MU=rng.uniform(0.2, 0.8, (size, size, 3)), PC=rng.normal(0, 0.01, (size, size, 3, 4)),
        vt=m.uv, ft=m.faces_uv.astype(np.uint32),
    )  # fmt: skip


def _matrix(a: np.ndarray) -> bytes:
    return struct.pack("<ii", *a.shape) + np.asfortranarray(a, dtype="<f4").tobytes(order="F")


def write_eos(path: Path, m: MorphableModel, version: int = 1, empty_uv: bool = False) -> None:
    basis, sigma = unit_modes(m.identity, m.unit_mm)
    faces = struct.pack("<Q", len(m.faces)) + m.faces.astype("<i4").tobytes()
    shape = _matrix(m.unit_mm * m.mean.reshape(-1, 1)) + _matrix(basis) + _matrix((sigma**2).reshape(-1, 1)) + faces
    empty = np.zeros((0, 0))
    out = struct.pack("<I", version) + shape + _matrix(empty) * 3 + struct.pack("<Q", 0)
    if version >= 2:
        out += struct.pack("<i", 1) + _blendshapes(m)
    if version >= 3:
        out += struct.pack("<Q", 1) + struct.pack("<Q", 2) + b"37" + struct.pack("<i", 5)
    uv = m.uv.astype("<f8") * (1, -1) + (0, 1)
    if empty_uv:
        uv = uv[:0]
    elif version < 4:  # one coordinate a vertex
        uv = np.zeros((m.n_vertices, 2))
        uv[m.faces.ravel()] = m.uv[m.faces_uv.ravel()] * np.array([1, -1]) + (0, 1)
    out += struct.pack("<Q", len(uv)) + uv.astype("<f8").tobytes()
    if version >= 4:
        out += struct.pack("<Q", len(m.faces_uv)) + m.faces_uv.astype("<i4").tobytes()
    path.write_bytes(out)
    landmarks_beside(path, m)


def _blendshapes(m: MorphableModel) -> bytes:
    out = struct.pack("<Q", m.n_expression)
    for k, name in enumerate(m.expression_names):
        out += struct.pack("<Q", len(name)) + name.encode() + _matrix(m.unit_mm * m.expression[:, :, k].reshape(-1, 1))
    return out


def write_eos_blendshapes(path: Path, m: MorphableModel) -> None:
    path.write_bytes(_blendshapes(m))


def write_gnm(path: Path, m: MorphableModel, changes: dict | None = None) -> np.ndarray:
    """A GNM head: the model in metres with corneas before its eyes; returns their vertices.

    Every piece has the unit square of texture coordinates, names are those of version 3.
    """
    from mifit.morphable.openings import eyeballs

    eyes = np.concatenate(eyeballs(m))
    count = m.n_vertices
    corneas = np.arange(count, count + len(eyes))
    metres = 0.001 * m.unit_mm
    shift = np.array([0.0, 0.0, 0.0005])
    after = np.full(count, -1)
    after[eyes] = corneas
    faces = np.concatenate([m.faces, after[m.faces[np.isin(m.faces, eyes).all(axis=1)]]])

    def doubled(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, values[eyes]])

    mean = doubled(metres * m.mean.astype(np.float64))
    mean[corneas] += shift
    groups = {"skin": np.ones(len(mean)), "eyes": np.zeros(len(mean)), "eye_exteriors": np.zeros(len(mean))}
    groups["skin"][eyes], groups["skin"][corneas] = 0.0, 0.0
    groups["eyes"][eyes], groups["eyes"][corneas], groups["eye_exteriors"][corneas] = 1.0, 1.0, 1.0
    groups["scleras"] = groups["eyes"] - groups["eye_exteriors"]
    # A third of the identity modes move teeth alone, which are not there.
    identity = np.moveaxis(metres * doubled(m.identity), 2, 0)
    identity = np.concatenate([identity, np.zeros((len(identity) // 2, *identity.shape[1:]))])
    low, high = mean.min(axis=0)[:2], mean.max(axis=0)[:2]
    uv = (mean[:, :2] - low) / (high - low)
    joints = 4
    data = {
        "version": "3.0", "variant": "head", "template_vertex_positions": mean.astype(np.float32),
        "template_joint_positions": np.zeros((joints, 3)), "vertex_identity_basis": identity.astype(np.float32),
        "joint_identity_basis": np.zeros((len(identity), joints, 3)),
        "expression_basis": np.moveaxis(metres * doubled(m.expression), 2, 0).astype(np.float32),
        "identity_names": np.array([f"head_{k}" for k in range(len(identity))]),
        "joint_names": np.array(["neck", "head", "left_eye", "right_eye"]),
        "expression_names": np.array([f"lower_face_region_{k}" for k in range(m.n_expression)]),
        "joint_parent_indices": np.array([-1, 0, 1, 1]), "skinning_weights": np.zeros((joints, len(mean))),
        "quads": np.zeros((0, 4), np.int32), "triangles": faces.astype(np.int32),
        "quad_uvs": np.zeros((0, 4, 2)), "triangle_uvs": uv[faces].astype(np.float32),
        "mesh_component_names": np.array(["skin", "eyes"]), "mirror_indices": np.arange(len(mean)),
        "joint_regressor": np.zeros((joints, len(mean))),
        "pose_correctives_regressor": np.zeros((9 * joints, 3)),
        "bone_aligned_template_joint_orientations": np.tile(np.eye(3), (joints, 1, 1)),
        "vertex_groups": np.stack(list(groups.values())).astype(np.float32),
        "vertex_group_names": np.array(list(groups)),
    } | (changes or {})  # fmt: skip
    np.savez_compressed(path, **{key: value for key, value in data.items() if value is not None})
    return corneas
