"""The command ``legdistort``."""

import gc

from .parser import main

__all__ = ["command", "main"]


def command():
    """What the shell calls: `main` in a process of its own, where garbage is sought less often, and not at the end.

    What a run loads and makes are millions of objects that stay. Looking through them takes a tenth of its time and
    finds next to nothing, since arrays are freed without a search.
    """
    first, *others = gc.get_threshold()
    gc.set_threshold(10 * first, *others)
    try:
        return main()
    finally:
        gc.freeze()
