"""What the check of a reference says of right and wrong ones. Truth from numpy alone (`dense_model`)."""

import warnings

import dense_model
import drawn_sets
import made_catalogues
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.solving.checks.limits import addition_that_shows


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
        ("bent by 1 px", "fail", "bent against what the exposures show by 1.1 px rms"),
        ("five years off", "fail", "they agree with epochs that are 5 years later"),
        ("errors x 1000", "warn", "its errors are smaller than it states"),
        ("errors / 1000", "warn", "its errors were taken 9.4e+02 times as large"),
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


def test_errors_that_are_found_are_not_blamed():
    for fault in ("errors x 1000", "errors / 1000"):
        assert check_of(solved(0, fault, reference_error="found")).state == "unknown"


def test_few_stars_tell_nothing_of_errors():
    check = check_of(solved(0, n=4))
    assert check.state == "unknown"
    assert "its errors (of 4 stars) are believed" in check.sentence


def test_many_mismatches_are_named():
    check = check_of(solved(1, "20 % blunders"))
    assert check.state == "warn"
    assert "of 40 stars of the reference lie elsewhere in it" in check.sentence


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


@pytest.mark.slow
@pytest.mark.parametrize(("prior", "rolls"), [(True, 0.0), (True, 30.0), (False, 30.0)])
def test_statistics_of_right_references_are_those_of_chance(prior, rolls):
    made = [solved(seed, prior=prior, taken={"rolls": rolls}).gauge.tie.agreement for seed in range(40)]
    for chi2, dof in ((sum(m.chi2 for m in made), sum(m.dof for m in made)),
                      (sum(m.bend_chi2 for m in made), sum(m.bend_dof for m in made))):  # fmt: skip
        assert chi2 / dof == pytest.approx(1, abs=max(0.1, 4 * np.sqrt(2 / dof)))
    p = [stats.chi2.sf(m.bend_chi2, m.bend_dof) for m in made if m.bend_dof]
    assert stats.kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("prior", "rolls"), [(True, 0.0), (True, 30.0), (False, 30.0)])
def test_wrong_references_are_found(prior, rolls):
    for fault in ("bent by 1 px", "five years off", "errors x 1000"):
        states = [check_of(solved(seed, fault, prior=prior, taken={"rolls": rolls})).state for seed in range(10)]
        assert set(states) <= {"warn", "fail"}, fault
