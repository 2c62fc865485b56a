"""Layouts of headers, found with everything else; what no star ties is not determined."""

import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import four_detectors
import header_layouts
import numpy as np
import pytest
from astropy.table import Table

import legdistort
from legdistort.cameras import ties
from legdistort.exceptions import AssumptionWarning, InputError, LegdistortWarning
from legdistort.geometry.similarity import apply, fit_similarity
from legdistort.solving.camera_fit import in_camera
from legdistort.solving.checks import cures

STATES = ("camera", "absolute")


def states(solution):
    return {check.name: check.state for check in solution.checks if check.name in STATES}


@pytest.fixture(scope="module")
def near():
    night = header_layouts.Night(11, off=1.0, n=7, n_stars=250)
    return night, legdistort.match(night.table, exposures=night.exposures)


@pytest.mark.slow
def test_a_prior_of_one_detector_of_several_is_refused_with_what_to_do(near):
    _, matches = near
    prior = legdistort.Prior(np.zeros((2, 6)), shape=next(iter(matches.camera.detectors.values())).shape)
    with pytest.raises(InputError, match=r"the focal plane of several: .* a camera .*static='fit' \(--static fit\)"):
        legdistort.solve(matches, prior=prior)


@pytest.fixture(scope="module")
def far():
    return header_layouts.Night(11, off=10.0, turn=0.1, n=7, n_stars=250)


@pytest.fixture(scope="module")
def solution(far):
    return legdistort.solve(legdistort.match(far.table, exposures=far.exposures))


def test_it_is_found_by_default(far, solution):
    """Errors of the stars are true though the layout was wrong by 10 px."""
    assert solution.settings.layout is None
    assert far.pulls(solution)[0] == pytest.approx(1, abs=0.4)
    assert solution.chi2 == pytest.approx(solution.dof, rel=0.06)
    assert states(solution)["camera"] == "pass"
    assert "group" not in solution.stars.colnames


def test_the_check_says_how_far_headers_have_each_detector(far, solution):
    """By numpy: corners where headers have them, after one similarity, less where they lie."""
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * header_layouts.SIZE - 0.5
    stated, right = (
        np.array([(corners - place[:, 2]) @ np.linalg.inv(place[:, :2]).T for place in each])
        for each in (far.stated, far.places)
    )
    z, w = (each.reshape(-1, 2) @ [1, 1j] for each in (stated, right))
    a, b = np.linalg.lstsq(np.stack([z, np.ones(len(z))], axis=1), w, rcond=None)[0]
    off = np.abs((a * z + b - w).reshape(4, 4).mean(axis=1))
    (check,) = [each for each in solution.checks if each.name == "camera"]
    told = re.search(r"detectors up to ([\d.]+) px from where the stars put them \((.*) px\), and none", check.sentence)
    assert float(told[1]) == pytest.approx(off.max(), abs=1.5)
    each = dict(word.split() for word in told[2].split(", "))
    np.testing.assert_allclose([float(each[key]) for key in header_layouts.KEYS], off, atol=1.5)


def test_no_cure_is_what_is_fitted_already(monkeypatch):
    """A wrong layout that is held is named with --layout fit; the same residuals of a fitted one name none."""
    tried, night = [], header_layouts.Night(11, off=0.03, dither=200.0, n=6, n_stars=300, size=0.0)
    matches = legdistort.match(night.table, exposures=night.exposures)
    effects_in = cures.effects_in
    monkeypatch.setattr(cures, "effects_in", lambda *words: tried.append(words) or effects_in(*words))
    held = legdistort.solve(matches, degree=1, layout="hold")
    assert {check.cure for check in held.checks if check.name in ("chi2", "place", "degree")} == {"--layout fit"}
    (residuals, observed, errors), free = tried[0], np.zeros((4, 2, 10), dtype=bool)
    assert errors is None or not errors.free[:, :, :3].any()
    free[:, :, :3] = True
    found = effects_in(residuals, observed, SimpleNamespace(free=free))
    assert "--layout fit" not in [each.effect.cure for each in found]
    assert "--layout fit" in [each.effect.cure for each in effects_in(residuals, observed, SimpleNamespace(free=~free))]


@pytest.mark.slow
def test_it_does_not_matter_how_wrong_it_was(near, far, solution):
    """The same night by headers that are ten times nearer: the same stars after the map that nothing determines.

    That has the degree of the distortions: nothing is known of them.
    """
    night, matches = near
    again = legdistort.solve(matches, layout="fit")
    a = dict(zip(far.true_stars(solution), solution.estimate.positions, strict=True))
    b = dict(zip(night.true_stars(again), again.estimate.positions, strict=True))
    assert a.keys() == b.keys()
    a, b = (np.array([each[star] for star in sorted(a)]) for each in (a, b))
    x, y = (a / np.ptp(a, axis=0)).T
    design = np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)])
    assert np.abs(b - design @ np.linalg.lstsq(design, b, rcond=None)[0]).max() < 2e-3
    assert np.allclose(again.stars["x_err"].value.mean(), solution.stars["x_err"].value.mean(), rtol=0.01)
    for key in header_layouts.KEYS:  # what the headers have right of scale and rotation is not given up for shifts
        assert abs(again.camera[key].place.scale - 1) < 1e-3
        assert abs(solution.camera[key].place.scale - 1) < 2e-3


@pytest.fixture(scope="module")
def bent():
    """Matches of a night whose detectors have distortions of their own, of 1 px a term, and headers that are right."""
    night, size = header_layouts.Night(12, off=0.3, n=6, n_stars=260, size=0.01), header_layouts.SIZE
    bend = np.random.default_rng(12).normal(0, 1.0, (4, 2, 3))
    for row in night.table:
        u, v = (2 * row[axis] / (size - 1) - 1 for axis in "xy")
        row["x"], row["y"] = (row["x"], row["y"]) + bend[int(row["detector"]) - 1] @ [u * u, u * v, v * v]
    return legdistort.match(night.table, exposures=night.exposures)


@pytest.mark.slow
def test_what_nothing_determines_stays_as_headers_have_it(bent):
    """Detectors with distortions of their own are not turned for a map which exposures and detectors exchange."""
    solution = legdistort.solve(bent, degree=2, static="fit")
    assert solution.chi2 == pytest.approx(solution.dof, rel=0.1)
    assert np.abs(solution.camera.headers.rotations).max() < 0.04
    assert np.abs(solution.camera.headers.shifts).max() < 1.0
    assert np.abs([solution.camera[key].place.scale - 1 for key in header_layouts.KEYS]).max() < 2e-4


@pytest.mark.parametrize(
    ("degree", "stated"),
    [
        pytest.param(2, {"pose_sigma": {"shift": 3.0, "rotation": 0.003}}, marks=pytest.mark.slow),
        pytest.param(2, {"pose_sigma": {"shift": 3.0, "rotation": 0.05}}, marks=pytest.mark.slow),
        pytest.param(3, {"layout_sigma": {"shift": 1.0, "rotation": 0.02}}, marks=pytest.mark.slow),
    ],
)
def test_what_is_known_little_of_poses_and_layouts_leads_nowhere_astray(bent, degree, stated):
    """It determines what stars do not, and the camera is found as without it."""
    solution = legdistort.solve(bent, degree=degree, static="fit", **stated)
    assert solution.status.startswith("converged")
    assert "static distortions not" not in solution.status
    assert solution.chi2 == pytest.approx(solution.dof, rel=0.1)
    assert np.abs(solution.camera.headers.shifts).max() < 1.0


@pytest.mark.slow
def test_detectors_together_keep_the_scale_of_headers(bent):
    """However little is stated of them: what all have in common poses take up, and the stars tell nothing of it."""
    solution = legdistort.solve(bent, degree=2, static="fit", layout_sigma={"shift": 20.0, "rotation": 0.5})
    scales = [each.place.scale for each in solution.camera.detectors.values()]
    assert np.mean(scales) == pytest.approx(1, abs=2e-4)
    assert solution.chi2 == pytest.approx(solution.dof, rel=0.1)


@pytest.mark.parametrize(
    "name", [pytest.param("pose_sigma", marks=pytest.mark.slow), pytest.param("layout_sigma", marks=pytest.mark.slow)]
)
def test_the_check_of_absolute_positions_names_what_cures_it(near, name):
    """Where headers may tell what stars do not; and with it the check passes."""
    before, after = (
        next(check for check in legdistort.solve(near[1], static="hold", **known).checks if check.name == "absolute")
        for known in ({}, {name: {"shift": 4.0, "rotation": 0.01}})
    )
    assert before.state == "unknown"
    assert f"--{name.replace('_', '-')} shift=PIXELS,rotation=DEGREES" in before.cure
    assert after.state == "pass"


def test_no_width_is_offered_of_a_layout_that_is_to_be_found_without(near):
    """--layout fit with --layout-sigma is refused: the check led there."""
    check = next(check for check in legdistort.solve(near[1], layout="fit").checks if check.name == "absolute")
    assert "--pose-sigma" in check.cure
    assert "--layout-sigma" not in check.cure


def test_held(near):
    """As exact: the stars do not agree with it, and that is said."""
    solution = legdistort.solve(near[1], layout="hold")
    assert states(solution)["camera"] == "fail"
    assert solution.camera["1"].place.errors is None
    assert "fit" in next(check.cure for check in solution.checks if check.name == "camera")


@pytest.fixture(scope="module")
def apart():
    return header_layouts.Night(12, off=2.5, dither=12.0, n=6, n_stars=250)


@pytest.fixture(scope="module")
def groups(apart):
    matches = legdistort.match(apart.table, exposures=apart.exposures)
    with pytest.warns(AssumptionWarning, match=r"no star in common: 1 \| 2 \| 3 \| 4"):
        return legdistort.solve(matches)


def test_what_no_star_ties_is_not_determined(apart, groups):
    """Errors are true within the stars of a detector, NaN and infinite beyond; no check passes it."""
    stars, own = groups.stars, np.asarray(groups.stars["group"])
    detector = dict(zip(groups.residuals["star"], groups.residuals["detector"], strict=True))
    assert len({(g, detector[star]) for g, star in zip(own, stars["star"], strict=True)}) == 4
    assert np.mean(apart.pulls(groups, groups=[own == g for g in range(4)])) == pytest.approx(1, abs=0.15)
    assert np.isnan(stars["x_err_abs"]).all()
    assert np.isinf(stars["x_err_known"]).all()
    assert states(groups) == {"camera": "unknown", "absolute": "unknown"}
    for check in groups.checks:
        if check.name in STATES:
            assert "1 | 2 | 3 | 4" in check.sentence
            assert "dithers larger than the gaps" in check.cure
    assert groups.camera["2"].place.errors == (np.inf,) * 3


@pytest.mark.slow
def test_a_layout_that_hides_the_stars_that_cross_is_named():
    """Farther off than these are looked for: that was blamed on the dithers, which are three times the gaps."""
    night = header_layouts.Night(2, off=2.0, turn=0.05, odd=(70.0, 0.0, 0.0))
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = legdistort.solve(legdistort.match(night.table, exposures=night.exposures))
    assert ties.apart(solution.camera, solution.residuals).endswith("1, 2, 4 | 3")
    check = next(check for check in solution.checks if check.name == "camera")
    assert check.state == "warn"
    assert re.search(
        r"1, 2, 4 \| 3\), but by the layout \d+ stars are seen by several of them: it may be wrong", check.sentence
    )
    assert check.cure.startswith("a layout that is nearer, by better headers or a camera file (--camera)")
    absolute = next(check for check in solution.checks if check.name == "absolute")
    assert "if these dithers are larger than the gaps: stars are looked for to 60 px and 1 degree" in absolute.cure


def with_drawn_statics(night, seed, sigma=0.3):
    """Matches of a camera that states static distortions which are off by their widths; there are none."""
    matches, rng = legdistort.match(night.table, exposures=night.exposures), np.random.default_rng(seed)
    statics = np.concatenate([np.zeros((4, 2, 3)), rng.normal(0, sigma, (4, 2, 7))], axis=2)
    detectors = {key: replace(each, static=static, static_sigma=sigma)
                 for (key, each), static in zip(matches.camera.detectors.items(), statics, strict=True)}  # fmt: skip
    return in_camera(matches, replace(matches.camera, detectors=detectors))


@pytest.mark.slow
def test_a_layout_beside_statics_with_widths_is_determined():
    """Rounding was taken for a direction that is not: errors were infinite, and a wrong header went into the sky."""
    night = header_layouts.Night(2, off=2.0, turn=0.05, n=7, n_stars=250, odd=(22.0, -24.0, 0.6))
    solution = legdistort.solve(with_drawn_statics(night, 2), layout="fit", static="prior")
    errors = np.array([solution.camera[key].place.errors[:2] for key in header_layouts.KEYS])
    assert np.all((errors > 0.05) & (errors < 1))
    assert solution.camera.headers.odd == ("3",)
    check = next(check for check in solution.checks if check.name == "camera")
    assert check.state == "warn"
    assert check.sentence.startswith("the headers have detector 3 3")
    assert "after one affine map of all together" in " ".join(str(solution).split())


@pytest.mark.slow
def test_a_layout_beside_departures_by_evidence_is_determined():
    """Second order was taken for a direction that nothing determines: no star had an absolute error by a catalogue."""
    stars = np.random.default_rng(0).uniform(-400, 2 * (four_detectors.SIZE + four_detectors.GAP) + 340, (160, 2))
    matches, known = four_detectors.matches(None, 0), stars[:60] + np.random.default_rng(1).normal(0, 0.02, (60, 2))
    catalogue = Table({"star": np.arange(60), "x": known[:, 0], "y": known[:, 1]})
    catalogue["x_err"] = catalogue["y_err"] = 0.02
    options = {"layout": "fit", "static": "fit", "prior": legdistort.Prior(None, sigma="evidence")}
    solution = legdistort.solve(matches, degree=3, reference=catalogue, **options)
    table = solution.stars
    off = np.stack([table["x"].value, table["y"].value], axis=1) - stars[np.asarray(table["star"])]
    error = np.stack([table["x_err_abs"].value, table["y_err_abs"].value], axis=1)
    assert 0.3 < np.sum(off**2) / np.sum(error**2) < 2


@pytest.mark.slow
def test_errors_of_a_layout_beside_statics_with_widths_are_right():
    found = []
    for seed in range(6):
        night = header_layouts.Night(seed, off=2.0, turn=0.05, n=7, n_stars=250, odd=(22.0, -24.0, 0.6))
        solution = legdistort.solve(with_drawn_statics(night, seed))
        found.append((night.layout_pull(solution.camera), *night.pulls(solution)))
    assert np.mean(found, axis=0) == pytest.approx(1, abs=4 * np.sqrt(2 / 12))


def with_false_ties(matches, n):
    """Matches in which n stars of detector 1 are named as stars of detector 3: ties that are none."""
    table, detector = matches.table.copy(), np.asarray(matches.table["detector"]).astype(str)
    star = np.asarray(table["star"]).copy()
    for k in range(n):
        star[star == np.unique(star[detector == "1"])[5 + k]] = np.unique(star[detector == "3"])[9 + k]
    table["star"] = star
    return replace(matches, table=table)


@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_false_tie_moves_no_detector(apart, n):
    """One or two stars that tie detectors wrongly are left out, and named; the layout stays as headers have it."""
    matches = with_false_ties(legdistort.match(apart.table, exposures=apart.exposures), n)
    words = f"rests on {n} stars? seen on both 1 and 3, which .*: they are left out"
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        solution = legdistort.solve(matches)
    assert sum(bool(re.search(words, str(each.message))) for each in told) == 1
    for key in header_layouts.KEYS:
        place, begun = solution.camera[key].place, matches.camera[key].place
        assert np.hypot(place.x - begun.x, place.y - begun.y) < 0.5
        assert place.errors == (np.inf,) * 3
    assert "1 | 2 | 3 | 4" in next(check.sentence for check in solution.checks if check.name == "camera")


def test_ties_are_counted_and_few_are_told(near):
    """By sets of the numbers of true stars; of each pair with stars in common; what rests on one or two warns."""
    _, matches = near
    table, detector = matches.table, np.asarray(matches.table["detector"]).astype(str)
    star = np.asarray(table["star"])
    both = np.intersect1d(star[detector == "1"], star[detector == "2"])
    assert len(both) > 3
    for key in ("3", "4"):  # two of the stars that tie one detector to each of the others are left
        for other in ("1", "2"):
            common = np.intersect1d(star[detector == key], star[detector == other])[1 if other == "1" else 0 :]
            keep = ~(np.isin(star, common) & (detector == key))
            table, detector, star = table[keep], detector[keep], star[keep]
    seen = {(a, b): set(star[detector == a]) & set(star[detector == b]) for a in "1234" for b in "1234" if a < b}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        solution = legdistort.solve(replace(matches, table=table))
    found = {tuple(each["detectors"]): each["n_stars"] for each in ties.pairs(solution.camera, solution.residuals)}
    assert found == {pair: len(stars) for pair, stars in seen.items() if stars}
    camera = next(check for check in solution.checks if check.name == "camera")
    n = len(set(star[np.isin(detector, ["1", "2"])]) & set(star[np.isin(detector, ["3", "4"])]))
    assert 0 < n < 3
    assert camera.state == "warn"
    assert f"rests on {n} star{'s' * (n > 1)} seen on both 1 or 2 and 3 or 4" in camera.sentence
    assert "more stars" in camera.cure


@pytest.mark.slow
def test_stated_widths_determine_it(apart):
    """Shifts known to 2.5 px stand for what no star tells: finite errors, no groups."""
    camera = legdistort.Camera.of_frames(apart.exposures)
    stated = {key: replace(each, layout_sigma=[5.0, 0.5, 0.5]) for key, each in camera.detectors.items()}
    matches = legdistort.match(apart.table, exposures=apart.exposures, camera=replace(camera, detectors=stated))
    solution = legdistort.solve(matches)
    assert "group" not in solution.stars.colnames
    assert np.isfinite(solution.stars["x_err_abs"]).all()
    assert 0.1 < apart.pulls(solution)[0] < 3


def known_stars(night):
    """Matches of a night whose stars are known, with the camera that headers state; its errors are not."""
    table = Table(night.table, copy=True)
    table["star"] = table["true"]
    shape = header_layouts.SIZE, header_layouts.SIZE
    places = zip(header_layouts.KEYS, night.stated, strict=True)
    detectors = {key: legdistort.Detector(shape, layout=place, layout_sigma=np.inf) for key, place in places}
    return legdistort.Matches.from_table(table, camera=legdistort.Camera("four", detectors))


@pytest.mark.parametrize("n_sets", [pytest.param(2, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.sets)])
def test_nothing_stated_of_statics_is_not_none(n_sets):
    """Absolute errors are true where the focal plane has a distortion that nobody stated; dithers and rolls tell it."""
    squares = np.zeros(2)
    for seed in range(n_sets):
        night = header_layouts.Night(seed, off=0.5, n=9, rolls=(0.0, 0.0, 30.0, 90.0), size=0.1, static=3.0)
        solution = legdistort.solve(known_stars(night))
        true = night.sky[solution.estimate.star_names]
        off = apply(fit_similarity(solution.estimate.positions, true), solution.estimate.positions) - true
        stated = np.column_stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")])
        squares += np.sum(off**2), np.sum(stated**2)
    assert squares[0] / squares[1] == pytest.approx(1, abs=0.3 if n_sets > 10 else 0.6)


@pytest.mark.parametrize("n_sets", [pytest.param(2, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.sets)])
def test_a_reference_tells_what_exposures_without_widths_cannot(n_sets):
    """Shear and z^2 of the focal plane, where statics are fitted and exposures have nothing of their own."""
    squares, evidence = np.zeros(2), legdistort.Prior(None, sigma="evidence")
    for seed in range(n_sets):
        night = header_layouts.Night(seed, off=0.5, n=6, rolls=(0.0, 0.02), size=0.0, static=0.6, n_stars=250)
        matches, rng = known_stars(night), np.random.default_rng(seed)
        names = rng.permutation(matches.stars)[:60]
        catalogue = Table({"star": names})
        catalogue["x"], catalogue["y"] = (night.sky[names] + rng.normal(0, 0.02, (60, 2))).T
        catalogue["x_err"] = catalogue["y_err"] = 0.02
        solution = legdistort.solve(matches, static="fit", prior=evidence, reference=catalogue)
        off = solution.estimate.positions - night.sky[solution.estimate.star_names]
        stated = np.column_stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")])
        squares += np.sum(off**2), np.sum(stated**2)
        assert states(solution)["absolute"] == "pass"
    assert squares[0] / squares[1] == pytest.approx(1, abs=0.4 if n_sets > 10 else 0.8)
    without = legdistort.solve(matches, static="fit", prior=evidence)
    assert {"shear", "z^2", "i z^2"} <= set(without.gauge.unknown_names)
    assert states(without)["absolute"] == "unknown"


def pull_across(n_sets, **options):
    """Squared pull of relative positions of stars that nothing but the stated widths ties; finite errors all over."""
    found = []
    for seed in range(n_sets):
        night = header_layouts.Night(seed, off=1.0, turn=0.02, dither=12.0, n=5, n_stars=250)
        solution = legdistort.solve(known_stars(night), **options)
        assert "group" not in solution.stars.colnames
        assert np.isfinite(solution.stars["x_err"]).all()
        found.append(night.pulls(solution)[0])
    return np.mean(found)


WIDTHS = {"shift": 1.0, "rotation": 0.02, "scale": 1e-6}


@pytest.mark.parametrize("n_sets", [pytest.param(4, marks=pytest.mark.slow), pytest.param(25, marks=pytest.mark.sets)])
def test_what_the_caller_knows_of_the_layout(n_sets):
    assert pull_across(n_sets, layout_sigma=WIDTHS) == pytest.approx(1, abs=0.5 if n_sets < 10 else 0.2)


@pytest.mark.slow
def test_the_caller_s_widths_are_those_of_a_camera(apart):
    """In pixels of the modes; without an error of the scale that is as large as the rotation's, in radians."""
    matches, turn = known_stars(apart), np.radians(0.02) * header_layouts.SIZE / np.sqrt(3)
    stated = {key: replace(each, layout_sigma=[2.0, turn, turn]) for key, each in matches.camera.detectors.items()}
    by_camera = legdistort.solve(replace(matches, camera=replace(matches.camera, detectors=stated)))
    by_option = legdistort.solve(matches, layout_sigma={"shift": 1.0, "rotation": 0.02})
    assert by_option.settings.layout_sigma == {"shift": 1.0, "rotation": 0.02}
    for column in ("x", "x_err", "x_err_abs"):
        np.testing.assert_allclose(by_option.stars[column].value, by_camera.stars[column].value, rtol=1e-6)
    with pytest.raises(InputError, match=r"turn.*: give, for example"):
        legdistort.solve(matches, layout_sigma={"turn": 0.1})


@pytest.mark.parametrize(
    ("n_sets", "n_known", "error", "n_wrong"),
    [
        pytest.param(4, 80, 0.01, 0, marks=pytest.mark.slow),
        pytest.param(12, 80, 0.05, 0, marks=pytest.mark.sets),
        pytest.param(12, 40, 0.02, 4, marks=pytest.mark.sets),
    ],
)
def test_a_catalogue_joins_detectors(n_sets, n_known, error, n_wrong):
    """Absolute errors are true of all stars, those that it does not have too, and hold between detectors."""
    squares = np.zeros((2, 2))
    for seed in range(n_sets):
        night = header_layouts.Night(seed, off=2.5, turn=0.02, dither=12.0, n=5, n_stars=250)
        matches, rng = known_stars(night), np.random.default_rng(1000 + seed)
        names = rng.permutation(matches.stars)[:n_known]
        xy = night.sky[names] + rng.normal(0, error, (n_known, 2))
        xy[:n_wrong] += rng.normal(0, 5, (n_wrong, 2))
        catalogue = Table({"star": names, "x": xy[:, 0], "y": xy[:, 1]})
        catalogue["x_err"] = catalogue["y_err"] = error
        solution = legdistort.solve(matches, reference=catalogue)
        assert "group" not in solution.stars.colnames
        off = solution.estimate.positions - night.sky[solution.estimate.star_names]
        stated = np.column_stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")])
        known = np.isin(solution.estimate.star_names, names)
        squares += [[np.sum(each[rows] ** 2) for each in (off, stated)] for rows in (known, ~known)]
        assert max(solution.camera["2"].place.errors[:2]) < 0.1
        assert states(solution)["absolute"] == "pass"
    assert squares[:, 0] / squares[:, 1] == pytest.approx(1, abs=0.25 if n_sets > 10 else 0.4)


@pytest.mark.parametrize(
    ("dither", "n", "n_stars"),
    [pytest.param(80.0, 6, 200, marks=pytest.mark.slow), pytest.param(12.0, 8, 300, marks=pytest.mark.sets)],
)
def test_frames(tmp_path, dither, n, n_stars):
    """From images with headers to the stars: across the gaps if dithers are larger, else within detectors."""
    night = header_layouts.Night(13, off=2.5, dither=dither, n=n, n_stars=n_stars)
    night.write(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AssumptionWarning)  # of what is not determined
        solution = legdistort.run(str(tmp_path / "e*.fits"), out=tmp_path / "out", ext="SCI", psf="moffat").solution
    detectors = {}
    for star, true in zip(solution.stars["star"], night.true_stars(solution), strict=True):
        detectors.setdefault(true, set()).update(solution.residuals["detector"][solution.residuals["star"] == star])
    crossing = {true for true, seen in detectors.items() if len(seen) > 1}
    if dither > header_layouts.GAP:
        assert len(crossing & night.crossing()) > 0.9 * len(night.crossing() & detectors.keys())
        assert night.pulls(solution)[0] == pytest.approx(1, abs=0.4)
    else:
        group = np.asarray(solution.stars["group"])
        assert np.mean(night.pulls(solution, groups=[group == g for g in range(4)])) == pytest.approx(1, abs=0.4)
        assert states(solution)["absolute"] == "unknown"
