"""Fixtures that every test may use."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest
from filelock import FileLock

from mifit.core.process import set_threads, threads
from tests.variant import VARIANT

LONGEST = (
    "tests/checks/test_wrong_captures.py", "tests/docs/test_commands.py", "tests/stages/test_find_surface.py",
    "tests/stages/test_fit_geometry.py", "tests/extras/test_boards.py", "tests/test_experiment.py",
    "tests/checks/test_odd_captures.py", "tests/checks/test_fits.py", "tests/hostile/test_promises.py",
    "tests/test_resume.py", "tests/extras/test_calibrate_densely.py", "tests/stages/test_reflectance_stability.py",
    "tests/test_film.py", "tests/stages/test_infer_reflectance.py", "tests/test_cli.py",
    "tests/stages/test_segment.py", "tests/hostile/test_writing.py", "tests/render/test_shdirect.py",
    "tests/test_foreign.py", "tests/test_experiment_page.py",
)  # fmt: skip
"""Files that take longest, in that order: with two processes they go first, or one would work on after the other."""
SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of shared data beside the checkout; tests that need it skip where it is missing."""
    if not (SHARED / "captures").is_dir():
        pytest.skip(f"needs the data folder {SHARED}, which is not here")
    return SHARED


@pytest.fixture(scope="session")
def ict_path(shared: Path) -> Path:
    """The ICT-FaceKit head model."""
    return shared / "models" / "ict_facekit" / "ict_facekit_head.npz"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let kernels be compiled as on another machine: rounding and the order of sums differ there."""
    parser.addoption("--llvm-target", metavar="CPU:WIDTH", help="LLVM's processor, lanes: x86-64-v3:8, nehalem:4")
    parser.addoption("--threads", type=int, help="threads of Dr.Jit")


def pytest_configure(config: pytest.Config) -> None:
    """Share the processors among xdist's workers: threads that wait for one another cost more than they bring."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 1))
    if workers > 1:
        set_threads(max(1, threads() // workers))


@pytest.fixture(scope="session")
def variant(request: pytest.FixtureRequest) -> str:
    """Activate the variant under test once for the session."""
    import mifit

    name = mifit.set_variant(VARIANT)
    target, count = request.config.getoption("--llvm-target"), request.config.getoption("--threads")
    if target:
        cpu, width = target.split(":")
        compile_for(cpu, int(width))
    if count:
        import drjit as dr

        dr.set_thread_count(count)
    return name


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the longest files first; the rest stays in order."""
    rank = {config.rootpath / name: place for place, name in enumerate(LONGEST)}
    assert all(path.is_file() for path in rank), "LONGEST names a file that is no longer there"
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


def compile_for(cpu: str, width: int) -> None:
    """Have Dr.Jit compile for another processor: what ``jit_llvm_set_target`` of its C++ interface does."""
    import drjit as dr

    core = ctypes.CDLL(str(next(Path(dr.__file__).parent.glob("libdrjit-core.*"))))
    dr.eval(dr.opaque(dr.llvm.Float, 0.0))  # the backend must be up, or its own choice comes after this one
    core._Z19jit_llvm_set_targetPKcS0_j.argtypes = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint32)
    core._Z19jit_llvm_set_targetPKcS0_j.restype = None
    core._Z19jit_llvm_set_targetPKcS0_j(cpu.encode(), b"", width)
    assert core._Z21jit_llvm_vector_widthv() == width


@pytest.fixture(scope="session")
def tiny_capture(variant: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A path-traced capture of the built-in model: cameras left, right and third, three timesteps, 200 x 150.

    Made once for all of xdist's workers: nothing may change it.
    """
    from mifit.synth import synthesize

    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "tiny" / "capture"
    with FileLock(folder.parent.with_suffix(".lock")):
        if not folder.exists():
            part = folder.with_name("part")
            synthesize(part, timesteps=3, model="builtin:coarse", width=200, height=150, spp=16, seed=3)
            part.rename(folder)
    return folder
