"""The errors of mifit: each names the value found, the one expected and the remedy."""

from __future__ import annotations


class MifitError(Exception):
    """Base of all errors that mifit raises on purpose."""


class InputError(MifitError, ValueError):
    """A file, option or argument is not what it must be; the message says what was found and expected."""


class VariantError(MifitError, RuntimeError):
    """Mitsuba's variant, or the LLVM or CUDA behind it, can't run here; the message names the fix."""


class UnknownVariantError(VariantError, InputError):
    """No such variant of Mitsuba, or one that mifit doesn't run on: bad usage, not a fault of this machine."""


class ConvergenceError(MifitError, RuntimeError):
    """An optimisation ended without a usable result; the message says in which stage and why."""
