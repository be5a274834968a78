"""The public Digital Emily repository (github.com/hpd/DigitalEmily) as a capture with its measured mesh as truth.

Its pbrt scenes ``maya/renderData/*.NNNN.pbrt`` each hold one camera of the light stage (``LookAt`` and the field of
view across the shorter side), ``maya/images/Emily_2_1_Assemble_pbrt/SIZE/jpg`` the picture that pbrt made of it, and
``maya/renderData/*Emily_head_mesh.ply`` the measured head in centimetres. The repository is MIT licensed.
"""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import numpy as np

from mifit.capture.capture import Capture
from mifit.capture.transforms import Shot, View, write_transforms
from mifit.core.camera import Camera
from mifit.core.files import replacing_folder
from mifit.core.image import load_image
from mifit.errors import InputError

_NUMBER = r"[-+0-9.eE]+"
_LOOK_AT = re.compile(r"^\s*LookAt\s+" + r"\s+".join([f"({_NUMBER})"] * 9), re.MULTILINE)
_FIELD = re.compile(rf'"float fov"\s*\[\s*({_NUMBER})\s*\]')
SCENES = "maya/renderData/*_pbrt.[0-9][0-9][0-9][0-9].pbrt"
IMAGES = "maya/images/Emily_2_1_Assemble_pbrt"
HEAD = "maya/renderData/*Emily_head_mesh.ply"


def import_digital_emily(repository: str | Path, out: str | Path, size: str = "1080x1680") -> Path:
    """Convert a checkout of the repository into a capture folder.

    Cameras are called ``c1`` to ``c7`` after the frames; there is one timestep and no landmarks yet
    (`mifit landmarks` finds them). The mesh becomes ``truth/head.ply``.

    Parameters
    ----------
    repository : path
        The checkout.
    out : path
        Folder to make; it must be missing or empty.
    size : str
        Folder of the pictures: ``1080x1680`` or ``3482x5218``.

    Returns
    -------
    Path
        ``out``; nothing is left there when the import fails.

    Raises
    ------
    InputError
        The folder isn't laid out like the repository, or ``out`` isn't empty.
    """
    repository, out = Path(repository), Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is there already and not empty; name another folder")
    scenes, heads = sorted(repository.glob(SCENES)), sorted(repository.glob(HEAD))
    if not scenes or not heads:
        missing = SCENES if not scenes else HEAD
        raise InputError(f"{repository}: found no {missing}; expected a checkout of github.com/hpd/DigitalEmily")
    with replacing_folder(out) as part:
        views, shots = [], []
        for scene in scenes:
            number = int(scene.suffixes[-2][1:])
            name = f"c{number}"
            source = repository / IMAGES / size / "jpg" / f"{scene.stem}.jpg"
            if not source.exists():
                raise InputError(f"{source}: missing; expected the picture that belongs to {scene.name}")
            height, width = load_image(source).pixels.shape[:2]
            views.append(View.of(read_camera(scene, name, width, height)))
            target = part / "images" / name / "0000.jpg"
            target.parent.mkdir(parents=True)
            shutil.copyfile(source, target)
            shots.append(Shot(name, 0, target))
        (part / "truth").mkdir()
        shutil.copyfile(heads[0], part / "truth" / "head.ply")
        for text in repository.glob("LICENSE*"):
            shutil.copyfile(text, part / text.name)
        write_transforms(part / "transforms.json", views, shots, "cm")
        Capture.load(part)  # nothing is handed over that can't be read back
    return out


def read_camera(path: Path, name: str, width: int, height: int) -> Camera:
    """The perspective camera of a pbrt v3 scene, for a picture of the given size.

    pbrt's field of view, in degrees, spans the shorter side; ``LookAt`` gives eye, target and up in world space.

    Raises
    ------
    InputError
        No ``LookAt`` or no ``"float fov"`` in the file.
    """
    text = path.read_text(encoding="utf-8", errors="replace").split("WorldBegin")[0]
    look, field = _LOOK_AT.search(text), _FIELD.search(text)
    if look is None or field is None:
        raise InputError(f"{path}: found no {'LookAt' if look is None else 'float fov'}, expected a pbrt v3 scene")
    eye, target, up = np.array(list(map(float, look.groups()))).reshape(3, 3)
    ratio = width / min(width, height)
    fov = 2.0 * math.degrees(math.atan(ratio * math.tan(math.radians(0.5 * float(field[1])))))
    return Camera.look_at(eye, target, up, width, height, fov, name)
