"""What stars that are not seen do to the positions of those that are.

A neighbour of signal-to-noise ratio u at the distance d, left in, shifts a star by ``u g(d)`` of its errors, with
``g(d) = (d / (sqrt(2) s)) exp(-d^2 / 4 s^2)`` for a PSF of standard deviation s. It is not seen up to a ratio that
grows the nearer it is: what it leaves once one star has been fitted to both is less than its own light. The number of
such neighbours follows from those that are seen around a star, by the law that the fluxes of all stars follow. Shifts
by more than some errors are rare, and no matter of a variance.
"""

import numpy as np
from scipy.spatial import cKDTree

_COMPLETE = 3.0  # times the threshold: fainter stars are not all seen
_AROUND = 12  # stars whose distance tells how many there are
_FEWEST = 30  # stars from which the law of fluxes follows
_LARGEST = 5.0  # errors by which a star is shifted: what is shifted by more is an outlier, whatever the variance
_SLOPE = (0.2, 1.8)  # of the number of stars over their flux, minus its power
_SEPARATIONS = np.linspace(0, 6, 121)[1:]  # standard deviations of the PSF


def flux_law(flux, snr, threshold):
    """The law that fluxes of stars follow: their number above a flux goes with its power -p.

    Parameters
    ----------
    flux, snr : ndarray, shape (n,)
        Signal-to-noise ratios at known positions.
    threshold : float
        Signal-to-noise ratio from which a star alone is found.

    Returns
    -------
    tuple of float or None
        The flux above which all stars are seen, and p by these; None where too few tell.
    """
    faint = snr < 2 * _COMPLETE * threshold
    if np.count_nonzero(faint) < _FEWEST:
        return None
    least = float(_COMPLETE * threshold * np.median(flux[faint] / snr[faint]))
    seen = flux > least
    n = np.count_nonzero(seen)
    return None if n < _FEWEST else (least, float(np.clip(n / np.log(flux[seen] / least).sum(), *_SLOPE)))


def confusion(xy, flux, snr, *, sigma, threshold, area):
    """Variance that stars not seen add to a position, in units of that of its fit.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
        Stars [pix].
    flux, snr : ndarray, shape (n,)
        Signal-to-noise ratios at known positions.
    sigma : float
        Standard deviation of the PSF [pix].
    threshold : float
        Signal-to-noise ratio from which a star alone is found.
    area : float
        Of the frame [pix^2]; it bounds the space around a star.

    Returns
    -------
    ndarray, shape (n,)
        0 where too few stars tell.
    """
    law = flux_law(flux, snr, threshold)
    if law is None:
        return np.zeros(len(flux))
    least, power = law
    seen = flux > least
    n = np.count_nonzero(seen)
    distance = cKDTree(xy[seen]).query(xy, k=min(_AROUND, n))[0][:, -1]
    density = _AROUND / np.minimum(np.pi * np.maximum(distance, sigma) ** 2, area)
    # stars per px^2 of more than u times the noise of this star: number * u ** -power
    number = density * (least * snr / flux) ** power
    square = _SEPARATIONS**2 / 2
    unseen = threshold / np.sqrt(1 - np.exp(-square) * (1 + square))
    brightest = np.minimum(np.minimum(unseen, _LARGEST * np.exp(square / 2) / np.sqrt(square)), snr[:, None])
    moment = power / (2 - power) * number[:, None] * brightest ** (2 - power)
    return np.pi * sigma**2 * np.trapezoid(moment * square * np.exp(-square) * _SEPARATIONS, _SEPARATIONS, axis=1)
