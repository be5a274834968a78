"""Memory that is kept between arrays."""

from __future__ import annotations

import subprocess
import sys

import pytest

FAULTS = """
import resource, sys
import numpy as np
from mifit.core.process import keep_freed_memory

if sys.argv[1] == "keep" and not keep_freed_memory():
    sys.exit(3)
values = np.zeros(1 << 17)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    several = [values + k for k in range(8)]
    del several
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def test_pages_are_not_asked_for_again():
    pytest.importorskip("resource")
    found = {}
    for way in ("keep", "as it is"):
        done = subprocess.run([sys.executable, "-c", FAULTS, way], capture_output=True, text=True, check=False)
        if done.returncode == 3:
            pytest.skip("another C library than glibc")
        found[way] = int(done.stdout)
    assert 3 * found["keep"] < found["as it is"]
