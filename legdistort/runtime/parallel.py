"""Work that falls into independent items: in this process, on its cores, or on a cluster of dask."""

import ctypes
import logging
import os
import signal
import sys
import threading
import time
import warnings
from collections import deque
from concurrent.futures import CancelledError, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from functools import cache, partial
from importlib.metadata import version
from logging.handlers import QueueHandler
from multiprocessing import get_context
from numbers import Integral
from queue import SimpleQueue

import scipy.linalg  # noqa: F401  (it comes with a linear algebra library of its own, which is to be loaded by then)
from threadpoolctl import ThreadpoolController

from ..exceptions import InputError, LegdistortError, warn
from .checks import first_line
from .progress import Bar

_END_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)
_THREADS, _PATIENCE = "/proc/self/task", 50  # one entry a thread; milliseconds
_AHEAD = 4  # items in flight for every worker


def map_items(function, items, *, workers=None, threads=False, progress=False, description=None, unit="frame"):
    """Results of a function for every item, in the order of the items, however they are shared.

    Parameters
    ----------
    function : callable
        Of one item. For other processes it must be one that can be pickled.
    items : iterable
        Drawn from as work goes on: four items a worker are in flight, no more.
    workers : int, optional
        Cores of this machine to use. None = the current ``dask.distributed.Client`` of the caller if there is one, else
        this process alone, as for 1. Results do not depend on it.
    threads : bool
        Local workers are threads of this process (for functions that leave Python's lock alone) and not processes.
    progress : bool
        Show a progress bar.
    description, unit : str, optional
        For the bar.

    Yields
    ------
    object
        The result for each item.

    Raises
    ------
    InputError
        If `workers` is not a positive integer.
    LegdistortError
        If a worker process dies, or the cluster goes away. What `function` raises for the first item that fails comes
        as it is; what it warns of and logs in local processes is repeated in this one.
    """
    workers, client = check_workers(workers), _client() if workers is None else None
    bar = Bar(
        total=len(items) if hasattr(items, "__len__") else None, desc=description, unit=unit, disable=not progress
    )
    threads = threads and client is None and workers > 1
    # The limit is one of the process: threads that begin and end at different times would restore it wrongly.
    with bar, one_blas_thread() if threads else nullcontext():
        function = function if threads else partial(_on_one_thread, function)
        if client is None and workers == 1:
            results = map(function, items)
        else:
            results = _shared(function, items, workers=workers, threads=threads, client=client)
        for result in results:
            bar.update()
            yield result


@cache
def _libraries():
    return ThreadpoolController()


def one_blas_thread():
    """Context in which the linear algebra library keeps to one thread when this thread calls it.

    Its threads wait for one another in a busy loop. With small matrices that costs more than they gain, and on cores
    that others use as well, or our own loops, it takes many times as long.
    """
    return _libraries().limit(limits=1, user_api="blas")


def _on_one_thread(function, item):
    with one_blas_thread():
        return function(item)


def check_workers(workers):
    """The number of workers, None standing for 1; `InputError` if it is not a positive integer."""
    if workers is None:
        return 1
    if isinstance(workers, bool) or not isinstance(workers, Integral) or workers < 1:
        raise InputError(f"workers must be a positive integer, got {workers!r}")
    return int(workers)


def n_cores():
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _client():
    """The current client of dask.distributed, if the caller has one."""
    distributed = sys.modules.get("distributed")  # who has a client has imported it
    try:
        client = distributed and distributed.default_client()
    except ValueError:
        return None
    return None if client is None or client.asynchronous else client


def _shared(function, items, *, workers, threads, client):
    """Results of other threads or processes, in the order of the items, of which few are in flight."""
    quiet = not threads and client is None
    work = partial(_attempt, function) if quiet else function
    finish = _finish if quiet else lambda result: result
    with nullcontext() if client is None else _cluster_needed(client), _executor(workers, threads, client) as submit:
        if client is not None:
            workers = max(1, sum(client.nthreads().values()))
            _check_versions(client)
        waiting = deque()
        for item in items:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Sending large graph")  # images that the caller has in memory
                waiting.append(submit(partial(work, item)))
            if len(waiting) == _AHEAD * workers:
                yield finish(waiting.popleft().result())
        while waiting:
            yield finish(waiting.popleft().result())


@contextmanager
def _cluster_needed(client):
    """`LegdistortError` in the place of whatever a cluster leaves behind that went away in the block."""
    try:
        yield
    except Exception as error:  # what `function` raised comes through here as well
        killed = isinstance(error, sys.modules["distributed"].KilledWorker)
        whole = client.status == "running" and not isinstance(error, CancelledError)
        if isinstance(error, LegdistortError) or (whole and not killed):
            raise
        lost = "workers of the cluster died again and again at the same work" if killed else "the cluster is gone"
        cure = "give its workers more memory" if killed else "see why its scheduler ended, connect a new Client"
        raise LegdistortError(
            f"{lost} ({type(error).__name__}): {cure}, and call again; or close the Client and give workers=, the "
            "number of cores of this machine"
        ) from None


def _check_versions(client):
    """Raise `LegdistortError` if workers of a cluster have another version of the package, or none."""
    own, cure = _version(), "install the same version there"
    found = client.run(_version, on_error="return").values()
    for error in found:
        if isinstance(error, Exception) and not isinstance(error, OSError):  # one that died since is started again
            raise LegdistortError(f"workers of the cluster cannot load legdistort ({first_line(error)}): {cure}")
    others = sorted({each for each in found if isinstance(each, str)} - {own})
    if others:
        raise LegdistortError(f"workers of the cluster have legdistort {', '.join(others)}, here it is {own}: {cure}")


def _version():
    return version("legdistort")


@contextmanager
def _executor(workers, threads, client):
    """The function that hands work on and returns a future; local workers stand as long as the block."""
    if client is not None:
        yield partial(client.submit, pure=False)
        return
    if threads:
        pool = ThreadPoolExecutor(workers)
    else:
        context = get_context("fork" if _may_fork() else "spawn")
        pool = ProcessPoolExecutor(workers, context, initializer=_serve, initargs=(os.getpid(),))
    try:
        yield pool.submit
    except BrokenProcessPool:
        raise LegdistortError(
            "a worker process died: it ran out of memory, or this is a script whose work does not stand under "
            "`if __name__ == '__main__':` (other processes import it); mend that, or give workers=None"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _may_fork():
    """Whether other processes can begin as copies of this one, which spares them all imports.

    A copy has one thread: what others were at would never be finished there. OpenBLAS, where its threads are its own,
    ends them before a copy is made, and starts them again when they are needed.
    """
    if not os.path.isdir(_THREADS) or threading.active_count() > 1:
        return False
    known = sum(
        library["num_threads"] - 1
        for library in _libraries().info()
        if library["internal_api"] == "openblas" and library["threading_layer"] == "pthreads"
    )
    for _ in range(_PATIENCE):  # a thread that has ended is still listed for a moment
        if len(os.listdir(_THREADS)) - 1 <= known:
            return True
        time.sleep(0.001)
    return False


def _serve(master):
    """What a worker process does first: it leaves Ctrl-C to the process that it works for, and ends with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_END_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != master:  # which has ended meanwhile
            os._exit(1)


@contextmanager
def beside(function, *, workers=None):
    """Call a function in a copy of this process, while the block runs.

    Parameters
    ----------
    function : callable
        Without arguments. It sees this process as it is before the block; what it is to leave are files.
    workers : int, optional
        Cores to use, as for `map_items`.

    Yields
    ------
    callable
        To be called in the block: it waits for the copy, returns what the function returns and raises what it raises;
        `LegdistortError` if the copy dies. Where there is no second core, or no memory for a copy, it is the function
        itself. A copy that is not waited for ends with the block.
    """
    copy = _copied(function) if check_workers(workers) > 1 and _may_fork() else None
    if copy is None:
        yield function
        return
    process, receiver = copy
    with receiver:
        try:
            yield partial(_receive, receiver)
        finally:
            process.kill()
            process.join()


def _copied(function):
    """A copy of this process that calls a function, and where its answer comes in; None without memory for it."""
    context = get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_attempt, args=(function, sender, os.getpid()))
    with sender:
        try:
            process.start()
        except OSError:
            receiver.close()
            return None
    return process, receiver


def _send_attempt(function, sender, master):
    _serve(master)
    sender.send(_attempt(function))


def _receive(receiver):
    try:
        attempt = receiver.recv()
    except (EOFError, OSError):  # before an answer, or in the middle of it
        raise LegdistortError("a worker process died: it ran out of memory; give workers=1") from None
    return _finish(attempt)


def _attempt(function, *arguments):
    """Result, error, warnings and log records of a call, to be passed on from a worker process."""
    records, result, raised = SimpleQueue(), None, None
    log = logging.getLogger("legdistort")
    log.handlers[:], log.propagate = [QueueHandler(records)], False
    log.setLevel(logging.INFO)
    with warnings.catch_warnings(record=True, action="always") as warned:
        try:
            result = function(*arguments)
        except Exception as error:
            raised = error
    return result, raised, [w.message for w in warned], [records.get() for _ in range(records.qsize())]


def _finish(attempt):
    """The result of an `_attempt`; what was warned of, logged and raised there is so here."""
    result, error, warned, logged = attempt
    for message in warned:
        warn(message, type(message))
    for record in logged:
        log = logging.getLogger(record.name)
        if log.isEnabledFor(record.levelno):
            log.handle(record)
    if error is not None:
        raise error
    return result
