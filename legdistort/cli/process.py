"""The process of a command: Ctrl-C before there is anything to stop, and streams that were closed.

Nothing is imported here that takes time: until `beginning` is entered, Ctrl-C ends in a traceback of Python.
"""

import os
import signal
import sys
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout

#: What the shell is told of an end by Ctrl-C.
INTERRUPTED = 130


@contextmanager
def beginning():
    """A block in which Ctrl-C ends the process with one line, unless `stoppable` is inside.

    While modules are imported there is nothing to be undone, and an exception might be taken for a fault of theirs.
    """
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # in the background it may be ignored
    if ours:
        signal.signal(signal.SIGINT, _leave)
    _open_descriptors()
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # all is done, or told: nobody wants to read of it


@contextmanager
def stoppable():
    """A block in which Ctrl-C raises `KeyboardInterrupt`, as SIGTERM and SIGHUP do (batch systems, lost terminals)."""
    before = {}
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (signal.SIG_DFL, _leave):  # as nohup ignores it, so do we
            before[number] = signal.getsignal(number)
    try:
        for number in before:
            signal.signal(number, signal.default_int_handler)
    except ValueError:  # not in the main thread, where signals do not arrive
        before = {}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def with_streams():
    """A block in which there is a standard output and a standard error, be it nowhere: daemons have none."""
    with ExitStack() as stack:
        for stream, redirect in ((sys.stdout, redirect_stdout), (sys.stderr, redirect_stderr)):
            if stream is None:
                stack.enter_context(redirect(stack.enter_context(open(os.devnull, "w"))))
        yield


def tell(text):
    """A line on standard error, if anybody can take it."""
    try:
        print(f"legdistort: {text}", file=sys.stderr or sys.__stderr__, flush=True)
    except (OSError, ValueError, AttributeError):  # full, closed, or none
        return


def _leave(*_):
    tell("interrupted")
    os._exit(INTERRUPTED)


def _open_descriptors():
    """Files take the numbers that are free: results would be opened as 2, and what goes wrong be written into them."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
