"""Layouts from the dithers alone: neither a camera nor headers say how the detectors lie."""

import gsaoi_images
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time

import legdistort
from legdistort.cameras.camera import GSAOI_SCALE
from legdistort.exceptions import InputError, MatchError
from legdistort.inputs.exposures import Exposure
from legdistort.matching.detectors import detector_layout

SIGMA = 0.01


@pytest.fixture(scope="module")
def night():
    return gsaoi_images.Night(n_exposures=5, n_stars=250, dither=9.0, dynamic=0.2)


def detections(night, keys="1234"):
    """Positions without numbers of stars, of some detectors, and the numbers."""
    table = night.table(sigma=SIGMA, least=1)
    table = table[np.isin(table["detector"], list(keys))]
    return table[["exposure", "detector", "x", "y", "x_err", "y_err"]], np.asarray(table["star"])


@pytest.fixture(scope="module")
def matches(night):
    return legdistort.match(detections(night)[0], shape=(2048, 2048), min_exposures=3)


def test_layout(matches):
    """Where the middles of the detectors lie, after a similarity, to some of the pixels of their distortions."""
    middle = np.full((1, 2), gsaoi_images.SIZE / 2)
    true = [gsaoi_images.to_arcsec(c, middle)[0] / GSAOI_SCALE for c in gsaoi_images.published()]
    found = [matches.camera[key].to_focal_plane(middle)[0] for key in "1234"]
    z, w = np.array(found) @ [1, 1j], np.array(true) @ [1, 1j]
    design = np.stack([z, np.ones(4)], axis=1)
    assert np.abs(w - design @ np.linalg.lstsq(design, w, rcond=None)[0]).max() < 12


def test_stars_cross(matches, night):
    """The same number on one detector and another, and nearly all stars are found."""
    table, star = detections(night)
    where = {(e, d, x): s for e, d, x, s in zip(table["exposure"], table["detector"], table["x"], star, strict=True)}
    rows = zip(
        *(matches.table[name] for name in ("exposure", "detector")), matches.table["x_detector"].value, strict=True
    )
    true = np.array([where[row] for row in rows])
    number = np.asarray(matches.table["star"])
    assert all(len(np.unique(true[number == n])) == 1 for n in np.unique(number))
    crossing = [n for n in np.unique(number) if len(np.unique(matches.table["detector"][number == n])) > 1]
    assert len(crossing) > 20
    assert len(number) > 0.9 * np.count_nonzero(np.bincount(star)[star] >= 3)


@pytest.mark.slow
def test_it_can_be_solved(matches, night):
    """The layout to begin with is wrong by pixels and knows no static distortion: both are fitted."""
    solution = legdistort.solve(matches, degree=5, layout="fit", static="fit")
    assert solution.chi2 == pytest.approx(solution.dof, rel=0.15)


def test_no_star_crosses(night):
    """Detectors in opposite corners: the two are named."""
    table, _ = detections(night, "13")
    middle = np.abs(table["x"] - 1023.5) + np.abs(table["y"] - 1023.5) < 1000
    words = r"how detectors 1 and 3 lie to each other is not known: .* on both .*1 \| 3.* give the camera"
    with pytest.raises(MatchError, match=words):
        legdistort.match(table[middle], shape=(2048, 2048), min_exposures=3)


def test_parts_of_exposures_that_do_not_meet_are_no_fields():
    """Groups that have detectors in common: what says how these lie is named, and fields are not."""
    table = QTable({"exposure": ["e0", "e0", "e1", "e1"], "detector": ["1", "2", "1", "2"]})

    def match(parts, shapes):
        raise MatchError("2 groups", groups=[["e0-1", "e1-2"], ["e0-2", "e1-1"]])

    with pytest.raises(MatchError, match=r"fall into 2 groups .*\(of detectors 1, 2 \| 1, 2\).*--wcs.*--camera"):
        detector_layout.match_parts(table, dict.fromkeys("12", (100, 100)), match)


def test_shapes(night):
    table, _ = detections(night)
    with pytest.raises(InputError, match=r"several detectors \(1, 2, 3, 4\) and no camera is given: give the shape"):
        legdistort.match(table)
    with pytest.raises(InputError, match="missing: 3, 4"):
        legdistort.match(table, shape={"1": (2048, 2048), 2: (2048, 2048)})


@pytest.mark.slow
def test_images_without_wcs(night, matches):
    """Exposures whose headers have no WCS give shapes, names and times, no more."""
    table, _ = detections(night)
    dates = {str(name): 59000.0 + 10 * k for k, name in enumerate(np.unique(table["exposure"]))}
    exposures = [
        Exposure(
            f"{name}-{key}", np.broadcast_to(np.float32(0), (2048, 2048)), header=fits.Header({"MJD-OBS": date}),
            exposure=name, detector=key,
        )
        for name, date in dates.items()
        for key in "1234"
    ]  # fmt: skip
    again = legdistort.match(table, exposures=exposures, min_exposures=3)
    assert np.array_equal(again.table["star"], matches.table["star"])
    assert again.times[1] == "days"
    assert again.epoch == pytest.approx(np.mean(Time(list(dates.values()), format="mjd").jyear), abs=0.01)
    assert matches.epoch is None
