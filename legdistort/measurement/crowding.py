"""How much other stars disturb the position of a star.

"We only consider relatively well-isolated stars in order to avoid any confusion" (Bernard et al. 2017, section 5.2.1).
Two quantities are computed for every star. *Detected neighbours*: how far their light would pull the position if it
were not subtracted, in standard errors of the position (`crowding`). Subtraction leaves a small part of that, some per
cent. *Neighbours too close to be detected*: whether the shape of the star shows one (`is_deformed`).
"""

from functools import lru_cache
from numbers import Real

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

from ..exceptions import InputError
from .flags import Flag, flags_of
from .profiles.shape_field import deviation, shape_field, usual

#: Largest `crowding` of a star called isolated: what subtraction leaves of it is then a small part of its error.
LIMIT = 3.0
#: Chi2 of a shape, per parameter, beyond which it is not that of a single star; chance alone gives 1 in 300.
DEFORMED = 4.0
#: Signal-to-noise ratio of stars that determine what shape is usual.
SHAPELY = 20

#: Part of the detections of another program that must have no neighbours for those that have some to be left out.
CLEAN = 0.5

#: FWHM: two stars nearer than that are one, where neighbours are fitted together.
SAME = 0.2

_CLOSE = 2.0  # FWHM of stars that touch
_CROWD, _FEW = 0.05, 10  # of the detections, at least so many, have another one as close as that: a crowd
_BETA = 3.0
_REACH = 6.0  # FWHM: neighbours farther away than this pull at nothing but the background
_QUARTILE = 0.3186  # of the absolute value of a unit normal
_FEWEST = 20  # stars that determine what shape is usual


def check_isolation(limit):
    """Raise `InputError` if a limit of `is_isolated` is neither positive nor None."""
    if limit is not None and not (isinstance(limit, Real) and limit > 0):
        raise InputError(f"isolation must be a positive number of standard errors, or None, got {limit!r}")


def is_isolated(table, limit=LIMIT):
    """Whether detections have neither `crowding` above a limit nor the flag ``DEFORMED``.

    Of tables without a column ``crowding``, of other programs, those pass that have no flag ``BLENDED`` either, if that
    is most of them (`CLEAN`), else all.

    Parameters
    ----------
    table : `~astropy.table.Table`
        As from `legdistort.measure`.
    limit : float or None
        None or infinity: everything passes.

    Returns
    -------
    ndarray of bool, shape (n,)

    Raises
    ------
    InputError
        If the limit is not positive.
    """
    check_isolation(limit)
    isolated = np.ones(len(table), dtype=bool)
    if limit is None or limit == np.inf or not {"crowding", "flags"} & set(table.colnames):
        return isolated
    if "crowding" not in table.colnames:  # how far a neighbour pulls is not known
        clean = (flags_of(table) & Flag.BLENDED) == 0
        return clean if np.count_nonzero(clean) >= CLEAN * len(table) else isolated
    isolated = np.asarray(table["crowding"], dtype=float) <= limit
    if "flags" in table.colnames:
        isolated &= (flags_of(table) & Flag.DEFORMED) == 0
    return isolated


def displacement(xy, flux, fwhm, *, sources=None):
    """Shift of every star's position by the light of its neighbours, were that left in.

    To first order, for round Moffat profiles (beta = 3) of one width, fitted in a box of 4 FWHM with free background:
    shifts of several neighbours add as vectors.

    Parameters
    ----------
    xy : ndarray, shape (n, 2)
        Positions [pix].
    flux : ndarray, shape (n,)
    fwhm : float
        [pix]
    sources : ndarray of bool, shape (n,), optional
        Which of them give light; by default all with a positive flux.

    Returns
    -------
    ndarray, shape (n, 2)
        Pixels, towards the neighbours; NaN for stars without a positive flux.
    """
    xy, flux = np.asarray(xy, dtype=float), np.asarray(flux, dtype=float)
    lit = flux > 0
    sources = lit if sources is None else lit & sources
    i, j = KDTree(xy).query_pairs(_REACH * fwhm, output_type="ndarray").T
    i, j = np.concatenate([i, j]), np.concatenate([j, i])
    pairs = lit[i] & sources[j]
    i, j = i[pairs], j[pairs]
    away = xy[j] - xy[i]
    distance = np.maximum(np.hypot(*away.T), 1e-9)
    pull = flux[j] / flux[i] * fwhm * np.interp(distance / fwhm, *_pull()) / distance
    out = np.where(lit[:, None], np.zeros_like(xy), np.nan)
    np.add.at(out, i, pull[:, None] * away)
    return out


@lru_cache(maxsize=1)
def _pull():
    """Distances, and the shift of a star by an equal one there; both in FWHM."""
    half = np.linspace(-2, 2, 81)
    x, y = np.meshgrid(half, half)

    def profile(x):
        return (1 + 4 * (2 ** (1 / _BETA) - 1) * (x**2 + y**2)) ** -_BETA

    slope = (profile(x - 1e-4) - profile(x + 1e-4)) / 2e-4  # derivative by the position of the star
    distances = np.linspace(0, _REACH, 121)
    return distances, np.array([(slope * profile(x - d)).sum() for d in distances]) / (slope**2).sum()


def crowding(table, fwhm):
    """Shift by the light of detected neighbours, were that left in, in standard errors of the position.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Detections of one exposure: ``x``, ``y``, ``x_err``, ``y_err``, ``flux``, ``flags``.
    fwhm : float
        Of its stars [pix].

    Returns
    -------
    ndarray, shape (n,)
        0 for a star without neighbours; infinite for one without a positive flux.
    """
    x, y, x_err, y_err = (table[name].value for name in ("x", "y", "x_err", "y_err"))
    sources = (table["flags"] & (Flag.NOT_CONVERGED | Flag.INSIGNIFICANT)) == 0
    shift = displacement(np.column_stack([x, y]), table["flux"], fwhm, sources=sources)
    ratio = np.hypot(shift[:, 0] / x_err, shift[:, 1] / y_err)
    return np.where(np.isnan(ratio), np.inf, ratio)


def is_deformed(shapes, covariance, *, xy, peak, snr, chi2, usable):
    """Whether shapes differ by more than their noise from what is usual at their place in the frame.

    What is usual is a polynomial of degree 2 in x and y, and linear in the height of the star, through the shapes of
    bright stars (`shape_field`). Allowed for, besides noise, are the error of that polynomial, what Moffat profiles
    leave of bright stars whose images are none, and the scatter of shapes among the best quarter of the stars.

    Parameters
    ----------
    shapes : ndarray, shape (n, 4)
        Of fitted profiles, see `legdistort.measurement.profiles.moffat.NAMES`.
    covariance : ndarray, shape (n, 4, 4)
    xy : ndarray, shape (n, 2)
        Positions [pix].
    peak : ndarray, shape (n,)
        Heights of the stars.
    snr : ndarray, shape (n,)
    chi2 : ndarray, shape (n,)
        Of the fits, reduced.
    usable : ndarray of bool, shape (n,)
        Stars whose shape counts for what is usual.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    order = np.flatnonzero(usable)[np.argsort(-snr[usable], kind="stable")]
    best = order[: max(_FEWEST, len(order) // 4)]
    if len(best) < 8:
        return np.zeros(len(shapes), dtype=bool)
    # the quartile stays what it is among single stars even where half of the others are blends
    misfit = max(0.0, np.quantile((chi2[best] - 1) / snr[best] ** 2, 0.25))
    covariance = covariance * (1 + misfit * snr**2)[:, None, None]
    bright = np.zeros(len(shapes), dtype=bool)
    bright[order[: max(len(best), np.count_nonzero(snr[order] > SHAPELY))]] = True
    fallback = np.median(shapes[best], axis=0)
    field, known = shape_field(shapes, covariance, xy, bright, degree=2, fallback=fallback, peak=peak)
    off = shapes - field
    spread = (np.quantile(np.abs(off[best]), 0.25, axis=0) / _QUARTILE) ** 2
    noise = np.median(np.einsum("nii->ni", covariance[best]), axis=0)
    deviations = deviation(off, np.linalg.inv(covariance + known + np.diag(np.maximum(spread - noise, 0))))
    return deviations > DEFORMED * shapes.shape[1] * usual(deviations[best])  # the spread is known from few stars


def is_crowded(frame, centres, width):
    """Whether more than 5 % of the detections, and ten, have another one within two FWHM.

    Those beside saturated pixels and defects do not count: trails and tracks break up into many.

    Parameters
    ----------
    frame : `~legdistort.measurement.detection.Frame`
    centres : ndarray of int, shape (n, 2)
        Detections.
    width : float
        Full width at half maximum [pix].
    """
    if not _have_neighbours(centres, width):
        return False
    bad = frame.saturated if frame.defects is None else frame.saturated | frame.defects
    if bad.any():
        bad = binary_dilation(bad, iterations=int(np.ceil(_CLOSE * width)))
        centres = centres[~bad[centres[:, 1], centres[:, 0]]]
    return _have_neighbours(centres, width)


def _have_neighbours(centres, width):
    if len(centres) < _FEW:
        return False
    nearest = KDTree(centres).query(centres, k=2)[0][:, 1]
    return np.count_nonzero(nearest < _CLOSE * width) >= max(_FEW, _CROWD * len(centres))
