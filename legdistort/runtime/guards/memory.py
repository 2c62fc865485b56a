"""How much memory a file may ask for: what may come of its size, and what is left."""

import os
from contextlib import suppress
from pathlib import Path

from ...exceptions import InputError

try:
    import resource
except ImportError:  # Windows
    resource = None

#: Bytes that anything packed may unpack to: as many for every byte of it, but those that any file may; and never more.
_RATIO, ANY_BYTES, MAX_BYTES = 100, 1 << 28, 2 << 30
_MEMINFO, _STATM, _CGROUP = Path("/proc/meminfo"), Path("/proc/self/statm"), Path("/sys/fs/cgroup")


def free_memory():
    """Bytes that this process may still take, about; infinite where the system does not tell."""
    left = [float("inf")]
    with suppress(OSError, ValueError, StopIteration):
        line = next(line for line in _MEMINFO.read_text().splitlines() if line.startswith("MemAvailable:"))
        left.append(1024 * int(line.split()[1]))
    with suppress(OSError, ValueError):  # of a container
        left.append(int((_CGROUP / "memory.max").read_text()) - int((_CGROUP / "memory.current").read_text()))
    with suppress(OSError, ValueError, AttributeError):  # ulimit -v and -d; sizes of this process are in pages
        sizes = [int(word) * os.sysconf("SC_PAGE_SIZE") for word in _STATM.read_text().split()]
        for kind, size in ((resource.RLIMIT_AS, sizes[0]), (resource.RLIMIT_DATA, sizes[5])):
            most = resource.getrlimit(kind)[0]
            if most != resource.RLIM_INFINITY:
                left.append(most - size)
    return max(0, min(left))


def most_bytes(size):
    """Bytes that a file of a size may hold when it is unpacked: more is not there by accident."""
    return min(MAX_BYTES, max(_RATIO * size, ANY_BYTES))


def check_memory(need, what):
    """Raise `InputError` if there is not as much memory left as something needs."""
    left = free_memory()
    if need > left:
        raise InputError(
            f"{what} {need} bytes, more than the memory that is left, {left} bytes: end other programs, or use a "
            "machine with more"
        )
