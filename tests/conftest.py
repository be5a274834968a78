"""Fixtures that every test may use."""

from __future__ import annotations

from pathlib import Path

import pytest

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


@pytest.fixture(scope="session")
def variant() -> str:
    """Activate the CPU variant once for the session."""
    import mifit

    return mifit.set_variant("llvm_ad_rgb")


@pytest.fixture(scope="session")
def tiny_capture(variant: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A path-traced capture of the built-in model: cameras left, right and third, three timesteps, 200 x 150."""
    from mifit.synth import synthesize

    folder = tmp_path_factory.mktemp("tiny") / "capture"
    synthesize(folder, timesteps=3, model="builtin:coarse", width=200, height=150, spp=12, seed=3)
    return folder
