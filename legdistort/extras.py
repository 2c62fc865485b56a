"""Which optional parts are installed."""

from functools import cache
from importlib.util import find_spec


@cache
def has_fast():
    """Whether the extra ``fast``, compiled loops, is installed."""
    return find_spec("numba") is not None and find_spec("threadpoolctl") is not None
