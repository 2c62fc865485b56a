"""The cards of a header that belong to its WCS: whose they are, and that they are numbers.

A header of an extension is complete in itself. Only where it has ``INHERIT = T``, and no WCS of its own, that of the
primary header is meant: half of one and half of the other is no WCS.
"""

import re

import numpy as np
from astropy.io import fits

from ...exceptions import DamagedError
from .cards import as_number, is_nothing

#: Keywords of a WCS and its distortion, without the letter of alternative ones; lookup tables and plates of scans
#: (DSS), polynomials of IRAF and of wcstools, and parameters under old names among them.
KEYWORDS = (
    r"WCSAXES|WCSNAME|LONPOLE|LATPOLE|RADESYS|RADECSYS|EQUINOX|D2IMARR|AXISCORR"
    r"|(CTYPE|CUNIT|CRVAL|CRPIX|CDELT|CROTA|CNAME|CRDER|CSYER|CPDIS|CQDIS|CPERR|CQERR|D2IMDIS|D2IMERR)\d+"
    r"|(PC|CD|PV|PS|TR|CO)\d+_\d+|(PC|CD)\d{6}|PROJP\d+|WAT\d+_\d+|(DP|DQ|D2IM)\d+(\.\w+)*"
    r"|(A|B|AP|BP)_(ORDER|DMAX|\d+_\d+)"
    r"|PLTRA[HMS]|PLTDEC(SN|[DMS])|PLTSCALE|PLTLABEL|AMD[XY]\d+|PPO\d+|CNPIX[12]|[XY]PIXELSZ|OBJCTPLT|[XY]POLY\d*"
)
_ANY = re.compile(rf"({KEYWORDS}|EPOCH)[A-Z]?")
_MATRIX = re.compile(r"(CD|PC)\d+_\d+|(PC|CD)\d{6}|(CDELT|CROTA)\d+")
_NUMBERS = re.compile(
    r"(CRVAL|CRPIX|CDELT|CROTA)\d+|(CD|PC|PV)\d+_\d+|(PC|CD)\d{6}|LONPOLE|LATPOLE|EQUINOX|(A|B|AP|BP)_(ORDER|\d+_\d+)"
)
#: Without these a WCS is another one; where others state nothing, their usual values are meant.
_NEEDED = re.compile(r"(CRVAL|CRPIX|CDELT)\d+|(CD|PC)\d+_\d+|(PC|CD)\d{6}")
_FURTHER = re.compile(
    r"WCSAXES|NAXIS[3-9]|(CTYPE|CUNIT|CRVAL|CRPIX|CDELT|CROTA|CNAME|CRDER|CSYER)[3-9]|(CD|PC)([3-9]_\d|\d_[3-9])|PV[3-9]_\d+"
)
_ALIKE = 1e-3  # of a scale: matrices that differ by less are one
_SKY = re.compile(r"(RA--|DEC-|[GESH]L(ON|AT)|[A-Z]{2}(LN|LT))")


def header_of_image(primary, own):
    """The header of an image in an extension, with what the primary header states for all: all but a WCS.

    Further axes, of one plane, are left out: astropy reads a distortion with two axes alone.

    Parameters
    ----------
    primary, own : `~astropy.io.fits.Header`
        The same where the image is the primary one.

    Returns
    -------
    `~astropy.io.fits.Header`
        A new one.
    """
    header = primary.copy()
    if primary is own:
        return _of_two_axes(header)
    inherits = _inherits(own) and not _has_sky(own)
    others = any(_MATRIX.fullmatch(key) for key in own)
    for key in {
        key for key in header if _ANY.fullmatch(key) and not (inherits and not (others and _MATRIX.match(key)))
    }:
        header.remove(key, remove_all=True)
    header.update(own)
    return _of_two_axes(header)


def _of_two_axes(header):
    if header.get("NAXIS", 2) > 2:
        for key in {key for key in header if _FURTHER.fullmatch(key)}:
            header.remove(key, remove_all=True)
        header["NAXIS"] = 2
    return header


def is_left_out(primary, own):
    """Whether the primary header has a WCS, and an extension neither that nor one of its own."""
    return primary is not own and _has_sky(primary) and not _has_sky(own) and not _inherits(own)


def _inherits(own):
    """Whether ``INHERIT = T`` stands in a header, as a word of FITS or as text."""
    return own.get("INHERIT") is True or str(own.get("INHERIT")).strip().upper() in ("T", "TRUE")


def two_matrices(header):
    """What is to be said of a header with both CDi_j and PCi_j that are different matrices, or None.

    Either is allowed, not both; libraries differ in which they take.
    """
    places = [(i, j) for i in (1, 2) for j in (1, 2)]
    if not (_has_sky(header) and all(any(f"{kind}{i}_{j}" in header for i, j in places) for kind in ("CD", "PC"))):
        return None
    cd = np.array([float(header.get(f"CD{i}_{j}", 0.0)) for i, j in places])
    pc = np.array([float(header.get(f"PC{i}_{j}", i == j) * header.get(f"CDELT{i}", 1.0)) for i, j in places])
    if np.abs(cd - pc).max() <= _ALIKE * np.abs(cd).max():
        return None
    return (
        "the header has two matrices of its WCS that differ, CDi_j and PCi_j with CDELTi, and the latter is taken; "
        "remove the cards of the wrong one"
    )


def _has_sky(header):
    return any(_SKY.match(str(header.get(f"CTYPE{k}", "")).upper()) for k in (1, 2))


def make_numbers(header, label):
    """Make the cards of a celestial WCS numbers, where they are texts, in place.

    Returns
    -------
    str or None
        The card without which it is no WCS.

    Raises
    ------
    DamagedError
        Naming the card that is no number.
    """
    if not _has_sky(header):
        return None
    for key in [key for key in header if _NUMBERS.fullmatch(key)]:
        value = header[key]
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            continue
        number = as_number(value[1:] if key == "EQUINOX" and str(value).startswith(("J", "B")) else value)
        if number is not None:
            header[key] = int(number) if key.endswith("ORDER") else number
        elif is_nothing(value) and not _NEEDED.fullmatch(key):
            del header[key]
        else:
            shown = "nothing" if isinstance(value, fits.card.Undefined) else repr(value)
            raise DamagedError(
                f"{label}: {key} = {shown} is no number, the WCS of its header cannot be read; correct the card, or "
                "remove CTYPE1 and CTYPE2 for a frame without a WCS"
            )
    return next((key for key in ("CRVAL1", "CRVAL2") if key not in header), None)
