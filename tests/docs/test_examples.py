"""The examples in docstrings run and give what stands there."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize("name", ["config", "core.camera", "core.image", "core.photometry", "core.sh"])
def test_examples_give_what_they_say(name):
    found = doctest.testmod(importlib.import_module(f"mifit.{name}"), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted and not found.failed
