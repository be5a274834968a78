"""How large an input may be: every bound on files, counts and sizes, in one place.

A message that refuses something larger names the bound. All are far above what an honest capture, model or
experiment needs; they keep a damaged or hostile file from taking the machine's memory or time.
"""

from __future__ import annotations

from mifit.errors import InputError

MAX_PIXELS = 2**26
"""Largest image that is decoded: 8192 x 8192."""
MAX_RENDERED_PIXELS = 2**24
"""Largest image that is path traced (4096 x 4096): a render holds many numbers per pixel."""
MAX_DECODED_BYTES = 2**31
"""All channels and parts of one decoded image."""
MAX_IMAGE_BYTES = 2**30
"""One image file: a 64 megapixel EXR of four uncompressed float channels."""
MAX_VIDEO_BYTES = 2**40
"""One video file."""
MAX_VIDEO_FRAMES = 10**6
"""Frames of one video, nine hours at 30 per second."""
MAX_DOCUMENT_BYTES = 64 * 2**20
"""``transforms.json``, ``result.json``, COLMAP and other text with an entry per image."""
MAX_SETTINGS_BYTES = 2**20
"""A configuration, an experiment, a calibration, the landmarks of one image: kilobytes, all of them."""
MAX_MODEL_BYTES = 4 * 2**30
"""A model file, and what it may unpack to: no model that exists is larger."""
MAX_TEXT_MODEL_BYTES = 256 * 2**20
"""A mesh in an OBJ file, or an eos model."""
MAX_UNPACKING, UNPACKING_SLACK = 100, 16 * 2**20
"""A packed file may hold at most this many times its size, and this much more: arrays of floats pack far less."""
MAX_TIMESTEPS = 10**5
"""Timesteps of one capture or one option."""
MAX_RUNS = 10**4
"""Runs of one experiment's sweep."""
MAX_SAMPLES = 2**20
"""Samples per pixel."""
MAX_NUMBER = 1e9
"""Magnitude of lengths, coefficients, colours and angles in files and options: what is larger is damage."""
MAX_LANDMARK_NOISE = 1000.0
"""Standard deviation of a landmark, pixels."""
MAX_LIGHTS = 16
"""Compact lights of one result: each is traced to every point that is shown."""
MAX_SEED = 2**31 - 1
"""What both NumPy and Mitsuba take."""
MAX_NAME_BYTES = 100
"""A file name made from text (`mifit.core.files.file_name`)."""


def check_range(where: str, value: float, low: float, high: float) -> None:
    """Refuse a number outside ``low`` to ``high``; ``where`` names the option or argument in the message."""
    if not low <= value <= high:
        raise InputError(f"{where}: found {value}, expected {low} to {high}")
