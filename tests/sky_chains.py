"""Solutions with a distortion drawn at will, and their exact chain from pixels to the sky, written a second time."""

import dataclasses
from dataclasses import replace

import numpy as np
from astropy.coordinates import SkyCoord
from numpy.testing import assert_allclose

from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.simulation.observations import simulate_matches
from legdistort.simulation.truth import displacement, mode_orders
from legdistort.solving.estimation import solve

SHAPE = (700, 1100)  # oblong: an exchange of the axes cannot hide
SCALE = 0.02 / 3600


def drawn(degree, peak, shape=SHAPE, seed=1, decay=3.0):
    """Coefficients (2, n_modes) that fall with the degree, `peak` pixels at most over the detector."""
    orders = np.array(mode_orders(degree))
    c = np.random.default_rng(seed).normal(size=(2, len(orders))) * decay ** -orders.sum(axis=1)
    c[:, 0] = 0
    x, y = np.meshgrid(np.linspace(-0.5, shape[1] - 0.5, 41), np.linspace(-0.5, shape[0] - 0.5, 41))
    d = displacement(c, np.stack([x, y], axis=-1), shape)
    return c * peak / np.hypot(d[..., 0], d[..., 1]).max()


def geometries():
    """A function that makes solutions of given geometry; what it does not set is of no account here."""
    base = solve(simulate_matches(n_stars=20, n_exposures=2, degree=1, static=0, dynamic=0, seed=1).matches, degree=1)

    def make(
        degree=3, peak=20.0, *, lon=10.0, lat=-30.0, turn=12.0, parity=-1, shift=(0, 0), shape=SHAPE, names=("a",)
    ):
        """The tangent point falls on the middle of the detector, less `shift` pixels."""
        middle = (np.array(shape[::-1]) - 1) / 2
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        rotation = np.array([[c, -s], [s, c]])
        m = SCALE * np.diag([parity, 1.0])
        coefficients = np.stack([drawn(degree, peak, shape, seed=1 + i) for i in range(len(names))])
        return dataclasses.replace(
            base,
            names=tuple(names),
            degree=degree,
            poses={name: np.column_stack([rotation, middle - rotation @ middle + shift]) for name in names},
            coefficients=coefficients,
            estimate=dataclasses.replace(
                base.estimate,
                shapes=dict.fromkeys(names, shape),
                prior_mean=np.zeros_like(coefficients),
                checked=(),  # it is no solution of any stars
            ),
            sky=TangentPlane(lon, lat, np.column_stack([m, -m @ middle])),
        )

    return make


def sky_of(solution, name, q):
    """Undistorted pixels (n, 2) -> ra, dec [deg] by the textbook formula of the gnomonic projection."""
    pose, sky = solution.poses[name], solution.sky
    x = (q - pose[:, 2]) @ np.linalg.inv(pose[:, :2]).T
    xi, eta = np.radians(x @ sky.matrix[:, :2].T + sky.matrix[:, 2]).T
    lon, lat = np.radians([sky.lon, sky.lat])
    below = np.cos(lat) - eta * np.sin(lat)
    ra = lon + np.arctan2(xi, below)
    dec = np.arctan2(np.sin(lat) + eta * np.cos(lat), np.hypot(xi, below))
    return np.degrees(ra) % 360, np.degrees(dec)


def pixels_of(solution, name, ra, dec):
    """Degrees -> detector pixels (n, 2): gnomonic projection, pose, and the direct model of the distortion."""
    sky, pose = solution.sky, solution.poses[name]
    lon, lat, ra, dec = (np.radians(a) for a in (sky.lon, sky.lat, ra, dec))
    below = np.sin(lat) * np.sin(dec) + np.cos(lat) * np.cos(dec) * np.cos(ra - lon)
    xi = np.cos(dec) * np.sin(ra - lon) / below
    eta = (np.cos(lat) * np.sin(dec) - np.sin(lat) * np.cos(dec) * np.cos(ra - lon)) / below
    plane = np.degrees(np.column_stack([xi, eta]))
    x = (plane - sky.matrix[:, 2]) @ np.linalg.inv(sky.matrix[:, :2]).T
    q = x @ pose[:, :2].T + pose[:, 2]
    return q + displacement(solution.coefficients[solution.names.index(name)], q, solution.estimate.shapes[name])


def detector(solution, name):
    """Random pixels, many along the edges, and the corners, with their exact sky positions."""
    ny, nx = solution.estimate.shapes[name]
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-0.5, nx - 0.5, 900), rng.uniform(-0.5, ny - 0.5, 900)
    x[:100], x[100:200], y[200:300], y[300:400] = -0.5, nx - 0.5, -0.5, ny - 0.5
    x[400:404], y[400:404] = [-0.5, nx - 0.5, -0.5, nx - 0.5], [-0.5, -0.5, ny - 0.5, ny - 0.5]
    p = np.column_stack([x, y])
    pose = solution.poses[name]
    q = solution[name].correct(p) @ pose[:, :2].T + pose[:, 2]
    # the direct model vouches for the correction
    direct = q + displacement(solution.coefficients[solution.names.index(name)], q, solution.estimate.shapes[name])
    assert_allclose(direct, p, rtol=0, atol=1e-8)
    return p, *sky_of(solution, name, q)


def largest(found, expected):
    return np.hypot(*(np.asarray(found) - expected).T).max()


def solution_at(wcs, shape, peak=10.0):
    """A solution with `peak` pixels of distortion, its plane that of the WCS at the middle of the detector."""
    middle = (np.array(shape[::-1]) - 1) / 2
    points = middle + [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
    lon, lat = wcs(*points.T, with_bounding_box=False)
    seen = TangentPlane(lon[0], lat[0], np.eye(2, 3)).from_sky(SkyCoord(lon, lat, unit="deg"))
    jacobian = (seen[1:] - seen[0]).T
    sky = TangentPlane(lon[0], lat[0], np.column_stack([jacobian, -jacobian @ middle]))
    return replace(geometries()(3, peak, shape=shape, turn=0.0), sky=sky)
