"""What a reference told of a camera serves the next visit, which has none: scale, rotation, shear of the focal plane.

Headers have the detectors where they lie, a common scale and rotation wrong, and their roll and pointing by visit; all
exposures share a distortion of the focal plane.
"""

import logging
from dataclasses import replace

import header_layouts
import numpy as np
import pytest
from astropy.table import Table
from astropy.wcs import WCS

import legdistort as ld
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry import basis, detector_modes, similarity

#: What headers have wrong: relative scale, rotation [deg]; roll [deg] and pointing [px] of two visits beside that.
SCALE, TURN, ROLLS, POINTINGS = 3e-4, 0.02, (0.002, -0.003), (2.0, -3.0)
EVIDENCE = ld.Prior(None, sigma="evidence")


def on_sky(xy):
    """Right ascension and declination (n, 2) of positions of the plane: gnomonic projection by astropy."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ("RA---TAN", "DEC--TAN"), (150.0, -20.0)
    wcs.wcs.crpix = np.full(2, header_layouts.MIDDLE + 1)
    wcs.wcs.cdelt = np.array([-1, 1]) * header_layouts.ARCSEC / 3600
    return wcs.all_pix2world(xy, 0)


def misled(exposure, scale, turn, moved):
    """An exposure whose header has scale, rotation [deg] and pointing [px] wrong."""
    header, angle = exposure.header.copy(), np.radians(turn)
    wrong = (1 + scale) * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    cd = wrong @ [[header["CD1_1"], header["CD1_2"]], [header["CD2_1"], header["CD2_2"]]]
    for a in (0, 1):
        for b in (0, 1):
            header[f"CD{a + 1}_{b + 1}"] = cd[a, b]
    header["CRVAL2"] += moved * header_layouts.ARCSEC / 3600
    return replace(exposure, header=header, wcs=WCS(header))


def drawn(seed):
    made = header_layouts.Night(seed, off=0.0, n=10, size=0.0, static=0.3, n_stars=350)
    made.exposures = [
        misled(each, SCALE, TURN + ROLLS[int(each.exposure[1:]) >= 6], POINTINGS[int(each.exposure[1:]) >= 6])
        for each in made.exposures
    ]
    return made


@pytest.fixture(scope="module")
def night():
    return drawn(5)


def visit(night, number):
    """Table and exposures of the first visit, six exposures, or the second, four."""
    mine = {f"e{i}" for i in range(*((0, 6), (6, 10))[number])}
    return night.table[np.isin(night.table["exposure"], list(mine))], [e for e in night.exposures if e.exposure in mine]


def matched(night, number, camera=None):
    table, exposures = visit(night, number)
    return ld.match(table, exposures=exposures, camera=camera)


def catalogue_of(night, seed):
    """80 stars with errors of 2 mas."""
    rng = np.random.default_rng(seed)
    stars = rng.permutation(len(night.sky))[:80]
    sky = on_sky(night.sky[stars] + rng.normal(0, 0.02, (80, 2)))
    return Table({"ra": sky[:, 0], "dec": sky[:, 1], "ra_error": np.full(80, 2.0), "dec_error": np.full(80, 2.0)})


@pytest.fixture(scope="module")
def catalogue(night):
    return catalogue_of(night, 1)


@pytest.fixture(scope="module")
def first(night, catalogue):
    return ld.solve(matched(night, 0), static="fit", prior=EVIDENCE, reference=catalogue)


def off_sky(night, solution):
    """Scale and rotation [deg] of the stars on the sky beside the truth, and what is left after these and a shift."""
    true = on_sky(night.sky[night.true_stars(solution)])
    found = np.column_stack([solution.stars["ra"].value, solution.stars["dec"].value])
    z, w = (((each - true.mean(axis=0)) * [np.cos(np.radians(-20.0)), 1]) @ [1, 1j] for each in (true, found))
    z, w = z - z.mean(), w - w.mean()
    factor = np.vdot(z, w) / np.vdot(z, z)
    left = np.abs(w - factor * z) * 3600 / header_layouts.ARCSEC / np.sqrt(2)
    return abs(factor) - 1, np.degrees(np.angle(factor)), np.sqrt(np.mean(left**2))


def pointing_off(night, solution):
    """How far the stars lie from the truth on the sky, in mean, east and north: pixels."""
    true = on_sky(night.sky[night.true_stars(solution)])
    found = np.column_stack([solution.stars["ra"].value, solution.stars["dec"].value])
    return np.mean((found - true) * [np.cos(np.radians(-20.0)), 1], axis=0) * 3600 / header_layouts.ARCSEC


@pytest.mark.slow
def test_the_pointing_of_the_next_visit_is_that_of_its_headers(night, first):
    """What a reference corrected of the first visit's, whose headers are off by 5 px more, is no part of the camera."""
    assert np.abs(pointing_off(night, first)).max() < 0.02
    alone, second = (ld.solve(matched(night, 1, each), prior=EVIDENCE) for each in (None, first.camera))
    assert np.abs(pointing_off(night, alone)).max() > 0.3
    assert pointing_off(night, second) == pytest.approx(pointing_off(night, alone), abs=0.1)


def test_the_next_visit_has_the_scale_and_the_rotation_of_the_first(night, first, tmp_path):
    """Through a file; its roll is wrong by what the headers have otherwise than in the first one."""
    assert off_sky(night, first)[0] == pytest.approx(0, abs=1e-5)
    first.camera.write(tmp_path / "camera.asdf")
    camera = ld.Camera.read(tmp_path / "camera.asdf")
    for prior in (EVIDENCE, None):
        second = ld.solve(matched(night, 1, camera), prior=prior)
        scale, turn, left = off_sky(night, second)
        assert scale == pytest.approx(0, abs=1e-5)
        assert abs(turn) == pytest.approx(abs(ROLLS[1] - ROLLS[0]), abs=1e-3)
        assert left < 0.02
        assert next(check.state for check in second.checks if check.name == "absolute") == "pass"
        assert second.camera.states_scale
        of_scale, of_turn = second.camera.header_errors
        assert (of_scale, of_turn) == first.camera.header_errors
        assert abs(scale) < 3 * of_scale < 1e-4
        assert abs(abs(turn) - abs(ROLLS[1] - ROLLS[0])) < 3 * of_turn < 5e-3
        assert f"the error of its scale, which is {of_scale:.1g} by a reference of camera FOUR" in str(second).replace(
            "\n        ", " "
        )
        third = second.camera.header_map[:, :2] - first.camera.header_map[:, :2]
        assert np.abs(third).max() < 1e-5
    alone = ld.solve(matched(night, 1), prior=EVIDENCE)
    assert off_sky(night, alone)[0] == pytest.approx(SCALE, rel=0.1)
    assert not alone.camera.states_scale
    assert alone.camera.header_errors is None
    absolute = next(check for check in alone.checks if check.name == "absolute")
    assert absolute.state == "unknown"
    assert "(match --camera RESULTS)" in absolute.cure
    assert "--prior" not in absolute.cure


def in_a_corner(night, share):
    """The first visit with the stars of one exposure that lie in a corner alone."""
    matches = matched(night, 0)
    (ny, nx), table = matches.shapes["e3"], matches.table
    far = (table["x"].value > share * nx) | (table["y"].value > share * ny)
    return matches.keep(~(far & (table["exposure"] == "e3")))


def test_an_exposure_that_is_known_badly_does_not_spoil_the_scale_of_the_camera(night, catalogue):
    matches = in_a_corner(night, 0.3)
    assert np.count_nonzero(matches.table["exposure"] == "e3") == 10
    camera = ld.solve(matches, static="fit", reference=catalogue).camera
    assert similarity.describe(camera.header_map)["scale"] == pytest.approx(1 + SCALE, abs=3e-5)  # of 7e-3 by all alike


@pytest.mark.slow
def test_an_exposure_that_a_reference_does_not_determine_is_left_out(night, catalogue):
    """The fit without the reference has an answer; that with it has none."""
    with pytest.warns(AssumptionWarning, match="exposure e3 is left out: its 4 stars .* do not determine"):
        solution = ld.solve(in_a_corner(night, 0.2), static="fit", prior=EVIDENCE, reference=catalogue)
    assert list(solution.left_out) == ["e3"]
    assert off_sky(night, solution)[0] == pytest.approx(0, abs=1e-5)


@pytest.mark.slow
def test_the_next_visit_comes_into_the_first(night, first, catalogue):
    """Its layout that of its headers, as in the first; with the camera that this found it would count twice."""
    with pytest.raises(InputError, match=r"with a reference, of which .*: give it again, reference= \(--reference\)$"):
        ld.solve(matched(night, 1), base=first)
    with pytest.raises(InputError, match="camera FOUR as the solution found it, whose own exposures would count twice"):
        ld.solve(matched(night, 1, first.camera), base=first, reference=catalogue)
    both = ld.solve(matched(night, 1), base=first, reference=catalogue)
    assert len(both.names) == 10
    scale, turn, left = off_sky(night, both)
    assert [scale, turn] == pytest.approx([0, 0], abs=1e-3)
    assert left**2 < 1.5 * np.mean(np.square([both.stars[name].value for name in ("x_err_abs", "y_err_abs")]))


@pytest.mark.slow
def test_the_shell_writes_the_camera_of_a_solution(night, first, tmp_path, capsys):
    """All of it, of a visit that a reference tied and of one that had that camera; files are not replaced unasked."""
    second = ld.solve(matched(night, 1, first.camera), prior=EVIDENCE)
    assert second.estimate.uncertainty.camera.departure is not None  # it was known beforehand
    for i, visited in enumerate([first, second]):
        path, solved = tmp_path / f"{i}.asdf", visited.write(tmp_path / f"solved{i}.asdf")
        assert main(["camera", str(solved), "--out", str(path), "--quiet"]) == 0
        read, known = ld.Camera.read(path), visited.camera
        assert list(read.detectors) == list(known.detectors)
        assert capsys.readouterr().out.endswith(f"px in {path}\n")
        for name in ("common_map", "common_sigma", "header_map", "header_errors", "place_errors"):
            one, other = (np.array(getattr(each, name), dtype=float) for each in (read, known))  # None is nan
            np.testing.assert_allclose(one, other, rtol=1e-12)
        for key in known.detectors:
            for name in ("layout", "layout_covariance", "static", "static_sigma"):
                one, other = (np.array(getattr(each[key], name), dtype=float) for each in (read, known))
                np.testing.assert_allclose(one, other, rtol=1e-12)
    assert main(["camera", str(solved), "--out", str(path), "--quiet"]) == 1
    assert "exists already; give --overwrite" in capsys.readouterr().err


def test_the_errors_of_the_common_map_are_those_of_the_reference(first):
    """20 mas of a pixel in each of 80 stars, noise aside: a coefficient is known to a few thousandths of a pixel."""
    sigma = first.camera.common_sigma
    assert np.isfinite(sigma).all()
    assert sigma[:, 1:6].min() > 1e-3
    assert sigma[:, 1:6].max() < 0.05


def test_one_exposure_tells_nothing_of_what_exposures_share(night, catalogue):
    table, exposures = visit(night, 0)
    matches = ld.match(table[table["exposure"] == "e0"], exposures=[e for e in exposures if e.exposure == "e0"])
    camera = ld.solve(matches, reference=catalogue).camera
    assert np.isinf(camera.common_sigma[:, 1:]).all()
    assert np.abs(camera.common_map).max() < 1e-9
    assert camera.states_scale


def test_headers_that_were_made_anew_are_taken_as_they_are(night, first, caplog):
    """They have detectors where the first visit found them: to correct these would be to do it twice."""
    table, exposures = visit(night, 1)
    moved = [misled(each, -SCALE, -TURN, 0.0) for each in exposures]
    for each in moved:
        if each.detector == "2":
            each.wcs.wcs.crpix = each.wcs.wcs.crpix + 0.5
    with caplog.at_level(logging.WARNING):
        matches = ld.match(table, exposures=moved, camera=first.camera)
    assert "otherwise than those with which a reference tied camera FOUR" in caplog.text
    assert not matches.camera.states_scale
    assert off_sky(night, ld.solve(matches, prior=EVIDENCE))[0] == pytest.approx(0, abs=1e-3 * 0.5)


def test_a_map_without_errors_is_refused():
    chip = {"1": ld.Detector((64, 64))}
    with pytest.raises(InputError, match="common_map needs the errors of all of its modes"):
        ld.Camera("c", chip, common_map=np.zeros((2, 6)), common_sigma=np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"common_map must be finite numbers \(2, n_modes\)"):
        ld.Camera("c", chip, common_map=[np.nan, 1.0], common_sigma=np.zeros((2, 3)))
    with pytest.raises(InputError, match="header_map is not a similarity"):
        ld.Camera("c", chip, header_map=[[1.0, 0.5, 0.0], [0.0, 1.0, 0.0]])


def shared_on(key):
    """Coefficients (2, 10) on a detector of what all exposures share, shift, rotation and scale taken off."""
    shape, powers = (header_layouts.SIZE, header_layouts.SIZE), [(a, b) for a in range(4) for b in range(4 - a)]
    common = np.random.default_rng((5, 1)).normal(0, 0.3 / 2, (10, 2))
    x, y, weights = basis.quadrature(6)
    f = basis.denormalize(x, y, shape) + header_layouts.CORNERS[header_layouts.KEYS.index(key)]
    t = f / header_layouts.MIDDLE - 1
    moved = np.stack([t[:, 0] ** a * t[:, 1] ** b for a, b in powers], axis=1) @ common
    modes = (weights * basis.values(3, x, y) @ moved).T
    rows = detector_modes.dynamic_basis(shape, 10)
    return (rows.T @ (rows @ modes.ravel())).reshape(2, -1)


def test_what_was_found_beyond_the_headers_has_its_shear(night, first, tmp_path):
    """With errors, by the solution and by the file of its camera alike."""
    _, exposures = visit(night, 0)
    stated = ld.Camera.from_exposures([each for each in exposures if each.exposure == "e0"])
    found, pulls = ld.difference(stated, first), []
    assert found.n_undetermined == 0
    for key in header_layouts.KEYS:
        assert np.isfinite(found.errors[key]).all()
        pulls.append(((found.coefficients[key] - shared_on(key)) / np.maximum(found.errors[key], 1e-9))[:, 1:])
    assert np.mean(np.square(pulls)) == pytest.approx(1, abs=0.7)
    by_file = ld.difference(stated, ld.Camera.read(first.camera.write(tmp_path / "camera.asdf")))
    for key in header_layouts.KEYS:
        assert by_file.coefficients[key] == pytest.approx(found.coefficients[key], abs=1e-4)
        assert 0 < by_file.errors[key][0, 1] < 0.05
    assert ld.difference(first.camera, first).rms < 1e-6


def test_directions_that_are_not_determined_are_named(night):
    alone = ld.solve(matched(night, 0), static="fit", prior=EVIDENCE)
    found = ld.difference(ld.Camera.from_exposures([e for e in night.exposures if e.exposure == "e0"]), alone)
    assert found.undetermined[0].startswith("shear")
    assert f"{found.n_undetermined} directions (shear" in found.sentence


@pytest.mark.parametrize(
    ("n_sets", "low", "high"),
    [pytest.param(2, 0.35, 1.5, marks=pytest.mark.slow), pytest.param(6, 0.5, 1.2, marks=pytest.mark.sets)],
)
def test_absolute_errors_of_the_next_visit(n_sets, low, high):
    """Of the stars after a similarity: what the reference may be bent by, which it is not, is in those stated."""
    squares, pulls = np.zeros(2), np.zeros(2)
    for seed in range(5, 5 + n_sets):
        night = drawn(seed)
        first = ld.solve(matched(night, 0), static="fit", prior=EVIDENCE, reference=catalogue_of(night, seed))
        second = ld.solve(matched(night, 1, first.camera), prior=EVIDENCE)
        stated = [second.stars[name].value for name in ("x_err_abs", "y_err_abs")]
        scale, turn, left = off_sky(night, second)
        squares += left**2, np.mean(np.square(stated))
        pulls += np.square([scale, abs(turn) - abs(ROLLS[1] - ROLLS[0])] / np.array(first.camera.header_errors))
    assert low < squares[0] / squares[1] < high
    assert (pulls / n_sets > 0.1).all()
    assert (pulls / n_sets < 1.5).all()
