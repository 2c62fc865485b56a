"""What the check of a reference says of right and wrong ones. Truth from numpy alone (`dense_model`)."""

import re
import warnings
from types import SimpleNamespace

import dense_model
import drawn_sets
import four_detectors
import made_catalogues
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from scipy import stats

import legdistort as ld
from legdistort.exceptions import InputError, LegdistortWarning
from legdistort.geometry import basis
from legdistort.solving.checks.limits import addition_that_shows
from legdistort.solving.checks.reference_check import _missing
from legdistort.solving.gauge import bent_reference


def solved(seed, fault=None, *, prior=True, n=40, taken=None, **options):
    data, truth = dense_model.drawn_set(seed, **({"rolls": 30.0} if taken is None else taken))
    table = made_catalogues.catalogue(truth["stars"], seed, fault, n=n)
    given = ld.Prior(truth["static"]) if prior else None
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        return ld.solve(
            drawn_sets.as_matches(data), prior=given, reference=table, degree=3, epoch=made_catalogues.EPOCH, **options
        )


def check_of(solution, name="reference"):
    return next(check for check in solution.checks if check.name == name)


def test_a_right_reference_is_believed_where_exposures_cannot_test_its_shape():
    solution = solved(0)
    check = check_of(solution)
    assert check.state == "unknown"
    assert "agree with the exposures (offsets 1.1 times" in check.sentence
    assert "not bent by less than 0.43 px rms is believed, not tested" in check.sentence
    assert check_of(solution, "absolute").sentence.endswith(
        "they rest on the reference (not tested) and the static distortion given"
    )


def test_a_turned_camera_is_no_cure_where_it_was_turned():
    def cure(*rolls):
        turned = np.radians(rolls)
        return _missing([np.array([[np.cos(a), -np.sin(a), 3.0], [np.sin(a), np.cos(a), -2.0]]) for a in turned])

    without = "more of its stars, dithers by a good part of the field, or a prior test it"
    assert cure(0, 0, 30) == cure(170, -90) == cure(5, 5, -85) == without
    assert cure(0.0, 0.5) == cure(179, -179) == cure(30) == without.replace("or a prior", "a turned camera, or a prior")
    assert check_of(solved(0)).cure == without  # of rolls up to 30 degrees


def test_absolute_positions_do_not_pass_on_a_reference_that_fails():
    solution = solved(0, "bent by 1 px")
    assert check_of(solution).state == "fail"
    absolute = check_of(solution, "absolute")
    assert absolute.state == "fail"
    assert "by errors that stars of the reference contradict: they are off by" in absolute.sentence
    assert absolute.cure == "see reference, whose cure it is"
    assert solution.gauge.sentence.endswith("if the reference is right, which the exposures contradict")
    assert "contradict" not in solved(0).gauge.sentence


def test_a_degree_that_is_too_low_is_named_before_a_reference_that_is_right():
    """And its cure, first, cures: the exposures are of degree 3."""
    data, truth = dense_model.drawn_set(0, rolls=30.0, dynamic=0.05, static=0.0)
    table = made_catalogues.catalogue(truth["stars"], 0)
    with pytest.warns(LegdistortWarning):
        check = check_of(ld.solve(drawn_sets.as_matches(data), reference=table, degree=2))
    assert check.state == "fail"
    assert check.sentence.endswith("; too low a degree of the exposures may be the cause")
    first = re.match(
        r"--degree (\d) first, which the residuals call for \(see degree\); if the reference does not agree", check.cure
    )
    assert check_of(ld.solve(drawn_sets.as_matches(data), reference=table, degree=int(first[1]))).state == "unknown"


def test_a_right_reference_passes_where_exposures_are_as_good():
    data, truth = dense_model.drawn_set(0, rolls=30.0, dynamic=0.002)
    table = made_catalogues.catalogue(truth["stars"], 0)
    solution = ld.solve(drawn_sets.as_matches(data), prior=ld.Prior(truth["static"]), reference=table)
    check = check_of(solution)
    assert check.state == "pass", check
    assert "believed" not in check.sentence


@pytest.mark.parametrize(
    ("fault", "state", "words"),
    [
        (
            "bent by 1 px",
            "fail",
            "bent against what the exposures show by 1 px rms; with a map of its own, of degree 2, it agrees",
        ),
        ("five years off", "fail", "they agree with epochs that are 5 years later"),
        ("errors x 1000", "warn", "its errors are smaller than it states"),
        pytest.param("errors / 1000", "fail", "its errors were taken 1.1e+03 times as large", marks=pytest.mark.slow),
        ("20 % blunders", "unknown", "agree with the exposures"),
    ],
)
def test_what_is_wrong_is_named(fault, state, words):
    check = check_of(solved(0, fault))
    assert check.state == state
    assert words in check.sentence
    assert check.cure


def test_epochs_that_are_right_are_not_named():
    check = check_of(solved(0, "motions"))
    assert check.state == "unknown"
    assert "years" not in check.sentence


@pytest.mark.slow
def test_errors_that_are_found_are_not_blamed():
    for fault in ("errors x 1000", "errors / 1000"):
        assert check_of(solved(0, fault, reference_error="found")).state == "unknown"


def test_a_catalogue_of_another_year_without_motions_is_told_what_to_do():
    """Its positions moved by 0.1 px; errors as found, or stated with these motions, pass where stated ones do not."""
    data, truth = dense_model.drawn_set(0, rolls=30.0)
    table, rng = made_catalogues.catalogue(truth["stars"], 0), np.random.default_rng(3)
    for axis in "xy":
        table[axis] += 0.1 * rng.normal(size=len(table))
    matches, prior = drawn_sets.as_matches(data), ld.Prior(truth["static"])
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        wrong = check_of(ld.solve(matches, prior=prior, reference=table))
    assert wrong.state == "fail"
    assert wrong.cure.startswith("absolute errors contain this factor; if it is of another year and without proper")
    assert "--reference-error found, or errors that contain the years times a usual motion" in wrong.cure
    found = check_of(ld.solve(matches, prior=prior, reference=table, reference_error="found"))
    table["x_err"] = table["y_err"] = np.hypot(made_catalogues.ERROR, 0.1)
    stated = check_of(ld.solve(matches, prior=prior, reference=table))
    assert "agree with the exposures" in found.sentence
    assert "agree with the exposures" in stated.sentence


def test_few_stars_tell_nothing_of_errors():
    check = check_of(solved(0, n=4))
    assert check.state == "unknown"
    assert "its errors (of 4 stars) are believed" in check.sentence


@pytest.mark.slow
def test_many_mismatches_are_named():
    check = check_of(solved(1, "20 % blunders"))
    assert check.state == "warn"
    assert "of 40 stars of the reference lie elsewhere in it" in check.sentence


@pytest.mark.slow
def test_factors_have_what_was_known_beforehand():
    factors = solved(0, "five years off").factors
    assert list(factors["name"]) == ["static distortion", "reference: positions", "reference: map"]
    assert list(factors["rows"][:2]) == [16, 80]
    assert factors["p"][0] > 1e-3
    assert factors["p"][1] < 1e-6
    assert_allclose(factors["p"][1:], stats.chi2.sf(factors["chi2"][1:], factors["dof"][1:]))


def test_a_file_has_what_was_tested(tmp_path):
    solution = solved(0, "five years off")
    again = ld.Solution.read(solution.write(tmp_path / "solution.asdf"))
    assert again.gauge.tie.agreement == solution.gauge.tie.agreement
    assert check_of(again) == check_of(solution)
    assert list(again.factors.pformat()) == list(solution.factors.pformat())


@pytest.mark.parametrize("nu", [3, 20, 200])
def test_what_is_said_to_show_shows(nu):
    """The noncentral chi2 of scipy: so much more is beyond what chance gives once in a thousand, 19 times of 20."""
    limit = stats.chi2.isf(1e-3, nu)
    assert stats.ncx2.sf(limit, nu, addition_that_shows(nu)) == pytest.approx(0.95, abs=0.02)
    assert addition_that_shows(0) == np.inf


@pytest.mark.parametrize(
    ("prior", "rolls", "n_sets"),
    [
        pytest.param(True, 0.0, 40, marks=pytest.mark.sets),
        pytest.param(True, 30.0, 12, marks=pytest.mark.slow),
        pytest.param(True, 30.0, 40, marks=pytest.mark.sets),
        pytest.param(False, 30.0, 40, marks=pytest.mark.sets),
    ],
)
def test_statistics_of_right_references_are_those_of_chance(prior, rolls, n_sets):
    made = [solved(seed, prior=prior, taken={"rolls": rolls}).gauge.tie.agreement for seed in range(n_sets)]
    for chi2, dof in ((sum(m.chi2 for m in made), sum(m.dof for m in made)),
                      (sum(m.bend_chi2 for m in made), sum(m.bend_dof for m in made))):  # fmt: skip
        assert chi2 / dof == pytest.approx(1, abs=max(0.1, 4 * np.sqrt(2 / dof)))
    p = [stats.chi2.sf(m.bend_chi2, m.bend_dof) for m in made if m.bend_dof]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.parametrize(
    ("prior", "rolls", "n_sets"),
    [
        pytest.param(True, 0.0, 10, marks=pytest.mark.sets),
        pytest.param(True, 30.0, 3, marks=pytest.mark.slow),
        pytest.param(True, 30.0, 10, marks=pytest.mark.sets),
        pytest.param(False, 30.0, 10, marks=pytest.mark.sets),
    ],
)
def test_wrong_references_are_found(prior, rolls, n_sets):
    for fault in ("bent by 1 px", "five years off", "errors x 1000"):
        states = [check_of(solved(seed, fault, prior=prior, taken={"rolls": rolls})).state for seed in range(n_sets)]
        assert set(states) <= {"warn", "fail"}, fault


# --- a map of its own --------------------------------------------------------------------------------------------


def bent(table, stars, degree, size, seed=0):
    """A table whose positions have a polynomial of a degree added to them, `size` px rms."""
    rng, out = np.random.default_rng([seed, 5]), table.copy()
    u, v = ((np.column_stack([table["x"], table["y"]]) - stars.mean(axis=0)) / 1024).T
    powers = [u**i * v**j for i in range(degree + 1) for j in range(degree + 1 - i) if i + j > 1]
    move = np.stack(powers, axis=1) @ rng.normal(size=(len(powers), 2))
    for name, each in zip("xy", (size * move / np.sqrt(np.mean(move**2))).T, strict=True):
        out[name] += each
    return out


def without_similarity(offsets, xy, weight):
    """Offsets (n, 2) less the shift, rotation and scale that fit them best with weights (n,)."""
    (x, y), one = (xy - xy.mean(axis=0)).T, np.ones(len(xy))
    design = np.stack([one, 0 * one, x, -y, 0 * one, one, y, x], axis=1).reshape(len(xy), 2, 4)
    root = np.sqrt(weight)[:, None, None]
    fit = np.linalg.lstsq((root * design).reshape(-1, 4), (root[:, :, 0] * offsets).ravel(), rcond=None)[0]
    return offsets - design @ fit


def columns(solution, suffix):
    return np.column_stack([solution.stars[f"{axis}_{suffix}"].value for axis in "xy"])


@pytest.mark.parametrize(
    ("degree", "options"),
    [(2, {"prior": True}), (3, {"prior": True}), (3, {"prior": False, "static": "fit", "taken": {"dynamic": 0.0}})],
)
def test_what_bends_a_reference_alone_bends_nothing_else(degree, options):
    """A polynomial of that degree, of a pixel, changes positions by no more than a similarity, and no error."""
    taken = {"rolls": 30.0, "dynamic": 0.05} | options.get("taken", {})
    data, truth = dense_model.drawn_set(1, **taken)
    matches, plain = drawn_sets.as_matches(data), made_catalogues.catalogue(truth["stars"], 1)
    given = {"prior": ld.Prior(truth["static"])} if options["prior"] else {"static": options["static"]}
    found = []
    for table in (plain, bent(plain, truth["stars"], degree, 1.0)):
        found.append(ld.solve(matches, **given, reference=table, reference_degree=degree))
    first, second = found
    error = columns(first, "err")
    moved = second.estimate.positions - first.estimate.positions
    assert np.abs(without_similarity(moved, truth["stars"], error[:, 0] ** -2) / error).max() < 0.05
    for suffix in ("err", "err_abs"):
        assert_allclose(columns(second, suffix), columns(first, suffix), rtol=0.01)
    assert second.gauge.tie.own.rms == pytest.approx(1, abs=0.3)
    assert first.gauge.tie.own.rms < 0.2
    assert f"a map of degree {degree} that is its own" in second.gauge.tie.statement


@pytest.mark.parametrize(
    ("degree", "error", "prior", "n_sets"),
    [
        pytest.param(2, 0.001, True, 20, marks=pytest.mark.sets),
        pytest.param(3, 0.01, True, 6, marks=pytest.mark.slow),
        pytest.param(3, 0.01, True, 20, marks=pytest.mark.sets),
        pytest.param(3, 0.001, False, 6, marks=pytest.mark.slow),
        pytest.param(3, 0.001, False, 20, marks=pytest.mark.sets),
    ],
)
def test_errors_beside_a_map_of_the_reference_alone_are_calibrated(degree, error, prior, n_sets, monkeypatch):
    """Absolute errors, and those of the catalogue's stars relative to the others."""
    monkeypatch.setattr(made_catalogues, "ERROR", error)
    squares = np.zeros((n_sets, 2))
    for seed in range(n_sets):
        data, truth = dense_model.drawn_set(seed, rolls=30.0, dynamic=0.05 if prior else 0.0)
        given = {"prior": ld.Prior(truth["static"])} if prior else {"static": "fit"}
        table = made_catalogues.catalogue(truth["stars"], seed)
        solution = ld.solve(drawn_sets.as_matches(data), **given, reference=table, reference_degree=degree)
        off = solution.estimate.positions - truth["stars"]
        squares[seed] = np.sum(off**2), np.sum(columns(solution, "err_abs") ** 2)
    assert squares[:, 0].sum() / squares[:, 1].sum() == pytest.approx(1, abs=0.2 * np.sqrt(20 / n_sets))


@pytest.mark.parametrize("degree", [pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_the_degree_that_is_named_cures(degree):
    data, truth = dense_model.drawn_set(2, rolls=30.0, dynamic=0.05)
    table = bent(made_catalogues.catalogue(truth["stars"], 2), truth["stars"], degree, 1.0)
    matches, prior = drawn_sets.as_matches(data), ld.Prior(truth["static"])
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        tied = ld.solve(matches, prior=prior, reference=table)
    check = check_of(tied)
    assert check.state == check_of(tied, "absolute").state == "fail"
    assert check.cure.startswith(f"--reference-degree {degree}, if it is the reference that is bent")
    assert 0.4 < check.value < 1.2  # similarities take some of it
    cured = check_of(ld.solve(matches, prior=prior, reference=table, reference_degree=degree))
    assert cured.state in ("unknown", "pass")
    assert "agree with the exposures" in cured.sentence


def test_no_degree_is_named_that_is_refused():
    """Static distortions that headers give may have more modes than the fit, whose degree is the highest allowed."""
    state = SimpleNamespace(positions=np.zeros((2, 60)), coefficients=np.zeros((8, 2, basis.n_modes(4))))
    tried = []

    def estimate(*_, **__):
        tried.append(1)
        raise InputError("no map")

    stated, gauge = SimpleNamespace(with_bends=lambda maps: None), SimpleNamespace(n_fields=1)
    known = stated, estimate, SimpleNamespace(state=state, gauge=gauge), SimpleNamespace(rows=np.arange(60))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(bent_reference, "bends", lambda *_: None)
        assert bent_reference.cure(*known, 0, 3) == {}
    assert len(tried) == 3


@pytest.mark.parametrize(
    "options", [{"static": "hold"}, pytest.param({"static": "hold", "layout": "fit"}, marks=pytest.mark.slow)]
)
def test_detectors_that_are_distorted_are_to_be_fitted(options):
    """Nothing was given of their distortions that could be left out; with these fitted the reference agrees."""
    matches, rng = four_detectors.matches("static", 2, n=6, n_stars=160), np.random.default_rng(2)
    xy = rng.uniform(-400, 2 * (four_detectors.SIZE + four_detectors.GAP) + 340, (160, 2))[:60]  # as in four_detectors
    xy = xy + 0.05 * np.random.default_rng(3).normal(size=xy.shape)
    known = Table({"star": np.arange(60).astype(str), "x": xy[:, 0], "y": xy[:, 1], "x_err": np.full(60, 0.05),
                   "y_err": np.full(60, 0.05)})  # fmt: skip
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        check = check_of(ld.solve(matches, degree=2, reference=known, **options))
        plain = {each.name: each for each in ld.solve(matches, degree=2, reference=known).checks}
        cured = ld.solve(matches, degree=2, reference=known, layout="fit", static="fit")
    cured = {each.name: each for each in cured.checks}
    assert check.state == "fail"
    assert "--static fit" in check.cure
    assert "given" not in check.cure
    assert plain["chi2"].cure == plain["camera"].cure == "--static fit"
    assert plain["reference"].cure.startswith("--static fit first, which the residuals call for (see camera)")
    assert plain["reference"].cure.count("--static fit") == 1
    assert plain["absolute"].state == plain["reference"].state == "fail"
    assert "they are off by" in plain["absolute"].sentence
    assert cured["reference"].state in ("unknown", "pass")
    assert cured["absolute"].state == "pass"


def test_a_map_of_its_own_is_written_and_read(tmp_path):
    solution = solved(3, "bent by 1 px", reference_degree=2)
    back = ld.Solution.read(solution.write(tmp_path / "s.asdf"))
    assert back.gauge.tie.statement == solution.gauge.tie.statement
    assert_allclose(columns(back, "err_abs"), columns(solution, "err_abs"), rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"reference_degree": 4}, "reference_degree=4 is beyond the degree of the fit"),
        ({"reference_degree": 2.5}, "reference_degree must be an integer from 0 to 30, got 2.5"),
        ({"reference_degree": 3, "n": 9}, "reference_degree=3 needs 11 stars of the reference in the exposures"),
    ],
)
def test_degrees_that_cannot_be(options, words):
    with pytest.raises(ld.exceptions.InputError, match=words):
        solved(0, **options)


def test_whose_map_it_cannot_be():
    matches = drawn_sets.as_matches(dense_model.drawn_set(0)[0])
    with pytest.raises(ld.exceptions.InputError, match="reference_degree is for the catalogue of reference"):
        ld.solve(matches, reference_degree=2)
    with pytest.raises(ld.exceptions.InputError, match="a solution states what is known of its plane"):
        ld.solve(matches, reference=ld.solve(matches), reference_degree=2)


@pytest.mark.parametrize(("how", "said"), [({}, True), ({"static": "fit"}, False)], ids=["held", "fitted"])
def test_a_reference_that_is_not_found_may_be_right_where_detectors_are_distorted(how, said):
    """Places that no star has: with distortions left in the positions, the message names these too."""
    matches = four_detectors.matches("static", 1)
    places = np.random.default_rng(1).uniform(-300, 2400, (60, 2)) + 9000
    other = Table({"x": places[:, 0], "y": places[:, 1], "x_err": [0.01] * 60, "y_err": [0.01] * 60})
    words = r"Or detectors have distortions of their own: chi2 is \d+ for \d+ degrees of freedom; fit them, static="
    with (
        warnings.catch_warnings(action="ignore", category=LegdistortWarning),
        pytest.raises(ld.exceptions.InputError, match="lies where a star of the exposures is") as error,
    ):
        ld.solve(matches, degree=2, reference=other, **how)
    assert bool(re.search(words, str(error.value))) == said
