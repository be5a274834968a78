"""What commands share."""

from __future__ import annotations

import sys
from argparse import Namespace


def use_variant(arguments: Namespace) -> str:
    """Activate the variant that ``--variant`` names; returns its name. VariantError where it can't fit."""
    from mifit.render.variant import set_fitting_variant

    return set_fitting_variant(arguments.variant)


def say(arguments: Namespace, text: str) -> None:
    """Print a line on standard error unless ``--quiet``."""
    if not arguments.quiet:
        print(text, file=sys.stderr, flush=True)
