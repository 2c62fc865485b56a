"""Where the reference plane lies on the sky."""

from dataclasses import dataclass

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.modeling import models

from .similarity import apply


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
