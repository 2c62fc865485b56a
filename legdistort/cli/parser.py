"""The command ``legdistort``: what is asked, and what there is to ask for.

Nothing here loads the package, so that help and wrong usage are answered at once.
"""

import argparse
import difflib
import re
import sys
import time
from importlib.metadata import version

from .arguments import add_options, flagged
from .process import with_streams
from .usage import COMMANDS


def main(argv=None):
    """Run the command line; returns the exit status.

    0; 1 for a failed run, 2 for wrong usage, 3 where `--strict` is given and a check fails, 130 after Ctrl-C.
    """
    begun = time.perf_counter()
    with with_streams():
        arguments = _parsed(argv)
        from ..runtime.guards.offline import offline

        with offline():  # while modules are imported, too: astropy would fetch leap seconds where the clock is ahead
            from .running import run_command

            arguments.begun, arguments.argv = begun, sys.argv[1:] if argv is None else list(argv)
            return run_command(arguments)


def _parsed(argv):
    arguments, unknown = _parser().parse_known_args(argv)
    if unknown:
        flags = [word.partition("=")[0] for word in unknown]
        others = "".join(f"; {flag} is an option of {', '.join(of)}" for flag in flags if (of := _having(flag)))
        arguments.parser.error(f"no option or place for {' '.join(unknown)}{others}")
    return arguments


class _Parser(argparse.ArgumentParser):
    """A parser that takes no shortened options, and states an error in one line, with the nearest option."""

    def __init__(self, **settings):
        super().__init__(allow_abbrev=False, **settings)

    def error(self, message):
        known = list(self._option_string_actions)
        if wrong := re.search(r"invalid choice: '?([^' ]*)'? \(choose from (.*)\)", message):
            known = re.findall(r"[^', ]+", wrong[2])
        words = [wrong[1]] if wrong else re.findall(r"(?<!\S)-[\w-]+", message)
        near = [match for word in words if word not in known and not _having(word) for match in _nearest(word, known)]
        message = re.sub(r"'([^' ]*)'", r"\1", message)
        hint = f"; did you mean {' '.join(near)}?" if near else ""
        self.exit(2, f"{self.prog}: {message}{hint} ({self.prog} --help lists what there is)\n")


def _having(word):
    """Names of the commands that have an option."""
    return [name for name, command in COMMANDS.items() if word in (flag for _, flag, _, _ in flagged(command.groups))]


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
        p.set_defaults(command=name, groups=command.groups, parser=p)
        add_options(p, command.groups)
    return parser
