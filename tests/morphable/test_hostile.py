"""Files that lie: each is refused with a clear message, at once and without much memory."""

from __future__ import annotations

import io
import json
import os
import pickle
import resource
import struct
import time
import tracemalloc
import zipfile
import zlib
from contextlib import contextmanager
from pathlib import Path

import h5py
import layouts
import numpy as np
import pytest
import scipy.io

from mifit.errors import InputError
from mifit.morphable import MorphableModel, recognise  # noqa: F401 - imported here so that no test times it


@pytest.fixture(scope="module")
def source() -> MorphableModel:
    return MorphableModel.load("builtin:coarse").subset(identity=3, expression=slice(4, 6), albedo=2)


@contextmanager
def refused(message: str):
    """The block raises InputError with the message, within a second of CPU time and 100 MB of memory."""
    tracemalloc.start()
    peak_before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    try:
        with pytest.raises(InputError, match=message) as caught:
            yield caught
        seconds = time.process_time() - start
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_before
    assert seconds < 1.0
    assert peak < 100 << 20 and grown < 200 << 10  # bytes traced, kilobytes resident
    assert "Traceback" not in str(caught.value)


# -- pickles ------------------------------------------------------------------------------------------------------


class Runs:
    """Leaves a mark when unpickled."""

    def __init__(self, mark: Path, how) -> None:
        self.mark, self.how = mark, how

    def __reduce__(self):
        return self.how, (f"touch {self.mark}",)


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_pickle_that_runs_code_is_refused_without_running_it(tmp_path, protocol):
    mark, path = tmp_path / "mark", tmp_path / "model.pkl"
    path.write_bytes(pickle.dumps({"v_template": Runs(mark, os.system)}, protocol))
    with refused(r"wants to run (posix|nt)\.system, which is refused"):
        MorphableModel.load(path)
    assert not mark.exists()


@pytest.mark.parametrize(
    "stream",
    [
        b"\x80\x02cbuiltins\neval\n(X\x04\x00\x00\x001+1\ntR.",
        b"\x80\x02c__builtin__\n__import__\n(U\x02ostR.",
        b"\x80\x02csubprocess\nPopen\n(U\x02lstR.",
        b"(dp0\nS'f'\np1\ncos\nsystem\n(S'true'\ntRs.",
        b"\x80\x02cnumpy\nload\n(U\x01xtR.",
        b"\x80\x02cnumpy.core.multiarray\nfromfile\n(U\x01xtR.",
        b"\x80\x02ccollections\nOrderedDict\n(tR.",
        b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x04true\x85R.",
        b"\x80\x02U\x05hello\x82\x01.",
    ],
)
def test_other_names_are_refused(tmp_path, stream):
    path = tmp_path / "model.pkl"
    path.write_bytes(stream)
    with refused("refused|damaged pickle"):
        MorphableModel.load(path)


def test_pickle_that_allocates_is_refused(tmp_path):
    path = tmp_path / "model.pkl"
    path.write_bytes(
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n\x8a\x06\x00\x00\x00\x00\x00\x01\x85U\x01dtR."
    )
    with refused(r"built with shape \(1099511627776,\), expected \(0,\)"):
        MorphableModel.load(path)


def test_pickle_whose_string_claims_ten_gigabytes(tmp_path):
    path = tmp_path / "model.pkl"
    path.write_bytes(b"\x80\x04\x8e" + struct.pack("<Q", 10 << 30) + b"abc.")
    with refused("damaged pickle"):
        MorphableModel.load(path)


def test_pickle_with_object_array_or_wrong_content(tmp_path):
    path = tmp_path / "model.pkl"
    good = {"shapedirs": np.zeros((4, 3, 2)), "f": np.zeros((1, 3), dtype=int)}
    for content, message in (
        ([1, 2], "holds a list, expected a dictionary"),
        (good, "lacks v_template"),
        (good | {"v_template": np.array([None, 1])}, "type '\\|?O8?', expected plain numbers|damaged"),
        (good | {"v_template": "text"}, "v_template: found str, expected a numeric array"),
        (good | {"v_template": np.zeros((5, 3))}, r"shapedirs has shape \(4, 3, 2\), expected \(5, 3, modes\)"),
        (good | {"v_template": np.full((4, 3), np.nan)}, "finite"),
        (good | {"v_template": np.zeros((4, 3)), "f": np.full((1, 3), 9)}, r"indices in 0\.\.3"),
    ):
        path.write_bytes(pickle.dumps(content, protocol=2))
        with refused(message):
            MorphableModel.load(path)


def test_truncated_pickle(tmp_path, source):
    layouts.write_flame_pickle(tmp_path / "m.pkl", source)
    data = (tmp_path / "m.pkl").read_bytes()
    (tmp_path / "m.pkl").write_bytes(data[: len(data) // 2] + b".")
    with refused("m.pkl"):
        MorphableModel.load(tmp_path / "m.pkl")


# -- npz ----------------------------------------------------------------------------------------------------------


def npy_header(shape: tuple, dtype: str = "<f4") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}"
    text = text.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def npz_with(path: Path, **members: bytes) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as z:
        for name, data in members.items():
            z.writestr(f"{name}.npy", data)


def plain(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def test_zip_bomb(tmp_path):
    path = tmp_path / "bomb.npz"
    npz_with(path, mifit_model=plain(np.int64(1)), mean=npy_header((8_333_333, 3)) + bytes(100_000_000))
    assert path.stat().st_size < 1 << 20
    with refused(r"claims 100\d+ bytes when unpacked, expected at most"):
        MorphableModel.load(path)


def test_npz_member_that_unpacks_to_more_than_it_says(tmp_path):
    path = tmp_path / "liar.npz"
    npz_with(path, mifit_model=plain(np.int64(1)), mean=npy_header((250_000, 3)) + bytes(100_000_000))
    data = path.read_bytes().replace(struct.pack("<I", 100_000_128), struct.pack("<I", 3_000_128))
    path.write_bytes(data)
    with refused("liar.npz"):
        MorphableModel.load(path)


def test_npy_header_that_claims_ten_gigabytes(tmp_path):
    path = tmp_path / "huge.npz"
    npz_with(path, mifit_model=plain(np.int64(1)), mean=npy_header((1 << 30, 3)) + bytes(64))
    with refused(r"mean: header claims shape \(1073741824, 3\)"):
        MorphableModel.load(path)


@pytest.mark.parametrize("shape", ["(-1, 3)", "('a', 3)", "((((3,", "(1,) * 10**9"])
def test_npy_header_that_is_nonsense(tmp_path, shape):
    path = tmp_path / "odd.npz"
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    header = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()
    npz_with(path, mifit_model=plain(np.int64(1)), mean=header + bytes(64))
    with refused("odd.npz"):
        MorphableModel.load(path)


def test_object_array_in_npz(tmp_path):
    path = tmp_path / "object.npz"
    np.savez(path, mifit_model=np.int64(1), mean=np.array([Runs(tmp_path / "mark", os.system)], dtype=object))
    with refused("mean: holds Python objects, which are refused"):
        MorphableModel.load(path)
    assert not (tmp_path / "mark").exists()


def test_own_file_with_wrong_content(tmp_path, source):
    path = tmp_path / "m.npz"
    source.save(path)
    with np.load(path) as archive:
        good = dict(archive)
    for changes, message in (
        ({"mean": None}, "lacks mean"),
        ({"mifit_model": np.int64(9)}, "mifit_model version 9, expected 1"),
        ({"mifit_model": np.zeros(3)}, "mifit_model"),
        ({"unit_mm": np.array("x")}, "unit_mm"),
        ({"identity": good["identity"][:-1]}, r"identity has shape \(\d+, 3, 3\)"),
        ({"faces": good["faces"] + 1}, "faces holds indices 1"),
        ({"mean": np.full_like(good["mean"], np.nan)}, r"mean\[0, 0\] is nan"),
        ({"landmarks": good["landmarks"][:3]}, "landmarks has shape"),
    ):
        changed = {k: v for k, v in (good | changes).items() if v is not None}
        np.savez(path, **changed)
        with refused(message):
            MorphableModel.load(path)


def test_truncated_npz(tmp_path, source):
    path = tmp_path / "m.npz"
    source.save(path)
    data = path.read_bytes()
    path.write_bytes(data[:-20])
    with refused("m.npz"):
        MorphableModel.load(path)
    path.write_bytes(data[: len(data) // 2] + data[-400:])
    with refused("m.npz"):
        MorphableModel.load(path)


# -- MATLAB -------------------------------------------------------------------------------------------------------


def test_mat_without_the_keys(tmp_path, source):
    path = tmp_path / "m.mat"
    scipy.io.savemat(path, {"shapely": np.zeros(3)})
    with refused("MATLAB file with shapely, expected keys of a known model"):
        MorphableModel.load(path)
    layouts.write_bfm2009(path, source, texEV=None)
    with refused("lacks texEV; found"):
        MorphableModel.load(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shapePC": np.zeros((24, 3))}, r"shapeMU has shape \(\d+, 1\), expected 24 values"),
        ({"shapePC": np.zeros((25, 3))}, r"shapePC has shape \(25, 3\)"),
        ({"shapeEV": np.zeros((9, 1))}, r"shapeEV has shape \(9, 1\), expected 3 values"),
        ({"tl": np.full((5, 3), 1e6)}, "tl holds 1000000.0..1000000.0, expected 1-based"),
        ({"tl": np.full((5, 3), np.nan)}, "tl holds nan"),
        ({"tl": np.zeros((5, 4))}, r"tl has shape \(5, 4\)"),
        ({"shapeMU": np.array([[1 + 1j]])}, "shapeMU is complex"),
        ({"shapeMU": "text"}, "lacks shapeMU"),
    ],
)
def test_mat_with_wrong_content(tmp_path, source, changes, message):
    layouts.write_bfm2009(tmp_path / "m.mat", source, **changes)
    with refused(message):
        MorphableModel.load(tmp_path / "m.mat")


def mat_matrix(name: bytes, rows: int, columns: int, claimed: int, data: bytes) -> bytes:
    body = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, rows, columns)
    body += struct.pack("<II", 1, len(name)) + name.ljust((len(name) + 7) // 8 * 8, b"\0")
    return struct.pack("<II", 14, len(body) + 8 + claimed) + body + struct.pack("<II", 9, claimed) + data


MAT_HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
OTHERS = [b"shapePC", b"shapeEV", b"texMU", b"texPC", b"texEV", b"tl"]


def test_mat_that_claims_ten_gigabytes(tmp_path):
    path = tmp_path / "m.mat"
    small = b"".join(mat_matrix(n, 1, 1, 8, bytes(8)) for n in OTHERS)
    path.write_bytes(MAT_HEAD + small + mat_matrix(b"shapeMU", 1 << 30, 1, 0xFFFFFF00, bytes(64)))
    with refused("an element claims 4294967\\d+ bytes, 64|truncated|remain"):
        MorphableModel.load(path)
    path.write_bytes(MAT_HEAD + small + mat_matrix(b"shapeMU", 1 << 30, 1, 64, bytes(64)))
    with refused(r"shapeMU claims shape \(1073741824, 1\), but holds 64 bytes"):
        MorphableModel.load(path)


def test_compressed_mat_bomb(tmp_path):
    path = tmp_path / "m.mat"
    small = b"".join(mat_matrix(n, 1, 1, 8, bytes(8)) for n in OTHERS)
    packed = zlib.compress(mat_matrix(b"shapeMU", 10_000_000, 1, 80_000_000, bytes(80_000_000)))
    path.write_bytes(MAT_HEAD + small + struct.pack("<II", 15, len(packed)) + packed)
    with refused(r"shapeMU claims 80\d+ bytes unpacked, expected at most"):
        MorphableModel.load(path)


def test_truncated_mat(tmp_path, source):
    path = tmp_path / "m.mat"
    layouts.write_bfm2009(path, source)
    data = path.read_bytes()
    for size in (129, 200, 5000, len(data) // 2, len(data) - 3):
        path.write_bytes(data[:size])
        with refused("m.mat"):
            MorphableModel.load(path)


# -- HDF5 ---------------------------------------------------------------------------------------------------------


def test_h5_that_claims_ten_gigabytes(tmp_path):
    path = tmp_path / "m.h5"
    with h5py.File(path, "w") as f:
        f.create_dataset("shape/model/mean", shape=(3 << 30,), dtype="f4", chunks=(1 << 20,))
        f["shape/model/pcaVariance"] = np.ones(2)
    with refused("shape/model/mean claims 12884901888 bytes, expected at most"):
        MorphableModel.load(path)


def test_h5_with_wrong_content(tmp_path, source):
    path = tmp_path / "m.h5"
    for changes, message in (
        ({"shape/model/mean": None}, "without shape/model/mean"),
        ({"shape/model/pcaBasis": np.zeros((7, 3))}, r"pcaBasis has shape \(7, 3\), expected \(\d+, 3\)"),
        ({"shape/model/pcaVariance": -np.ones(3)}, "pcaVariance holds -1.0"),
        ({"shape/representer/cells": np.full((3, 9), 1 << 20)}, "cells hold indices outside"),
        ({"shape/model/mean": np.array([b"text"])}, "mean has type"),
        ({"version/majorVersion": np.array([b"x"])}, "m.h5"),
    ):
        layouts.write_bfm_h5(path, source)
        with h5py.File(path, "a") as f:
            for key, value in changes.items():
                del f[key]
                if value is not None:
                    f[key] = value
        with refused(message):
            MorphableModel.load(path)


def test_truncated_h5(tmp_path, source):
    path = tmp_path / "m.h5"
    layouts.write_bfm_h5(path, source)
    path.write_bytes(path.read_bytes()[:50_000])
    with refused("damaged HDF5 file"):
        MorphableModel.load(path)


# -- eos, ICT, anything -------------------------------------------------------------------------------------------


def test_eos_that_claims_too_much(tmp_path):
    path = tmp_path / "m.bin"
    path.write_bytes(struct.pack("<Iii", 1, 3 << 28, 1) + bytes(100))
    with refused(r"shape mean claims 3221225472 bytes at offset 12, 100 remain"):
        MorphableModel.load(path)


def test_truncated_eos_at_every_kind_of_place(tmp_path, source):
    path = tmp_path / "m.bin"
    layouts.write_eos(path, source, 4)
    data = path.read_bytes()
    for size in (12, 100, len(data) // 3, len(data) - 1):
        path.write_bytes(data[:size])
        with refused("m.bin"):
            MorphableModel.load(path)
    path.write_bytes(data + b"x")
    with refused("1 bytes after the end"):
        MorphableModel.load(path)


def test_ict_folder_with_wrong_content(tmp_path):
    (tmp_path / "vertex_indices.json").write_text("{}")
    (tmp_path / "generic_neutral_mesh.obj").write_text("v 0 0 0\n")
    with refused("idx_to_landmark_verts"):
        MorphableModel.load(tmp_path)
    (tmp_path / "vertex_indices.json").write_text(json.dumps({"idx_to_landmark_verts": [0] * 68, "expressions": []}))
    for text, message in (
        ("v 0 0\n", "'v' line does not hold 3 numbers"),
        ("v 0 0 nan\n", "not finite"),
        ("v 0 0 0\nvt 0 0\nf 1/1 2/1 3/1\n", "outside 1..1"),
        ("v 0 0 0\nvt 0 0\nf 1 2 3\n", "expected vertex/texture indices"),
        ("v 0 0 0\nvt 0 0\nf 1/1 1/1 1/1\n", "1 vertices, expected at least 11248"),
    ):
        (tmp_path / "generic_neutral_mesh.obj").write_text(text)
        with refused(message):
            MorphableModel.load(tmp_path)


def test_ict_npz_with_wrong_content(tmp_path):
    good = {
        "mean": np.zeros((80, 3)), "faces": np.zeros((4, 3), int), "uv": np.zeros((3, 2)),
        "faces_uv": np.zeros((4, 3), int),
        "identity": np.zeros((2, 80, 3)), "expression": np.zeros((1, 80, 3)), "expression_names": np.array(["a"]),
        "landmarks_ibug68": np.arange(68), "face_area_faces": np.int32(4),
    }  # fmt: skip
    for changes, message in (
        ({"uv": None}, "lacks uv"),
        ({"identity": np.zeros((2, 79, 3))}, r"identity has shape \(2, 79, 3\)"),
        ({"landmarks_ibug68": np.full(68, 80)}, "68 indices in 0..79"),
        ({"faces": np.full((4, 3), -1)}, r"indices in 0\.\.79"),
        ({"mean": np.full((80, 3), np.inf)}, "finite"),
    ):
        np.savez(tmp_path / "m.npz", **{k: v for k, v in (good | changes).items() if v is not None})
        with refused(message):
            MorphableModel.load(tmp_path / "m.npz")


@pytest.mark.parametrize(
    "content", [b"", b"\x00", b"hello world, this is no model", bytes(4096), b"PK\x03\x04" + bytes(200)]
)
def test_files_of_no_kind(tmp_path, content):
    path = tmp_path / "m.dat"
    path.write_bytes(content)
    with refused("not a model of a known kind"):
        MorphableModel.load(path)


def test_random_damage_never_escapes(tmp_path, source):
    """Flip bytes of every format: the result is a model or an InputError."""
    rng = np.random.default_rng(0)
    writers = {
        "m.mat": layouts.write_bfm2009,
        "m.h5": layouts.write_bfm_h5,
        "m.pkl": layouts.write_flame_pickle,
        "m.bin": layouts.write_eos,
    }
    for name, write in writers.items():
        path = tmp_path / name
        write(path, source)
        path.with_name(name + ".landmarks.json").write_text("[]")  # ends each load before the costly part
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
        for _ in range(25):
            damaged = data.copy()
            damaged[rng.integers(0, min(len(data), 2000), 3)] = rng.integers(0, 256, 3)
            path.write_bytes(damaged.tobytes())
            with pytest.raises(InputError):
                MorphableModel.load(path)


def test_missing_file_and_unknown_kind(tmp_path):
    with refused("no such model; expected builtin, builtin:coarse or an existing file"):
        MorphableModel.load(tmp_path / "nothing.npz")
    (tmp_path / "m").write_bytes(b"x")
    with refused("kind 'smpl' is unknown, expected one of mifit"):
        MorphableModel.load(tmp_path / "m", kind="smpl")
    with refused("a folder without generic_neutral_mesh.obj"):
        MorphableModel.load(tmp_path)


def test_landmark_file_beside_is_checked(tmp_path, source):
    layouts.write_eos(tmp_path / "m.bin", source)
    for content, message in (
        ("[1, 2]", "68 vertex indices"),
        ("{", "not readable as JSON"),
        (str([10**6] * 68), "68 indices"),
    ):
        (tmp_path / "m.bin.landmarks.json").write_text(content)
        with refused(message):
            MorphableModel.load(tmp_path / "m.bin")
