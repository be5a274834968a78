"""Where the built-in model is kept once it is made: in memory, and in the user's cache folder."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

from mifit.core.files import cache_folder
from mifit.errors import InputError
from mifit.morphable.builtin.head import make_head
from mifit.morphable.formats.own import load_own, save_model
from mifit.morphable.model import MorphableModel


@cache
def builtin_model(coarse: bool = False) -> MorphableModel:
    """Return the built-in model, made now, read from the cache folder, or still in memory.

    Parameters
    ----------
    coarse : bool
        About 8 000 instead of 31 000 vertices.
    """
    path = cache_folder() / f"builtin-{'coarse' if coarse else 'full'}-{_DIGEST}.npz"
    if path.is_file():
        try:
            model = load_own(path)
        except InputError:
            pass  # damaged: make it anew and replace it
        else:
            with contextlib.suppress(OSError):
                os.utime(path)
            return model
    model = replace(make_head(coarse), fingerprint=path.stem)
    try:
        for other in path.parent.glob(f"{path.name.rsplit('-', 1)[0]}-*.npz"):
            if time.time() - other.stat().st_mtime > 30 * 86400:  # of other versions, unused for a month
                other.unlink(missing_ok=True)
        save_model(model, path)
    except (OSError, InputError):
        pass  # a cache that can't be written only costs time
    return model


def _source_digest() -> str:
    """Digest of the code that makes the model: a cached file is valid for this code only."""
    here = Path(__file__).parent
    files = sorted(
        [
            *here.glob("*.py"),
            *(here.parent / f for f in ("gaussian_process.py", "openings.py", "pigment.py", "topology.py")),
            here.parents[1] / "core" / "mesh.py",
        ]
    )
    h = hashlib.blake2b(digest_size=8)
    for file in files:
        h.update(file.read_bytes())
    return h.hexdigest()


_DIGEST = _source_digest()  # at import, while the files are those that were imported
