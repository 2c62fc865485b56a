"""Errors and warnings; every message names its cause and says what to do.

All errors derive from `LegdistortError`, so that one ``except`` catches them
and the command line can turn each into one clear line.
"""


class LegdistortError(Exception):
    """Base of every error that the package raises on purpose."""


class InputError(LegdistortError, ValueError):
    """An argument, file or table is not what was asked for; correct it and call again."""


class MatchError(LegdistortError, ValueError):
    """Exposures cannot be tied together; check overlap, the number of stars or the nominal poses."""


class SolveError(LegdistortError, ValueError):
    """The least-squares problem has no usable answer; lower the degree, add stars or a prior."""


class FoldError(LegdistortError, ValueError):
    """A distortion maps two places onto one; lower the degree or look at the exposure named."""


class DiskFullError(LegdistortError, OSError):
    """No space is left where a file was to be written; nothing is there half-written: make room or write elsewhere."""


class ExportError(LegdistortError, ValueError):
    """A result does not fit the form asked for; allow a larger error, or choose a form that is exact."""


def check_choice(value, allowed, name):
    """Raise `InputError` naming the argument if `value` is not one of the words allowed."""
    if value not in allowed:
        raise InputError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")


class LegdistortWarning(UserWarning):
    """Base of every warning of the package."""


class ConvergenceWarning(LegdistortWarning):
    """A minimisation stopped before it converged; its message says how far it was."""


class AssumptionWarning(LegdistortWarning):
    """Something was missing from the input and a stated value was assumed."""
