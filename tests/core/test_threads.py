"""One number of threads for everything, in this process and in those that it starts."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import mifit
from mifit.core.process import VARIABLES, on_all_cores, one_blas_thread, set_threads
from mifit.errors import InputError

ASK = """
import sys
from mifit.core.process import set_threads, threads
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


def blas_threads() -> set[int]:
    assert np.ones(2) @ np.ones(2) == 2.0  # loaded
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_one_blas_thread_ends_with_the_call() -> None:
    @one_blas_thread()
    def inside(fails: bool) -> set[int]:
        if fails:
            raise InputError("no")
        return blas_threads()

    with threadpool_limits(2, user_api="blas"):
        assert inside(False) == {1}
        with pytest.raises(InputError):
            inside(True)
        assert blas_threads() == {2}


LONG = ("fit", "fit_geometry", "find_surface", "refine_surface", "infer_reflectance", "refine_normals", "refine")


@pytest.mark.parametrize("name", LONG)
def test_what_takes_long_uses_one(name: str) -> None:
    """Their first look at an argument tells, before anything is computed."""

    class Seen(Exception):
        pass

    class Probe:
        def __getattr__(self, attribute: str) -> None:
            raise Seen(blas_threads())

        def __iter__(self) -> None:
            raise Seen(blas_threads())

    mifit.set_variant("auto")
    with threadpool_limits(2, user_api="blas"), pytest.raises(Seen) as seen:
        function = getattr(mifit, name).__wrapped__  # within what looks at the arguments' classes
        required = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty]
        function(*[Probe()] * len(required))
    assert seen.value.args[0] == {1}


def test_parts_run_side_by_side_and_come_back_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MIFIT_THREADS", "2")
    both = threading.Barrier(2, timeout=20.0)  # one after the other they would wait for ever

    def meet(part: int) -> int:
        both.wait()
        return 10 * part

    assert on_all_cores(meet, [3, 1]) == [30, 10]
    assert on_all_cores(lambda _: threading.current_thread(), [0]) == [threading.current_thread()]
    with pytest.raises(ZeroDivisionError):
        on_all_cores(lambda part: 1 / part, [1, 0])
