"""How well the model of the stars explains their light in every exposure: what frames less models leave around stars.

Measuring has that already, as chi2 of the pixels around every star. A model that is off by the same part of the light
leaves more of it the brighter a star is, so that it is compared with the star's ratio of signal to noise.
"""

from dataclasses import dataclass

import numpy as np

from ..measurement.profiles.cutouts import box_half

_FEWEST = 5  # stars that tell how well a model fits
_BRIGHT = 8, 3  # so many are looked at, the brightest, or that part of all
_COLUMNS = "chi2", "fwhm", "flags", "psf"
_MEDIAN = np.sqrt(np.pi / 2)  # error of a median over that of a mean


@dataclass(frozen=True)
class Misfit:
    """By how much the bright stars of an exposure deviate from their model.

    Attributes
    ----------
    square : float
        Mean square of the deviations, in parts of the light, beyond noise; where there is none its sign is chance.
    error : float
        Of the square, by noise; too large rather than too small where stars differ in brightness.
    model : str
        With which the stars were measured, as in the column psf.
    """

    square: float
    error: float
    model: str

    @property
    def size(self):
        """The deviation, a part of the light."""
        return float(np.sqrt(max(self.square, 0.0)))


def model_misfits(table):
    """Misfits of the exposures, each detector by itself.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Stars with the columns of `legdistort.measure`.

    Returns
    -------
    dict
        ``{name: Misfit}`` of those with enough unflagged stars; empty if the table has not all columns.
    """
    if any(name not in table.colnames for name in _COLUMNS):
        return {}
    several = "detector" in table.colnames
    keys = [f"{e} {d}" for e, d in zip(table["exposure"], table["detector"], strict=True)] if several else None
    names, which = np.unique(keys if several else np.asarray(table["exposure"]), return_inverse=True)
    x_err, y_err, fwhm = (table[name].value for name in ("x_err", "y_err", "fwhm"))
    chi2, flags = np.asarray(table["chi2"], dtype=float), np.asarray(table["flags"])
    good = (flags == 0) & np.isfinite(chi2) & (chi2 > 0) & (fwhm > 0)
    found = {}
    for i, name in enumerate(names):
        rows = np.flatnonzero(good & (which == i))
        if len(rows) >= _FEWEST:
            square, error = _of_stars(chi2[rows], fwhm[rows], np.sqrt(x_err[rows] * y_err[rows]))
            found[str(name)] = Misfit(square, error, str(table["psf"][rows[0]]))
    return found


def _of_stars(chi2, fwhm, error):
    """Square of the misfit and its error, from the brightest of some stars with errors (n,) of their positions."""
    dof = (2 * box_half(float(np.median(fwhm))) + 1) ** 2 - 5
    # Errors of positions tell the signal to noise of all models alike, those of fluxes not; they were scaled by chi2.
    snr = fwhm / (np.sqrt(8 * np.log(2)) * error) * np.sqrt(np.maximum(1, chi2 - 3 * np.sqrt(2 / dof)))
    best = np.argsort(-snr, kind="stable")[: max(_BRIGHT[0], len(snr) // _BRIGHT[1])]
    lever = dof / snr[best] ** 2
    noise = _MEDIAN * np.sqrt(2 / dof / len(best)) * np.median(lever)
    return float(np.median((chi2[best] - 1) * lever)), float(noise)
