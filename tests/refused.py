"""What every reader does with input that it can't use."""

from __future__ import annotations

import time

import pytest

from mifit.errors import InputError


def refused(read, *arguments, match: str) -> None:
    """The reader raises InputError with the message, in one line, within two seconds of processor time."""
    start = time.process_time()
    with pytest.raises(InputError, match=match) as caught:
        read(*arguments)
    assert time.process_time() - start < 2
    assert "\n" not in str(caught.value)
