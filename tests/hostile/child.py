"""What a forked child does with its output and with the command line, for the suites that attack and interrupt it."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn


def run_command(folder: Path, arguments: Sequence[str], prepare: Callable[[], None]) -> NoReturn:
    """Run ``mifit ARGUMENTS`` in this process and end it with the command's exit code, 99 where it raised.

    Parameters
    ----------
    folder : Path
        Where ``stdout`` and ``stderr`` are written.
    arguments : sequence of str
    prepare : callable
        Called with the output turned already: working folder, limits, hooks.
    """
    code = 99
    try:
        for name, descriptor in (("stdout", 1), ("stderr", 2)):
            opened = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(opened, descriptor)
            os.close(opened)
        prepare()
        sys.argv = ["mifit", *arguments]
        from mifit.cli import main

        try:
            code = main()
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)
