"""Image files: what is written comes back, and what is broken is refused in one line."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as Pillow

from mifit.core import process as quiet
from mifit.core.image import (
    linear_to_srgb,
    load_image,
    read_image,
    srgb_to_linear,
    to_8_bit,
    write_image,
)
from mifit.errors import InputError

RNG = np.random.default_rng(3)
COLOUR = RNG.random((20, 30, 3)).astype(np.float32)


def test_srgb_curve_matches_known_values_and_inverts() -> None:
    # IEC 61966-2-1: code 188 of 255 is linear 0.5029
    assert srgb_to_linear(188 / 255) == pytest.approx(0.50289, abs=1e-5)
    assert linear_to_srgb(0.0031308) == pytest.approx(0.04045, abs=1e-5)
    v = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(v)), v, atol=1e-6)


def test_every_8_bit_code_survives_a_round_trip(tmp_path: Path) -> None:
    codes = np.arange(256, dtype=np.uint8).reshape(16, 16)
    write_image(tmp_path / "ramp.png", srgb_to_linear(codes / 255.0))
    np.testing.assert_array_equal(to_8_bit(read_image(tmp_path / "ramp.png"))[..., 1], codes)


@pytest.mark.parametrize(("suffix", "tolerance"), [(".png", 0.005), (".exr", 0.0), (".hdr", 0.005)])
def test_colour_round_trip(tmp_path: Path, suffix: str, tolerance: float) -> None:
    path = tmp_path / "ein bild é" / f"x{suffix}"
    write_image(path, COLOUR)
    found = read_image(path)
    assert found.dtype == np.float32
    assert found.shape == COLOUR.shape
    assert np.abs(found - COLOUR).max() <= tolerance
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no temporary file stays behind


@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_alpha_is_kept_and_not_gamma_coded(tmp_path: Path, suffix: str) -> None:
    alpha = np.linspace(0, 1, 600, dtype=np.float32).reshape(20, 30)
    write_image(tmp_path / f"a{suffix}", np.dstack([COLOUR, alpha]))
    found = load_image(tmp_path / f"a{suffix}")
    assert found.alpha is not None
    assert np.abs(found.alpha - alpha).max() <= 0.5 / 255 + 1e-6


def test_exr_keeps_values_beyond_one_and_grey_maps(tmp_path: Path) -> None:
    write_image(tmp_path / "grey.exr", 7.5 * COLOUR[..., 0])
    found = load_image(tmp_path / "grey.exr")
    np.testing.assert_array_equal(found.pixels, np.repeat(7.5 * COLOUR[..., :1], 3, axis=2))
    assert found.bits == 32
    assert not found.clipped.any()


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_16_bits_are_read_in_full(tmp_path: Path, suffix: str) -> None:
    codes = RNG.integers(0, 65536, (20, 30, 3)).astype(np.uint16)
    codes[3, 4] = (65535, 10, 20)
    cv2.imwrite(str(tmp_path / f"deep{suffix}"), codes[..., ::-1])
    found = load_image(tmp_path / f"deep{suffix}")
    assert found.bits == 16
    np.testing.assert_allclose(found.pixels, srgb_to_linear(codes / 65535.0), atol=1e-6)
    assert found.clipped[3, 4]
    np.testing.assert_array_equal(found.clipped, (codes == 65535).any(axis=2))


@pytest.mark.parametrize("mode", ["L", "LA", "P", "1", "RGBA"])
def test_grey_indexed_and_alpha_modes_become_three_channels(tmp_path: Path, mode: str) -> None:
    picture = Pillow.fromarray(to_8_bit(COLOUR)).convert("L" if mode in ("L", "LA", "1") else "RGB").convert(mode)
    picture.save(tmp_path / "m.png")
    found = load_image(tmp_path / "m.png")
    assert found.pixels.shape == (20, 30, 3)
    assert (found.alpha is not None) == (mode in ("LA", "RGBA"))
    expected = srgb_to_linear(np.asarray(picture.convert("RGB")) / 255.0)
    np.testing.assert_allclose(found.pixels, expected, atol=1e-6)


def test_8_bit_clipping_marks_the_top_code_only(tmp_path: Path) -> None:
    codes = np.full((16, 16, 3), 254, dtype=np.uint8)
    codes[2, 5, 1] = 255
    Pillow.fromarray(codes).save(tmp_path / "c.png")
    assert np.argwhere(load_image(tmp_path / "c.png").clipped).tolist() == [[2, 5]]


def test_orientation_tag_is_not_applied(tmp_path: Path) -> None:
    picture = Pillow.fromarray(to_8_bit(COLOUR))
    exif = picture.getexif()
    exif[0x0112] = 6
    picture.save(tmp_path / "turned.jpg", exif=exif)
    assert read_image(tmp_path / "turned.jpg").shape == (20, 30, 3)


def _png_claiming(width: int, height: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(b"\0" * 1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


def test_a_header_that_claims_100_megapixels_is_refused_before_decoding(tmp_path: Path) -> None:
    (tmp_path / "bomb.png").write_bytes(_png_claiming(10000, 10000))
    with pytest.raises(InputError, match=r"bomb.png: the header claims 10000 x 10000 pixels, expected at most 67"):
        read_image(tmp_path / "bomb.png")
    hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 20000 +X 40000\n"
    (tmp_path / "bomb.hdr").write_bytes(hdr)
    with pytest.raises(InputError, match=r"claims 40000 x 20000"):
        read_image(tmp_path / "bomb.hdr")
    (tmp_path / "huge.png").write_bytes(_png_claiming(60000, 60000))
    with pytest.raises(InputError, match=r"huge.png"):
        read_image(tmp_path / "huge.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr", ".hdr"])
@pytest.mark.parametrize("part", [0.0, 0.02, 0.5, 0.9])
def test_truncated_files_are_refused_in_one_line(
    tmp_path: Path, suffix: str, part: float, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"cut{suffix}"
    write_image(path, RNG.random((64, 64, 3)))
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    monkeypatch.setattr(quiet, "_around", quiet.no_chatter)  # as the command line does
    with pytest.raises(InputError, match=f"cut{suffix}") as caught:
        read_image(path)
    assert "\n" not in str(caught.value)
    assert "".join(capfd.readouterr()) == ""  # the decoders' own complaints are kept off the terminal


def test_other_refusals_name_the_file_and_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing.png: no such image file"):
        read_image(tmp_path / "nothing.png")
    (tmp_path / "text.png").write_text("hello there")
    with pytest.raises(InputError, match=r"starts with b'hello th', expected a PNG"):
        read_image(tmp_path / "text.png")
    Pillow.new("CMYK", (20, 20)).save(tmp_path / "ink.jpg")
    with pytest.raises(InputError, match=r"ink.jpg: found a CMYK image, expected RGB; convert it"):
        read_image(tmp_path / "ink.jpg")
    with pytest.raises(InputError, match=r"expected \(H, W\)"):
        write_image(tmp_path / "x.png", np.zeros((4, 4, 2)))
    with pytest.raises(InputError, match=r"found suffix '.bmp'"):
        write_image(tmp_path / "x.bmp", COLOUR)
    with pytest.raises(InputError, match=r"alpha"):
        write_image(tmp_path / "x.hdr", np.zeros((4, 4, 4)))


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kept.png"
    write_image(path, COLOUR)
    before = path.read_bytes()

    def fail(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device", str(self))

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(InputError, match=r"kept.png: can't be written: No space left on device; what was there"):
        write_image(path, 1 - COLOUR)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["kept.png"]
