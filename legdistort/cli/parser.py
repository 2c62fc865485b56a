"""The command ``legdistort``: thin calls of the functions of the package."""

import argparse
import difflib
import logging
import re
import signal
import sys
import threading
import warnings
from contextlib import contextmanager, nullcontext
from importlib.metadata import version

from tqdm.contrib.logging import logging_redirect_tqdm

from ..exceptions import LegdistortError, LegdistortWarning
from .arguments import add_options, check_paths
from .commands import COMMANDS, wants_progress

log = logging.getLogger("legdistort")


def main(argv=None):
    """Run the command line; returns the exit status.

    0; 1 for a failed run, 2 for wrong usage, 3 where `--strict` is given and a check fails, 130 after Ctrl-C.
    """
    arguments, unknown = _parser().parse_known_args(argv)
    if unknown:
        arguments.parser.error(f"no option or place for {' '.join(unknown)}")
    try:
        with _stopping(), _logging(arguments), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other packages
            warnings.simplefilter("default", LegdistortWarning)
            warnings.showwarning = lambda message, *_, **__: log.warning("%s", message)
            with logging_redirect_tqdm([log]) if wants_progress(arguments) else nullcontext():  # bars stay whole
                check_paths(arguments, arguments.command.groups)
                status = arguments.command.function(arguments)
    except LegdistortError as error:
        if arguments.debug:
            raise
        print(f"legdistort: {error}", file=sys.stderr)
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


class _Parser(argparse.ArgumentParser):
    """A parser that takes no shortened options, and says in one line what is wrong, with the nearest option."""

    def __init__(self, **settings):
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message):
        known = list(self._option_string_actions)
        if wrong := re.search(r"invalid choice: '?([^' ]*)'? \(choose from (.*)\)", message):
            known = re.findall(r"[^', ]+", wrong[2])
        words = [wrong[1]] if wrong else re.findall(r"(?<!\S)-[\w-]+", message)
        near = [match for word in words if word not in known for match in _nearest(word, known)]
        hint = f"; did you mean {' '.join(near)}?" if near else ""
        self.exit(2, f"{self.prog}: {message}{hint} ({self.prog} --help lists what there is)\n")


def _nearest(word, known):
    """What begins with a word, or is spelled much like it; a list of one or none."""
    return ([each for each in known if each.startswith(word)] or difflib.get_close_matches(word, known, n=1))[:1]


def _parser():
    parser = _Parser(
        prog="legdistort",
        description="Star positions and image distortions from dithered exposures, as WCS and mosaic.",
        epilog="Start with: legdistort demo --out demo",
    )
    parser.add_argument("--version", action="version", version=f"legdistort {version('legdistort')}")
    subparsers = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        p = subparsers.add_parser(
            name,
            help=command.what,
            description=command.what[0].upper() + command.what[1:] + ".",
            epilog=f"Example: legdistort {name} {command.example}",
        )
        p.set_defaults(command=command, parser=p)
        add_options(p, command.groups)
    return parser
