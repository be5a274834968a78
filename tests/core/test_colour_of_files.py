"""What the header of an image file says of its colours: heeded, or refused in words."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from mifit.core.image import encode_png, read_environment, read_image, write_image
from mifit.errors import InputError

ACES = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)


def write_exr(path: Path, planes: dict[str, np.ndarray], **header: object) -> Path:
    channels = {name: plane.astype(np.float32) for name, plane in planes.items()}
    fields = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(fields, channels) as file:
        file.write(str(path))
    return path


def flat(*colour: float) -> dict[str, np.ndarray]:
    return {name: np.full((16, 32), value) for name, value in zip("RGB", colour, strict=True)}


def test_other_primaries_of_an_exr_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "e.exr"
    plain = read_image(write_exr(path, flat(0.5, 0.4, 0.3)))[0, 0]
    np.testing.assert_array_equal(plain, np.float32([0.5, 0.4, 0.3]))
    same = read_image(write_exr(path, flat(0.5, 0.4, 0.3), chromaticities=REC_709))[0, 0]
    np.testing.assert_array_equal(same, plain)
    for primaries in (ACES, REC_2020, (0.0,) * 8, (0.3,) * 8, (np.nan,) * 8):
        with pytest.raises(InputError, match=r"e\.exr: found chromaticities .*; convert it to linear Rec\. 709"):
            read_image(write_exr(path, flat(1, 1, 1), chromaticities=primaries))


@pytest.mark.parametrize("names", [("Y", "RY", "BY"), ("X", "Y", "Z")])
def test_channels_that_are_no_rgb_are_refused(tmp_path: Path, names: tuple[str, ...]) -> None:
    planes = {name: np.ones((16, 32)) for name in names}
    with pytest.raises(InputError, match=r"found channels .*expected R, G, B or Y alone"):
        read_image(write_exr(tmp_path / "e.exr", planes))


def radiance(path: Path, header: str) -> Path:
    pixels = np.tile(np.uint8([128, 64, 32, 129]), 16 * 32)  # 1, 0.5, 0.25
    path.write_bytes(f"#?RADIANCE\n{header}\n-Y 16 +X 32\n".encode() + pixels.tobytes())
    return path


def test_exposure_of_a_radiance_file_is_undone(tmp_path: Path) -> None:
    path, rgbe = tmp_path / "e.hdr", "FORMAT=32-bit_rle_rgbe\n"
    plain = read_image(radiance(path, rgbe))[0, 0]
    np.testing.assert_allclose(plain, [1.0, 0.5, 0.25], rtol=0.02)
    np.testing.assert_allclose(read_image(radiance(path, rgbe + "EXPOSURE=2\nEXPOSURE= 4.0\n"))[0, 0], plain / 8)
    corrected = read_image(radiance(path, rgbe + "COLORCORR=1 2 4\n"))[0, 0]
    np.testing.assert_allclose(corrected, plain / np.float32([1, 2, 4]))
    bad = [rgbe + f"EXPOSURE={value}\n" for value in ("0", "nan", "-1", "x", "1e300", "")]
    for header in ("FORMAT=32-bit_rle_xyze\n", *bad):
        with pytest.raises(InputError, match=r"e\.hdr: "):
            read_image(radiance(path, header))


def test_other_primaries_of_a_radiance_file_are_refused(tmp_path: Path) -> None:
    path, rgbe = tmp_path / "e.hdr", "FORMAT=32-bit_rle_rgbe\n"
    plain = read_image(radiance(path, rgbe))[0, 0]
    same = read_image(radiance(path, rgbe + f"PRIMARIES={' '.join(map(str, REC_709))}\n"))[0, 0]
    np.testing.assert_array_equal(same, plain)
    none = read_image(radiance(path, rgbe + "PRIMARIES=0 0 0 0 0 0 0 0\n"))[0, 0]
    np.testing.assert_array_equal(none, plain)
    wide = " ".join(map(str, REC_2020))
    for value in (wide, "0.3 0.3 0.3 0.3 0.3 0.3 0.3 0.3", "0.64 0.33", "x", "nan " * 8, ""):
        with pytest.raises(InputError, match=r"e\.hdr: "):
            read_image(radiance(path, rgbe + f"PRIMARIES={value}\n"))


@pytest.mark.parametrize("bits", [8, 16])
def test_another_gamma_of_a_png_is_refused(tmp_path: Path, bits: int) -> None:
    import cv2

    path = tmp_path / "e.png"
    codes = np.full((4, 4, 3), 128, np.uint8) if bits == 8 else np.full((4, 4, 3), 257 * 128, np.uint16)
    data = encode_png(codes) if bits == 8 else cv2.imencode(".png", codes)[1].tobytes()

    def stored(gamma: int | None, srgb: bool = False) -> float:
        chunks = b""
        for name, content in ((b"gAMA", struct.pack(">I", gamma or 0)), (b"sRGB", b"\0")):
            if (gamma is not None) if name == b"gAMA" else srgb:
                chunks += struct.pack(">I", len(content)) + name + content
                chunks += struct.pack(">I", zlib.crc32(name + content))
        path.write_bytes(data[:33] + chunks + data[33:])
        return float(read_image(path)[0, 0, 0])

    coded = stored(None)
    assert coded == pytest.approx(0.2159, abs=1e-3)
    assert stored(45455) == coded and stored(100000, srgb=True) == coded
    for gamma in (0, 55556, 100000, 2**31 - 1):
        with pytest.raises(InputError, match=r"e\.png: found gamma"):
            stored(gamma)


def test_environments_are_lat_long_and_measured(tmp_path: Path) -> None:
    from mifit import SHLighting

    write_image(tmp_path / "square.hdr", np.ones((16, 16, 3)))
    write_image(tmp_path / "e.png", np.ones((16, 32, 3)))
    for name, message in (("square.hdr", "twice as wide as high"), ("e.png", "8 bits per channel")):
        for read in (read_environment, SHLighting.from_envmap):
            with pytest.raises(InputError, match=message):
                read(tmp_path / name)
