"""Image files: PNG, JPEG, TIFF, OpenEXR and Radiance HDR, read to linear float32 and written whole or not at all.

8- and 16-bit files hold sRGB-coded values and are decoded to linear Rec. 709, 0..1; floating-point files (EXR, HDR) are
linear already. The exposure of a Radiance file is heeded. A header that names another gamma, other primaries, luminance
and chroma, or XYZ is refused. The first bytes give the kind of a file, not its name. Sizes
are read from the header and checked before a pixel is decoded, so a small file can't claim gigabytes. An orientation
tag is not applied: pixel coordinates of a calibration refer to the pixels as stored.
"""

from __future__ import annotations

import functools
import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mifit.core.files import read_bytes, write_bytes
from mifit.core.limits import MAX_FILE_BYTES, MAX_PIXELS
from mifit.core.process import decoding
from mifit.errors import InputError

if TYPE_CHECKING:
    import PIL.Image

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".hdr")
"""Names that image folders are searched for."""


@dataclass(frozen=True)
class Image:
    """A decoded image file.

    ``pixels`` (H, W, 3) are linear Rec. 709; ``alpha`` (H, W) is coverage 0..1, where the file has it; ``clipped`` (H,
    W) pixels have a channel at the largest code value of an integer format; ``bits`` per channel are 8, 16 or 32.
    """

    pixels: NDArray[np.float32]
    alpha: NDArray[np.float32] | None
    clipped: NDArray[np.bool_]
    bits: int


def srgb_to_linear(values: ArrayLike) -> NDArray:
    """Linear values of sRGB codes 0..1 (IEC 61966-2-1), any shape; float32 stays float32.

    Examples
    --------
    >>> srgb_to_linear([0.0, 0.5, 1.0]).round(3)
    array([0.   , 0.214, 1.   ])
    """
    v = _as_float(values)
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.0) + 0.055) / 1.055) ** 2.4).astype(v.dtype)


def linear_to_srgb(values: ArrayLike) -> NDArray:
    """Codes of linear values in sRGB (IEC 61966-2-1), any shape; values above 1 stay above 1.

    Examples
    --------
    >>> linear_to_srgb([0.0, 0.214, 1.0]).round(3)
    array([0. , 0.5, 1. ])
    """
    v = _as_float(values)
    return np.where(v <= 0.0031308, v * 12.92, 1.055 * np.maximum(v, 0.0) ** (1 / 2.4) - 0.055).astype(v.dtype)


def _as_float(values: ArrayLike) -> NDArray:
    v = np.asarray(values)
    return v if v.dtype in (np.float32, np.float64) else v.astype(np.float64)


def to_8_bit(linear: ArrayLike) -> NDArray[np.uint8]:
    """Linear colour -> 8-bit sRGB codes, clipped to 0..255; NaN becomes 0."""
    coded = np.nan_to_num(linear_to_srgb(linear), nan=0.0)
    return np.asarray(np.clip(coded, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def read_image(path: str | Path) -> NDArray[np.float32]:
    """Linear float32 (H, W, 3) of an image file; see `load_image` for alpha, clipping, bit depth and errors."""
    return load_image(path).pixels


def load_image(path: str | Path) -> Image:
    """Read an image file with its alpha, clipped pixels and bit depth.

    Grey images become three equal channels. CMYK is refused: without its ink profile the colours would be a guess.
    InputError for a file that is missing, not an image, truncated, or larger than `mifit.core.limits.MAX_PIXELS`.
    """
    return decode_image(read_bytes(path, MAX_FILE_BYTES, "image file"), path)


def decode_image(data: bytes, path: str | Path) -> Image:
    """Decode the content of an image file; ``path`` is for messages. See `load_image`."""
    decode = {".exr": _decode_exr, ".hdr": _decode_hdr}.get(image_kind(data, path), _decode_raster)
    try:
        with decoding():
            return decode(data, path)
    except InputError:
        raise
    except (Exception, MemoryError) as error:  # decoders raise all kinds; for the caller they mean one thing
        raise _damaged(path, error) from None


def image_kind(data: bytes, path: str | Path) -> str:
    """Suffix that belongs to an image file's content: ``.png``, ``.jpg``, ``.tif``, ``.exr`` or ``.hdr``."""
    starts = {
        b"\x76\x2f\x31\x01": ".exr",
        b"#?": ".hdr",
        b"\x89PNG\r\n\x1a\n": ".png",
        b"\xff\xd8": ".jpg",
        b"II*\0": ".tif",
        b"MM\0*": ".tif",
    }
    for start, suffix in starts.items():
        if data.startswith(start):
            return suffix
    found = f"a file that starts with {data[:8]!r}" if data else "an empty file"
    raise InputError(f"{path}: found {found}, expected a PNG, JPEG, TIFF, EXR or HDR image")


def _damaged(path: str | Path, error: Exception | None = None) -> InputError:
    text = "" if error is None else f" ({(str(error) or type(error).__name__).splitlines()[0]})"
    return InputError(f"{path}: damaged or truncated image{text}; expected a whole file: export or copy it again")


def _check_size(size: tuple[int, int], path: str | Path) -> None:
    width, height = size
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise InputError(
            f"{path}: the header claims {width} x {height} pixels, expected at most {MAX_PIXELS // 10**6} megapixels; "
            "scale the image down"
        )


def _open_raster(data: bytes) -> PIL.Image.Image:
    from PIL import Image as Pillow
    from PIL import UnidentifiedImageError

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns of large images; we check the size ourselves
        try:
            return Pillow.open(io.BytesIO(data), formats=("PNG", "JPEG", "TIFF"))
        except UnidentifiedImageError:  # its text names a memory address
            raise ValueError("header not understood") from None


def _decode_raster(data: bytes, path: str | Path) -> Image:
    """PNG, JPEG, TIFF: Pillow decodes 8 bits (it notices truncation), OpenCV 16 bits."""
    with _open_raster(data) as image:
        _check_size(image.size, path)
        if image.mode == "CMYK":
            raise InputError(f"{path}: found a CMYK image, expected RGB; convert it with its ink profile first")
        gamma = None if "srgb" in image.info else image.info.get("gamma")
        if gamma is not None and not abs(gamma - 1 / 2.2) < 0.02:
            raise InputError(f"{path}: found gamma {gamma:g} in the header (gAMA), expected sRGB's; save it as sRGB")
        if _bits(image, data) > 8:
            image.verify()
            return _decode_16_bit(data, path)
        has_alpha = image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
        codes = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    alpha = np.float32(1 / 255) * codes[..., 3] if has_alpha else None
    colour = np.ascontiguousarray(codes[..., :3])
    return Image(_linear(8)[colour], alpha, cv2.inRange(colour, (0, 0, 0), (254, 254, 254)) == 0, 8)


@functools.lru_cache(maxsize=2)
def _linear(bits: int) -> NDArray[np.float32]:
    """Linear value of each sRGB code."""
    return srgb_to_linear(np.arange(2**bits) / (2**bits - 1.0)).astype(np.float32)


def _bits(image: PIL.Image.Image, data: bytes) -> int:
    from PIL.TiffImagePlugin import TiffImageFile

    if image.format == "PNG":
        return data[24]
    if isinstance(image, TiffImageFile):
        return max(image.tag_v2.get(258, (8,)))
    return 8


def _decode_16_bit(data: bytes, path: str | Path) -> Image:
    codes = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if codes is None:
        raise _damaged(path)
    if codes.dtype != np.uint16:
        raise InputError(f"{path}: found {codes.dtype} pixels, expected 8 or 16 bits; save floating point as EXR")
    if codes.ndim == 2:
        codes = codes[..., None]
    channels = codes.shape[2]
    colour = codes[..., 2::-1] if channels >= 3 else np.repeat(codes[..., :1], 3, axis=-1)
    alpha = np.float32(1 / 65535) * codes[..., -1] if channels in (2, 4) else None
    return Image(_linear(16)[colour], alpha, (colour == 65535).any(-1), 16)


def _float_image(colour: NDArray, alpha: NDArray | None) -> Image:
    pixels = np.ascontiguousarray(colour, dtype=np.float32)
    coverage = None if alpha is None else np.ascontiguousarray(alpha, dtype=np.float32)
    return Image(pixels, coverage, np.zeros(pixels.shape[:2], dtype=bool), 32)


def _exr_header(data: bytes) -> tuple[tuple[int, int], int]:
    """(width, height) of the first part and the number of values in all channels of all parts."""
    import OpenEXR

    size, decoded = (0, 0), 0
    with OpenEXR.File(io.BytesIO(data), header_only=True) as file:
        for i, part in enumerate(file.parts):
            low, high = part.header["dataWindow"]
            width, height = (np.asarray(high, dtype=np.int64) - np.asarray(low, dtype=np.int64) + 1).tolist()
            decoded += max(width, 0) * max(height, 0) * len(part.header["channels"])
            size = (width, height) if i == 0 else size
    return size, decoded


def _decode_exr(data: bytes, path: str | Path) -> Image:
    import OpenEXR

    size, decoded = _exr_header(data)
    _check_size(size, path)
    if decoded > 8 * MAX_PIXELS:
        raise InputError(
            f"{path}: the header claims {decoded} values in all channels and parts, expected at most "
            f"{8 * MAX_PIXELS}; save one part with R, G, B and A"
        )
    with OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
        found = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
        primaries = file.header().get("chromaticities")
    names = next((n for n in (("R", "G", "B"), ("Y", "Y", "Y")) if set(n) <= set(found)), None)
    if names is None or (names[0] == "Y" and {"RY", "BY", "X", "Z"} & set(found)):
        raise InputError(f"{path}: found channels {', '.join(sorted(found))[:80]}, expected R, G, B or Y alone")
    if any(found[name].shape != size[::-1] for name in names):
        raise InputError(f"{path}: found channels of different resolutions, expected one; save them at full size")
    colour = np.stack([found[name] for name in names], axis=-1)
    if names[0] == "R" and primaries is not None:
        _check_primaries(np.ravel(primaries), path)
    return _float_image(colour, found.get("A"))


def _check_primaries(found: NDArray, path: str | Path) -> None:
    """Refuse colours of other primaries or another white than those of Rec. 709, given as x, y of each."""
    rec_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
    if found.shape != (8,) or not np.allclose(found, rec_709, atol=2e-3):
        raise InputError(
            f"{path}: found chromaticities {np.round(found, 4).tolist()}, expected those of Rec. 709, "
            f"{list(rec_709)}; convert it to linear Rec. 709"
        )


def _hdr_header(data: bytes) -> tuple[tuple[int, int], int]:
    """(width, height) and where the pixels start: the line behind the first blank one gives the resolution."""
    blank = data.find(b"\n\n", 0, 65536)
    match = re.compile(rb"-Y (\d{1,9}) \+X (\d{1,9})\n").match(data, blank + 2) if blank > 0 else None
    if match is None:
        raise ValueError("no resolution line '-Y height +X width' behind the header's blank line")
    return (int(match[2]), int(match[1])), match.end()


def _decode_hdr(data: bytes, path: str | Path) -> Image:
    (width, height), start = _hdr_header(data)
    _check_size((width, height), path)
    if width * height > (len(data) - start) * 16:  # a run of 127 values of four channels takes two bytes
        raise _damaged(path)
    factor = np.ones(3)
    for line in data[:start].decode("latin-1").splitlines():
        key, _, value = line.partition("=")
        if key == "FORMAT" and value.strip() != "32-bit_rle_rgbe":
            raise InputError(f"{path}: found FORMAT={value.strip()[:40]}, expected 32-bit_rle_rgbe; save it as RGB")
        if key in ("EXPOSURE", "COLORCORR"):  # what the pixels were multiplied by; of several lines the product
            factor = factor * np.array(value.split(), dtype=np.float64)
        if key == "PRIMARIES" and value.split() != ["0"] * 8:  # which Photoshop writes for none
            _check_primaries(np.array(value.split(), dtype=np.float64), path)
    if not ((factor >= 1e-9) & (factor <= 1e9)).all():
        raise InputError(f"{path}: found an exposure of {factor.tolist()}, expected positive numbers within 1e9")
    # OpenCV gets a header of ours: it can't find another resolution than the one that was checked
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    pixels = cv2.imdecode(np.frombuffer(head + data[start:], np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.shape != (height, width, 3):
        raise _damaged(path)
    return _float_image(pixels[..., ::-1] / factor.astype(np.float32), None)


def read_environment(path: str | Path) -> NDArray[np.float32]:
    """A lat-long environment (H, 2 H, 3) of linear radiance; InputError as of `check_environment`, or for 8 bits."""
    image = load_image(path)
    if image.bits < 32:
        raise InputError(
            f"{path}: found {image.bits} bits per channel, which cut lamps off; expected a measured environment, "
            ".hdr or .exr"
        )
    return check_environment(path, image.pixels)


def check_environment(name: str | Path, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image, where it is a lat-long one: twice as wide as high, finite, from 0 up and not black."""
    if image.ndim != 3 or image.shape[2] != 3 or image.shape[0] < 8 or image.shape[1] != 2 * image.shape[0]:
        raise InputError(
            f"{name}: found an image of shape {image.shape}, expected a lat-long one twice as wide as high (H, 2 H, 3)"
        )
    if not np.isfinite(image).all() or image.min() < 0 or image.max() <= 0:
        raise InputError(f"{name}: found radiance {image.min():g} to {image.max():g}, expected finite values from 0 up")
    return image


def reduced(environment: NDArray, rows: int = 512) -> NDArray[np.float32]:
    """A lat-long image of at most so many rows: finer light makes no difference on skin."""
    height, width = environment.shape[:2]
    if height > rows:
        environment = cv2.resize(environment, (round(width * rows / height), rows), interpolation=cv2.INTER_AREA)
    return np.asarray(environment, np.float32)


def write_image(path: str | Path, linear: ArrayLike) -> None:
    """Write linear colour, (H, W), (H, W, 1), (H, W, 3) or with alpha (H, W, 4), to a file, whole or not at all.

    ``.png`` is 8-bit sRGB (alpha as it is), ``.jpg`` likewise at quality 95, ``.exr`` linear float32, ``.hdr`` linear
    RGBE; missing folders are made. InputError for another shape or suffix, or alpha in a format without it.
    """
    pixels = np.asarray(linear, dtype=np.float32)
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (3, 4))) or 0 in pixels.shape:
        raise InputError(f"{path}: found an array of shape {pixels.shape}, expected (H, W), (H, W, 3) or (H, W, 4)")
    suffix = Path(path).suffix.lower()
    if suffix == ".exr":
        data = _encode_exr(pixels)
    elif suffix in (".png", ".jpg", ".jpeg", ".hdr"):
        if suffix != ".png" and pixels.ndim == 3 and pixels.shape[2] == 4:
            raise InputError(f"{path}: found an image with alpha, which {suffix} can't hold; write .png or .exr")
        data = _encode_opencv(suffix, pixels)
    else:
        raise InputError(f"{path}: found suffix {suffix!r}, expected .png, .jpg, .exr or .hdr")
    write_bytes(path, data)


def encode_png(codes: NDArray[np.uint8]) -> bytes:
    """8-bit sRGB codes, (H, W) grey, (H, W, 3) RGB or (H, W, 4) RGBA -> bytes of a PNG file."""
    if codes.ndim == 3:
        codes = codes[..., [2, 1, 0, 3][: codes.shape[2]]]
    return cv2.imencode(".png", np.ascontiguousarray(codes))[1].tobytes()


def _encode_opencv(suffix: str, pixels: NDArray[np.float32]) -> bytes:
    if suffix == ".hdr":
        rgb = np.repeat(pixels[..., None], 3, axis=-1) if pixels.ndim == 2 else pixels
        return cv2.imencode(".hdr", np.ascontiguousarray(rgb[..., ::-1]))[1].tobytes()
    codes = to_8_bit(pixels)
    if pixels.ndim == 3 and pixels.shape[2] == 4:  # alpha is coverage, not light: no transfer curve
        alpha = np.clip(np.nan_to_num(pixels[..., 3]), 0.0, 1.0)
        codes[..., 3] = (alpha * 255.0 + 0.5).astype(np.uint8)
    if suffix == ".png":
        return encode_png(codes)
    bgr = codes if codes.ndim == 2 else np.ascontiguousarray(codes[..., ::-1])
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def _encode_exr(pixels: NDArray[np.float32]) -> bytes:
    import OpenEXR

    names = "Y" if pixels.ndim == 2 else "RGBA"[: pixels.shape[2]]
    planes = pixels[..., None] if pixels.ndim == 2 else pixels
    channels = {name: np.ascontiguousarray(planes[..., i]) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    with OpenEXR.File(header, channels) as file:
        file.write(stream)
    return stream.getvalue()


def box(mask: NDArray[np.bool_], margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns around the pixels of a mask (H, W), with a margin; all of them around an empty mask."""
    ends = []
    for axis, size in enumerate(mask.shape):
        inside = np.flatnonzero(mask.any(axis=1 - axis))
        first, last = (int(inside[0]), int(inside[-1])) if len(inside) else (0, size - 1)
        ends.append(slice(max(first - margin, 0), min(last + margin + 1, size)))
    return ends[0], ends[1]
