"""The variant that tests run under: ``MIFIT_TEST_VARIANT=cuda_ad_rgb make test`` runs them on a GPU."""

from __future__ import annotations

import os

VARIANT = os.environ.get("MIFIT_TEST_VARIANT", "llvm_ad_rgb")
