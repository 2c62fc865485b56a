"""Static distortions of detectors fitted with a reference: the minimum of J over all there is, of `rolled_mosaic`."""

import warnings

import numpy as np
import pytest
import rolled_mosaic

import legdistort as ld
from legdistort.exceptions import LegdistortWarning

FITTED = {"static": "fit", "layout": "fit"}
#: Excess of J and departure of stars, in their errors, by directions of the camera that hardly show and so are kept.
EXCESS, OFF = 30.0, 0.3


def solved(mosaic, reference=None, **options):
    layouts = mosaic.layouts.items()
    camera = ld.Camera("M", {k: ld.Detector((rolled_mosaic.SIZE,) * 2, layout=each) for k, each in layouts})
    matches = ld.Matches.from_table(mosaic.table, camera=camera, poses=mosaic.poses)
    reference = mosaic.reference if reference is None else reference
    return ld.solve(matches, degree=mosaic.degree, reference=reference, **options)


def places(solution):
    """Stars, positions (n, 2) and their absolute errors (n, 2)."""
    stars = solution.stars
    xy, errors = ([stars[f"{axis}{end}"].value for axis in "xy"] for end in ("", "_err_abs"))
    return stars["star"].astype(int), np.transpose(xy), np.transpose(errors)


def beside(solution, mosaic):
    """J of a solution."""
    star, xy, _ = places(solution)
    known = star < len(mosaic.catalogue)
    off = (mosaic.catalogue[star[known]] - xy[known]) / mosaic.error
    return solution.chi2 + np.sum(off**2)


def squared_pull(solution, mosaic):
    star, xy, errors = places(solution)
    return np.mean(((xy - mosaic.stars[star]) / errors) ** 2)


@pytest.mark.parametrize(
    "how", [{"degree": 2, "n_stars": 60}, pytest.param({"degree": 3, "n_stars": 60}, marks=pytest.mark.slow)]
)
def test_they_are_at_the_minimum_of_all_that_is_known(how):
    """Found without the reference, and held while it moved the plane, they left 6.4 times the least J (degree 2)."""
    mosaic = rolled_mosaic.mosaic(0, **how)
    least, _, stars, covariance = rolled_mosaic.minimum(mosaic)
    solution = solved(mosaic, **FITTED)
    star, xy, errors = places(solution)
    own = np.sqrt(np.diag(covariance)).reshape(2, -1).T[star]
    assert least - 1 < beside(solution, mosaic) < least + EXCESS
    assert np.sqrt(np.mean(((xy - stars[star]) / own) ** 2)) < OFF
    assert np.sqrt(np.mean(errors**2) / np.mean(own**2)) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 3])
def test_more_unknowns_never_make_chi2_larger(degree):
    mosaic = rolled_mosaic.mosaic(1, degree=degree, n_stars=60, static=0.02)
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        each = [solved(mosaic, clip=None, **how) for how in ({"layout": "fit"}, FITTED)]
    held, fitted = (beside(solution, mosaic) for solution in each)
    assert fitted <= held + 1e-3
    assert each[1].chi2 / each[1].dof < 1.2


@pytest.mark.slow
def test_a_reference_with_a_map_of_its_own_moves_nothing_that_it_does_not_tell():
    mosaic = rolled_mosaic.mosaic(0, n_stars=60)
    plain = solved(mosaic, **FITTED)
    own = solved(mosaic, reference_degree=2, **FITTED)
    assert own.chi2 < 1.05 * plain.chi2
    assert 0.3 < squared_pull(own, mosaic) < 2


@pytest.mark.slow
def test_stars_of_the_reference_that_lie_elsewhere_move_nothing():
    mosaic, rng = rolled_mosaic.mosaic(0, n_stars=60), np.random.default_rng(5)
    table, wrong = mosaic.reference, rng.permutation(len(mosaic.catalogue))[:6]
    for axis in "xy":
        table[axis][wrong] += rng.normal(0, 0.5, 6)
    solution = solved(mosaic, table, **FITTED)
    assert solution.chi2 / solution.dof < 1.2
    assert squared_pull(solution, mosaic) < 1.6


@pytest.mark.sets
@pytest.mark.slow
def test_errors_are_right():
    found = []
    for seed in range(20):
        mosaic = rolled_mosaic.mosaic(seed, n_stars=60)
        found.append(squared_pull(solved(mosaic, **FITTED), mosaic))
    assert np.mean(found) == pytest.approx(1, abs=0.2)
