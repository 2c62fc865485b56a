"""The arguments of the command line: values from their text, and paths that are checked before any work."""

import argparse

from ..inputs.exposure_files import expand_paths
from ..runtime.outputs import check_file, check_folder, check_not_read

#: Arguments that name what is read.
_READ = ("frames", "tables", "table", "sources", "solution", "stars", "prior", "reference", "grid")


def columns(text):
    """``ours=theirs,...`` as pairs."""
    pairs = [item.split("=") for item in text.split(",") if item]
    if not all(len(pair) == 2 and all(pair) for pair in pairs):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form star=name,x_err=xe")
    return pairs


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


def number_or_name(text):
    """A whole number if it is one, else the text itself."""
    return int(text) if text.isdigit() else text


def check_paths(arguments):
    """Raise `InputError` if an output of a command cannot be written, or would replace what is read."""
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    folder = given.get("out") if "leaves" in given else None
    files = [given[name] for name in ("out", "plot") if name in given and given[name] != folder]
    replaced = [path for path in files if not path.is_dir()]
    replaced += [folder / name for name in given.get("leaves", ()) if folder]
    inputs = [path for name in _READ if name in given for path in expand_paths(given[name])]
    for path in replaced:
        check_not_read(path, inputs)
    for path in files:
        check_file(path, overwrite=arguments.overwrite)
    if folder:
        check_folder(folder)
