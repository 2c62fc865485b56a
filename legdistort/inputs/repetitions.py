"""The same exposure twice, under two names: its positions agree to the last bit, which two measurements never do."""

import hashlib

import numpy as np

from ..exceptions import AssumptionWarning, reasons_of, warn

#: Positions that must agree, and they are more than half of those of the exposure that has fewer.
FEWEST = 5
#: From so many positions on in every exposure an eighth of them is looked at first; that none of the positions of a
#: copy is among them happens once in 10^11 times, if they have values of x of their own.
_MANY = 400
_HASHES = 8  # positions of an exposure that its fingerprint has


def copies(exposure, xy):
    """Exposures that repeat another one.

    Parameters
    ----------
    exposure : ndarray of int, shape (n,)
    xy : ndarray, shape (n, 2)

    Returns
    -------
    dict of int to int
        ``{exposure: the first one that it repeats}``.
    """
    counts, x = np.bincount(exposure), _bits(xy[:, 0]) * np.uint64(0x9E3779B97F4A7C15)  # wraps around
    some = np.flatnonzero(x < 2**61)
    if counts.min() >= _MANY and len(some) and not _repeated(x[some] + _bits(xy[some, 1])):
        return {}
    key = x + _bits(xy[:, 1])  # what falls together is looked at below
    if _repeated(key) < FEWEST:
        return {}
    order = np.argsort(key)
    again = key[order[1:]] == key[order[:-1]]
    places = {}
    for row in order[np.concatenate([[False], again]) | np.concatenate([again, [False]])]:
        places.setdefault(tuple(xy[row].tolist()), set()).add(int(exposure[row]))
    alike = {}
    for found in places.values():
        for one in found:
            for other in found:
                if one < other:
                    alike[one, other] = alike.get((one, other), 0) + 1
    out = {}
    for (one, other), n in sorted(alike.items()):
        if one not in out and other not in out and n >= FEWEST and n > min(counts[one], counts[other]) / 2:
            out[other] = one
    return out


def _bits(values):
    return (values + 0.0).view(np.uint64)  # -0.0 is 0.0


def _repeated(keys):
    """How many neighbours of the sorted keys are equal; sorting takes a tenth of the time that their order does."""
    ascending = np.sort(keys)
    return np.count_nonzero(ascending[1:] == ascending[:-1])


def reasons(names, exposure, xy):
    """`copies` in words, ``{name: reason}``, with a warning that names both."""
    found = {names[copy]: names[original] for copy, original in copies(exposure, xy).items()}
    return warned({name: f"its positions are those of {original} to the last bit" for name, original in found.items()})


def warned(repeated):
    """Exposures that repeat another one, ``{name: reason}``, after a warning of them."""
    if repeated:
        warn(f"the same exposure more than once, which counts as one: {reasons_of(repeated)}", AssumptionWarning)
    return repeated


def fingerprints(table):
    """Of the positions that were measured in every exposure, ``{exposure: texts}``: those with the smallest hashes.

    So some are the same if other stars of it were matched. Of a camera those on its detectors, wherever these lie.
    """
    measured = ("x_detector", "y_detector") if "x_detector" in table.colnames else ("x", "y")
    name, x, y = (np.asarray(getattr(table[c], "value", table[c])) for c in ("exposure", *measured))
    out = {}
    for exposure in dict.fromkeys(name.tolist()):
        mine = name == exposure
        hashes = sorted(
            hashlib.sha256(f"{a:.6f} {b:.6f}".encode()).hexdigest()[:12] for a, b in zip(x[mine], y[mine], strict=True)
        )
        out[exposure] = tuple(hashes[:_HASHES])
    return out
