"""What an option of the command line is: value from text, way to a function, paths checked before any work."""

import argparse
import os
import sys
from pathlib import Path

from ..runtime.words import ALL_PLANES

#: Images of which each has a line.
_MOST_LINES = 10

# -- values from their text


def names(text):
    """``NAME,...`` as a list, each without dashes before it."""
    return [name.lstrip("-").replace("_", "-") for name in text.split(",") if name]


def keywords(text):
    """``NAME,...`` as a list, as they stand."""
    return [name.strip() for name in text.split(",") if name.strip()]


def columns(text):
    """``ours=theirs,...`` as pairs."""
    pairs = [item.split("=") for item in text.split(",") if item]
    if not all(len(pair) == 2 and all(pair) for pair in pairs):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form star=name,x_err=xe")
    return pairs


def planes(text):
    """Names of planes of a mosaic, ``UNCERT,WEIGHT``, or ``all``, in any case; none of them for ``none``."""
    words = () if text.lower() == "none" else text.split(",")
    return tuple(ALL_PLANES if word.lower() == ALL_PLANES else word.upper() for word in words)


def some_words(choices):
    """Parser of some words, ``NAME,...``, as a list."""

    def parse(text):
        for word in (words := text.split(",")):
            if word not in choices:
                raise argparse.ArgumentTypeError(f"{word!r} is none of {', '.join(choices)}")
        return words

    return parse


def pairs(text):
    """``{name: number}`` of ``NAME=NUMBER,...``."""
    try:
        return {name: float(value) for name, value in (each.split("=") for each in text.split(","))}
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form NAME=NUMBER,...") from None


def sized_terms(choices):
    """Parser of terms with their sizes, ``NAME=SIZE[:SIZE...],...``, as ``[(name, sizes)]``."""

    def parse(text):
        made = []
        for each in text.split(","):
            name, _, sizes = each.partition("=")
            try:
                made.append((name, [float(size) for size in sizes.split(":")]))
            except ValueError:
                raise argparse.ArgumentTypeError(f"{each!r} is not of the form NAME=SIZE") from None
            if name not in choices:
                raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(choices)}")
        return made

    return parse


def spectrum(text):
    """``degree=rms,...`` as a dict."""
    try:
        return {int(degree): float(rms) for degree, rms in (item.split("=") for item in text.split(",") if item)}
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form 3=0.9,4=0.1") from None


def word_or(number, word):
    """Parser of a number, or of one word that stands for another way."""

    def parse(text):
        try:
            return text if text == word else number(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor {word!r}") from None

    return parse


def length(text):
    """A number, of pixels, or one with a unit: ``0.4mas``."""
    from astropy.units import Quantity

    try:
        return float(text)
    except ValueError:
        pass
    try:
        return Quantity(text)
    except (TypeError, ValueError):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor one with a unit, such as 0.4mas") from None


def number_or_name(text):
    """A whole number if it is one, else the text itself."""
    return int(text) if text.isdigit() else text


def extension(text):
    """The extension of a FITS file: number, name, or ``NAME,VERSION`` as a pair."""
    name, comma, number = text.partition(",")
    return (name, int(number)) if comma and number.isdigit() else number_or_name(text)


# -- what an option is


class Option:
    """How the command line takes one argument of a function.

    Parameters
    ----------
    help : str
    flag : str, optional
        The flag, or a word for a positional argument; by default the name of the argument as a flag.
    none : object
        What stands for None.
    path : {"read", "inputs", "file", "folder", "results"}, optional
        It names what is read, and must not be replaced; several such files, all of which must be there; or what is
        written: a file, a folder in which nothing is
        replaced, or the folder of the results of a run.
    endings : tuple of str, optional
        Endings that a name of a file may have: they select its format.
    one_of : str, optional
        Options with the same word here exclude one another; one of them is needed if they are `required`.
    **settings
        As `argparse.ArgumentParser.add_argument` takes them.
    """

    def __init__(self, help, flag=None, *, none=None, path=None, endings=None, one_of=None, **settings):
        self.flag, self.none, self.path, self.endings, self.one_of = flag, none, path, endings, one_of
        self.settings = settings | {"help": help}


class Group(dict):
    """Options by name that stand together in the help, under a title."""

    def __init__(self, title, options):
        super().__init__(options)
        self.title = title


def flagged(groups):
    """Name, flag, name among the parsed arguments, and `Option` of every option of some groups."""
    for group in groups:
        for name, option in group.items():
            flag = option.flag or f"--{name.replace('_', '-')}"
            yield name, flag, flag.lstrip("-").replace("-", "_"), option


def add_options(parser, groups):
    """Give a parser the options of some groups."""
    exclusive = {}
    for group in groups:
        titled = parser.add_argument_group(group.title) if isinstance(group, Group) else parser
        for _, flag, _, option in flagged([group]):
            place, settings = titled, dict(option.settings)
            if option.one_of is not None:
                required = settings.pop("required", False)
                if option.one_of not in exclusive:
                    exclusive[option.one_of] = titled.add_mutually_exclusive_group(required=required)
                place = exclusive[option.one_of]
            place.add_argument(flag, **settings)


def given(arguments, *groups):
    """Those options of some groups that were given, or have a default here, as keyword arguments of a function."""
    found = {name: (getattr(arguments, dest), option.none) for name, _, dest, option in flagged(groups)}
    return {name: None if value == none else value for name, (value, none) in found.items() if value is not None}


def check_paths(arguments, groups):
    """Raise `InputError` if an output of a command cannot be written, or would replace what is read."""
    from ..inputs.exposure_files import expand_paths
    from ..runtime.outputs import check_ending, check_file, check_folder, check_not_read, try_to_write

    named = {"read": [], "inputs": [], "file": [], "folder": [], "results": []}
    for _, _, dest, option in flagged(groups):
        value = getattr(arguments, dest)
        if option.path is not None and value not in (None, option.none):
            named[option.path].append(value)
    inputs = [path for value in named["read"] + named["inputs"] if value for path in expand_paths(value)]
    replaced = [path for path in named["file"] if not path.is_dir()]
    for folder in named["results"]:
        from ..pipeline import RESULTS

        replaced += [folder / Path(name).parts[0] for name in RESULTS]
    for path in replaced:
        check_not_read(path, inputs)
    for path in named["file"]:
        check_file(path, overwrite=arguments.overwrite)
    for folder in named["folder"] + named["results"]:
        check_folder(folder)
    for _, _, dest, option in flagged(groups):
        if option.endings is not None and getattr(arguments, dest) is not None:
            check_ending(getattr(arguments, dest), option.endings)
    for path in named["file"] + named["folder"] + named["results"]:
        try_to_write(path)
    for value in filter(None, named["inputs"]):
        _check_all_there(expand_paths(value))


def _check_all_there(paths):
    """Raise one `InputError` for all of several files that are missing; of one alone whoever reads it says so."""
    from ..exceptions import InputError, some_of

    missing = [path for path in paths if not os.path.lexists(path)]
    if len(paths) > 1 and missing:
        here = f", looked for from {os.getcwd()}" * any(not os.path.isabs(path) for path in missing)
        raise InputError(
            f"{len(missing)} of {len(paths)} files are not there ({some_of(missing, 5)}{here}): correct their names, "
            "or leave them out"
        )


def wants_progress(arguments):
    """Whether progress bars are shown: on a terminal, unless asked to be quiet."""
    return not arguments.quiet and sys.stderr.isatty()


def lines_of_images(arguments, done):
    """A line for every `~legdistort.wcs.attachment.Attachment`; of many one for the least exact of them."""
    if len(done) > _MOST_LINES and not arguments.verbose:
        worst = max(done, key=lambda item: max(item.errors.values(), default=0))
        first = f"{len(done)} images, the least exact of them (--verbose lists all):"
        return [first, *lines_of_images(arguments, [worst])]
    return [repr(item)[1:-1].partition(": ")[2] for item in done]
