"""Effects that displace stars are named where they are and nowhere else; sets of `known_displacements`, numpy alone."""

import warnings

import dense_model
import drawn_sets
import known_displacements
import numpy as np
import pytest

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.solving.checks.known_effects import EFFECTS
from legdistort.solving.checks.residual_tests import Residuals, in_cells
from legdistort.solving.checks.smooth_fields import smooth_fields

#: A part of the words for every effect.
WORDS = {effect.name: effect.found.partition("{")[0] for effect in EFFECTS}
WORDS["turbulence"] = "neighbouring stars of an exposure are displaced alike, in every exposure in another way"

each_effect = pytest.mark.parametrize("effect", known_displacements.DISPLACED)


def solved(data, **options):
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        return ld.solve(drawn_sets.as_matches(data), clip=None, **options)


def named(solution):
    """Effects that checks which do not pass name."""
    text = "; ".join(check.sentence for check in solution.checks if check.state in ("warn", "fail"))
    return {name for name, words in WORDS.items() if words in text}


def residuals(solution):
    parts = solution.estimate.checked.keywords
    return Residuals(parts["problem"], parts["state"], parts["blocks"], parts["uncertainty"].system, solution.dof)


@pytest.mark.parametrize("effect", known_displacements.SMALL)
def test_an_effect_of_the_size_of_the_errors_is_named(effect):
    data, _ = known_displacements.displaced(effect, 0)
    solution = solved(data)
    assert named(solution) == {effect}
    chi2 = next(check for check in solution.checks if check.name == "chi2")
    assert WORDS[effect] in chi2.sentence
    if effect != "turbulence":
        assert chi2.cure == next(each.cure for each in EFFECTS if each.name == effect)


@pytest.mark.parametrize("n_sets", [pytest.param(3, marks=pytest.mark.slow), pytest.param(30, marks=pytest.mark.sets)])
@each_effect
def test_effects_are_named_in_nine_of_ten_sets(effect, n_sets):
    found = [named(solved(known_displacements.displaced(effect, 100 + seed)[0])) for seed in range(n_sets)]
    few = np.ceil(0.1 * n_sets)
    assert sum(effect in names for names in found) >= n_sets - few
    assert sum(bool(names - {effect}) for names in found) <= few


@pytest.mark.parametrize(
    "n_sets", [pytest.param(10, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.sets)]
)
def test_nothing_is_named_where_nothing_is(n_sets):
    """Not even where errors are wrong, or exposures noisier than the others."""
    taken = known_displacements.TAKEN, known_displacements.ROLLED, {}, {"dither": 0.5}, {"n": 5}
    found, rng = [], np.random.default_rng(1)
    for seed in range(n_sets):
        data = dense_model.drawn_set(1000 + seed, **taken[seed % 5])[0]
        if seed % 2:
            data["err"] = data["err"] * np.where(data["exposure"] == 3, 0.5, rng.uniform(0.5, 1))[:, None]
        found.append(named(solved(data)))
    assert sum(map(bool, found)) <= 0.05 * n_sets + (1 if n_sets < 100 else 0)  # a standard deviation


@pytest.mark.parametrize("kind", [pytest.param("pixel phase", marks=pytest.mark.slow), "step"])
def test_what_would_be_left_without_an_effect_is_what_is_left_without_it(kind):
    """Chi2 that is promised is that of the same set with the pattern taken off by hand."""
    data, shift = known_displacements.displaced(kind, 3)
    chi2 = next(check for check in solved(data).checks if check.name == "chi2")
    promised = float(chi2.sentence.partition("chi2/dof would be ")[2])
    without = solved(data | {"xy": data["xy"] - shift})
    assert promised == pytest.approx(without.chi2 / without.dof, rel=0.1)
    assert next(check for check in without.checks if check.name == "chi2").state == "pass"


def test_fits_of_columns_gain_what_a_fit_with_these_displacements_gains():
    """Of a known combination of columns all of chi2 goes, and of others none."""
    data, _ = dense_model.drawn_set(2, **known_displacements.TAKEN)
    step = (data["xy"][:, 0] > 900).astype(float)
    before, after = (residuals(solved(data | {"xy": data["xy"] + k * step[:, None] * [0.02, 0.01]})) for k in (0, 1))
    columns = in_cells(np.zeros(len(step), dtype=int), step * np.eye(2)[:, :, None])
    order = after.problem.order
    columns = [c.tocsr()[order] for c in columns]
    left = [each.without(columns) for each in (before, after)]
    assert left[1].chi2 == pytest.approx(left[0].chi2, rel=1e-3)
    assert after.chi2 - left[1].chi2 == pytest.approx(after.of_columns(columns)[0].t, rel=1e-6)
    assert after.chi2 - left[1].chi2 > 30
    assert left[1].dof == after.dof - 2


def test_neighbours_have_nothing_in_common_where_nothing_is():
    values = [smooth_fields(residuals(solved(dense_model.drawn_set(seed)[0]))).errors for seed in range(4)]
    assert np.max(np.abs(values)) < 3.5
