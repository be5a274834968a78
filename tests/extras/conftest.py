"""Fixtures that tests of outputs have too."""

from tests.output.conftest import ball  # noqa: F401
