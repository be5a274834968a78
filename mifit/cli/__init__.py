"""The ``mifit`` command: parsing and exit codes; one module for each kind of command.

Exit codes: 0 success, 2 bad usage or bad input (one line on stderr), 3 a named fault of the capture (with
``--strict``), 1 a failure of mifit's own, 130 interrupted.
"""

from __future__ import annotations

import errno
import os
import sys
import warnings
from collections.abc import Sequence

from mifit.cli.arguments import drop_chatter, one_line
from mifit.cli.options import build_parser as build_parser
from mifit.core.files import FULL
from mifit.errors import InputError, MifitError


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code.

    Without ``argv`` this is the program itself, which owns its process: what C libraries print is dropped.
    """
    if argv is None and not _own_streams():
        print("mifit: standard output is closed; expected somewhere to write, such as /dev/null", file=sys.stderr)
        return 2
    parser = build_parser()
    for word in sys.argv[1:] if argv is None else argv:
        if word.startswith("--") and word.endswith("=--"):  # argparse would make an empty list of it
            parser.error(f"argument {word[:-3]}: found '--', expected a value")
    if not (sys.argv[1:] if argv is None else argv):
        parser.print_help()
        return 0
    arguments = parser.parse_args(argv)
    if argv is None:
        if not arguments.debug:
            drop_chatter()
            warnings.simplefilter("ignore", RuntimeWarning)  # of NumPy, in terms of arrays; results are checked
            warnings.showwarning = _say_warning
    try:
        if arguments.threads:
            from mifit.core.process import set_threads

            set_threads(arguments.threads)
        code = arguments.run(arguments) or 0
        sys.stdout.flush()  # a full disk behind a redirection is met here
        return code
    except KeyboardInterrupt:
        print("mifit: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of our output has gone; nothing is left to say
        _give_up_unwritten()
        return 1
    except Exception as error:
        if arguments.debug:
            raise
        _give_up_unwritten()
        return _report(error)


def _own_streams() -> bool:
    """Whether standard output is open; what is closed leads nowhere then, lest a file of ours takes its number."""
    is_open = sys.stdout is not None
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
            setattr(sys, name, os.fdopen(number, "r" if name == "stdin" else "w"))
    return is_open


def _say_warning(message: Warning | str, category: type[Warning], *where: object, **options: object) -> None:
    """A warning of the library, or of what it stands on, as one line."""
    print(f"mifit: warning: {one_line(str(message))}", file=sys.stderr)


def _out_of_memory(error: Exception) -> bool:
    """Whether an error says in one of many ways that memory, or room for addresses, has run out."""
    text = str(error).lower()
    return (
        isinstance(error, MemoryError)
        or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        or (isinstance(error, ImportError) and ("failed to map" in text or "cannot allocate" in text))
        or (isinstance(error, RuntimeError) and ("can't start new thread" in text or "out of memory" in text))
    )


def _give_up_unwritten() -> None:
    """Drop output that can't be written: the interpreter would try again at its end, and fail in words of its own."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _report(error: Exception) -> int:
    """One line on stderr and the exit code that goes with the error."""
    message = one_line(str(error))
    if isinstance(error, MifitError):
        print(f"mifit: {message}", file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    if _out_of_memory(error):
        print("mifit: not enough memory; use fewer timesteps, smaller images or smaller maps", file=sys.stderr)
        return 2
    if isinstance(error, OSError) and (error.filename or error.errno in FULL):
        place = error.filename or "an output file"
        print(one_line(f"mifit: {place}: {error.strerror}; what was there is unchanged"), file=sys.stderr)
        return 2
    print(f"mifit: internal error, {type(error).__name__}: {message}; run again with --debug", file=sys.stderr)
    return 1
