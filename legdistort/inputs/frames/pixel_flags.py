"""Flags of pixels (data quality, DQ): which make a pixel bad."""

import re

import numpy as np
from astropy.nddata.bitmask import interpret_bit_flags

from ...exceptions import InputError

#: The bit by which JWST and Roman mark a pixel that is not to be used; their others only describe.
DO_NOT_USE = 1
#: Names of flags that describe what is on a pixel, and are no reason against its value (LSST, Pan-STARRS).
_DESCRIPTIVE = re.compile(
    r"DETECTED(_.*)?|(NOT_)?DEBLENDED|DEBLENDED_.*|INEXACT_PSF|CROSSTALK|FAKE|INJECTED.*|BRIGHT_OBJECT|OBJECTS?|STARS?"
    r"|SOURCES?|PRIMARY|CONV\.POOR",
    re.IGNORECASE,
)


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


def descriptive_flags(header):
    """``{name: flag}`` of those that only describe, by the names in the header of a plane of flags.

    ``MP_NAME = bit`` (LSST), ``MSKNAMnn = name`` with ``MSKVALnn = flag`` (Pan-STARRS), ``BITnn = name`` or
    ``BITnn = bit / name (more)`` (PTF, ZTF).
    """
    named = {key[3:]: 1 << header[key] for key in header if key.startswith("MP_") and _is_bit(header[key])}
    for key in filter(re.compile(r"BIT_?\d{1,2}").fullmatch, header):
        value, bit = header[key], int(key.removeprefix("BIT").lstrip("_"))
        words = value if isinstance(value, str) else header.comments[key] if value == bit else ""
        if _is_bit(bit):
            named[words.split("(")[0].strip()] = 1 << bit
    for key in header:
        value = header.get(key.replace("NAM", "VAL")) if re.fullmatch(r"MSKNAM\d+", key) else None
        if isinstance(value, int):
            named[str(header[key]).strip()] = value
    return {name: flag for name, flag in named.items() if _DESCRIPTIVE.fullmatch(name)}


def _is_bit(value):
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 63
