"""A public model is fetched when asked for, checked, converted once, and then found by ``auto``."""

from __future__ import annotations

import hashlib
import json
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from mifit.cli import main
from mifit.errors import InputError, MifitError
from mifit.extras import fetch_model
from mifit.morphable import MorphableModel
from mifit.morphable.formats.ict import load_ict_folder

EXPRESSIONS = ("browInnerUp_L", "jawOpen")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments) -> None:
        pass


@pytest.fixture
def site(shared: Path, tmp_path: Path, monkeypatch):
    """Address and folder of a small copy of the model on a server of this machine, whose digest is expected."""
    folder = tmp_path / "site"
    folder.mkdir()
    sample = shared / "models" / "ict_facekit" / "FaceXModel_sample"
    for name in ("generic_neutral_mesh", "identity000", "identity001", *EXPRESSIONS):
        (folder / f"{name}.obj").symlink_to(sample / f"{name}.obj")
    index = json.loads((sample / "vertex_indices.json").read_text()) | {"expressions": list(EXPRESSIONS)}
    (folder / "vertex_indices.json").write_text(json.dumps(index))
    monkeypatch.setattr(fetch_model, "IDENTITIES", 2)
    digest = hashlib.sha256()
    for name in fetch_model.wanted((folder / "vertex_indices.json").read_bytes()):
        digest.update(f"{name} {hashlib.sha256((folder / name).read_bytes()).hexdigest()}\n".encode())
    monkeypatch.setattr(fetch_model, "DIGEST", digest.hexdigest())
    monkeypatch.setenv("MIFIT_CACHE", str(tmp_path / "cache"))
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}", folder
    server.shutdown()
    server.server_close()


def test_a_fetched_model_is_what_auto_is(site, tmp_path: Path, capsys) -> None:
    address, folder = site
    assert MorphableModel.load("auto").source == "builtin"
    assert main(["model", "fetch", "ict", "--from", address, "--quiet"]) == 0
    assert "--model auto, the default, takes it" in capsys.readouterr().out
    files = [p.relative_to(tmp_path / "cache").as_posix() for p in (tmp_path / "cache").rglob("*") if p.is_file()]
    assert [name for name in files if "builtin" not in name] == ["models/ict.npz"]
    model, original = MorphableModel.load("auto"), load_ict_folder(folder)
    assert model.source == str(tmp_path / "cache" / "models" / "ict.npz")
    assert model.digest == original.digest
    np.testing.assert_array_equal(model.expression, original.expression)


def test_files_that_are_there_are_not_fetched_and_others_are_refused(site, tmp_path: Path) -> None:
    address, folder = site
    copied = tmp_path / "cache" / "models" / "FaceXModel"
    copied.mkdir(parents=True)
    for file in folder.iterdir():
        (copied / file.name).write_bytes(file.read_bytes())
        file.unlink()
    (copied / "jawOpen.obj").write_text("v 0 0 0\n")
    with pytest.raises(MifitError, match=r"digest .*, expected .* changed or damaged, and are removed"):
        fetch_model.fetch_ict(address)
    assert not list((tmp_path / "cache" / "models").iterdir())
    with pytest.raises(MifitError) as caught:
        fetch_model.fetch_ict(address)
    text = str(caught.value)
    assert "\n" not in text and "File not found" in text and f"to {copied}, and run this again" in text


@pytest.mark.parametrize("address", ["http://example.org/FaceXModel", "ftp://127.0.0.1/x", "/somewhere", ""])
def test_only_safe_addresses_are_asked(address: str) -> None:
    with pytest.raises(InputError, match="expected an https address"):
        fetch_model.fetch_ict(address)
