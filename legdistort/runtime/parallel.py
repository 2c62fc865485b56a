"""One door for work that falls into independent items: in this process, on its cores, or on a cluster, all by dask."""

import logging
import signal
import sys
import warnings
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import islice

from tqdm import tqdm

from ..exceptions import InputError, LegdistortError, warn

_AHEAD = 4  # items in flight for every worker


def each(function, items, *, workers=None, threads=False, progress=False, description=None, unit="frame"):
    """Results of a function for every item, in the order of the items, whoever works on them.

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
        If a worker process dies. What `function` raises for the first item that fails comes as it is; what it warns of
        and logs in local processes is repeated in this one.
    """
    workers, client = check_workers(workers), _client() if workers is None else None
    bar = tqdm(
        total=len(items) if hasattr(items, "__len__") else None, desc=description, unit=unit, disable=not progress
    )
    with bar:
        if client is None and workers == 1:
            results = map(function, items)
        else:
            results = _dask(function, iter(items), workers=workers, threads=threads, client=client)
        for result in results:
            bar.update()
            yield result


def check_workers(workers):
    """The number of workers, None standing for 1; `InputError` if it is not a positive integer."""
    if workers is None:
        return 1
    if isinstance(workers, bool) or workers != int(workers) or workers < 1:
        raise InputError(f"workers must be a positive integer, or None for one, got {workers!r}")
    return int(workers)


def _client():
    """The current client of dask.distributed, if the caller has one."""
    distributed = sys.modules.get("distributed")  # who has a client has imported it
    try:
        client = distributed and distributed.default_client()
    except ValueError:
        return None
    return None if client is None or client.asynchronous else client


def _dask(function, items, *, workers, threads, client):
    """Results by dask, a few items at a time, so that neither items nor results pile up."""
    import dask  # takes a third of a second

    if client is not None:
        workers = max(1, sum(client.nthreads().values()))
    call = partial(_attempt if threads or client is not None else _attempt_quietly, function)
    with _scheduler(workers, threads, client) as scheduler:
        while batch := list(islice(items, _AHEAD * workers)):
            tasks = [dask.delayed(partial(call, item), pure=False, traverse=False)() for item in batch]
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Sending large graph")  # images that the caller has in memory
                done = dask.compute(*tasks, optimize_graph=False, traverse=False, **scheduler)
            for result, error, warned, logged in done:
                for message in warned:
                    warn(message, type(message))
                for record in logged:
                    logger = logging.getLogger(record.name)
                    if logger.isEnabledFor(record.levelno):
                        logger.handle(record)
                if error is not None:
                    raise error
                yield result


@contextmanager
def _scheduler(workers, threads, client):
    """What tells dask where to work; local workers stand as long as the block."""
    if client is not None:
        yield {"scheduler": client}
        return
    from dask.multiprocessing import get_context

    if threads:
        pool = ThreadPoolExecutor(workers)
    else:
        pool = ProcessPoolExecutor(workers, mp_context=get_context(), initializer=_begin)
    try:
        yield (
            {"scheduler": "threads", "pool": pool}
            if threads
            else {"scheduler": "processes", "pool": pool, "chunksize": 1}
        )
    except BrokenProcessPool:
        raise LegdistortError(
            "a worker process died: it ran out of memory, or this is a script whose work does not stand under "
            "`if __name__ == '__main__':` (other processes import it); mend that, or give workers=None"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _begin():
    """In a new worker: Ctrl-C is for the process that it works for, which then stops it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # forked workers would have the handler of the command line


def _attempt(function, item):
    """Result, error, warnings and log records; dask would glue the traceback of a worker to the message of an error."""
    try:
        return function(item), None, [], []
    except Exception as error:
        return None, error, [], []


def _attempt_quietly(function, item):
    """The same in a process that nobody listens to: warnings and log records are handed over."""
    logged = _Records()
    log = logging.getLogger("legdistort")
    log.handlers[:], log.propagate = [logged], False
    log.setLevel(logging.INFO)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        result, error, *_ = _attempt(function, item)
    return result, error, [w.message for w in warned], logged.records


class _Records(logging.Handler):
    """Log records that can be pickled."""

    def __init__(self):
        super().__init__()
        self.records = []

    def emit(self, record):
        record.msg, record.args, record.exc_info = record.getMessage(), None, None
        self.records.append(record)
