"""Parallax factors: by how much a star of unit parallax is displaced as the Earth moves."""

import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time

from .tangent_plane import compass


def parallax_factors(lon, lat, years):
    """Displacements to the east and to the north for a unit parallax, shape (n, 2).

    From the place of the Earth by the analytical ephemeris that astropy has built in (no download; good to some 1e-5
    of a parallax).

    Parameters
    ----------
    lon, lat : float
        Place on the sky, ICRS degrees.
    years : array_like, shape (n,)
        Julian years.
    """
    time = Time(np.asarray(years, dtype=float), format="jyear", scale="tdb")
    earth = get_body_barycentric("earth", time, ephemeris="builtin").xyz.to_value("au")
    return -(np.stack(compass(*np.radians([lon, lat]))) @ earth).T


def on_plane(plane, years):
    """The same along the axes of the reference plane, for a parallax in its pixels, shape (n, 2).

    `plane` is the `~legdistort.geometry.tangent_plane.TangentPlane`; the factors are those of its tangent point.
    """
    slope = plane.jacobian(_tangent_pixel(plane))[0]
    scale = np.sqrt(abs(np.linalg.det(slope)))
    return parallax_factors(plane.lon, plane.lat, years) @ np.linalg.inv(slope / scale).T


def _tangent_pixel(plane):
    return -np.linalg.solve(plane.matrix[:, :2], plane.matrix[:, 2])[None]
