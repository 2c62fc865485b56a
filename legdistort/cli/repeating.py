"""Options of an earlier run, which hold again where a run goes on from it and does not state them."""

import json
import logging
import os
import re
import shlex
from pathlib import Path

from ..exceptions import InputError, some_of
from ..runtime.provenance import SUMMARY
from . import options
from .arguments import flagged

log = logging.getLogger("legdistort")

#: What can differ from the earlier run; how frames are read and measured cannot.
_GROUPS = (options.MATCHING, options.SOLVING, options.COADDING, options.LAST_STEP, options.COMPARING)
#: What names of files begin with that count from the folder of the results.
_HERE = os.path.join(os.curdir, "")

#: Values by which a server is asked, which no file does (see the page on files).
_ASKS_A_SERVER = re.compile(r"gaia$|siaf:")


def repeatable(arguments):
    """The options that a run was asked for, beside defaults, as its summary keeps them: ``{flag: text or None}``.

    None stands behind a flag without a value. Files are named from the folder of the results.
    """
    found = {}
    for _, flag, dest, option in flagged(_GROUPS):
        value = getattr(arguments, dest)
        if dest == "scratch" or value == arguments.parser.get_default(dest):
            continue
        text = _text(value)
        if option.path == "read" and Path(text).exists():
            text = _HERE + os.path.relpath(text, arguments.out)
        found[flag] = text
    return found


def again(arguments):
    """The command that goes on with what a run has measured, but for ``--from``: what its folder does not repeat."""
    words = ["legdistort", "run", "--out", str(arguments.out)]
    for flag, text in repeatable(arguments).items():
        words += [flag, text] if text is not None and _ASKS_A_SERVER.match(text) else []
    words += ["--keep"] * bool(arguments.keep) + ["--overwrite"] * bool(arguments.overwrite)
    return shlex.join(words)


def with_earlier(arguments):
    """The arguments of a command; those of ``run --from`` with the options of the earlier run that are not given again.

    Raises
    ------
    InputError
        For an option that is to be forgotten and was none of that run, and for one that asks a server.
    """
    if arguments.command != "run":
        return arguments
    earlier = getattr(arguments, "from")
    if earlier is None:
        if arguments.forget:
            raise InputError("--forget is for options of the run of --from: leave it out")
        return arguments
    kept = _kept(Path(earlier))
    if kept is None:
        log.info("the options of %s are not known: what is not given here is as by default", earlier)
        kept = {}
    names = [flag.removeprefix("--") for flag in kept]
    for name in set(arguments.forget) - {*names, "all"}:
        known = some_of(names, 9) or "none"
        measured = "; the camera is that of the frames as they were measured: run them anew without it"
        measured *= name == "camera"
        raise InputError(f"--forget {name} is none of the options of {earlier}, which are {known}{measured}")
    given = {word.partition("=")[0] for word in arguments.argv if word.startswith("--")}
    dropped = {flag for flag in kept if "all" in arguments.forget or flag.removeprefix("--") in arguments.forget}
    if "--no-mosaic" in given:
        dropped |= {flag for _, flag, _, _ in flagged([options.COADDING])}
    kept = {flag: text for flag, text in kept.items() if flag not in given | dropped}
    for flag, text in kept.items():
        if text is not None and _ASKS_A_SERVER.match(text) and not Path(text).exists():
            name = flag.removeprefix("--")
            raise InputError(
                f"{flag} {text} of {earlier} asks a server: give it again, or leave it out, --forget {name}"
            )
    words = [[flag] if text is None else [flag, text] for flag, text in kept.items()]
    if words:
        shown = " ".join(part for each in words for part in each)
        log.info("repeated from %s: %s (--forget NAME,... leaves them out)", earlier, shown)
    more = [each[0] if len(each) == 1 else "=".join(each) for each in words]
    whole = arguments.parser.parse_args([*more, *arguments.argv[1:]])
    whole.begun, whole.argv, whole.repeated = arguments.begun, arguments.argv, list(kept)
    return whole


def how_to_forget(message, arguments):
    """What to add to a message about options that are repeated and contradict those that are given; else nothing."""
    repeated = getattr(arguments, "repeated", ())
    if repeated:  # the folder may have the name of an option
        folder = re.escape(str(getattr(arguments, "from")))
        message = re.sub(rf"(?<![\w./-]){folder}(?![\w/-])", "", message)
    flags = [flag for flag in repeated if re.search(rf"(?<![\w-])({flag}|{_name(flag)})(?![\w-])", message)]
    if not flags:
        return ""
    names = ",".join(flag.removeprefix("--") for flag in flags)
    return f"; --forget {names} leaves out what is repeated from {getattr(arguments, 'from')}"


def _kept(folder):
    """The options that the summary of a run has; None where it has none."""
    try:
        kept = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))["options"]
        known = {flag for _, flag, dest, _ in flagged(_GROUPS) if dest != "scratch"}
        kept = {flag: text for flag, text in kept.items() if flag in known and isinstance(text, str | None)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None
    return {flag: _from(folder, text) for flag, text in kept.items()}


def _from(folder, text):
    return os.path.normpath(folder / text) if text is not None and text.startswith(_HERE) else text


def _name(flag):
    return flag.removeprefix("--").replace("-", "_")


def _text(value):
    """The text of an option that gives a value; None for a flag alone."""
    if isinstance(value, bool):
        return None
    if isinstance(value, dict):
        return ",".join(f"{key}={number!r}" for key, number in value.items())
    return (",".join(value) or "none") if isinstance(value, tuple | list) else str(value)
