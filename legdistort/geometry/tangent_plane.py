"""Where the reference plane lies on the sky, and the trigonometry of the sphere that this takes."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.modeling import models
from astropy.modeling.core import FittableModel
from astropy.modeling.parameters import Parameter

from ..runtime.notebook import ShownAsPrinted
from ..runtime.trees.facts import array, number
from .models import CHUNK, leaves
from .similarity import apply, invert

if TYPE_CHECKING:
    from astropy.modeling import Model
    from astropy.units import Quantity
    from numpy.typing import ArrayLike

    from ..runtime.annotations import Shape


def directions(lon, lat):
    """Unit vectors (..., 3) to places on the sphere, radians."""
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def angles(vectors):
    """Longitude and latitude [rad] that vectors (..., 3) of any length point to; inverse of `directions`."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def compass(lon, lat):
    """Unit vectors to the east and to the north at places on the sphere, radians, each (..., 3)."""
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    return east, north


def gnomonic(lon, lat, lon0, lat0, degrees=1.0):
    """Projection of places (lon, lat) on the plane that touches the sphere at (lon0, lat0).

    Small offsets keep all their digits; the stock models of `TangentPlane.model` keep those of the angles, some 3e-14
    degrees, and have values beyond 90 degrees too.

    Parameters
    ----------
    lon, lat : array_like, shape (...)
    lon0, lat0 : float
        Tangent point.
    degrees : float
        Size of the unit of all angles, degrees; the plane has that unit too.

    Returns
    -------
    xi, eta : ndarray, shape (...)
        To the east and to the north; NaN at 90 degrees and beyond.
    """
    unit, turn = np.radians(degrees), 360 / degrees
    sin0, cos0 = np.sin(unit * lat0), np.cos(unit * lat0)
    dlon, dlat = np.asarray(lon) - lon0, unit * (np.asarray(lat) - lat0)
    dlon = unit * (dlon - turn * np.round(dlon / turn))  # small angles are exact, across 360 degrees too
    lat = unit * np.asarray(lat)
    # sin(lat) cos0 - cos(lat) sin0 cos(dlon), without the difference of large numbers
    up = np.sin(dlat) + 2 * np.cos(lat) * sin0 * np.sin(dlon / 2) ** 2
    ahead = np.cos(dlat) - 2 * np.cos(lat) * cos0 * np.sin(dlon / 2) ** 2
    ahead = np.where(ahead > 0, ahead, np.nan) * unit
    return np.cos(lat) * np.sin(dlon) / ahead, up / ahead


@dataclass(frozen=True, eq=False)
class TangentPlane(ShownAsPrinted):
    """Where the reference plane lies on the sky (gnomonic projection).

    Attributes
    ----------
    lon, lat : float
        Tangent point, ICRS degrees.
    matrix : ndarray, shape (2, 3)
        Reference-plane pixels -> (xi, eta) on the tangent plane, degrees, xi to the east.
    """

    lon: float = field(metadata=number(minimum=-360, maximum=360, unit="deg"))
    lat: float = field(metadata=number(minimum=-90, maximum=90, unit="deg"))
    matrix: np.ndarray = field(metadata=array(2, 3, unit="deg", invertible=True))

    def __repr__(self) -> str:
        return f"<TangentPlane: {self.lon:.5f} {self.lat:+.5f} deg, {self.pixel_scale:.4f} arcsec/px>"

    def model(self) -> Model:
        """The astropy model (x, y) [pix] -> (ra, dec) [deg], stock parts only, inverse included."""
        m = np.asarray(self.matrix, dtype=float)
        plane = models.AffineTransformation2D(matrix=m[:, :2], translation=m[:, 2], name="plane")
        sky = models.Pix2Sky_TAN() | models.RotateNative2Celestial(self.lon, self.lat, 180.0)
        return plane | sky

    @cached_property
    def _ways(self) -> tuple[Model, Model]:
        """`model` and its inverse for positions, never given away: making them takes longer than to use them."""
        there = self.model()
        return there, there.inverse

    @property
    def pixel_scale(self) -> float:
        """Size of a reference-plane pixel, arcsec."""
        return 3600 * np.sqrt(abs(np.linalg.det(self.matrix[:, :2])))

    def to_sky(self, xy: ArrayLike) -> SkyCoord:
        """Reference-plane positions (n, 2) -> `~astropy.coordinates.SkyCoord` (ICRS)."""
        xy = np.asarray(xy, dtype=float)
        return SkyCoord(*self._ways[0](xy[..., 0], xy[..., 1]) * u.deg, frame="icrs")

    def jacobian(self, xy: ArrayLike) -> np.ndarray:
        """Derivative of (ra cos(dec), dec) [deg] by (x, y) [pix] at reference positions (n, 2), shape (n, 2, 2).

        The direction to a point of the plane is ``s = (s0 + xi e + eta n) / N``; what changes along s itself is of
        no matter for the directions east and north of s, which are perpendicular to it.
        """
        lon, lat = np.radians(self.lon), np.radians(self.lat)
        plane = np.radians(apply(self.matrix, xy))
        length = np.sqrt(1 + (plane**2).sum(axis=1))
        axes = np.stack(compass(lon, lat))  # e, n of the tangent point
        s = (directions(lon, lat) + plane @ axes) / length[:, None]
        return np.stack(compass(*angles(s)), axis=1) @ axes.T @ self.matrix[:, :2] / length[:, None, None]

    def orientation(self, pose: ArrayLike, shape: Shape) -> tuple[float, float]:
        """How a detector lies on the sky, at its centre, its distortion aside.

        Parameters
        ----------
        pose : ndarray, shape (2, 3)
            Reference plane -> undistorted pixels.
        shape : tuple
            ``(ny, nx)``.

        Returns
        -------
        position_angle : float
            Of the y axis of the detector, from north through east, degrees in [-180, 180).
        pixel_scale : float
            Arcsec.
        """
        back = invert(pose)
        centre = apply(back, [[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
        east, north = slope = self.jacobian(centre)[0] @ back[:, :2]
        angle = np.degrees(np.arctan2(east[1], north[1]))
        return float((angle + 180) % 360 - 180), float(3600 * np.sqrt(abs(np.linalg.det(slope))))

    def to_sky_errors(self, xy: ArrayLike, variance: ArrayLike) -> tuple[Quantity, Quantity, np.ndarray]:
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

    def from_sky(self, coordinates: SkyCoord) -> np.ndarray:
        """`~astropy.coordinates.SkyCoord` -> reference-plane positions (..., 2); inverse of `to_sky`."""
        icrs = coordinates.icrs
        return np.stack(self._ways[1](icrs.ra.deg, icrs.dec.deg), axis=-1)


class PlaneToSky(FittableModel):
    """`TangentPlane.model` as one model, which takes no sines of angles that have just been made: thrice as fast.

    (x, y) [pix] -> (ra, dec) [deg]; the parameters are those of a `TangentPlane`. The inverse is the stock one.
    """

    n_inputs = n_outputs = 2
    _separable = False
    lon, lat = (Parameter(default=0.0, fixed=True) for _ in range(2))
    xx, xy, dx = (Parameter(default=d, fixed=True) for d in (1.0, 0.0, 0.0))
    yx, yy, dy = (Parameter(default=d, fixed=True) for d in (0.0, 1.0, 0.0))

    @classmethod
    def of(cls, sky):
        """That of a `TangentPlane`."""
        return cls(sky.lon, sky.lat, *np.ravel(sky.matrix))

    @classmethod
    def like(cls, model):
        """That of a model as `TangentPlane.model` makes it; ValueError for another."""
        parts = leaves(model)
        kinds = [models.AffineTransformation2D, models.Pix2Sky_TAN, models.RotateNative2Celestial]
        if [type(part) for part in parts] != kinds or parts[2].lon_pole.value != 180:
            raise ValueError("the way to the sky should be an affine map, Pix2Sky_TAN and RotateNative2Celestial")
        plane, _, turn = parts
        return cls(turn.lon.value, turn.lat.value, *np.column_stack([plane.matrix.value, plane.translation.value]).flat)

    @staticmethod
    def evaluate(x, y, lon, lat, *plane):
        """Right ascension, 0 to 360, and declination."""
        lon, lat, *plane = (float(np.ravel(each)[0]) for each in (lon, lat, *plane))
        xx, xy, dx, yx, yy, dy = np.radians(plane)
        sin0, cos0 = np.sin(np.radians(lat)), np.cos(np.radians(lat))
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        out = np.empty((2, *x.shape))
        flat_x, flat_y, flat = x.reshape(-1), y.reshape(-1), out.reshape(2, -1)
        for start in range(0, flat_x.size, CHUNK):
            part = slice(start, start + CHUNK)
            xi = xx * flat_x[part] + xy * flat_y[part] + dx
            eta = yx * flat_x[part] + yy * flat_y[part] + dy
            ahead = cos0 - eta * sin0
            flat[0, part] = (lon + np.degrees(np.arctan2(xi, ahead))) % 360
            flat[1, part] = np.degrees(np.arctan2(sin0 + eta * cos0, np.hypot(xi, ahead)))
        return out[0], out[1]

    @property
    def inverse(self):
        """The opposite direction, of stock parts."""
        return self.stock().inverse

    def stock(self):
        """The same function of stock parts."""
        lon, lat, *plane = self.parameters
        return TangentPlane(lon, lat, np.reshape(plane, (2, 3))).model()
