"""Twelve raw frames of a small telescope with hot pixels, bleeding stars and a drift: what is left in the stack."""

import numpy as np
import photutils.detection as photutils
import pytest
from astropy.table import vstack
from scipy.ndimage import maximum_filter
from star_fields import detections

from legdistort import Exposure, coadd, match, read_exposures, solve
from legdistort.measurement.positions import measure

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def night(shared_data):
    paths = sorted((shared_data / "microobs_hatp32" / "frames").glob("*.fit*"))
    exposures = read_exposures(paths)
    tables = []
    for e in exposures:
        data = e.data - np.median(e.data)
        finder = photutils.DAOStarFinder(threshold=18 * np.median(np.abs(data)), fwhm=2.0, n_brightest=250)
        found = finder(data)
        xy = np.column_stack([found["x_centroid"], found["y_centroid"]])
        tables.append(detections(e.name, xy, flux=np.asarray(found["flux"])))
    # clip=None: the errors are made up, so that the brightest star would seem to contradict itself
    solution = solve(match(vstack(tables), shape=exposures[0].shape), degree=2, clip=None)
    return exposures, solution, {m: coadd(exposures, solution, method=m) for m in ("mean", "clipped")}


def excess(image, x, y):
    """Largest pixel of 3 x 3 above the median of those around, at rounded positions well inside."""
    out = []
    for column, row in np.rint(np.column_stack([x, y])).astype(int):
        if 3 <= column < image.shape[1] - 3 and 3 <= row < image.shape[0] - 3:
            box = image[row - 2 : row + 3, column - 2 : column + 3].copy()
            core = box[1:4, 1:4].max()
            box[1:4, 1:4] = np.nan
            out.append(core - np.nanmedian(box))
    return np.array(out)


def test_hot_pixels_are_gone(night):
    exposures, solution, mosaics = night
    ring = np.ones((3, 3), dtype=bool)
    ring[1, 1] = False
    above = np.array([e.data - maximum_filter(e.data, footprint=ring) for e in exposures])
    y, x = np.nonzero((above > 30).sum(axis=0) >= 9)
    assert len(x) > 50
    left = {}
    for method, mosaic in mosaics.items():
        for shift in (0, 7):
            places = [solution[e.name].correct(np.stack([x + shift, y + shift], 1) * 1.0) for e in exposures]
            left[method, shift] = np.nanmedian(excess(mosaic.data, *(np.concatenate(places) - mosaic.offset).T))
    assert left["mean", 0] > 3 * left["mean", 7]  # they were there
    assert left["clipped", 0] < 1.3 * left["clipped", 7]  # no more than anywhere


def test_background_is_flat(night):
    mosaic, count = night[2]["clipped"], night[2]["mean"].footprint
    blocks = []
    for y in range(0, mosaic.shape[0] - 32, 32):
        for x in range(0, mosaic.shape[1] - 32, 32):
            box = slice(y, y + 32), slice(x, x + 32)
            if count[box].min() >= 9:
                values = mosaic.data[box]
                middle = np.median(values)
                blocks.append(np.median(values[values < middle + 3 * np.median(np.abs(values - middle))]))
    assert len(blocks) > 100
    assert np.std(blocks) < np.sqrt(np.nanmedian(mosaic.variance[count >= 9]))


@pytest.mark.filterwarnings("ignore:.*the noise is .* too small for a gain of 1 ")  # it has none; widths alone count
def test_cores_of_stars_are_intact_and_sharp(night):
    exposures, solution, mosaics = night
    mean, clipped = mosaics["mean"], mosaics["clipped"]
    flux = np.asarray(solution.stars["flux"])
    xy = solution.estimate.positions - mean.offset
    chosen = np.argsort(-flux)[20:120]  # below saturation
    chosen = chosen[np.all((xy[chosen] > 12) & (xy[chosen] < np.array(mean.shape[::-1]) - 12), axis=1)]
    y, x = np.mgrid[: mean.shape[0], : mean.shape[1]]
    ratio = []
    for a, b in xy[chosen]:
        near = (x - a) ** 2 + (y - b) ** 2 <= 2.5**2
        level = mean.header["SKYLEVEL"]
        ratio.append((clipped.data[near] - level).sum() / (mean.data[near] - level).sum())
    assert np.median(ratio) == pytest.approx(1, abs=1e-3)
    assert np.mean(np.abs(np.array(ratio) - 1) < 0.01) > 0.9
    widths = []
    for images in (exposures[5:7], [Exposure("stack", clipped.data)]):
        table = measure(images, gain=1.0, psf="moffat", threshold=30)
        widths.append(np.median(table["fwhm"][np.argsort(-table["flux"])[20 * len(images) : 120 * len(images)]]))
    assert widths[1] < 1.15 * widths[0]


def test_nothing_dark_beside_saturated_stars(night):
    exposures, solution, mosaics = night
    mosaic = mosaics["clipped"]
    level, count = mosaic.header["SKYLEVEL"], mosaics["mean"].footprint
    seen = 0
    for e in exposures:
        y, x = np.nonzero(e.data >= e.saturation)
        for column, row in np.rint(solution[e.name].correct(np.stack([x, y], 1) * 1.0) - mosaic.offset).astype(int):
            box = slice(max(row - 6, 0), row + 7), slice(max(column - 6, 0), column + 7)
            if count[box].size and count[box].min() >= 6:
                seen += 1
                assert mosaic.data[box].min() > level - 10  # a spline over the flat tops goes 250 below
    assert seen > 20
