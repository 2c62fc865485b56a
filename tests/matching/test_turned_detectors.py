"""Headers that have one detector mirrored, turned or larger than it is: dithers tell, and the night goes on."""

from dataclasses import replace

import header_layouts
import numpy as np
import pytest
from astropy.wcs import WCS

import legdistort as ld
from legdistort.exceptions import AssumptionWarning, InputError

KEY, MIDDLE = "3", np.full(2, (header_layouts.SIZE - 1) / 2)


def spoilt(night, matrix, pivot=MIDDLE, only=None):
    """The night with the CD matrix of detector 3 times a matrix, one pixel where it was; None: the reference pixel."""
    out = []
    for exposure in night.exposures:
        if exposure.detector == KEY and exposure.exposure in (only or [exposure.exposure]):
            header = exposure.header.copy()
            cd = np.array([[header[f"CD{a}_{b}"] for b in (1, 2)] for a in (1, 2)]) @ matrix
            reference = np.array([header["CRPIX1"], header["CRPIX2"]]) - 1
            if pivot is not None:
                reference = pivot + np.linalg.solve(matrix, reference - pivot)
            header["CRPIX1"], header["CRPIX2"] = reference + 1
            for a, b in np.ndindex(2, 2):
                header[f"CD{a + 1}_{b + 1}"] = cd[a, b]
            exposure = replace(exposure, header=header, wcs=WCS(header))
        out.append(exposure)
    night.exposures = out
    return night


def made(matrix, pivot=MIDDLE, *, seed=3, n=4, n_stars=300, **options):
    return spoilt(
        header_layouts.Night(seed, off=1.0, n=n, n_stars=n_stars), np.asarray(matrix, float), pivot, **options
    )


def turned(degrees):
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def matched(night, words):
    with pytest.warns(AssumptionWarning, match=rf"the dithers contradict the headers .* of detector 3 \({words}\)"):
        return ld.match(night.table, exposures=night.exposures)


def check_all_is_found(night, matches):
    """As many of each detector as of the others, no star mixed up, and those that cross."""
    detector = np.asarray(matches.table["detector"])
    star = np.asarray(night.table["true"])
    enough = np.bincount(star)[star] >= 4
    for key in header_layouts.KEYS:
        assert np.count_nonzero(detector == key) > 0.9 * np.count_nonzero(enough & (night.table["detector"] == key))
    assert night.found(matches) >= night.crossing()


def test_a_mirrored_header_whose_detector_then_lies_on_another():
    """As if the sign of a CD matrix were wrong: by the reference pixel it has the place of detector 4."""
    night = made(np.diag([-1, 1]), None)
    check_all_is_found(night, matched(night, "mirrored, x reversed"))


WRONG = [
    ("y", np.diag([1, -1]), MIDDLE, "mirrored, y reversed"),
    ("180", -np.eye(2), MIDDLE, r"turned by 180.00 deg"),
    ("180 on another", -np.eye(2), None, r"turned by 180.00 deg"),
    ("90 on another", turned(90.0), None, r"turned by -90.00 deg"),
    ("xy", [[0, 1], [1, 0]], MIDDLE, "mirrored, x and y exchanged"),
    ("20 %", 1.2 * np.eye(2), MIDDLE, r"its pixels 1.\d\d\d times as large as they are"),
    ("20 % elsewhere", 1.2 * np.eye(2), None, r"its pixels 1.\d\d\d times as large as they are"),
    ("small", 0.8 * np.eye(2), None, r"its pixels 0.\d\d\d times as large as they are"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("matrix", "pivot", "words"), [each[1:] for each in WRONG], ids=[each[0] for each in WRONG])
def test_what_is_wrong_is_told_and_the_night_goes_on(matrix, pivot, words):
    """To the end: the solution is as good as with right headers, and has no use for the wrong one."""
    night = made(matrix, pivot, n=5, n_stars=450)
    matches = matched(night, words)
    check_all_is_found(night, matches)
    solution = ld.solve(matches)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.1)
    assert solution.camera.headers.odd == (KEY,)
    xi, eta = (night.sky[night.true_stars(solution)] - header_layouts.MIDDLE).T * header_layouts.ARCSEC / 3600
    off_x = (solution.stars["ra"].value - 150.0) * np.cos(np.radians(-20.0)) + xi
    off_y = solution.stars["dec"].value + 20.0 - eta
    assert np.hypot(np.mean(off_x), np.mean(off_y)) * 3600 / header_layouts.ARCSEC < 5.0


def test_a_detector_that_fits_nowhere_is_left_out(caplog):
    """Its positions are of another field in every exposure, and the dithers tell nothing."""
    night = header_layouts.Night(3, off=1.0, n=4, n_stars=300)
    rows = np.flatnonzero(night.table["detector"] == KEY)
    night.table["x"][rows], night.table["y"][rows] = np.random.default_rng(1).uniform(0, 511, (2, len(rows)))
    with pytest.warns(AssumptionWarning, match="hardly a detection of detector 3 fits those of the others"):
        matches = ld.match(night.table, exposures=night.exposures)
    assert set(matches.table["detector"]) == {"1", "2", "4"}


@pytest.mark.slow
def test_headers_on_each_other_of_which_nothing_tells_are_refused_in_words():
    """A dither along x alone is no help, nor is one too small: the exposure, the detectors, and what goes on."""
    night = header_layouts.Night(3, off=1.0, n=4, n_stars=300, dither=1.0)
    spoilt(night, -np.eye(2), None)
    words = "headers of e0 put detectors on each other: 1 and 3 .by 100 % of their area.*dithers do not tell.*--camera"
    with pytest.raises(InputError, match=words):
        ld.match(night.table, exposures=night.exposures)


@pytest.mark.slow
def test_a_camera_that_is_taken_as_exact_is_refused_and_without_it_the_night_goes_on():
    night = header_layouts.Night(3, off=1.0, n=5, n_stars=450)
    shape = header_layouts.SIZE, header_layouts.SIZE
    right = dict(zip(header_layouts.KEYS, night.places, strict=True))
    right[KEY] = np.column_stack([-right[KEY][:, :2], 2 * MIDDLE - right[KEY][:, 2]])
    camera = ld.Camera("four", {key: ld.Detector(shape, layout=layout) for key, layout in right.items()})
    with pytest.raises(InputError, match=r"camera four, .* of detector 3 \(turned by 180.00 deg\).*leave camera out"):
        ld.match(night.table, exposures=night.exposures, camera=camera)
    check_all_is_found(night, ld.match(night.table, exposures=night.exposures))
    sigma = np.full((2, 3), np.inf)
    free = {key: replace(each, layout_sigma=sigma) for key, each in camera.detectors.items()}
    with pytest.warns(AssumptionWarning, match="contradict the layout of camera four, of detector 3"):
        matches = ld.match(night.table, camera=ld.Camera("four", free))
    check_all_is_found(night, matches)
