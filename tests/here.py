"""Runs of an experiment one after the other in this process, where the processes themselves are tested elsewhere."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import Any

import pytest


class Here(Executor):
    """Calls what is submitted at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def run_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let experiments run in this process."""

    @contextlib.contextmanager
    def executor(jobs: int, dask: str | None) -> Iterator[Executor]:
        yield Here()

    monkeypatch.setattr("mifit.experiments.run._executor", executor)
