"""The stars of a frame: how wide they are, one width for all, and where."""

import numpy as np

from ...exceptions import InputError
from ..detection import MESH, bright_peaks, detect, prepare, sky_noise
from . import moffat
from .cutouts import Stamps, box_half
from .defects import are_points, without_defects
from .first_fit import fit_once

_FIRST_FWHM = 3.0
#: Peaks that determine the width, the brightest: so many that stars remain if a hundred of them are saturated.
_BRIGHTEST = 300
_CLEAR = 10.0  # standard deviations of a peak of which one can tell whether it is a point
_SETTLED = 0.1  # relative change of the width that ends the search
_POINTLIKE = 0.03  # share of the variance of a stamp outside its peak pixel: no star, however sharp, has so little
_STEADY = 0.02  # relative error of a width below which stars count alike
_FEWEST = 10  # stars whose widths are averaged, if there are
_CROWDED = 0.6  # of the variance at first: what is left of it where much of it was stars
#: Pixels: nothing wider is taken for stars unasked. Sky and detector have structures of any width.
WIDEST = 30.0


def locate_stars(exposure, *, threshold, fwhm=None, known=False):
    """An exposure prepared for fitting, its stars and their shape.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
    threshold : float
        Signal-to-noise ratio.
    fwhm : float, optional
        Of the stars [pix], if it is known.
    known : bool
        Whether it is known where the stars are: they are not looked for, unless they must tell how many photons a unit
        of the data is.

    Returns
    -------
    frame : `~legdistort.measurement.detection.Frame`
        With the variance of the sky alone, see `legdistort.measurement.detection.detect`.
    centres : ndarray of int, shape (n, 2), or None
        Pixels (x, y), the highest signal-to-noise ratio first; None where they were not looked for.
    shape : ndarray, shape (4,)
        Usual one of the bright stars (see `legdistort.measurement.profiles.moffat.shape`).

    Raises
    ------
    InputError
        If what is seen is wider than stars are.
    """
    frame, mesh = prepare(exposure), MESH
    kernel, shape = _frame_shape(frame, fwhm, exposure.name)
    if moffat.fwhm(shape) > mesh / 8:  # stars as wide as that would pass for sky
        frame = prepare(exposure, mesh=int(8 * moffat.fwhm(shape)), before=frame)
        kernel, shape = _frame_shape(frame, fwhm, exposure.name)
    frame = without_defects(frame, shape)

    def look(frame):
        if known and frame.photon is not None:
            return None, sky_noise(frame, kernel)
        return detect(frame, kernel, threshold)

    before = frame
    centres, frame = look(before)
    if np.median(frame.variance[::8, ::8]) < _CROWDED * np.median(before.variance[::8, ::8]):
        centres, frame = look(frame)  # stars have passed for noise, and so for light around others
    return frame, centres, shape


def _frame_shape(frame, fwhm, name):
    """A width that serves to detect stars, and the usual shape of bright ones; found by trying if not known."""
    kernel, shape = fwhm or _FIRST_FWHM, moffat.shape(fwhm or _FIRST_FWHM)
    for _ in range(6):
        peaks = bright_peaks(frame, kernel)
        points = are_points(frame.signal, _CLEAR * np.sqrt(frame.variance[peaks[:, 1], peaks[:, 0]]), peaks)
        peaks = (peaks if points.all() else peaks[~points])[:_BRIGHTEST]
        if len(peaks) == 0:
            break
        shape = _usual_shape(Stamps(frame, peaks, box_half(kernel)), kernel)
        width = float(moffat.fwhm(shape))
        if fwhm is None and width > WIDEST:
            raise InputError(
                f"{name}: no stars are visible: what stands out of the sky has a FWHM of {width:.0f} pixels. Calibrate "
                "the frame (dark, flat field), mask what is no sky, or state how wide the stars are (fwhm=)"
            )
        if fwhm is not None or abs(width - kernel) < _SETTLED * width:
            break
        kernel = width
    return kernel, shape


def _usual_shape(stamps, fwhm):
    """Shape that most bright peaks have: neither that of blends, nor of saturated stars, nor of cosmic rays."""
    start = moffat.shape(fwhm)
    fit, pointlike = fit_once(stamps, start, moffat.quadrature(fwhm))
    clean = fit.converged & ~(stamps.saturated & stamps.near(fit.params, fwhm)).any(axis=1)
    clean &= (pointlike[:, 0] > _POINTLIKE * pointlike[:, 1]) & (pointlike[:, 0] > fit.chi2) & (fit.params[:, 2] > 0)
    if not clean.any():
        return start
    shapes, covariance = fit.params[clean, 3:7], fit.covariance[clean, 3:7, 3:7]
    variance = covariance[:, :2, :2].sum(axis=(1, 2)) / 16  # of the logarithm of the width
    return np.median(shapes[_densest(np.log(moffat.fwhm(shapes)), 1 / (variance + _STEADY**2))], axis=0)


def _densest(values, weights):
    """Indices of the shortest interval of values with half of the weight, or so many that they are `_FEWEST`."""
    order = np.argsort(values, kind="stable")
    before = np.append(0.0, np.cumsum(weights[order]))
    last = np.searchsorted(before, before[:-1] + before[-1] / 2)  # one past the last value of the interval
    last = np.maximum(last, np.arange(len(values)) + min(_FEWEST, len(values)))
    first = np.flatnonzero(last <= len(values))
    spans = values[order][last[first] - 1] - values[order][first]
    chosen = first[np.argmin(spans)]
    return order[chosen : last[chosen]]
