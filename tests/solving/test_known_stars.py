"""A finished solution as the reference of another exposure of its field; truth from numpy."""

from dataclasses import replace

import dense_model
import drawn_sets
import numpy as np
import pytest
from astropy.table import Table

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.geometry.tangent_plane import TangentPlane

SIZE = 2048


def field(seed, *, n=12, **setting):
    """A solution of all exposures but the last of a set, matches of this with other numbers, and the truth."""
    setting = {"n_stars": 110, "errors": (0.02, 0.0200001), "rolls": 30.0} | setting
    data, truth = dense_model.drawn_set(seed, n=n, **setting)
    matches, rng = drawn_sets.as_matches(data), np.random.default_rng(seed)
    is_last = matches.table["exposure"] == f"e{n - 1:02d}"
    hidden = np.isin(matches.table["star"], rng.permutation(len(truth["stars"]))[:30])  # only the last one has them
    table = Table(matches.table[is_last])
    table["star"] = 1000 + np.asarray(table["star"])
    prior = ld.Prior(truth["static"]) if setting.get("prior") else None
    return matches.keep(~is_last & ~hidden), ld.Matches.from_table(table, shape=(SIZE, SIZE)), truth["stars"], prior


def after_pointing(base, stars, positions, true):
    """Positions less truth once the similarity from the truth to the plane of a solution is taken off, (n, 2)."""
    there = stars[base.estimate.star_names] @ [1, 1j]
    design = np.stack([np.ones_like(there), there], axis=1)
    fit = np.linalg.lstsq(design, base.estimate.positions @ [1, 1j])[0]
    off = positions @ [1, 1j] - np.stack([np.ones(len(true)), true @ [1, 1j]], axis=1) @ fit
    return np.stack([off.real, off.imag], axis=1)


@pytest.mark.parametrize(
    ("n_sets", "setting", "tolerance"),
    [
        pytest.param(6, {}, 0.5, marks=pytest.mark.slow),
        pytest.param(40, {}, 0.2, marks=pytest.mark.sets),
        pytest.param(40, {"dynamic": 0.1}, 0.2, marks=pytest.mark.sets),
    ],
)
def test_absolute_errors_have_those_of_the_solution(n_sets, setting, tolerance):
    squares = np.zeros((2, 2))
    for seed in range(n_sets):
        matches, last, stars, _ = field(seed, **setting)
        base = ld.solve(matches, degree=3)
        solution = ld.solve(last, degree=3, reference=base)
        names = solution.estimate.star_names - 1000
        off = after_pointing(base, stars, solution.estimate.positions, stars[names])
        stated = np.stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")], axis=1)
        assert np.isfinite(stated).all()
        known = np.isin(names, base.estimate.star_names)
        assert np.count_nonzero(~known) > 5
        squares += [[np.sum(each[rows] ** 2) for each in (off, stated)] for rows in (known, ~known)]
    assert squares[:, 0] / squares[:, 1] == pytest.approx(1, abs=tolerance)


def test_what_the_solution_does_not_know_the_exposure_does_not_know():
    matches, last, *_ = field(0, rolls=0.0)
    base = ld.solve(matches, degree=3)
    solution = ld.solve(last, degree=3, reference=base)
    assert "shear" in base.gauge.unknown_names
    assert set(base.gauge.unknown_names) & set(solution.gauge.unknown_names)
    assert np.mean(np.isfinite(solution.stars["x_err_abs"])) < 0.2
    assert next(check.state for check in solution.checks if check.name == "absolute") == "unknown"


def test_relative_errors_are_those_of_measurement_and_solution():
    """Of all stars in both, 11 exposures and one, errors become those of twelve."""
    matches, last, stars, _ = field(3, dynamic=0.1, n_stars=200)
    base = ld.solve(matches, degree=3)
    solution = ld.solve(last, degree=3, reference=base)
    names = solution.estimate.star_names - 1000
    off = after_pointing(base, stars, solution.estimate.positions, stars[names])
    design = dense_model.basis(stars[names], 3, SIZE)[0]
    off -= design @ np.linalg.lstsq(design, off)[0]
    known = np.isin(names, base.estimate.star_names)
    assert np.sqrt(np.mean(off[known] ** 2)) < 0.5 * 0.02
    assert np.sqrt(np.mean(off[~known] ** 2)) == pytest.approx(0.02, rel=0.4)


@pytest.mark.parametrize(
    "with_sky", [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=pytest.mark.slow)]
)
def test_files_and_planes_that_are_turned(tmp_path, with_sky):
    """The plane of the solution is the one of its first exposure, that of the other its own: found by the pattern."""
    matches, last, *_ = field(1, rolls=75.0)
    sky = TangentPlane(83.8, -5.4, np.array([[-2e-5, 0, 0.02], [0, 2e-5, -0.02]]))
    if with_sky:
        matches = replace(matches, sky=sky)
    base = ld.solve(matches, degree=3)
    base.write(tmp_path / "solution.asdf")
    table = Table(last.table)
    blind = ld.Matches.from_table(table, shape=(SIZE, SIZE))
    found = [ld.solve(blind, degree=3, reference=each) for each in (base, tmp_path / "solution.asdf", tmp_path)]
    assert (found[0].sky is not None) == with_sky
    near = found[0].estimate.star_names - 1000
    both = np.isin(near, base.estimate.star_names)
    if with_sky:
        there, here = (each.sky.to_sky(each.estimate.positions) for each in (base, found[0]))
        rows = np.searchsorted(base.estimate.star_names, near[both])
        assert np.max(there[rows].separation(here[both]).deg) < 0.2 * 2e-5
    else:
        here = found[0].estimate.positions[both]
        there = base.estimate.positions[np.searchsorted(base.estimate.star_names, near[both])]
        assert np.max(np.abs(here - there)) < 0.2
    for other in found[1:]:
        assert np.allclose(other.estimate.positions, found[0].estimate.positions, rtol=0, atol=1e-6)
    assert str(tmp_path) in found[1].diagnostics.reference.name


def test_what_a_solution_cannot_do():
    matches, last, *_ = field(0)
    base = ld.solve(matches, degree=3)
    with pytest.raises(InputError, match="a solution states the errors of its stars"):
        ld.solve(last, reference=base, reference_error=0.1)
    with pytest.raises(InputError, match="motion='proper' with a solution as reference"):
        ld.solve(matches, reference=base, motion="proper")
