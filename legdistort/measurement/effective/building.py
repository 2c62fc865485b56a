"""An effective PSF made from stars: grid and stars' parameters fitted together.

The grid is that of a Moffat profile plus corrections, constant, linear and quadratic over the field, that carry a
Gaussian prior: they are as smooth as images that a telescope makes. How large they are, by degree, is what makes the
data most probable: a PSF that does not vary gets no terms that do. Where stars determine nothing (few of them, gaps
between the phases of pixels, the dark far wings) the PSF is the Moffat profile. Position, flux and local sky of every
star are free, and are eliminated from the normal equations of the grid.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dtrtri

from ..profiles import moffat
from ..profiles.pixel_noise import pixel_variance
from . import splines
from .corrections import Corrections
from .model import EffectivePSF, Polynomial

#: Usable stars that a PSF takes at least.
STARS_NEEDED = 12
#: Degree in x and y of what it varies over the field: how much it does, the stars determine.
DEGREE = 2

_PER_FWHM = 4  # knots: cubic splines then follow a diffraction-limited core to 0.1 % of its peak
_ITERATIONS = 4
_ANEW = 2  # with other stars, from a PSF that is nearly right
_MOVE = 0.3  # FWHM, largest step of a star in one iteration
_SETTLE = 2  # iterations of the stars alone
_DEVIANT = 3.0  # times the median of chi2 / dof: such a star is no single one
_SIZES = (0.01, 10.0)  # of corrections, relative to those expected: nothing less differs from none
_VARIES = 0.1  # size at first of those that vary over the field: it grows in fewer iterations than it shrinks
_EVEN = 0.02  # relative error that makes bright stars count alike in the mean of what is left
_AT_ONCE = 8  # stars whose patterns and normal matrices stay in the processor's cache


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Stars that make a PSF.

    Attributes
    ----------
    centres : ndarray of int, shape (n, 2)
        Central pixels of their stamps.
    data : ndarray, shape (n, npix)
        Stamps without the light of other stars.
    sky : ndarray, shape (n, npix)
        Variance without photon noise of the star and of its local sky; infinite where a pixel is not to be used.
    photon : float
        Variance per unit of star light.
    """

    centres: np.ndarray
    data: np.ndarray
    sky: np.ndarray
    photon: float

    @property
    def half(self):
        """Half the side of a stamp, without the central pixel."""
        return (round(np.sqrt(self.data.shape[1])) - 1) // 2

    def variance(self, light):
        """Of the pixels, with this light of the stars and their local skies."""
        return pixel_variance((self.sky, self.photon), light)

    def part(self, rows):
        """Some of the stars."""
        return Ensemble(self.centres[rows], self.data[rows], self.sky[rows], self.photon)


@dataclass(frozen=True, eq=False)
class Built:
    """An effective PSF with what its stars leave open.

    Attributes
    ----------
    base : ndarray, shape (ny, nx)
        Grid that is corrected.
    psf : EffectivePSF
    params : ndarray, shape (n, 4)
        x, y (from the central pixel), flux, background of the stars that made it.
    used : ndarray of bool, shape (n,)
    corrections : Corrections
    amplitudes : ndarray, shape (n_amplitudes,)
        Of the corrections.
    precision : ndarray, shape (n_amplitudes,)
        Inverse variances of their prior.
    factor : tuple
        Cholesky factor of the inverse covariance of the amplitudes.
    misfit : float
        Part of their light by which the brighter stars deviate from the PSF beyond their noise.
    """

    base: np.ndarray
    psf: EffectivePSF
    params: np.ndarray
    used: np.ndarray
    corrections: Corrections
    amplitudes: np.ndarray
    precision: np.ndarray
    factor: tuple
    misfit: float = 0.0

    def for_stars(self, params):
        """The same with other stars: x, y, flux, background (n, 4)."""
        return replace(self, params=params, used=np.ones(len(params), dtype=bool))


def profile_psf(shape, half, image_shape):
    """A Moffat profile as `EffectivePSF`, constant over the field: what a PSF is made to start from.

    Parameters
    ----------
    shape : ndarray, shape (4,)
        See `legdistort.measurement.profiles.moffat`.
    half : int
        Half the side of the stamps; the grid reaches twice as far, to describe neighbours.
    image_shape : tuple
        ``(ny, nx)`` of the detector.
    """
    spacing = float(moffat.fwhm(shape)) / _PER_FWHM
    reach = int(np.ceil((2 * half + 1) / spacing)) + 1
    places = splines.knots(2 * reach + 1, spacing)
    nodes, weights = np.polynomial.legendre.leggauss(5)
    params = moffat.parameters(np.ones(1), shape)
    image = np.zeros((len(places), len(places)))
    for dy, wy in zip(nodes / 2, weights / 2, strict=True):
        for dx, wx in zip(nodes / 2, weights / 2, strict=True):
            image += wx * wy * _profile(params[0], places[None, :] + dx, places[:, None] + dy)
    grid = splines.coefficients(image)
    return EffectivePSF(grid[None] / (grid.sum() * spacing**2), spacing, shape=image_shape)


def _profile(p, u, v):
    """Moffat profile of unit peak at any places."""
    beta = np.exp(p[6])
    form = np.exp(p[3]) * u**2 + np.exp(p[4]) * v**2 + 2 * p[5] * np.exp((p[3] + p[4]) / 2) * u * v
    return (1 + (np.exp2(1 / beta) - 1) * form) ** -beta


def build(stars, start, base):
    """Fit grid, positions, fluxes and local skies together.

    Parameters
    ----------
    stars : Ensemble
    start : ndarray, shape (n, 4)
        x, y (from the central pixel), flux, background.
    base : EffectivePSF
        From `profile_psf`.

    Returns
    -------
    Built
    """
    ny, nx = base.shape
    variation = Polynomial(DEGREE, ((nx - 1) / 2, (ny - 1) / 2), (nx / 2, ny / 2))
    corrections = Corrections.around(base.coefficients[0], base.spacing, variation.powers, stars.half)
    none = np.zeros(corrections.n_amplitudes)
    degrees = corrections.by_term(np.array([i + j for i, j in variation.powers]))
    precision = np.where(degrees > 0, _VARIES**-2.0, 1.0)
    psf = replace(
        base,
        coefficients=np.pad(base.coefficients, ((0, len(variation.powers) - 1), (0, 0), (0, 0))),
        variation=variation,
    )
    used = np.ones(len(start), dtype=bool)
    first = Built(base.coefficients[0], psf, start, used, corrections, none, precision, ())
    return improved(first, stars, iterations=_ITERATIONS)


def improved(before, stars, *, iterations=_ANEW):
    """A PSF fitted anew to its stars, by Gauss-Newton iterations.

    Parameters
    ----------
    before : Built
    stars : Ensemble
        Those of its parameters.
    iterations : int

    Returns
    -------
    Built
    """
    base, corrections, spacing, variation = before.base, before.corrections, before.psf.spacing, before.psf.variation
    params, used, misfit = before.params, before.used, 0.0
    terms = variation(stars.centres + params[:, :2])
    degrees = corrections.by_term(np.array([i + j for i, j in variation.powers]))
    amplitudes, precision = before.amplitudes, before.precision
    grids, longest = base + corrections.grids(terms @ corrections.raw(amplitudes)), _MOVE * _PER_FWHM * spacing
    for k in range(iterations):
        linear = _linearise(stars, params, grids, spacing, misfit)
        if k >= iterations // 2:  # what is left over is that of a PSF that follows the stars
            misfit = _misfit(_linearise(stars, params, grids, spacing, 0.0))
            linear = _linearise(stars, params, grids, spacing, misfit)
            used = _single(linear)
        normal, right, followed = _normal(stars, linear, params, corrections, spacing, terms, used)
        normal[np.diag_indices(len(normal))] += precision
        factor = cho_factor(normal, lower=True, overwrite_a=True, check_finite=False)
        change = cho_solve(factor, right - precision * amplitudes, check_finite=False)
        amplitudes = amplitudes + change
        if k < iterations - 1:
            precision = _evidence(precision, amplitudes, factor, degrees)
        follow = np.einsum("nam,nm->na", followed, terms @ corrections.raw(change))
        params = _moved(params, linear, longest, follow)
        grids = base + corrections.grids(terms @ corrections.raw(amplitudes))
        for _ in range(_SETTLE):  # positions are not linear: they follow the new grid before it is changed again
            linear = _linearise(stars, params, grids, spacing, misfit)
            params = _moved(params, linear, longest)
    coefficients = corrections.grids(corrections.raw(amplitudes))
    coefficients[0] += base
    linear = _linearise(stars, params, grids, spacing, 0.0)
    known = {"n_stars": int(used.sum()), "residual": _mean_residual(linear, params, used)}
    halo = max(_slope(params[used, 2], params[used, 3]), 0.0)
    psf = replace(before.psf, coefficients=coefficients, halo=halo, **known)
    return Built(base, psf, params, used, corrections, amplitudes, precision, factor, _misfit(linear))


def _slope(x, y):
    """Median of the slopes of all pairs: `scipy.stats.theilslopes`, which takes a third of a second to load."""
    dx, dy = x[:, None] - x, y[:, None] - y
    return float(np.median(dy[dx > 0] / dx[dx > 0]))


def _evidence(precision, amplitudes, factor, degrees):
    """Inverse variances of the prior, of every degree those that make the data most probable (MacKay 1992)."""
    inverse = np.square(np.tril(dtrtri(factor[0], lower=1)[0])).sum(axis=0)  # diagonal of the covariance
    out = np.empty_like(precision)
    for degree in np.unique(degrees):
        of = degrees == degree
        number = np.sum(1 - precision[of] * inverse[of])  # of amplitudes that the stars determine
        size = np.sqrt(np.sum(amplitudes[of] ** 2) / max(number, 1.0))
        out[of] = np.clip(size, *_SIZES) ** -2.0
    return out


def _mean_residual(linear, params, used):
    """Weighted mean of what is left of the stars used, in parts of their light, on their pixels; a square array."""
    flux, weights = params[used, 2:3], linear.weights[used]
    weights = weights / (1 + weights * (_EVEN * linear.model[used]) ** 2)  # else the brightest star alone would show
    left = (weights * flux * linear.residual[used]).sum(axis=0) / np.maximum((weights * flux**2).sum(axis=0), 1e-300)
    return left.reshape(round(np.sqrt(len(left))), -1)


def settled(stars, start, psf, *, iterations=4):
    """Stars fitted one by one with a PSF, by Gauss-Newton iterations.

    Parameters
    ----------
    stars : Ensemble
    start : ndarray, shape (n, 4)
        x, y (from the central pixel), flux, background.
    psf : EffectivePSF
    iterations : int

    Returns
    -------
    params : ndarray, shape (n, 4)
    chi2, dof : ndarray, shape (n,)
    """
    params, grids = start.copy(), psf.grids(stars.centres + start[:, :2])
    for _ in range(iterations):
        params = _moved(params, _linearise(stars, params, grids, psf.spacing, 0.0), _MOVE * psf.fwhm)
    return params, *_chi2(_linearise(stars, params, grids, psf.spacing, 0.0))


@dataclass(frozen=True, eq=False)
class _Linear:
    """Stars linearised at some parameters: residuals, weights, slopes (n, 4, npix), inverse normal matrices."""

    residual: np.ndarray
    weights: np.ndarray
    model: np.ndarray
    slopes: np.ndarray
    inverse: np.ndarray


def _linearise(stars, params, grids, spacing, misfit):
    value, by_x, by_y = splines.on_stamps(grids, params[:, :2], stars.half, spacing, slopes=True)
    flux = params[:, 2:3]
    model = flux * value
    # with the local sky: a level that PSF and sky share must not change the noise
    weights = 1 / (stars.variance(model + params[:, 3:]) + (misfit * model) ** 2)
    slopes = np.stack([flux * by_x, flux * by_y, value, np.ones_like(value)], axis=1)
    weighted = slopes * weights[:, None]
    inverse = np.linalg.inv(weighted @ slopes.swapaxes(1, 2))
    residual = stars.data - model - params[:, 3:]
    return _Linear(residual, weights, model, slopes, inverse)


def _chi2(linear):
    """Of every star, and its degrees of freedom."""
    chi2 = (linear.weights * linear.residual**2).sum(axis=1)
    return chi2, np.maximum(np.count_nonzero(linear.weights, axis=1) - 4, 1)


def _misfit(linear):
    """Relative deviation of the brighter stars from the PSF beyond their noise: no PSF is quite right."""
    chi2, dof = _chi2(linear)
    lever = (linear.weights * linear.model**2).sum(axis=1)
    bright = lever >= np.quantile(lever, 2 / 3)
    return float(np.sqrt(max(np.median(((chi2 - dof) / lever)[bright]), 0.0)))


def _single(linear):
    """Stars that look as the others do."""
    chi2, dof = _chi2(linear)
    return chi2 / dof < _DEVIANT * max(np.median(chi2 / dof), 1.0) + 3 * np.sqrt(2 / dof)


def _normal(stars, linear, params, corrections, spacing, terms, used):
    """Normal matrix and right side of the amplitudes, the stars' own parameters eliminated.

    Returns too how the stars' parameters follow the corrections at their place, (n, 4, n_modes).
    """
    n_terms, n_modes = terms.shape[1], corrections.modes.shape[-1]
    pairs = corrections.pairs()
    products = {size: np.zeros((len(first), *size)) for size, (first, _) in pairs.items()}
    right = np.zeros((n_terms, n_modes))
    followed = np.zeros((len(terms), 4, n_modes))
    rows = np.flatnonzero(used)
    for part in np.array_split(rows, -(-len(rows) // _AT_ONCE)):
        # single precision for the patterns: all that follows sees the same ones
        light = corrections.on_stamps(params[part, :2].astype(np.float32), stars.half, spacing)
        root = np.sqrt(linear.weights[part])[:, :, None]
        light = light * (params[part, 2, None, None] * root)
        slopes, residual = linear.slopes[part] * root.swapaxes(1, 2), linear.residual[part, :, None] * root
        followed[part] = linear.inverse[part] @ (slopes @ light)
        light -= slopes.swapaxes(1, 2) @ followed[part]  # what the star's own parameters do not take up
        across = light.swapaxes(1, 2)
        own, rest = across @ light, (across @ residual)[:, :, 0]
        t = terms[part]
        for (m, n), (first, second) in pairs.items():
            products[m, n] += np.tensordot(t[:, first] * t[:, second], own[:, :m, :n], (0, 0))
        right += t.T @ rest
    return corrections.normal(products), corrections.reduced(right), followed


def _moved(params, linear, longest, after=0.0):
    """Parameters of the stars after a step of their own less `after`, no position farther than `longest`."""
    pull = (linear.slopes * linear.weights[:, None]) @ linear.residual[:, :, None]
    step = (linear.inverse @ pull)[:, :, 0] - after
    step[:, :2] *= np.minimum(1, longest / np.maximum(np.hypot(*step[:, :2].T), 1e-12))[:, None]
    return params + step
