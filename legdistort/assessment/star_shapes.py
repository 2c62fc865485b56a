"""How sharp stars are: one elliptical Moffat profile on every cut-out, all pixels alike and none rejected.

Unlike the fits that measure positions (`legdistort.measurement.profiles.frame_fit`), these make no difference between
a star and whatever else there is: a star doubled or smeared by a wrong distortion counts with all its light.
"""

import numpy as np

from ..measurement.profiles import cutouts, levenberg_marquardt, moffat


def measure_shapes(image, xy, *, fwhm, bad=None, saturation=None):
    """Profiles of stars at known places of an image.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
    xy : array_like, shape (n, 2)
        Where the stars are, within a FWHM.
    fwhm : float
        Of the stars [pix], roughly: cut-outs and apertures reach to twice as far from the centre.
    bad : ndarray of bool, optional
        Pixels to leave out, besides those that are not finite.
    saturation : float, optional
        A star with a pixel at or above it is not measured.

    Returns
    -------
    ndarray, shape (n, 6)
        x, y, FWHM, ellipticity, peak over flux, position angle of the major axis [deg] from x to y; NaN for a star near
        the edge, with bad pixels at its centre or many around it, or without a fit.
    """
    half, (ny, nx) = cutouts.box_half(fwhm), np.shape(image)
    xy = np.asarray(xy, dtype=float).reshape(-1, 2)
    out = np.full((len(xy), 6), np.nan)
    centres = np.round(np.nan_to_num(xy, nan=-1e6)).astype(int)
    inside = np.flatnonzero(((centres >= half) & (centres < np.array([nx, ny]) - half)).all(axis=1))
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    pixels = centres[inside, 1, None] + dy, centres[inside, 0, None] + dx
    data = np.asarray(image[pixels], dtype=float)
    good = np.isfinite(data) if bad is None else np.isfinite(data) & ~bad[pixels]
    usable = (good.mean(axis=1) > 0.9) & good[:, np.hypot(dx, dy) < max(fwhm / 2, 1)].all(axis=1)
    if saturation is not None:
        usable &= ~(data >= saturation).any(axis=1)
    inside, data, good = inside[usable], data[usable], good[usable]
    if len(inside) == 0:
        return out
    params, converged = _fit(data, good, xy[inside] - centres[inside], fwhm)
    light = np.where(good, data - params[:, 7:], moffat.evaluate(params, half, moffat.quadrature(fwhm)))
    distance = np.hypot(dx - params[:, :1], dy - params[:, 1:2])
    flux = (np.clip(2 * fwhm + 0.5 - distance, 0, 1) * light).sum(axis=1)
    a, b = np.exp(params[:, 3:5]).T
    half_sum, c = (a + b) / 2, params[:, 5] * np.sqrt(a * b)
    gap = np.hypot((a - b) / 2, c)  # the eigenvalues of the quadratic form are half_sum +- gap, 1 / axis^2
    with np.errstate(divide="ignore", invalid="ignore"):
        peak = params[:, 2] / flux
    angle = np.degrees(np.arctan2(-c, (b - a) / 2)) / 2  # the longer axis is that of the smaller eigenvalue
    shapes = moffat.fwhm(params), 1 - np.sqrt((half_sum - gap) / (half_sum + gap)), peak, angle
    found = converged & (params[:, 2] > 0) & (flux > 0) & (np.abs(params[:, :2]) < half).all(axis=1)
    out[inside[found]] = np.column_stack([centres[inside] + params[:, :2], *shapes])[found]
    return out


def _fit(data, good, offset, fwhm):
    """Parameters (n, 8) and whether the fit converged, all good pixels weighted alike."""
    start = np.zeros((len(data), 8))
    start[:, :2], start[:, 3:7] = offset, moffat.shape(fwhm)
    filled = np.where(good, data, np.nan)
    start[:, 7] = np.nanpercentile(filled, 20, axis=1)
    start[:, 2] = np.nanmax(filled, axis=1) - start[:, 7]
    # the noise only sets the weight of the prior of the shape, which must not count
    noise = np.where(start[:, 2:3] > 0, 1e-3 * start[:, 2:3], 1.0)
    nodes, shape = moffat.quadrature(fwhm), moffat.shape(fwhm)
    found = levenberg_marquardt.fit(np.where(good, data, 0), good / noise**2, start, nodes=nodes, centre=shape)
    return found.params, found.converged
