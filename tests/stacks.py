"""Frames of Gaussian stars with a distortion of 20 px, made without the package, and what a stack must keep of them."""

import itertools
from functools import cache

import gwcs.coordinate_frames as cf
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling import models
from astropy.table import QTable
from gwcs import WCS as GWCS
from scipy.optimize import least_squares

from legdistort.coaddition.mosaicking import coadd
from legdistort.geometry import basis, similarity
from legdistort.geometry.distortion import Distortion
from legdistort.geometry.models import outside
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.exposures import Exposure
from legdistort.results.estimate import Estimate
from legdistort.results.solution import Solution
from legdistort.results.view import View

SHAPE = (300, 400)
SIGMA = 1.4  # of the Gaussian stars, px
SKY = TangentPlane(83.2, -31.7, np.array([[-5e-5, 1e-5, 0.004], [1e-5, 5e-5, -0.003]]))


class StandInView(View):
    """An exposure with a distortion that is known."""

    @property
    def distortion(self):
        return self.solution.distortions[self.name]

    def distort(self, xy):
        q = similarity.apply(self.pose, xy)
        p = self.distortion(q)
        p[outside(self.distortion.inverse.valid, *q.T)] = np.nan
        return p

    def correct(self, xy):
        return similarity.apply(similarity.invert(self.pose), self.distortion.invert(xy))

    def sigma_map(self, *, support=True):
        x, y = np.linspace(-0.5, SHAPE[1] - 0.5, 20), np.linspace(-0.5, SHAPE[0] - 0.5, 16)
        return (
            x,
            y,
            np.broadcast_to(self.solution.maps[self.name](x[None, :], y[:, None]), (16, 20))[..., None] * [1, 1],
        )

    @property
    def wcs(self):
        m = similarity.invert(self.pose)
        to_reference = models.AffineTransformation2D(m[:, :2], m[:, 2])
        pixels = cf.Frame2D(name="detector", unit=(u.pix, u.pix))
        forward = self.distortion.model()
        correction = forward.inverse
        correction.inverse = forward
        chain = correction | to_reference | self.solution.sky.model()
        return GWCS([(pixels, chain), (cf.CelestialFrame(reference_frame=ICRS(), unit=(u.deg, u.deg)), None)])


class StandIn(Solution):
    """The part of a solution that co-adding needs, with truth inside, error maps too where they are given.

    Without a table of residuals every exposure has stars at the corners of its detector.
    """

    def __init__(self, poses, distortions, sky=None, *, table=None, maps=None):
        names, degree = tuple(poses), max((d.degree for d in distortions.values()), default=0)
        series = [basis.change_degree(distortions[name].coefficients, degree) for name in names]
        shapes = {name: distortions[name].shape for name in names}
        super().__init__(
            names=names,
            degree=degree,
            poses=poses,
            coefficients=np.reshape(series, (len(names), 2, basis.n_modes(degree))),
            residuals=_at_corners(shapes) if table is None else table,
            chi2=1.0,
            dof=1,
            status="",
            gauge=None,
            settings=None,
            diagnostics=None,
            estimate=Estimate(np.zeros(0), np.zeros((0, 2)), shapes, np.zeros(0), None),
            sky=sky,
        )
        vars(self).update(distortions=distortions, maps=maps)

    def __getitem__(self, key):
        return StandInView(self, super().__getitem__(key).name)


def _at_corners(shapes):
    """Stars at the corners of all detectors, and their width."""
    rows = [
        (name, star, x, y, True, SIGMA * 2.3548)
        for name, (ny, nx) in shapes.items()
        for star, (x, y) in enumerate(itertools.product((-5, nx + 5), (-5, ny + 5)))
    ]
    units = {"x": u.pix, "y": u.pix, "fwhm": u.pix}
    return QTable(rows=rows, names=["exposure", "star", "x", "y", "used", "fwhm"], units=units)


def star_image(xy, flux, shape=SHAPE):
    """Gaussian stars sampled at pixel centres."""
    y, x = np.arange(shape[0]), np.arange(shape[1])
    gx, gy = (np.exp(-(np.subtract.outer(s, t) ** 2) / (2 * SIGMA**2)) for s, t in zip(xy.T, (x, y), strict=True))
    return (flux[:, None] / (2 * np.pi * SIGMA**2) * gy).T @ gx


def scene(n=4, *, peak=20.0, sky=SKY, rolls=(0, 2, -3, 40), spread=15.0, seed=1):
    """Exposures of one star field with different degree-3 distortions, dithers and rolls; stars, fluxes."""
    rng = np.random.default_rng(seed)
    names = [f"frame{i}" for i in range(n)]
    poses, distortions = {}, {}
    centre = np.array(SHAPE[::-1]) / 2
    for name, roll in zip(names, rolls, strict=False):
        angle = np.radians(roll)
        m = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        poses[name] = np.column_stack([m, centre - m @ centre + rng.uniform(-spread, spread, 2)])
        coefficients = rng.normal(size=(2, 10))
        coefficients[:, 0] = 0
        coefficients[:, 6:] /= 2
        raw = Distortion(coefficients, SHAPE)
        grid = np.stack(np.meshgrid(np.linspace(0, SHAPE[1], 20), np.linspace(0, SHAPE[0], 20)), -1).reshape(-1, 2)
        coefficients *= peak / np.abs(raw(grid) - grid).max()
        distortions[name] = Distortion(coefficients, SHAPE, name)
    gx, gy = np.meshgrid(np.arange(-20, 440, 33.0), np.arange(-20, 340, 33.0))
    stars = np.stack([gx.ravel(), gy.ravel()], 1) + rng.uniform(-4, 4, (gx.size, 2))
    flux = rng.uniform(3e3, 3e4, len(stars))
    return StandIn(poses, distortions, sky), stars, flux


def expose(solution, stars, flux, **changes):
    exposures = []
    for name in solution.poses:
        seen = solution[name].distort(stars)
        ok = np.isfinite(seen).all(axis=1)
        exposures.append(Exposure(name, star_image(seen[ok], flux[ok]), **changes))
    return exposures


@cache
def plain():
    """Scene, exposures and the mosaic with defaults; shared, not to be changed."""
    solution, stars, flux = scene()
    exposures = expose(solution, stars, flux, header=fits.Header({"BUNIT": "adu", "OBJECT": "field"}))
    return solution, stars, flux, exposures, coadd(exposures, solution)


def fit_star(image, xy, flux, r=6):
    """Position of an elliptical Gaussian fitted by plain least squares, and the sum of the pixels around it."""
    ix, iy = np.round(xy).astype(int)
    box = image[iy - r : iy + r + 1, ix - r : ix + r + 1]
    y, x = np.mgrid[iy - r : iy + r + 1, ix - r : ix + r + 1]

    def model(p):
        dx, dy = x - p[0], y - p[1]
        norm = p[2] * np.sqrt(p[3] * p[4] - p[5] ** 2) / (2 * np.pi)
        return norm * np.exp(-(p[3] * dx**2 + p[4] * dy**2 + 2 * p[5] * dx * dy) / 2) + p[6]

    start = [*xy, flux, 1 / SIGMA**2, 1 / SIGMA**2, 0, 0]
    p = least_squares(lambda p: (model(p) - box).ravel(), start, x_scale=[1, 1, flux, 0.1, 0.1, 0.1, 1], method="lm").x
    ring = 9  # far enough for the sum to be the flux, and neighbours are farther
    return p[:2], image[iy - ring : iy + ring + 1, ix - ring : ix + ring + 1].sum()


def covered(mosaic, xy, r=9):
    """Stars that no edge of an exposure crosses."""
    ny, nx = mosaic.shape
    out = []
    for i, (x, y) in enumerate(np.round(xy).astype(int)):
        inside = r <= x < nx - r and r <= y < ny - r
        around = mosaic.footprint[y - r : y + r + 1, x - r : x + r + 1]
        if inside and around.min() == around.max() > 0:
            out.append(i)
    return out


def check_stars(mosaic, xy, flux, *, position=0.01, relative=0.003, chosen=None):
    chosen = covered(mosaic, xy) if chosen is None else chosen
    assert len(chosen) > 20
    for i in chosen:
        place, f = fit_star(mosaic.data.astype(float), xy[i], flux[i])
        assert np.abs(place - xy[i]).max() < position
        if relative:
            assert f == pytest.approx(flux[i], rel=relative)
