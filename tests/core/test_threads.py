"""One number of threads for everything, in this process and in those that it starts."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from mifit.core.threads import VARIABLES, set_threads
from mifit.errors import InputError

ASK = """
import sys
from mifit.core.threads import set_threads, threads
if sys.argv[1] == "before":
    set_threads(1)
import cv2, drjit, numpy, scipy.linalg
import mifit
from threadpoolctl import threadpool_info
if sys.argv[1] == "after":
    set_threads(1)
mifit.set_variant("auto")
child = "import os; print(os.environ['OPENBLAS_NUM_THREADS'])"
import subprocess
print(threads(), cv2.getNumThreads(), drjit.thread_count(), {p["num_threads"] for p in threadpool_info()},
      subprocess.check_output([sys.executable, "-c", child], text=True).strip())
"""


@pytest.mark.parametrize("when", ["before", "after"])
def test_one_number_reaches_every_library(when: str) -> None:
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    command = [sys.executable, "-c", ASK, when]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "1", "2", "{1}", "1"]  # Dr.Jit waits for itself with one


def test_no_threads_are_refused() -> None:
    with pytest.raises(InputError, match="found 0, expected a whole number of at least 1"):
        set_threads(0)
