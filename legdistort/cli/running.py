"""A command while it runs: its log, and what becomes of its errors."""

import logging
import re
import sys
import warnings
from contextlib import contextmanager, nullcontext

from tqdm.contrib.logging import logging_redirect_tqdm

from ..exceptions import LegdistortError, LegdistortWarning
from ..runtime.progress import EACH_IMAGE, Bar
from . import commands
from .arguments import check_paths, wants_progress
from .process import INTERRUPTED, stoppable, tell
from .repeating import how_to_forget, with_earlier

log = logging.getLogger("legdistort")

#: The value of an argument as messages write it in Python: a dict, a tuple, a call, a text, or a word or number.
_VALUE = r"(?:\{[^{}]*\}|\([^()]*\)|[A-Z]\w*\([^()]*\)|'[^']*'|[^\s(){}',]*)"


def run_command(arguments):
    """Run a command of a parsed command line; returns the exit status."""
    try:
        with stoppable(), _logging(arguments), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other packages
            warnings.simplefilter("default", LegdistortWarning)
            warnings.showwarning = lambda message, *_, **__: log.warning("%s", in_shell_words(str(message)))
            arguments = with_earlier(arguments)
            with logging_redirect_tqdm([log], Bar) if wants_progress(arguments) else nullcontext():  # bars stay whole
                check_paths(arguments, arguments.groups)
                status = getattr(commands, f"do_{arguments.command}")(arguments)
    except BrokenPipeError:  # the reader of our output has left, as in ``legdistort show FILE | head``
        sys.stdout = None
        return 0
    except (LegdistortError, OSError, MemoryError) as error:
        if arguments.debug:
            raise
        tell(_in_words(error, arguments))
        return 1
    except KeyboardInterrupt:
        tell("interrupted")
        return INTERRUPTED
    return status or 0


def _in_words(error, arguments):
    if isinstance(error, LegdistortError):
        words = in_shell_words(str(error))
        return words + how_to_forget(words, arguments)
    return f"not enough memory ({error})" if isinstance(error, MemoryError) else str(error)


def in_shell_words(text):
    """A message with arguments of Python as the options of the shell, ``clip=None`` as ``--clip 0`` and the like."""
    text = re.sub(r"\b\w+\([\w.=]*\) \((legdistort \w+)\)", r"\1", text)  # match(table) (legdistort match)
    text = re.sub(rf"\b(?:\w+={_VALUE} or )*\w+=({_VALUE}),? \((--[^()]*)\)", _named_option, text)
    text = re.sub(r"\b(?:\w+=\{[^{}]*\}|\w+\(\w+=\.\.\.\)) or (?=--)", "", text)  # columns={...} or --columns
    text = re.sub(rf"\(\w+={_VALUE}, (--[^()]*)\)", r"(\1)", text)  # (earlier=, --from)
    text = re.sub(r"(?<![-\w])(?<!\w\()([a-z_]+)=(?:'([\w-]+)'|(\d[\d.]*))", _as_option, text)
    return re.sub(r"(?<!\w)'([\w.,-]+)'(?!\w)", r"\1", text)


def _named_option(found):
    """``overwrite=True (--overwrite)`` as ``--overwrite``, ``min_exposures=6 (--min-exposures)`` with its number."""
    value, flag = found.groups()
    return f"{flag} {value}" if re.fullmatch(r"\d[\d.]*", value) and " " not in flag else flag


def _as_option(found):
    return f"--{found[1].replace('_', '-')} {found[2] or found[3]}"


def _said_once():
    """A filter of what is logged that lets words of information pass once: those of many files are said for one."""
    said = set()

    def passes(record):
        words = record.levelno, record.getMessage()
        new = record.levelno != logging.INFO or words not in said
        said.add(words)
        return new

    return passes


@contextmanager
def _logging(arguments):
    """The log of the package on stderr while a command runs; afterwards as it was, for callers of `main`."""
    before = log.handlers[:], log.propagate, log.level
    level = logging.WARNING if arguments.quiet else logging.INFO
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    handler.addFilter(_said_once())
    log.handlers[:], log.propagate = [handler], False
    log.setLevel(logging.DEBUG if arguments.debug else level)
    if not (arguments.verbose or arguments.debug):
        logging.getLogger(EACH_IMAGE).setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.handlers[:], log.propagate = before[:2]
        log.setLevel(before[2])
        logging.getLogger(EACH_IMAGE).setLevel(logging.NOTSET)
