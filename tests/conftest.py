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
