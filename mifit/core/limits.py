"""How large an input may be: every bound on files, counts and sizes, in one place.

A message that refuses something larger names the bound. All are far above what an honest capture, model or
experiment needs; they keep a damaged or hostile file from taking the machine's memory or time.
"""

from __future__ import annotations

import numpy as np

MAX_PIXELS = 2**26
"""Largest image that is decoded or rendered: 8192 x 8192."""
MAX_FILE_BYTES = 2**30
"""One image, mesh or mask: a 64 megapixel EXR of four uncompressed float channels."""
MAX_MODEL_BYTES = 2**32
"""A model file, and what it may unpack to: no model that exists is larger."""
MAX_DOCUMENT_BYTES = 2**26
"""``transforms.json``, ``result.json``, COLMAP and other text with an entry per image."""
MAX_SETTINGS_BYTES = 2**20
"""A configuration, an experiment, a calibration, the landmarks of one image: kilobytes, all of them."""
MAX_UNPACKING, UNPACKING_SLACK = 100, 2**24
"""A packed file may hold at most this many times its size, and this much more: arrays of floats pack far less."""
MAX_COUNT = 10**5
"""Timesteps, frames, runs, or samples per pixel."""
MAX_NUMBER = 1e9
"""Magnitude of lengths, coefficients, colours and angles in files and options: what is larger is damage."""
MAX_LANDMARK_NOISE = 1000.0
"""Standard deviation of a landmark, pixels."""
MAX_LIGHTS = 16
"""Compact lights of one result: each is traced to every point that is shown."""
MAX_NAME_BYTES = 100
"""A file name made from text (`mifit.core.files.file_name`)."""
MAX_SEED = int(np.iinfo(np.int32).max)
"""What both NumPy and Mitsuba take."""
