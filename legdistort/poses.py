"""Similarities between the reference plane and detectors, and the tie to the sky.

A *pose* is a (2, 3) array ``[M | t]`` that maps a position X (pixels of the
reference plane) to undistorted pixels of one exposure, ``q = M X + t``; M is a
rotation, possibly with a flip, times a scale.
"""

from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.modeling import models

from .exceptions import InputError


def identity():
    """The pose that changes nothing, shape (2, 3)."""
    return np.eye(2, 3)


def apply(pose, xy):
    """Map positions (..., 2) through a pose."""
    return np.asarray(xy, dtype=float) @ pose[:, :2].T + pose[:, 2]


def invert(pose):
    """The pose of the opposite direction."""
    inverse = np.linalg.inv(pose[:, :2])
    return np.column_stack([inverse, -inverse @ pose[:, 2]])


def compose(second, first):
    """The pose ``x -> second(first(x))``."""
    return np.column_stack([second[:, :2] @ first[:, :2], apply(second, first[:, 2])])


def check(pose, name="pose"):
    """Return `pose` as a (2, 3) float array; raise `InputError` if it is not a similarity."""
    pose = np.asarray(pose, dtype=float)
    if pose.shape != (2, 3) or not np.all(np.isfinite(pose)):
        raise InputError(f"{name} must be a finite (2, 3) array [M | t], got shape {pose.shape}")
    scale2 = abs(np.linalg.det(pose[:, :2]))
    if scale2 == 0 or not np.allclose(pose[:, :2] @ pose[:, :2].T, scale2 * np.eye(2), rtol=0, atol=1e-6 * scale2):
        raise InputError(
            f"{name} is not a similarity (rotation, flip, scale, shift): its linear part is {pose[:, :2].tolist()}; "
            "leave shear to the distortion"
        )
    return pose


def describe(pose):
    """Shift [pix], rotation [deg], scale and parity (+1 or -1) of a pose, as a dict."""
    m = pose[:, :2]
    parity = 1 if np.linalg.det(m) > 0 else -1
    return {
        "dx": float(pose[0, 2]),
        "dy": float(pose[1, 2]),
        "rotation": float(np.degrees(np.arctan2(m[1, 0], m[0, 0]))),
        "scale": float(np.sqrt(abs(np.linalg.det(m)))),
        "parity": parity,
    }


def fit_similarity(source, target, *, weights=None, parity=None):
    """Least-squares similarity that carries `source` to `target`.

    Parameters
    ----------
    source, target : array_like, shape (n, 2)
    weights : array_like, shape (n,), optional
        Non-negative; at least two distinct points need a positive one.
    parity : {1, -1, None}
        Keep the orientation, flip it, or take whichever fits better.

    Returns
    -------
    ndarray, shape (2, 3)

    Raises
    ------
    InputError
        With fewer than two distinct points.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    w = np.ones(len(source)) if weights is None else np.asarray(weights, float)
    if len(source) < 2 or np.count_nonzero(w) < 2:
        raise InputError(f"a similarity needs at least two points, got {np.count_nonzero(w)}")
    w = w / w.sum()
    mean_s, mean_t = w @ source, w @ target
    ds, dt = source - mean_s, target - mean_t
    power = w @ (ds**2).sum(axis=1)
    if power == 0:
        raise InputError("a similarity needs at least two distinct points, all are at the same place")
    cross = (w[:, None] * dt).T @ ds / power  # M = argmin |dt - M ds|^2 within the similarities
    keep, flip = (np.hypot(*part) for part in _turns(cross))
    if parity is None:
        parity = 1 if keep >= flip else -1
    return similarity_of(mean_s, mean_t, cross, parity)


def similarity_of(mean_s, mean_t, cross, parity):
    """Least-squares similarities from the moments of their points.

    Parameters
    ----------
    mean_s, mean_t : ndarray, shape (..., 2)
        Weighted mean of source and target.
    cross : ndarray, shape (..., 2, 2)
        Weighted sum of target times source about their means, over the sum of squares of the source.
    parity : ndarray of 1 or -1, shape (...)

    Returns
    -------
    ndarray, shape (..., 2, 3)
    """
    a, b = np.where(np.asarray(parity) > 0, *_turns(cross))
    m = np.stack([np.stack([a, -b * parity], axis=-1), np.stack([b, a * parity], axis=-1)], axis=-2)
    shift = mean_t - np.einsum("...ab,...b->...a", m, mean_s)
    return np.concatenate([m, shift[..., None]], axis=-1)


def _turns(cross):
    """Scale times cosine and sine of the best rotation, and of the best rotation after a flip of y."""
    (xx, xy), (yx, yy) = np.moveaxis(cross, (-2, -1), (0, 1))
    return np.stack([xx + yy, yx - xy]), np.stack([xx - yy, yx + xy])


def _compass(lon, lat):
    """Unit vectors to the east and to the north at places on the sphere, radians, each (..., 3)."""
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    return east, north


@dataclass(frozen=True, eq=False)
class TangentPlane:
    """Where the reference plane lies on the sky (gnomonic projection).

    Attributes
    ----------
    lon, lat : float
        Tangent point, ICRS degrees.
    matrix : ndarray, shape (2, 3)
        Reference-plane pixels -> (xi, eta) on the tangent plane, degrees, xi to the east.
    """

    lon: float
    lat: float
    matrix: np.ndarray

    def __repr__(self):
        return f"<TangentPlane: {self.lon:.5f} {self.lat:+.5f} deg, {self.pixel_scale:.4f} arcsec/px>"

    def model(self):
        """The astropy model (x, y) [pix] -> (ra, dec) [deg], stock parts only, inverse included."""
        m = np.asarray(self.matrix, dtype=float)
        plane = models.AffineTransformation2D(matrix=m[:, :2], translation=m[:, 2], name="plane")
        sky = models.Pix2Sky_TAN() | models.RotateNative2Celestial(self.lon, self.lat, 180.0)
        return plane | sky

    @property
    def pixel_scale(self):
        """Size of a reference-plane pixel, arcsec."""
        return 3600 * np.sqrt(abs(np.linalg.det(self.matrix[:, :2])))

    def to_sky(self, xy):
        """Reference-plane positions (n, 2) -> `~astropy.coordinates.SkyCoord` (ICRS)."""
        xy = np.asarray(xy, dtype=float)
        return SkyCoord(*self.model()(xy[..., 0], xy[..., 1]) * u.deg, frame="icrs")

    def jacobian(self, xy):
        """Derivative of (ra cos(dec), dec) [deg] by (x, y) [pix] at reference positions (n, 2), shape (n, 2, 2).

        The direction to a point of the plane is ``s = (s0 + xi e + eta n) / N``; what changes along s itself is of
        no matter for the directions east and north of s, which are perpendicular to it.
        """
        lon, lat = np.radians(self.lon), np.radians(self.lat)
        plane = np.radians(apply(self.matrix, xy))
        length = np.sqrt(1 + (plane**2).sum(axis=1))
        axes = np.stack(_compass(lon, lat))  # e, n of the tangent point
        towards = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
        s = (towards + plane @ axes) / length[:, None]
        lon, lat = np.arctan2(s[:, 1], s[:, 0]), np.arctan2(s[:, 2], np.hypot(s[:, 0], s[:, 1]))
        return np.stack(_compass(lon, lat), axis=1) @ axes.T @ self.matrix[:, :2] / length[:, None, None]

    def to_sky_errors(self, xy, variance):
        """Errors on the sky of positions (n, 2) with variances (3, n) ``xx, yy, xy`` [pix^2].

        Returns
        -------
        ra_error, dec_error : `~astropy.units.Quantity`
            Standard deviations of ra cos(dec) and dec, mas.
        corr : ndarray
            Their correlation.
        """
        jacobian = self.jacobian(xy)
        covariance = np.moveaxis(np.array([[variance[0], variance[2]], [variance[2], variance[1]]]), -1, 0)
        covariance = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
        ra_error, dec_error = np.sqrt(covariance[:, 0, 0]), np.sqrt(covariance[:, 1, 1])
        corr = covariance[:, 0, 1] / (ra_error * dec_error)
        return (ra_error * u.deg).to(u.mas), (dec_error * u.deg).to(u.mas), corr

    def from_sky(self, coordinates):
        """`~astropy.coordinates.SkyCoord` -> reference-plane positions (..., 2); inverse of `to_sky`."""
        icrs = coordinates.icrs
        return np.stack(self.model().inverse(icrs.ra.deg, icrs.dec.deg), axis=-1)
