"""Pixels on disk instead of in memory: those of exposures while a mosaic is being made, and the mosaic itself."""

import mmap
import tempfile
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..exceptions import DiskFullError, InputError
from . import locks
from .disk_errors import free_bytes, is_full


@dataclass(frozen=True, eq=False, repr=False)
class Stored:
    """Planes of one exposure in a scratch folder.

    Attributes
    ----------
    planes : dict
        File of each plane, type and shape of its values, by its name.
    """

    planes: dict

    def piece(self, plane, part):
        """A piece of a plane, by slices of its rows and columns; None if there is no such plane."""
        if plane not in self.planes:
            return None
        path, dtype, shape = self.planes[plane]
        # Mapped for this piece alone: what stays mapped counts as memory of the process. No header is parsed, which
        # threads cannot do at the same time: now and then compiling ends there in a SystemError (Python 3.11).
        return np.array(np.memmap(path, dtype, mode="r", shape=shape)[part])


@contextmanager
def scratch_folder(parent, need, what="the pixels"):
    """A folder for planes that is gone when the block ends, however it ends.

    Parameters
    ----------
    parent : str, path or None
        Where to make it; None = where the system keeps temporary files (``TMPDIR``).
    need : int
        Bytes that will be stored.
    what : str
        What these bytes are, for the message.

    Raises
    ------
    InputError
        If it cannot be made there.
    DiskFullError
        If the disk is full.
    """
    place = Path(tempfile.gettempdir() if parent is None else parent)
    advice = "give another folder as scratch=... (--scratch), or in the environment as TMPDIR"
    with ExitStack() as stack:
        try:
            folder = stack.enter_context(locks.temporary_folder(place, "legdistort-"))
        except OSError as error:
            raise InputError(f"no scratch folder can be made in {place} ({error.strerror}): {advice}") from None
        free = free_bytes(place)
        if free < need:
            raise DiskFullError(
                f"{what} take {need / 2**30:,.2f} GB on disk while work goes on, {place} has {free / 2**30:,.2f} GB "
                f"left: {advice}; if they should not be so many, look at the poses and at the grid"
            )
        try:
            yield folder
        except OSError as error:
            if isinstance(error, DiskFullError) or not is_full(error, place):
                raise
            raise DiskFullError(f"No space left on the disk of {place}: {advice}; nothing was made") from None


def store(folder, planes):
    """Store planes of an exposure.

    Parameters
    ----------
    folder : path
        From `scratch_folder`.
    planes : dict of ndarray or None
        By name; None is left out.

    Returns
    -------
    Stored
    """
    own = Path(tempfile.mkdtemp(dir=folder))  # not named as the exposure, which is free text
    stored = {}
    for plane, values in planes.items():
        if values is not None:
            stored[plane] = own / plane, values.dtype, values.shape
            values.tofile(own / plane)
    return Stored(stored)


class _Shared(mmap.mmap):
    """Memory that is the same as a file, so that it may be dropped and read again.

    A type of its own, since `forget` must know its own: dropped from ``np.memmap(mode="c")`` of a caller, changes would
    be lost. And an array over it is a plain one.
    """


def spill(shape, value, dtype, folder):
    """An array on disk, all of one value; its file has no name and is gone when the array is.

    Parameters
    ----------
    shape : tuple
    value : number
    dtype : dtype
    folder : path

    Returns
    -------
    ndarray
        It may be larger than the memory, if `forget` is called now and then. Processes forked from this one share it.
    """
    size = int(np.prod(shape))
    values = np.full(min(size, 1 << 20), value, dtype)
    with tempfile.TemporaryFile(dir=folder) as file:
        # All of it: a disk that is full must be known now. Merely reserved pages would take a fifth longer in all.
        for start in range(0, size, len(values)):
            file.write(values[: size - start])
        file.flush()
        return np.frombuffer(_Shared(file.fileno(), size * values.itemsize), dtype).reshape(shape)


def moved(array, folder):
    """The array on disk, as those of `spill`; None stays None."""
    if array is None:
        return None
    out = spill(array.shape, 0, array.dtype, folder)
    out[:] = array
    forget(out)
    return out


def forget(array):
    """Drop the memory of an array that `spill` made; its values stay on disk. Others are left alone."""
    while isinstance(array, np.ndarray | memoryview):
        array = array.base if isinstance(array, np.ndarray) else array.obj
    if isinstance(array, _Shared) and hasattr(mmap, "MADV_DONTNEED"):  # not on Windows
        array.madvise(mmap.MADV_DONTNEED)
