"""Checks of arguments that more than one function has."""

from dataclasses import fields
from numbers import Real
from pathlib import Path

import numpy as np

from ..exceptions import InputError
from .locks import way_back

#: No number of pixels or standard errors is as large; squares of larger ones overflow.
LARGEST = 1e30


def check_choice(value, allowed, name):
    """Raise `InputError` naming the argument if `value` is not one of the words allowed."""
    if isinstance(value, np.ndarray) or value not in allowed:  # an array compares with each
        raise InputError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")


def check_counts(**counts):
    """Raise `InputError` naming the first count that is not a positive integer."""
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
            raise InputError(f"{name} must be a positive integer, got {value!r}")


def check_positive(value, name, what="number"):
    """Raise `InputError` naming the argument, and what it is a number of, unless `value` is positive and finite."""
    if isinstance(value, bool) or not isinstance(value, Real) or not 0 < value < LARGEST:
        raise InputError(f"{name} must be a positive {what}, got {value!r}")


def check_is_file(path, instead="", *, of_folder="name a file in it"):
    """Raise `InputError`, which says what to give `instead`, or `of_folder`, if a path is none of a file."""
    path = Path(path)
    lost = "" if path.exists() else way_back(path)
    if path.is_file():
        return
    if not path.exists():
        fault, instead = "no such file" + lost, "" if lost else instead
    elif path.is_dir():
        fault, instead = "is not a file but a folder", instead or of_folder
    else:
        fault = "is not a file"
    raise InputError(f"{path}: {fault}" + (f"; {instead}" if instead else ""))


def first_line(error):
    """The message of an error of a library, in one line."""
    text = getattr(error, "message", None) or str(error).strip() or type(error).__name__
    return text.strip().splitlines()[0]


def options_from(kind, given, argument):
    """Frozen options of class `kind` from a dict of keywords, as they come through another function.

    Parameters
    ----------
    kind : type
        A frozen dataclass that checks its fields when it is made.
    given : dict or None
    argument : str
        Name of the argument that the dict was given as.

    Raises
    ------
    InputError
        For what is no dict, for an unknown keyword, and what `kind` raises; the message names `argument`.
    """
    if given is not None and not isinstance(given, dict):
        raise InputError(f"{argument} must be a dict of options, got {type(given).__name__}")
    known = [field.name for field in fields(kind)]
    for name in given or {}:
        if name not in known:
            raise InputError(f"{argument} has no option {name!r}; it takes {', '.join(known)}")
    try:
        return kind(**(given or {}))
    except InputError as error:
        raise InputError(f"{argument}: {error}") from None
