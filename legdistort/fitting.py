"""All stars of a frame fitted: neighbours subtracted, noise from the model, hot pixels told from stars."""

from enum import IntFlag

import numpy as np

from . import moffat
from .detection import detect


class Flag(IntFlag):
    """Bits of the column ``flags``."""

    SATURATED = 1  #: a saturated pixel within one FWHM of the centre
    EDGE = 2  #: the centre lies less than one FWHM from the edge of the image
    HOT = 4  #: much sharper than the stars of the frame: hot pixel or cosmic ray
    NOT_CONVERGED = 8  #: the fit found no position, or one far from the detection
    INSIGNIFICANT = 16  #: the signal-to-noise ratio is below 3
    BLENDED = 32  #: another detection within two FWHM (its model was subtracted)
    MASKED = 64  #: bad or outlying pixels within one FWHM of the centre were left out of the fit
    SHARED_SHAPE = 128  #: too faint or disturbed for a shape of its own: fitted with the median shape of the frame


#: Flags that make a detection useless as a star position.
UNUSABLE = Flag.SATURATED | Flag.EDGE | Flag.HOT | Flag.NOT_CONVERGED | Flag.INSIGNIFICANT

_FIRST_FWHM = 3.0
_NEIGHBOUR = 0.05  # a subtracted neighbour leaves residuals of this fraction of itself
_HELD = np.full(4, 1e-3)  # a prior that holds the shape
_OUTLIER = 6.0  # standard deviations ...
_OUTLIER_MODEL = 0.2  # ... plus this fraction of the star itself, which no real profile follows exactly
_POINTLIKE = 0.03  # share of the variance of a stamp outside its peak pixel: no star, however sharp, has so little


class Stamps:
    """Square cut-outs around integer positions, and models of all stars laid over each other.

    Parameters
    ----------
    frame : `~legdistort.detection.Frame`
    centres : ndarray of int, shape (n, 2)
        Central pixels (x, y).
    half : int
        Stamps reach from -half to half; models of neighbours twice as far.
    """

    def __init__(self, frame, centres, half):
        self.frame, self.centres, self.half = frame, centres, half
        self.index, self.inside = self._pixels(half)
        self.index_wide, self.inside_wide = self._pixels(2 * half)
        offsets = np.abs(np.arange(-2 * half, 2 * half + 1)) <= half
        self.core = np.flatnonzero(offsets[:, None] & offsets)
        self.data = self.cut(frame.signal)
        self.variance = self.cut(frame.variance)
        self.saturated = self.cut(frame.saturated) & self.inside
        self.good = self.cut(frame.good) & self.inside & ~self.saturated

    def _pixels(self, half):
        ny, nx = self.frame.signal.shape
        dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
        x, y = self.centres[:, :1] + dx, self.centres[:, 1:] + dy
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        return np.clip(y, 0, ny - 1) * nx + np.clip(x, 0, nx - 1), inside

    def cut(self, image):
        """Values of an image in the stamps, (n, npix)."""
        values = image.ravel()[self.index]
        return values if values.dtype == bool else values.astype(float)

    def models(self, params, nodes):
        """Every star on its own stamp, and the sum of all others there; (n, npix) each."""
        own = moffat.evaluate(params, self.half, nodes)
        wide = moffat.evaluate(params, 2 * self.half, moffat.CENTRES)  # far from the centre pixels need no integration
        wide[:, self.core] = own
        wide[params[:, 2] <= 0] = 0
        total = np.zeros(self.frame.signal.size)
        np.add.at(total, self.index_wide[self.inside_wide], wide[self.inside_wide])
        others = total[self.index] - wide[:, self.core]
        return own, np.where(self.inside, others, 0.0)

    def near(self, params, radius):
        """Pixels within a radius of the fitted centres, (n, npix)."""
        dy, dx = np.mgrid[-self.half : self.half + 1, -self.half : self.half + 1].reshape(2, -1)
        return np.hypot(dx - params[:, :1], dy - params[:, 1:2]) <= np.maximum(radius, 0.8)


def _start(stamps, shape):
    middle = stamps.data.shape[1] // 2
    start = np.zeros((len(stamps.centres), 8))
    start[:, 3:7] = shape
    start[:, 2] = np.maximum(stamps.data[:, middle], np.sqrt(stamps.variance[:, middle]))
    return start


def _weights(good, variance):
    return np.where(good, 1 / variance, 0.0)


def find_stars(frame, threshold, fwhm=None):
    """Detect with a kernel as wide as the stars, which is found by trying.

    Parameters
    ----------
    frame : `~legdistort.detection.Frame`
        From `legdistort.detection.prepare`.
    threshold : float
        Signal-to-noise ratio.
    fwhm : float, optional
        Width of the kernel [pix], if it is known.

    Returns
    -------
    centres : ndarray of int, shape (n, 2)
        Pixels (x, y), the highest signal-to-noise ratio first.
    shape : ndarray, shape (4,)
        Median of the bright stars, hot pixels left out (see `legdistort.moffat.shape`).
    """
    kernel = fwhm or _FIRST_FWHM
    shape = moffat.shape(kernel)
    for _ in range(6):
        centres = detect(frame, kernel, threshold)
        if len(centres) == 0:
            break
        shape = _common_shape(Stamps(frame, centres[:150], box_half(kernel)), kernel)
        before, kernel = kernel, float(moffat.fwhm(shape))
        if fwhm is not None or abs(before - kernel) < 0.1 * kernel:
            break
    return centres, shape


def box_half(fwhm):
    """Half the side of the box fitted, without the central pixel."""
    return max(4, int(np.ceil(2 * fwhm)))


def _common_shape(stamps, fwhm):
    """Median shape of the bright stars."""
    start = moffat.shape(fwhm)
    fit, pointlike = _fit_once(stamps, start, moffat.quadrature(fwhm))
    clean = fit.converged & ~(stamps.saturated & stamps.near(fit.params, fwhm)).any(axis=1)
    clean &= (pointlike[:, 0] > _POINTLIKE * pointlike[:, 1]) & (pointlike[:, 0] > fit.chi2) & (fit.params[:, 2] > 0)
    if not clean.any():
        return start
    # the better half by signal-to-noise ratio, or 10 of them: faint stars have no shape to speak of
    ratio = np.where(clean, fit.params[:, 2] / np.sqrt(fit.covariance[:, 2, 2]), -1)
    best = np.argsort(-ratio)[: min(max(10, clean.sum() // 2), clean.sum())]
    return np.median(fit.params[best, 3:7], axis=0)


def _fit_once(stamps, shape, nodes):
    """First pass, with the noise of the sky alone; the fit, and `_point_chi2` of the same pixels."""
    start = _start(stamps, shape)
    _, others = stamps.models(start, nodes)
    data, weights = stamps.data - others, _weights(stamps.good, stamps.variance + (_NEIGHBOUR * others) ** 2)
    return moffat.fit(data, weights, start, nodes=nodes, centre=shape, max_iterations=20), _point_chi2(data, weights)


def _point_chi2(data, weights):
    """Chi2 of a single bright pixel on a flat background, and of the background alone; (n, 2)."""
    n, npix = data.shape
    size = round(np.sqrt(npix))
    middle = np.zeros((size, size), dtype=bool)
    middle[size // 2 - 1 : size // 2 + 2, size // 2 - 1 : size // 2 + 2] = True
    peak = np.argmax(np.where(middle.ravel() & (weights > 0), data, -np.inf), axis=1)
    out = []
    for drop in (True, False):
        w = weights.copy()
        if drop:
            w[np.arange(n), peak] = 0
        mean = (w * data).sum(axis=1) / np.maximum(w.sum(axis=1), 1e-300)
        out.append((w * (data - mean[:, None]) ** 2).sum(axis=1))
    return np.column_stack(out)


def fit_stars(stamps, shape):
    """Fit all stars of a frame in three passes.

    The first knows the noise of the sky alone; the others add the photon noise of the models of the pass
    before, subtract the models of the neighbours and leave out pixels that follow neither.

    Parameters
    ----------
    stamps : Stamps
        Around the detections.
    shape : ndarray, shape (4,)
        Of the stars of the frame.

    Returns
    -------
    fit : `~legdistort.moffat.Fit`
    flags : ndarray of int, shape (n,)
    snr : ndarray, shape (n,)
        Signal-to-noise ratio of the flux at known shape.
    dof : ndarray of int, shape (n,)
        Pixels used less parameters.
    photon : float
        Variance per unit of star light that was used.
    """
    width = moffat.fwhm(shape)
    nodes = moffat.quadrature(width)
    fit, _ = _fit_once(stamps, shape, nodes)
    sky = stamps.variance if stamps.frame.noise_given else stamps.variance * _sky_factor(stamps, fit, nodes)
    photon = stamps.frame.photon
    if photon is None:
        photon = _photon_noise(stamps, sky, fit, nodes)
    for iterations in (20, 40):
        own, others = stamps.models(fit.params, nodes)
        variance = sky + photon * np.maximum(own + others, 0) + (_NEIGHBOUR * others) ** 2
        data = stamps.data - others
        residual = np.abs(data - own - fit.params[:, 7:])
        good = stamps.good & (residual < _OUTLIER * np.sqrt(variance) + _OUTLIER_MODEL * np.abs(own))
        weights = _weights(good, variance)
        fit = moffat.fit(data, weights, fit.params, nodes=nodes, centre=shape, max_iterations=iterations)
    flags = np.zeros(len(stamps.centres), dtype=int)
    hot = (moffat.fwhm(fit.params) < 0.6 * width) | _is_hot(stamps, data, good, fit, nodes)
    wild = _is_wild(fit, width)
    if wild.any():
        fit = _share_shape(fit, wild, data, weights, shape=shape, nodes=nodes)
        hot |= wild & _is_hot(stamps, data, good, fit, nodes)
    flags[wild] |= Flag.SHARED_SHAPE
    flags[hot] |= Flag.HOT
    flags[_is_wild(fit, width)] |= Flag.NOT_CONVERGED
    snr = np.sqrt((weights * moffat.evaluate(fit.params, stamps.half, nodes) ** 2).sum(axis=1))
    flags[snr < 3] |= Flag.INSIGNIFICANT
    near = stamps.near(fit.params, width)
    flags[(near & stamps.inside & ~good & ~stamps.saturated).any(axis=1)] |= Flag.MASKED
    flags[(near & stamps.saturated).any(axis=1)] |= Flag.SATURATED
    return fit, flags, snr, good.sum(axis=1) - 8, photon


def _is_hot(stamps, data, good, fit, nodes):
    """Stars explained better by one bright pixel than by a profile."""
    weights = _weights(good, stamps.variance)
    residual = data - moffat.evaluate(fit.params, stamps.half, nodes) - fit.params[:, 7:]
    return _point_chi2(data, weights)[:, 0] <= (weights * residual**2).sum(axis=1)


def _is_wild(fit, width):
    ratio = moffat.fwhm(fit.params) / width
    shift = np.hypot(fit.params[:, 0], fit.params[:, 1])
    return ~fit.converged | (fit.params[:, 2] <= 0) | (ratio > 3) | (ratio < 1 / 3) | (shift > 1 + 0.5 * width)


def _share_shape(fit, which, data, weights, *, shape, nodes):
    """The fit with some stars fitted anew, their shape held at that of the frame."""
    start = np.zeros((np.count_nonzero(which), 8))
    start[:, 2] = np.maximum(fit.params[which, 2], 1e-3 * np.abs(data[which]).max(axis=1))
    start[:, 3:7] = shape
    again = moffat.fit(data[which], weights[which], start, nodes=nodes, centre=shape, sigma=_HELD)
    merged = {name: getattr(fit, name).copy() for name in ("params", "covariance", "chi2", "converged")}
    for name, values in merged.items():
        values[which] = getattr(again, name)
    return moffat.Fit(**merged)


def _residuals(stamps, fit, nodes):
    """Models of (some) stars and of their neighbours, and squares of what they leave, raised for what a fit absorbs."""
    own, others = stamps.models(fit.params, nodes)
    rows = np.unique(np.linspace(0, len(own) - 1, 400).astype(int))
    _, jac = moffat.evaluate(fit.params[rows], stamps.half, nodes, jacobian=True)
    absorbed = (jac * (fit.covariance[rows] @ jac)).sum(axis=1) / stamps.variance[rows]
    square = (stamps.data - own - others - fit.params[:, 7:])[rows] ** 2 / np.maximum(1 - absorbed, 0.1)
    return rows, own[rows], others[rows], square


def _sky_factor(stamps, fit, nodes):
    """Variance of the sky around the stars, relative to the map: the faint wings of stars raise the latter."""
    rows, own, others, square = _residuals(stamps, fit, nodes)
    variance = stamps.variance[rows]
    dark = stamps.good[rows] & (own + others < 0.5 * np.sqrt(variance))
    use = fit.converged[rows] & (dark.mean(axis=1) > 0.4)
    if np.count_nonzero(use) < 20:  # then the map is known better
        return 1.0
    # The median of a squared unit normal is 0.4549; unlike the mean it overlooks stars too faint to be detected.
    return float(np.clip(np.median((square / variance)[dark & use[:, None]]) / 0.4549, 0.5, 2.0))


def _photon_noise(stamps, sky, fit, nodes):
    """Variance per unit of star light, from the residuals of the first pass: the median over the stars.

    The squared residual of a pixel is expected at ``sky variance + photon * model``. Companions too faint to be
    detected and profiles that do not quite fit raise the value, and the errors with it: on the safe side.
    """
    rows, own, others, square = _residuals(stamps, fit, nodes)
    sky = sky[rows]
    use = fit.converged & (fit.params[:, 2] > 0) & ~stamps.saturated.any(axis=1)
    own = np.where(stamps.good[rows] & use[rows, None], own, 0.0)
    photon = 0.0
    for _ in range(20):
        weights = (sky + photon * own + (_NEIGHBOUR * others) ** 2) ** -2.0
        information = (weights * own**2).sum(axis=1)
        if not (information > 0).any():
            break
        single = (weights * own * (square - sky)).sum(axis=1) / np.maximum(information, 1e-300)
        order = np.argsort(single)
        share = np.cumsum(np.sqrt(information[order]))
        photon = max(float(single[order][np.searchsorted(share, share[-1] / 2)]), 0.0)
    return photon
