"""Flags of pixels (data quality, DQ): which make a pixel bad."""

import numpy as np
from astropy.nddata.bitmask import interpret_bit_flags

from ..exceptions import InputError

#: The bit by which JWST and Roman mark a pixel that is not to be used; their others only describe.
DO_NOT_USE = 1


def good_bits(bits):
    """Flags that are no reason to leave a pixel out, as one integer, or None for None.

    Parameters
    ----------
    bits : int, str, sequence of int, or None
        A sum, or bits one by one: 96, "64,32", "64+32" (`~astropy.nddata.bitmask.interpret_bit_flags`), [64, 32].

    Raises
    ------
    InputError
        For something else.
    """
    if bits is None:
        return None
    try:
        if isinstance(bits, str) and bits.strip().startswith("~"):
            raise ValueError("name those that are good, not those that are bad")
        if isinstance(bits, str) and bits.strip().isdigit():
            bits = int(bits)
        found = interpret_bit_flags(bits)
        if found is None or found < 0:
            raise ValueError("no bits")
    except (TypeError, ValueError) as error:
        raise InputError(
            f"dq_good (--dq-good) must be a sum of flags, 96, or the flags themselves, 64,32, got {bits!r} ({error})"
        ) from None
    return int(found)


def bad_pixels(flags, good=None, *, do_not_use=False):
    """Which pixels are bad.

    Parameters
    ----------
    flags : array_like
        Integer flags; or anything of which all but zero is bad.
    good : int, optional
        Flags that are no reason to leave a pixel out.
    do_not_use : bool
        Whether, without `good`, only the bit `DO_NOT_USE` is a reason.

    Returns
    -------
    ndarray of bool
    """
    flags = np.asarray(flags)
    if flags.dtype.kind not in "iu":
        return flags != 0
    if good is None:
        return (flags & flags.dtype.type(DO_NOT_USE) if do_not_use else flags) != 0
    return (flags.astype(np.int64) & ~np.int64(good)) != 0
