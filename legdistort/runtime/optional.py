"""Which optional parts are installed."""

from functools import cache


@cache
def has_fast():
    """Whether the extra ``fast``, compiled loops, is installed, and works with the NumPy that is there."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True
