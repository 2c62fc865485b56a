"""Columns of SExtractor under the names of the contract.

SExtractor counts pixels from 1 and gives errors as variances (``ERRX2WIN_IMAGE``) or as an ellipse
(``ERRAWIN_IMAGE``, standard deviations along its axes); its flags have meanings of their own.
"""

import logging
import re

import numpy as np
from astropy.table import Table

from ...exceptions import InputError
from ..column_contract import values

log = logging.getLogger(__name__)

#: Kinds of positions, the most precise first.
KINDS = ("PSF", "WIN", "")
#: Contract: columns, the best first.
_OTHERS = {
    "flux": ("FLUX_PSF", "FLUX_AUTO", "FLUX_APER", "FLUX_ISO"),
    "flux_err": ("FLUXERR_PSF", "FLUXERR_AUTO", "FLUXERR_APER", "FLUXERR_ISO"),
    "fwhm": ("FWHM_IMAGE",),
    "mag": ("MAG_PSF", "MAG_AUTO", "MAG_APER", "MAG_ISO"),
}
#: Bits of SExtractor -> bits of `legdistort.measurement.flags.Flag`: a neighbour or a blend is BLENDED, saturated
#: SATURATED, truncated at the edge or with incomplete data EDGE, memory overflow NOT_CONVERGED.
FLAGS = {1: 32, 2: 32, 4: 1, 8: 2, 16: 2, 32: 2, 64: 8, 128: 8}


def is_pixel(name):
    """Whether a column holds pixel positions of SExtractor, which count from 1."""
    return re.fullmatch(r"[XY](PSF|WIN|MODEL|PEAK)?_IMAGE(_DBL)?", name) is not None


def understand(table, columns, *, without_errors=False):
    """Add x, y, x_err, y_err, xy_corr, flux, flux_err, mag, fwhm and flags where columns of SExtractor hold them.

    Columns that the table has under these names already, or that the caller maps, are left alone. Rows without
    a usable error are left out. Positions stay counted from 1.

    Parameters
    ----------
    table : `~astropy.table.Table`
    columns : dict
        The caller's ``{contract name: name in the table}``.
    without_errors : bool
        Whether positions may come without errors.

    Returns
    -------
    `~astropy.table.Table`
    str or None
        The column that gave ``x``, if it was found here.

    Raises
    ------
    InputError
        If there are positions without their errors, unless `without_errors`.
    """
    present = set(table.colnames)
    kinds = [kind for kind in KINDS if {f"X{kind}_IMAGE", f"Y{kind}_IMAGE"} <= present]
    if not kinds:
        return table, None
    mapped = [kind for kind in kinds if columns.get("x") == f"X{kind}_IMAGE"]
    errors = {kind: _covariance(table, kind) for kind in mapped or kinds}
    kind = next((kind for kind in errors if errors[kind] is not None), (mapped or kinds)[0])
    taken = present | set(columns)
    if errors[kind] is None and not without_errors and not {"x_err", "y_err"} <= taken:
        raise InputError(
            f"X{kind}_IMAGE comes without errors: let SExtractor write ERRX2{kind}_IMAGE, ERRY2{kind}_IMAGE and "
            f"ERRXY{kind}_IMAGE (or ERRA{kind}_IMAGE, ERRB{kind}_IMAGE, ERRTHETA{kind}_IMAGE), map columns to x_err "
            "and y_err, or give one error for all (error=, --error PIXELS)"
        )
    made = {"x": table[f"X{kind}_IMAGE"], "y": table[f"Y{kind}_IMAGE"]}
    for name, choices in _OTHERS.items():
        choice = next((choice for choice in choices if choice in present), None)
        if choice is not None:  # of several apertures the first
            made[name] = table[choice] if table[choice].ndim == 1 else table[choice][:, 0]
    if "FLAGS" in present:
        made["flags"] = _flags(_numbers(table, "FLAGS")[0])
    good = slice(None)
    if errors[kind] is not None and not {"x_err", "y_err"} & taken:
        made |= _standard(*errors[kind])
        good = np.isfinite(made["xy_corr"])
        if without_errors:  # these rows get the error of all
            made |= {name: np.where(good, made[name], np.nan) for name in ("x_err", "y_err")}
            made["xy_corr"], good = np.where(good, made["xy_corr"], 0.0), slice(None)
    out = Table(table, copy=False)
    for name, column in made.items():
        if name not in taken:
            out[name] = column
    if isinstance(good, np.ndarray) and not np.all(good):
        bad = np.count_nonzero(~good)
        log.warning("%d of %d detections have no usable error of position and are left out", bad, len(table))
        out = out[good]
    return out, None if "x" in taken else f"X{kind}_IMAGE"


def _numbers(table, *names):
    """Columns as float arrays; None if one is missing."""
    return [values(table, name) for name in names] if set(names) <= set(table.colnames) else None


def _covariance(table, kind):
    """``var_x, var_y, cov_xy`` [pix^2] of one kind of positions; None if the table has no errors of it."""
    direct = _numbers(table, *(f"ERR{part}{kind}_IMAGE" for part in ("X2", "Y2", "XY")))
    if direct is not None:
        return direct
    ellipse = _numbers(table, *(f"ERR{part}{kind}_IMAGE" for part in ("A", "B", "THETA")))
    if ellipse is None:
        return None
    a, b, theta = ellipse[0] ** 2, ellipse[1] ** 2, np.radians(ellipse[2])  # theta from x towards y, degrees
    c, s = np.cos(theta), np.sin(theta)
    return [a * c**2 + b * s**2, a * s**2 + b * c**2, (a - b) * c * s]


def _standard(var_x, var_y, cov_xy):
    """Standard deviations and correlation; the correlation is NaN where they make no sense."""
    with np.errstate(all="ignore"):
        x_err, y_err = np.sqrt(var_x), np.sqrt(var_y)
        corr = cov_xy / (x_err * y_err)
    good = (x_err > 0) & (y_err > 0) & np.isfinite(x_err * y_err) & (np.abs(corr) < 1)
    return {"x_err": x_err, "y_err": y_err, "xy_corr": np.where(good, corr, np.nan)}


def _flags(theirs):
    """Our bits for theirs; a missing flag is none."""
    bits, ours = np.nan_to_num(np.clip(theirs, 0, 2**15)).astype(int), np.zeros(len(theirs), dtype=int)
    for bit, meaning in FLAGS.items():
        ours[(bits & bit) > 0] |= meaning
    return ours
