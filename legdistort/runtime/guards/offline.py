"""Astropy without a network: what stands in a file makes nobody ask a server.

Times and frames of some kinds (UT1, AltAz, ITRS) need tables of the rotation of the Earth, which astropy fetches when
its own are too old for the date. A date in a header would then start a request. While a file is read, and while a
command runs, astropy uses the tables that are installed.
"""

import threading
from contextlib import contextmanager

_LOCK = threading.Lock()
_inside, _before = 0, True


@contextmanager
def offline():
    """A block, of any thread, in which astropy downloads nothing; also as a decorator."""
    global _inside, _before
    from astropy.utils.data import conf

    with _LOCK:  # threads enter and leave in any order: the first notes what was, the last restores it
        if not _inside:
            _before, conf.allow_internet = conf.allow_internet, False
        _inside += 1
    try:
        yield
    finally:
        with _LOCK:
            _inside -= 1
            if not _inside:
                conf.allow_internet = _before
