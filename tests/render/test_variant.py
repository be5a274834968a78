from __future__ import annotations

import os
import subprocess
import sys

import pytest

from mifit.errors import VariantError
from mifit.render import variant as module


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/opt/homebrew/Cellar/llvm/20.1.2/lib/libLLVM.dylib", 20),
        ("/opt/homebrew/opt/llvm@18/lib/libLLVM.dylib", 18),
        ("libLLVM.so", None),
    ],
)
def test_the_version_is_read_from_a_name(path: str, version: int | None) -> None:
    assert module._version_of_name(path) == version


def test_an_unknown_variant_is_refused(variant: str) -> None:
    with pytest.raises(VariantError, match=r"found 'cuda_ad_xyz', expected auto or one of .*llvm_ad_rgb"):
        module.set_variant("cuda_ad_xyz")


def test_a_library_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so"))
    llvm = module.check_llvm()
    assert "can't be loaded" in llvm.error and str(tmp_path) in llvm.error
    with pytest.raises(VariantError, match="DRJIT_LIBLLVM_PATH names"):
        module.set_variant("llvm_ad_rgb")


def test_no_library_at_all_gives_the_command_that_installs_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(module, "find_llvm", list)
    monkeypatch.setattr(module, "_usable", lambda llvm: module.Llvm(llvm.path, None, "can't be loaded"))
    assert module.install_hint() in module.check_llvm().error
    assert "19" in module.install_hint() or "brew" in module.install_hint()


def test_the_newest_that_works_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "")
    candidates = [module.Llvm("b", 21), module.Llvm("a", 19), module.Llvm("c", 15)]
    monkeypatch.setattr(module, "find_llvm", lambda: candidates)
    broken = module.Llvm("b", 21, "can't be loaded")
    monkeypatch.setattr(module, "_usable", lambda llvm: broken if llvm.path == "b" else llvm)
    assert module.check_llvm().path == "a"
    assert os.environ["DRJIT_LIBLLVM_PATH"] == "a"


def test_an_old_llvm_is_refused_without_an_abort(variant: str) -> None:
    old = [llvm for llvm in module.find_llvm() if llvm.version and llvm.version <= 16]
    if not old:
        pytest.skip("no LLVM 16 or older on this machine")
    program = "import mifit\ntry: mifit.set_variant('llvm_ad_rgb')\nexcept mifit.VariantError as error: print(error)\n"
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": old[0].path}
    result = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert f"LLVM {old[0].version}, version 19 or newer is needed" in result.stdout


def test_doctor_reports_what_works(variant: str) -> None:
    checks = {check["check"]: check for check in module.doctor()}
    assert checks["llvm"]["ok"] and checks["mitsuba"]["ok"]
    assert all(check["fix"] for check in checks.values() if not check["ok"])


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs sched_setaffinity")
def test_one_processor_is_enough(tmp_path):
    """Mitsuba waits for ever for a second thread when it writes EXR; `mifit.set_variant` sees to one."""
    code = (
        "import os, sys; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "import mifit, numpy as np; mifit.set_variant('llvm_ad_rgb')\n"
        "import mitsuba as mi; mi.Bitmap(np.ones((64, 64, 3), np.float32)).write(sys.argv[1])\n"
        "assert np.allclose(np.array(mi.Bitmap(sys.argv[1])), 1)"
    )
    path = tmp_path / "x.exr"
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, timeout=60, check=False)
    assert done.returncode == 0 and path.stat().st_size > 0, done.stderr
