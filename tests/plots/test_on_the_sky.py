"""Pictures on WCSAxes: everything lies where the sky has it, on axes of another scale, rotation and parity."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.wcs import WCS
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey

from legdistort.exceptions import InputError
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.plots import stack_plots
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve

RA, DEC, PIXEL = 85.0, -70.0, 2e-5  # degrees
STAR = np.array([210.0, 95.0])


def tan(ra, dec, pixel, turn, parity, crpix):
    """A FITS WCS of astropy's own."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [ra, dec], crpix
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    wcs.wcs.cd = pixel * np.array([[parity * c, -s], [parity * s, c]])
    return wcs


OTHER = {
    "mirrored": tan(RA + 0.002, DEC - 0.001, 3e-5, 40.0, 1, [700.0, 500.0]),
    "coarse": tan(RA, DEC, 8e-5, -75.0, -1, [9, 9]),
}


def axes(wcs):
    figure = Figure(figsize=(5, 5))
    FigureCanvasAgg(figure)
    return figure.add_subplot(projection=wcs)


@pytest.fixture(scope="module")
def mosaic():
    """One star on noise, with a WCS of its own."""
    y, x = np.indices((200, 300))
    image = np.random.default_rng(2).normal(0, 1, x.shape)
    image += 500 * np.exp(-((x - STAR[0]) ** 2 + (y - STAR[1]) ** 2) / 8)
    return SimpleNamespace(data=image, wcs=tan(RA, DEC, PIXEL, 10.0, -1, [150.0, 100.0]))


@pytest.fixture(scope="module")
def view():
    matrix = np.array([[-PIXEL, 0, 0.02], [0, PIXEL, -0.02]])
    simulated = simulate_matches(
        n_exposures=4, n_stars=40, degree=2, sigma=0.02, dither=50, sky=TangentPlane(RA, DEC, matrix), seed=1
    )
    return solve(simulated.matches, degree=2)["exp01"]


def apart(ax, at, sky):
    """Distances on the sky between places on axes and those that they should have, pixels of 2e-5 degrees."""
    return ax.wcs.pixel_to_world(*np.transpose(at)).separation(sky).deg / PIXEL


@pytest.mark.parametrize("which", [None, *OTHER])
def test_mosaic_and_its_stars_lie_where_the_sky_has_them(mosaic, which):
    ax = axes(mosaic.wcs if which is None else OTHER[which])
    assert stack_plots.plot_mosaic(mosaic, stars=[STAR], ax=ax) is ax
    sky = mosaic.wcs.pixel_to_world(*STAR)
    assert apart(ax, ax.collections[-1].get_offsets()[0], sky) < 0.01
    assert len(ax.images) == (which is None)
    ax.collections[-1].remove()
    ax.figure.canvas.draw()
    box = ax.get_window_extent()
    shown = np.asarray(ax.figure.canvas.buffer_rgba())[::-1, :, :3].sum(axis=2)
    inside = shown[int(box.y0) + 4 : int(box.y1) - 4, int(box.x0) + 4 : int(box.x1) - 4]
    rows, columns = np.nonzero(inside <= inside.min() + 30)
    at = ax.transData.inverted().transform([columns.mean() + int(box.x0) + 4.5, rows.mean() + int(box.y0) + 4.5])
    assert apart(ax, at, sky) < 2  # pixels of the mosaic, about one of the screen
    corners = mosaic.wcs.pixel_to_world([-0.5, 299.5, 299.5, -0.5], [-0.5, -0.5, 199.5, 199.5])
    x, y = ax.wcs.world_to_pixel(corners)
    np.testing.assert_allclose([*ax.get_xlim(), *ax.get_ylim()], [x.min(), x.max(), y.min(), y.max()], atol=1e-6)
    assert "px" not in ax.get_xlabel()


@pytest.mark.parametrize("which", [None, *OTHER])
def test_residuals_are_where_their_stars_are_and_their_key_is_in_pixels_of_the_exposure(view, which):
    ax = axes(view.wcs if which is None else OTHER[which])
    assert view.plot_residuals(scale=500, ax=ax) is ax
    arrows = next(c for c in ax.collections if isinstance(c, Quiver))
    rows = view.residuals[view.residuals["used"]]
    stars = view.solution.stars
    of_star = stars["sky"][np.searchsorted(stars["star"], rows["star"])]
    assert np.max(apart(ax, arrows.get_offsets(), of_star)) < 0.2  # their residuals
    off = np.stack([rows["dx"].value, rows["dy"].value])
    length = np.hypot(arrows.U, arrows.V) / arrows.scale  # on the axes
    pixel = {None: 1.0, "mirrored": 2 / 3, "coarse": 0.25}[which]  # of the exposure, in pixels of the axes
    np.testing.assert_allclose(length / 500, pixel * np.hypot(*off), rtol=0.05)
    key = next(c for c in ax.get_children() if isinstance(c, QuiverKey))
    assert pytest.approx(pixel * float(key.label.removesuffix(" px")), rel=0.02) == key.U
    ends = view.wcs(*(np.stack([rows["x"].value, rows["y"].value]) + 500 * off))
    tips = ax.wcs.pixel_to_world(*(arrows.get_offsets() + np.stack([arrows.U, arrows.V], axis=1) / arrows.scale).T)
    assert np.max(np.hypot((tips.ra.deg - ends[0]) * np.cos(np.deg2rad(DEC)), tips.dec.deg - ends[1])) < 1e-3 * PIXEL


@pytest.mark.parametrize("which", [None, *OTHER])
def test_cells_of_an_error_map_cover_the_sky_of_the_exposure(view, which):
    ax = axes(view.wcs if which is None else OTHER[which])
    view.plot_error_map(ax=ax)
    corners = next(c for c in ax.collections if isinstance(c, QuadMesh)).get_coordinates()
    ny, nx = view.shape
    expected = view.wcs.pixel_to_world([-0.5, nx - 0.5], [-0.5, ny - 0.5])
    assert np.max(apart(ax, [corners[0, 0], corners[-1, -1]], expected)) < 0.01
    assert ax.get_xlim()[0] <= corners[..., 0].min() + 1
    if which is None:  # by 1e-7 px out of the image its axis would have no labels
        assert (ax.get_xlim(), ax.get_ylim()) == ((-0.5, nx - 0.5), (-0.5, ny - 0.5))


def test_without_a_common_sky_nothing_is_drawn_wrong(mosaic):
    linear = WCS(naxis=2)
    linear.wcs.ctype, linear.wcs.cunit = ["X", "Y"], ["pix", "pix"]
    for own, other in ((linear, mosaic.wcs), (mosaic.wcs, linear)):
        with pytest.raises(
            InputError, match="cannot be drawn on these WCSAxes: its WCS and theirs must lie on the sky"
        ):
            stack_plots.plot_mosaic(SimpleNamespace(data=mosaic.data, wcs=own), ax=axes(other))
    away = tan(RA + 180, 0.0, PIXEL, 0, 1, [9, 9])
    with pytest.raises(InputError, match="lies outside of the sky that these WCSAxes project"):
        stack_plots.plot_mosaic(mosaic, ax=axes(away))
    plain = solve(simulate_matches(n_exposures=3, n_stars=20, degree=1).matches, degree=1)["exp00"]
    with pytest.raises(InputError, match="solve with frames whose headers have a WCS"):
        plain.plot_residuals(ax=axes(mosaic.wcs))
