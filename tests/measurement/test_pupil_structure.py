"""Structure that is fixed to the pupil is no star, and all light counts: against frames made without the package."""

import numpy as np
import pupil_images
import pytest
from scipy.spatial import cKDTree

import legdistort as ld
from legdistort.inputs.exposures import Exposure
from legdistort.measurement.flags import UNUSABLE


@pytest.fixture(scope="module")
def telescope():
    return pupil_images.Telescope(np.random.default_rng(4), screens=20)


@pytest.fixture(scope="module")
def frame(telescope):
    return pupil_images.frame(telescope, np.random.default_rng(5))


def measured(frame, **changed):
    """Usable rows, and their places (n, 2)."""
    exposure = Exposure("pupil", frame.data, gain=1.0, read_noise=pupil_images.READ_NOISE, **changed)
    table = ld.measure(exposure)
    table = table[(table["flags"] & UNUSABLE) == 0]
    return table, np.column_stack([table["x"].value, table["y"].value])


@pytest.fixture(scope="module")
def found(frame):
    return measured(frame)


def test_spots_arms_and_speckles_are_no_stars(frame, found):
    """Without it there is more than one false star for every true one."""
    xy = found[1]
    assert np.count_nonzero(cKDTree(frame.xy).query(xy)[0] > frame.fwhm) <= 2
    assert (cKDTree(xy).query(frame.xy)[0] < 0.6 * frame.fwhm)[frame.snr > 10].all()


@pytest.mark.slow
def test_stars_whose_tops_are_saturated_have_the_same_structure(frame):
    level = np.sort(frame.data[tuple(np.round(frame.xy).astype(int).T[::-1])])[-3]
    _, xy = measured(frame, saturation=level)
    assert np.count_nonzero(cKDTree(frame.xy).query(xy)[0] > frame.fwhm) <= 3


@pytest.mark.slow
def test_companions_are_found_where_others_have_spots(telescope, frame):
    """A twentieth as bright as a star, at places that differ from star to star."""
    rng, bright = np.random.default_rng(6), np.argsort(-frame.flux)[2:10]
    angle = rng.uniform(0, 2 * np.pi, len(bright))
    beside = frame.xy[bright] + 8 * frame.fwhm * np.column_stack([np.cos(angle), np.sin(angle)])
    inside = ((beside > 10) & (beside < len(frame.data) - 10)).all(axis=1)
    both = np.vstack([frame.xy, beside[inside]]), np.append(frame.flux, frame.flux[bright][inside] / 20)
    more = pupil_images.frame(telescope, rng, xy=both[0], flux=both[1])
    _, xy = measured(more)
    assert (cKDTree(xy).query(beside[inside])[0] < 0.6 * frame.fwhm).all()


def test_fluxes_have_the_light_within_thirty_widths(telescope, frame, found):
    table, xy = found
    off, row = cKDTree(xy).query(frame.xy)
    use = (off < 1) & (frame.snr > 50)
    ratio = table["flux"][row][use] / frame.flux[use]
    assert np.median(ratio) == pytest.approx(telescope.within(30 * frame.fwhm), rel=0.02)
    assert set(table["psf"]) == {"effective"}
    assert 0 < table.meta["flux_factor_error"]["pupil"] < 0.05
