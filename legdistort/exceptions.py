"""Errors and warnings; every message names its cause and a cure.

All errors derive from `LegdistortError`, so that one ``except`` catches them
and the command line can turn each into one clear line.
"""

import contextlib
import functools
import inspect
import os
import warnings
from pathlib import Path

from astropy.utils.exceptions import AstropyUserWarning, AstropyWarning


class LegdistortError(Exception):
    """Base of every error that the package raises on purpose.

    See Also
    --------
    LegdistortWarning : The base of all warnings.

    Examples
    --------
    >>> import legdistort as ld
    >>> try:
    ...     ld.read_exposures("nowhere/*.fits")
    ... except ld.LegdistortError as error:
    ...     print(error)
    no file matches 'nowhere/*.fits'
    """


class InputError(LegdistortError, ValueError):
    """An argument, file or table is not what was asked for; correct it and call again."""


class DamagedError(InputError):
    """An image file is blank, truncated, damaged or without the image wanted; leave it out, or mend it."""


class MatchError(LegdistortError, ValueError):
    """Exposures cannot be tied together; check overlap, the number of stars or the nominal poses.

    Attributes
    ----------
    groups : tuple of list of str
        Exposures that share stars, where they fall apart in several such groups.
    """

    def __init__(self, *args: object, groups: tuple = ()) -> None:
        super().__init__(*args)
        self.groups = tuple(groups)


class SolveError(LegdistortError, ValueError):
    """The least-squares problem has no usable answer; lower the degree, add stars or a prior.

    Attributes
    ----------
    exposures : tuple of str
        Exposures whose own unknowns are not determined, where it is these alone.
    """

    def __init__(self, *args: object, exposures: tuple[str, ...] = ()) -> None:
        super().__init__(*args)
        self.exposures = tuple(exposures)


class FoldError(LegdistortError, ValueError):
    """A distortion maps two places onto one; lower the degree or look at the exposure named."""


class DiskFullError(LegdistortError, OSError):
    """No space is left for a file, which was left as it was: free some space or write elsewhere."""


class ExportError(LegdistortError, ValueError):
    """A result does not fit the form asked for; allow a larger error, or choose a form that is exact."""


class LegdistortWarning(AstropyUserWarning):
    """Base of every warning of the package.

    See Also
    --------
    LegdistortError : The base of all errors.

    Examples
    --------
    >>> import warnings
    >>> import legdistort as ld
    >>> warnings.filterwarnings("ignore", category=ld.LegdistortWarning)
    """


class ConvergenceWarning(LegdistortWarning):
    """A minimisation stopped before it converged; its message states how far it was."""


class AssumptionWarning(LegdistortWarning):
    """Something was missing from the input and a stated value was assumed."""


@contextlib.contextmanager
def without_astropy_warnings():
    """Ignore the warnings of astropy, of files a little off the standard; ours, a kind of them, stay as they were."""
    before = list(warnings.filters)
    with warnings.catch_warnings(action="ignore", category=AstropyWarning):
        warnings.simplefilter("default", LegdistortWarning)
        for action, message, category, module, line in reversed(before):
            if issubclass(LegdistortWarning, category):
                category = LegdistortWarning
            if issubclass(category, LegdistortWarning):
                texts = (each.pattern if each else "" for each in (message, module))
                warnings.filterwarnings(action, next(texts), category, next(texts), line)
        yield


def some_of(names, most):
    """The first `most` names for a message, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def by_reason(names):
    """``{reason: list of names}`` of ``{name: reason}``."""
    alike = {}
    for name, reason in names.items():
        alike.setdefault(reason, []).append(name)
    return alike


def reasons_of(names, most=5):
    """Names with their reasons, ``{name: reason}``, for a message: by reason, some of both, and how many more."""
    listed = [f"{some_of(same, most)}: {reason}" for reason, same in by_reason(names).items()]
    return "; ".join(listed[:most]) + (f"; and {len(listed) - most} more reasons" if len(listed) > most else "")


#: Frames of these do not count as a caller's: the package, and what calls its functions for it.
_INSIDE = str(Path(__file__).parent) + os.sep
_BETWEEN = {functools.__file__, contextlib.__file__}


def warn(message, category):
    """Warn, with the line outside the package that led here as the place of the warning.

    Parameters
    ----------
    message : str
    category : type
        A subclass of `LegdistortWarning`.
    """
    frame, level = inspect.currentframe(), 1
    while frame and (frame.f_code.co_filename.startswith(_INSIDE) or frame.f_code.co_filename in _BETWEEN):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
