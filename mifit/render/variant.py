"""Picks Mitsuba's variant and makes sure of the LLVM behind it before anything is compiled.

Dr.Jit loads libLLVM at run time: the file that ``DRJIT_LIBLLVM_PATH`` names, else ``libLLVM.so`` from the
loader's path, else the newest that it finds in the system's library folders. Old versions load without complaint
and abort the whole process at the first kernel, so the choice is made here, where it can still be an error message.
"""

from __future__ import annotations

import ctypes
import glob
import os
import platform
import re
import sys
from dataclasses import dataclass
from importlib import metadata

from mifit.core.process import OURS, threads
from mifit.errors import UnknownVariantError, VariantError

LLVM_SUPPORTED = 19
"""The first major version that works with this Dr.Jit; older ones may end the process."""

FITTING_VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants that the stages run under; the plugins render under any."""

_ENVIRONMENT = "DRJIT_LIBLLVM_PATH"


@dataclass(frozen=True)
class Llvm:
    """A libLLVM on this machine; ``error`` says why it can't be used, and is empty where it can.

    The major version is None where neither the library nor its name tells it: then it is older than 16.
    """

    path: str
    version: int | None
    error: str = ""


def find_llvm() -> list[Llvm]:
    """The libLLVM files on this machine, newest first by their names; Dr.Jit's own search covers fewer folders."""
    linux = [
        *os.environ.get("LD_LIBRARY_PATH", "").split(":"),
        f"{sys.prefix}/lib",
        f"{os.environ.get('CONDA_PREFIX', sys.prefix)}/lib",
        f"/usr/lib/{platform.machine()}-linux-gnu",
        *("/usr/lib/llvm*/lib", "/usr/lib/llvm/*/lib*", "/usr/lib64", "/usr/lib64/llvm*/lib*", "/usr/lib/wsl/lib"),
        *("/usr/lib", "/usr/local/lib"),
    ]
    patterns = [
        *(f"{folder}/libLLVM*.so*" for folder in linux if folder),
        *(f"{folder}/lib/libLLVM*.dylib" for folder in ("/opt/homebrew/Cellar/llvm*/*", "/opt/homebrew/opt/llvm*")),
        *(f"{folder}/lib/libLLVM*.dylib" for folder in ("/usr/local/Cellar/llvm*/*", sys.prefix)),
        rf"{os.environ.get('ProgramFiles', 'C:')}\LLVM\bin\LLVM-C.dll",
        rf"{sys.prefix}\Library\bin\LLVM-C*.dll",
    ]
    files = {os.path.realpath(path) for pattern in patterns for path in sorted(glob.glob(pattern))}
    found = [Llvm(path, _version_of_name(path)) for path in sorted(files)]
    return sorted(found, key=lambda llvm: -(llvm.version or 0))


def check_llvm() -> Llvm:
    """Decide which libLLVM Dr.Jit shall load and tell it through ``DRJIT_LIBLLVM_PATH``.

    A path that is already in the variable is honoured, whatever else is installed; otherwise the newest library
    that loads and works is taken. Nothing is compiled in this process. The ``error`` of what is returned says what is
    wrong and what mends it when none can be used.
    """
    named = os.environ.get(_ENVIRONMENT)
    if named:
        llvm = _usable(Llvm(named, _version_of_name(os.path.realpath(named))))
        if not llvm.error:
            return llvm
        better = next((c for c in find_llvm() if (c.version or 0) >= LLVM_SUPPORTED), None)
        fix = f"unset it, {better.path} will be used" if better else install_hint()
        return Llvm(llvm.path, llvm.version, f"{_ENVIRONMENT} names {named}: {llvm.error}; {fix}")

    rejected: list[Llvm] = []
    for candidate in [*find_llvm(), Llvm("libLLVM.so", None)]:
        llvm = _usable(candidate)
        if not llvm.error:
            os.environ[_ENVIRONMENT] = llvm.path
            return llvm
        rejected.append(llvm)
    if len(rejected) == 1:
        return Llvm("", None, f"no libLLVM found, version {LLVM_SUPPORTED} or newer is needed; {install_hint()}")
    reasons = "; ".join(f"{llvm.path}: {llvm.error}" for llvm in rejected[:-1])
    return Llvm(rejected[0].path, rejected[0].version, f"{reasons}; {install_hint()}")


def install_hint() -> str:
    """The command that installs a libLLVM that works, for this platform."""
    if sys.platform == "darwin":
        return "install it with: brew install llvm"
    if sys.platform == "win32" or os.environ.get("CONDA_PREFIX"):
        return f"install it with: conda install -c conda-forge 'libllvm{LLVM_SUPPORTED}'"
    return f"install it with: apt-get install libllvm{LLVM_SUPPORTED}"


def set_variant(name: str = "auto") -> str:
    """Name of the Mitsuba variant that is now active; the program calls this once, the library never does.

    ``"auto"`` is ``cuda_ad_rgb`` where CUDA works, else ``llvm_ad_rgb``. VariantError where the variant doesn't exist,
    or the CUDA or LLVM behind it doesn't work; the message names the fix.
    """
    if not isinstance(name, str):
        raise TypeError(f"set_variant: name: found {type(name).__name__}, expected str")
    llvm = check_llvm() if name == "auto" or name.startswith("llvm") else None
    import drjit as dr
    import mitsuba as mi

    if name == "auto":
        name = "cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"
    if name not in mi.variants():
        raise UnknownVariantError(f"variant: found {name!r}, expected auto or one of {', '.join(mi.variants())}")
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise VariantError(f"variant {name}: no working CUDA device or driver here; use llvm_ad_rgb")
    if name.startswith("llvm"):
        assert llvm is not None
        if llvm.error:
            raise VariantError(f"variant {name}: {llvm.error}")
        loaded = dr.detail.llvm_version()[0]
        if not dr.has_backend(dr.JitBackend.LLVM) or loaded < 0:
            raise VariantError(f"variant {name}: Dr.Jit could not load {llvm.path}; {install_hint()}")
        if loaded < LLVM_SUPPORTED:
            # Another package brought its own LLVM into the process before Dr.Jit looked for one.
            raise VariantError(
                f"variant {name}: found LLVM {loaded} loaded already, version {LLVM_SUPPORTED} or newer is needed; "
                f"start a new process, where {llvm.path} will be used"
            )
    mi.set_variant(name)
    # With one thread, as on a machine with one processor, Mitsuba 3.9 waits for ever when it reads or writes EXR.
    if dr.thread_count() < 2 or OURS in os.environ:
        dr.set_thread_count(max(2, threads()))
    return name


def set_fitting_variant(name: str = "auto") -> str:
    """`set_variant` for programs that fit: the stages run under ``*_ad_rgb`` alone, `UnknownVariantError` says so."""
    if name not in ("auto", *FITTING_VARIANTS):
        raise UnknownVariantError(f"variant: found {name!r}, expected auto or one of {', '.join(FITTING_VARIANTS)}")
    return set_variant(name)


def check_active_variant() -> None:
    """Raise VariantError unless the active Mitsuba variant is one that can fit."""
    import mitsuba as mi

    if mi.variant() not in FITTING_VARIANTS:
        raise VariantError(
            f"Mitsuba variant: found {mi.variant()}, expected one of {', '.join(FITTING_VARIANTS)} to be active; "
            "call mifit.set_variant('auto') first"
        )


def doctor() -> list[dict]:
    """What of the set-up works: entries with ``check``, ``ok``, ``required``, ``found`` and ``fix``, a command."""
    checks = [_package("mitsuba", "3.9.1", "3.10"), _package("drjit", "1.5", "1.6")]
    llvm = check_llvm()
    found = "none" if not llvm.path else f"{llvm.path} (LLVM {llvm.version or 'older than 16'})"
    cuda = False
    if all(check["ok"] for check in checks):
        import drjit as dr

        cuda = bool(dr.has_backend(dr.JitBackend.CUDA))
    checks.append(_check("llvm", not llvm.error, found, llvm.error, required=not cuda))
    cuda_fix = "optional: an NVIDIA driver and device; LLVM runs everything without"
    checks.append(_check("cuda", cuda, "works" if cuda else "none", cuda_fix, required=False))
    free, total = _memory_gb()
    if total:
        fix = "close other programs; a fit of 512 x 512 maps needs about 2 GB"
        checks.append(_check("memory", free >= 2.0, f"{free:.1f} GB free of {total:.1f}", fix, required=False))
    for package, purpose in (
        ("OpenEXR", "EXR images"),
        ("cv2", "images and video"),
        ("xatlas", "texture coordinates for models without"),
        ("viser", "the live view"),
    ):
        required = package in ("OpenEXR", "cv2")
        try:
            __import__(package)
            checks.append(_check(package, True, purpose, "", required))
        except ImportError as error:
            name = "opencv-contrib-python-headless" if package == "cv2" else package
            checks.append(_check(package, False, f"{error}", f"pip install {name}", required))
    return checks


def _check(check: str, ok: bool, found: str, fix: str, required: bool) -> dict:
    return {"check": check, "ok": ok, "required": required, "found": found, "fix": "" if ok else fix}


def _package(name: str, low: str, high: str) -> dict:
    """Whether a package's version lies in [low, high)."""

    def numbers(version: str) -> tuple[int, ...]:
        return tuple(int(n) for n in re.findall(r"\d+", version)[:3])

    fix = f"pip install '{name}>={low},<{high}'"
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return _check(name, False, "not installed", fix, required=True)
    return _check(name, numbers(low) <= numbers(version) < numbers(high), version, fix, required=True)


def _memory_gb() -> tuple[float, float]:
    """Free and total memory in GB; zeros where the system doesn't tell."""
    try:
        page = os.sysconf("SC_PAGE_SIZE")
        return (os.sysconf("SC_AVPHYS_PAGES") * page / 1e9, os.sysconf("SC_PHYS_PAGES") * page / 1e9)
    except (AttributeError, ValueError, OSError):
        return (0.0, 0.0)


def _version_of_name(path: str) -> int | None:
    """Major version in names such as libLLVM-15.so.1, libLLVM.so.19.1, llvm@20/20.1.2/lib/libLLVM.dylib."""
    numbers = re.search(r"libLLVM(?:-|\.so\.|-C\.so\.)(\d+)", path) or re.search(r"llvm(?:@|-|/)(\d+)", path)
    return int(numbers.group(1)) if numbers else None


def _usable(llvm: Llvm) -> Llvm:
    """Load a library to see that it can be loaded and which version it is."""
    try:
        library = ctypes.CDLL(llvm.path)
    except OSError as error:
        return Llvm(llvm.path, llvm.version, f"can't be loaded ({error})")
    version = llvm.version
    if hasattr(library, "LLVMGetVersion"):  # LLVM 16 and newer
        major, minor, patch = ctypes.c_uint(), ctypes.c_uint(), ctypes.c_uint()
        library.LLVMGetVersion(ctypes.byref(major), ctypes.byref(minor), ctypes.byref(patch))
        version = major.value
    if version is not None and version >= LLVM_SUPPORTED:
        return Llvm(llvm.path, version)
    found = f"LLVM {version}" if version else "an LLVM older than 16"
    return Llvm(llvm.path, version, f"is {found}, version {LLVM_SUPPORTED} or newer is needed")
