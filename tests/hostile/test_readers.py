"""Inputs made to harm: each is refused in one line, soon and without much memory."""

from __future__ import annotations

import json
import os
import pickle
import time
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import OpenEXR
import pytest

from mifit.capture import Capture
from mifit.capture.stereo import read_stereo
from mifit.cli import main
from mifit.core.image import load_image, write_image
from mifit.errors import InputError
from mifit.morphable import MorphableModel
from tests.refused import refused

SIZES = ((40, 30), (40, 30))


# -- pickles --------------------------------------------------------------------------------------------------------


def pickled(path: Path, stream: bytes) -> Path:
    path.write_bytes(stream)
    return path


def test_an_array_type_is_no_function(tmp_path: Path) -> None:
    """``numpy.ndarray((1,), "f8", buffer, offset, strides)`` builds arrays over memory that isn't theirs."""
    path = pickled(tmp_path / "m.pkl", b"\x80\x02}X\x01\x00\x00\x00fcnumpy\nndarray\n(K\x02\x85X\x02\x00\x00\x00f8tRs.")
    refused(MorphableModel.load, path, match=r"wants to run numpy\.ndarray")


def test_an_array_over_somebody_elses_memory(tmp_path: Path) -> None:
    shape = b"\x8a\x05\x00\x00\x00\x00\x02\x85"  # 2**33 values in no bytes
    array = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR"
    dtype = b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    path = pickled(tmp_path / "m.pkl", b"\x80\x02}U\x01f" + array + b"(K\x01" + shape + dtype + b"\x89U\x00tbs.")
    refused(MorphableModel.load, path, match="claims shape")


@pytest.mark.parametrize("how", ["collisions", "nested"])
def test_keys_that_take_for_ever_to_hash(tmp_path: Path, how: str) -> None:
    if how == "collisions":  # 40 000 integers of one hash value: a dictionary of them takes their square
        content = {i * (2**61 - 1): 0 for i in range(1)}
        body = b"".join(b"\x8a\x0b" + (i * (2**61 - 1)).to_bytes(11, "little") + b"N" for i in range(1, 40_000))
        data = pickle.dumps(content, 2)[:2] + b"}(" + body + b"u."
    else:  # a tuple of itself twice, sixty times over
        data = b"\x80\x02})" + b"".join(b"q%c0h%ch%c\x86" % (i, i, i) for i in range(60)) + b"Ns."
    refused(MorphableModel.load, pickled(tmp_path / "m.pkl", data), match=r"m\.pkl: ")


def test_state_can_be_set_on_arrays_only(tmp_path: Path) -> None:
    path = pickled(tmp_path / "m.pkl", b"\x80\x02ccopy_reg\n_reconstructor\nN}U\x0c__defaults__)s\x86b.")
    refused(MorphableModel.load, path, match="sets the state of a function, which is refused")


def test_arrays_of_protocol_5_are_read(tmp_path: Path) -> None:
    from mifit.morphable.formats.pickles import plain_array, read_pickle

    arrays = {
        "c": np.arange(6.0).reshape(2, 3),
        "fortran": np.asfortranarray(np.arange(6, dtype=">i4").reshape(2, 3)),
        "strided": np.arange(24, dtype="u1").reshape(2, 3, 4).transpose(1, 0, 2),
        "empty": np.zeros((0, 3), "f4"),
    }
    for protocol in range(2, 6):
        path = pickled(tmp_path / "m.pkl", pickle.dumps(arrays, protocol))
        for key, value in read_pickle(path).items():
            np.testing.assert_array_equal(plain_array(value, key), arrays[key])


# -- images ---------------------------------------------------------------------------------------------------------


def test_exr_with_parts_and_channels_beyond_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decoding takes memory for all of them; the bound is lowered here so that the file need not be large."""
    monkeypatch.setattr("mifit.core.image.MAX_PIXELS", 113)
    flat = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for parts, channels in ((1, "RGBA"), (1, "RGBACDEFHI"), (4, "RGB")):
        planes = {name: np.zeros((10, 10), np.float32) for name in channels}
        path = tmp_path / "parts.exr"
        OpenEXR.File([OpenEXR.Part({**flat, "name": str(i)}, planes) for i in range(parts)]).write(str(path))
        if parts * len(channels) < 10:
            assert load_image(path).alpha is not None
        else:
            refused(load_image, path, match="values in all channels and parts, expected at most 904")


def test_hdr_with_a_second_resolution_line(tmp_path: Path) -> None:
    """The first one is in a comment; the decoder follows the second."""
    path = tmp_path / "a.hdr"
    path.write_bytes(b"#?RADIANCE\n# \n-Y 4 +X 4\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 30000\n" + bytes(64))
    refused(load_image, path, match="claims 30000 x 30000 pixels")


def test_hdr_smaller_than_its_pixels_can_be_packed(tmp_path: Path) -> None:
    path = tmp_path / "a.hdr"
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8000 +X 8000\n" + bytes(64))
    refused(load_image, path, match="damaged or truncated")


# -- calibrations and models ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "%YAML:1.0\nM1: " + "data: " * 40_000 + "\n",
        "%YAML:1.0\nM1: " + "[" * 5000 + "\n",
        "%YAML:1.0\n" + "- " * 5000 + "1\n",
        "%YAML:1.0\na: &a [1]\nM1: *a\n",
        "%YAML:1.0\n" + "M1:" + "\n" * 200_000 + "x",
        "%YAML:1.0\n" + "data: [" * 30_000,
        "%YAML:1.0\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: " + "[ " * 30_000,
        '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b "c">]><opencv_storage><M1>&b;</M1></opencv_storage>',
        '<?xml version="1.0"?><opencv_storage>' + "<a>" * 30_000,
    ],
    ids=lambda text: text[10:30].replace("\n", " "),
)
def test_calibrations_that_take_for_ever(tmp_path: Path, text: str) -> None:
    path = tmp_path / "s.yml"
    path.write_text(text)
    refused(read_stereo, path, ["a", "b"], SIZES, match=r"s\.yml: ")


def test_h5_scalar_of_a_billion_values(tmp_path: Path) -> None:
    path = tmp_path / "m.h5"
    with h5py.File(path, "w") as f:
        f["shape/model/mean"] = np.zeros(12)
        f.create_dataset("version/majorVersion", shape=(10**9,), dtype="i4", chunks=(10**6,), compression="gzip")
        f["version/minorVersion"] = 9
    refused(MorphableModel.load, path, match=r"majorVersion has shape \(1000000000,\)")


def test_h5_that_points_into_another_file(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(48))
    for name, kind in (("a.h5", "external"), ("b.h5", "link")):
        with h5py.File(tmp_path / name, "w") as f:
            if kind == "external":
                f.create_dataset("shape/model/mean", (12,), "f4", external=[(str(secret), 0, 48)])
            else:
                with h5py.File(tmp_path / "other.h5", "w") as g:
                    g["x"] = np.zeros(12)
                f["shape/model/mean"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "x")
        refused(MorphableModel.load, tmp_path / name, match="lies in another file, which is refused")


# -- what is no file ------------------------------------------------------------------------------------------------


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A capture of one image whose files can be replaced."""
    folder = tmp_path / "capture"
    write_image(folder / "a.png", np.zeros((20, 20, 3)))
    (folder / "l.json").write_text(json.dumps({"points": [[i, i] for i in range(68)]}))
    frame = {"file_path": "a.png", "landmark_path": "l.json", "mask_path": "a.png", "w": 20, "h": 20}
    (folder / "transforms.json").write_text(json.dumps({"frames": [{**frame, "camera_id": "a"}]}))
    return folder


@pytest.mark.parametrize("name", ["a.png", "l.json", "transforms.json"])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "sparse"])
def test_pipes_devices_and_sparse_files_are_not_waited_for(capture: Path, name: str, kind: str) -> None:
    def use() -> None:
        loaded = Capture.load(capture)
        loaded.digest()
        loaded.frame("a", 0)

    use()
    path = capture / name
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        with path.open("wb") as f:
            f.truncate(1 << 42)
    refused(use, match=f"{name}: found .*, expected a ")


def test_model_that_is_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "m.npz")
    refused(MorphableModel.load, tmp_path / "m.npz", match="found a pipe or device, expected a model file")


# -- counts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "x", "--out", "y", "--timesteps", "0-999999999"], "expected at most 100000 timesteps"),
        (["turntable", "x", "--out", "y", "--steps", "1000000000"], "expected a whole number from 1 to 100000"),
        (["synth", "--out", "y", "--seed", "99999999999"], "expected a whole number from 0 to 2147483647"),
        (["synth", "--out", "y", "--width", "20000", "--height", "20000"], "width x height: found 400000000, expected"),
        (["synth", "--out", "y", "--spp", "1000000000"], "expected a whole number from 1 to 100000"),
        (["synth", "--out", "y", "--tone", "nan"], "expected a finite number"),
        (["fit", "", "--out", "y"], "expected a file or folder"),
        (["fit", "x", "--out", ""], "expected a file or folder"),
    ],
)
def test_counts_beyond_all_measure(tmp_path, monkeypatch, capsys, arguments, message) -> None:
    monkeypatch.chdir(tmp_path)
    start = time.process_time()
    try:
        code = main(arguments)
    except SystemExit as stop:
        code = stop.code
    assert code == 2 and time.process_time() - start < 20
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_sweep_of_a_billion_runs(tmp_path: Path, capsys) -> None:
    values = ", ".join(map(str, range(1, 1001)))
    path = tmp_path / "e.toml"
    grid = "".join(f"render.parameters.{name} = [{values}]\n" for name in "abc")
    path.write_text(f'[render]\nscene = "s.xml"\n[sweep.grid]\n{grid}')
    start = time.process_time()
    assert main(["run", str(path), "--out", str(tmp_path / "out")]) == 2
    assert "sweep: found 1000000000 runs, expected at most 100000;" in capsys.readouterr().err
    assert time.process_time() - start < 5


def test_unknown_and_scalar_variants_are_bad_usage(capsys) -> None:
    for name in ("nonsense", "scalar_rgb"):
        assert main(["turntable", "x", "--out", "y", "--variant", name]) == 2
    from mifit.render.variant import set_fitting_variant, set_variant

    with pytest.raises(InputError, match="expected auto or one of llvm_ad_rgb"):
        set_fitting_variant("scalar_rgb")
    with pytest.raises(InputError, match=r"expected auto or one of .*scalar_rgb"):
        set_variant("nonsense")


def test_cameras_without_pixels(tmp_path: Path) -> None:
    from mifit.core.camera import Camera

    for width, fx in ((0, 1.0), (10, 0.0), (10, float("nan"))):
        with pytest.raises(InputError, match=r"camera 'a': .*found"):
            Camera("a", width, 10, fx, 1.0, 5.0, 5.0, np.eye(4))


def test_landmarks_all_in_one_point(capture: Path) -> None:
    (capture / "l.json").write_text(json.dumps({"points": [[9, 9]] * 68}))
    refused(Capture.load(capture).landmarks, "a", 0, match="all 68 visible landmarks within 0 pixels")


def test_standard_error_is_left_alone(capture: Path) -> None:
    """Threads that decode don't take the program's standard error away."""
    from concurrent.futures import ThreadPoolExecutor

    before = os.fstat(2)
    data = cv2.imencode(".hdr", np.ones((50, 50, 3), np.float32))[1].tobytes()
    path = capture / "a.hdr"
    path.write_bytes(data)
    taken = []

    def watch(_: int) -> None:
        load_image(path)
        found = os.fstat(2)
        taken.append((found.st_dev, found.st_ino) != (before.st_dev, before.st_ino))

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(watch, range(400)))
    assert not any(taken)


@pytest.mark.parametrize("corners", ["0 0 0, 1 0 0, 0 1 0, 1 1 0", "0 0 0, 0 0 0, 0 0 0, 0 0 0"], ids=["flat", "point"])
def test_flat_meshes_are_no_heads(tmp_path: Path, capsys, corners: str) -> None:
    lines = [f"v {corner.strip()}" for corner in corners.split(",")]
    (tmp_path / "h.obj").write_text("\n".join([*lines, "vt 0 0", "vt 1 0", "vt 0 1", "f 1/1 2/2 3/3", "f 2/2 4/1 3/3"]))
    write_image(tmp_path / "a.png", np.full((8, 8, 3), 0.5))
    head = ("--head", str(tmp_path / "h.obj"), "--maps", f"albedo={tmp_path / 'a.png'}")
    assert main(["synth", "--out", str(tmp_path / "out"), *head, "--quiet"]) == 2
    assert "flat or without a middle, expected a head" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_flat_model_is_no_face(tmp_path: Path) -> None:
    model = MorphableModel.load("builtin:coarse")
    flat = replace(model, mean=model.mean * np.float32([1.0, 1.0, 0.001]), fingerprint="")
    flat.save(tmp_path / "flat.npz")
    with pytest.raises(InputError, match="in a plane; expected a face"):
        MorphableModel.load(tmp_path / "flat.npz")
