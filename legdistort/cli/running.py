"""A command while it runs: its log, its signals, what becomes of its errors."""

import logging
import re
import signal
import sys
import threading
import warnings
from contextlib import contextmanager, nullcontext

from tqdm.contrib.logging import logging_redirect_tqdm

from ..exceptions import LegdistortError, LegdistortWarning
from ..runtime.progress import Bar
from . import commands
from .arguments import check_paths, wants_progress

log = logging.getLogger("legdistort")

#: The value of an argument as messages write it in Python: a dict, a tuple, a text, or a word or number.
_VALUE = r"(?:\{[^{}]*\}|\([^()]*\)|'[^']*'|[^\s(){}',]*)"


def run_command(arguments):
    """Run a command of a parsed command line; returns the exit status."""
    try:
        with _stopping(), _logging(arguments), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other packages
            warnings.simplefilter("default", LegdistortWarning)
            warnings.showwarning = lambda message, *_, **__: log.warning("%s", in_shell_words(str(message)))
            with logging_redirect_tqdm([log], Bar) if wants_progress(arguments) else nullcontext():  # bars stay whole
                check_paths(arguments, arguments.groups)
                status = getattr(commands, f"do_{arguments.command}")(arguments)
    except LegdistortError as error:
        if arguments.debug:
            raise
        print(f"legdistort: {in_shell_words(str(error))}", file=sys.stderr)
        return 1
    except BrokenPipeError:  # the reader of our output has left, as in ``legdistort show FILE | head``
        sys.stdout = None
        return 0
    except OSError as error:
        if arguments.debug:
            raise
        print(f"legdistort: {error} (nothing was left half-written)", file=sys.stderr)
        return 1
    except MemoryError as error:
        if arguments.debug:
            raise
        print(f"legdistort: not enough memory ({error}); nothing was left half-written", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("legdistort: interrupted; nothing was left half-written", file=sys.stderr)
        return 130
    return status or 0


def in_shell_words(text):
    """A message with arguments of Python as the options of the shell, ``clip=None`` as ``--clip 0`` and the like."""
    text = re.sub(r"\b\w+\([\w.=]*\) \((legdistort \w+)\)", r"\1", text)  # match(table) (legdistort match)
    text = re.sub(rf"\b(?:\w+={_VALUE} or )*\w+=({_VALUE}),? \((--[^()]*)\)", _named_option, text)
    text = re.sub(r"\b(?:\w+=\{[^{}]*\}|\w+\(\w+=\.\.\.\)) or (?=--)", "", text)  # columns={...} or --columns
    text = re.sub(rf"\(\w+={_VALUE}, (--[^()]*)\)", r"(\1)", text)  # (earlier=, --from)
    text = re.sub(r"(?<![-\w])([a-z_]+)=(?:'([\w-]+)'|(\d[\d.]*))", _as_option, text)
    return re.sub(r"(?<!\w)'([\w.,-]+)'(?!\w)", r"\1", text)


def _named_option(found):
    """``overwrite=True (--overwrite)`` as ``--overwrite``, ``min_exposures=6 (--min-exposures)`` with its number."""
    value, flag = found.groups()
    return f"{flag} {value}" if re.fullmatch(r"\d[\d.]*", value) and " " not in flag else flag


def _as_option(found):
    return f"--{found[1].replace('_', '-')} {found[2] or found[3]}"


@contextmanager
def _stopping():
    """While a command runs, SIGTERM and SIGHUP (batch systems, lost terminals) are as Ctrl-C: temporary files go."""
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    numbers = [n for n in numbers if signal.getsignal(n) is signal.SIG_DFL]  # as nohup ignores it, so do we
    if threading.current_thread() is not threading.main_thread():  # where signals do not arrive
        numbers = []
    for n in numbers:
        signal.signal(n, signal.default_int_handler)
    try:
        yield
    finally:
        for n in numbers:
            signal.signal(n, signal.SIG_DFL)


@contextmanager
def _logging(arguments):
    """The log of the package on stderr while a command runs; afterwards as it was, for callers of `main`."""
    before = log.handlers[:], log.propagate, log.level
    level = logging.WARNING if arguments.quiet else logging.INFO
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    log.handlers[:], log.propagate = [handler], False
    log.setLevel(logging.DEBUG if arguments.debug else level)
    try:
        yield
    finally:
        log.handlers[:], log.propagate = before[:2]
        log.setLevel(before[2])
