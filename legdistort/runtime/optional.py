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


def compiled_loop(**options):
    """Decorator: `numba.njit` with these options, which keeps what it compiled where there is a place for that."""
    from numba import njit

    def decorate(function):
        try:
            return njit(cache=True, **options)(function)
        except RuntimeError:  # neither the package nor a home can be written: it is compiled anew in every process
            return njit(**options)(function)

    return decorate
