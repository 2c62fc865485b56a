"""Loops that numba compiles."""

from numba import njit


def compiled_loop(**options):
    """Decorator: `numba.njit` with these options, which keeps what it compiled where there is a place for that."""

    def decorate(function):
        try:
            return njit(cache=True, **options)(function)
        except RuntimeError:  # neither the package nor a home can be written: it is compiled anew in every process
            return njit(**options)(function)

    return decorate
