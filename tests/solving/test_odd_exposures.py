"""Which exposure is odd where some are turned against the others; lists made by numpy alone."""

import numpy as np
import pytest
from astropy.table import Table
from night_sets import SIZE, field
from numpy.polynomial.legendre import legval2d
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort.solving.checks.odd_ones import compared

STATIC, SINGLE, SIGMA = 1.5, 0.02, 0.03  # pixels
#: Which of how many lists are turned by how much, and which are bad, how: x and y exchanged, or bent by so many pixels.
SETTINGS = {
    "exchanged": {},
    "bent": {"how": 0.5},
    "bent much": {"how": 1.0},
    "exchanged, turned": {"bad": (7,)},
    "bent, turned": {"bad": (7,), "how": 0.5},
    "two exchanged": {"bad": (2, 5)},
    "two exchanged, one turned": {"bad": (2, 7)},
    "two bent": {"bad": (2, 5), "how": 0.5},
    "exchanged, of seven": {"n": 7, "turned": (5,)},
    "exchanged, three turned": {"turned": (4, 7, 8)},
    "bent, turned by 45 degrees": {"how": 0.5, "roll": 45.0},
    "exchanged, none turned": {"turned": ()},
    "none": {"bad": ()},
    "none, of seven": {"n": 7, "turned": (5,), "bad": ()},
}


def lists(seed, *, n=10, turned=(7,), roll=90.0, bad=(3,), how="exchanged"):
    """The table of dithered lists of one field, and the names of the bad ones."""
    rng = np.random.default_rng(seed)
    sky, static, rows = rng.uniform(-120, SIZE + 120, (220, 2)), field(rng, STATIC), []
    for i in range(n):
        angle = np.radians(rng.normal(0, 0.2) + roll * (i in turned))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        q = (1 + rng.normal(0, 2e-5)) * (sky - SIZE / 2) @ turn.T + SIZE / 2 + rng.uniform(-90, 90, 2)
        own = static + field(rng, SINGLE)
        if i in bad and how != "exchanged":
            own = own + field(rng, how)
        q = q + legval2d(*((2 * q + 1) / SIZE - 1).T, own.transpose(1, 2, 0)).T
        q = q + rng.normal(0, SIGMA, q.shape)
        if i in bad and how == "exchanged":
            q = q[:, ::-1]
        for j in np.flatnonzero(np.all((q > 0) & (q < SIZE - 1), axis=1)):
            rows.append((f"e{i:02d}", j, *q[j], SIGMA, SIGMA))
    names = ["exposure", "star", "x", "y", "x_err", "y_err"]
    return Table(rows=rows, names=names), [f"e{i:02d}" for i in bad]


def named(table):
    """The exposures that the check `dynamic part` names, sorted."""
    solution = ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE)))
    check = next(check for check in solution.checks if check.name == "dynamic part")
    return sorted(test.name.removeprefix("departure of ") for test in check.tests)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("setting", ["exchanged", pytest.param("two exchanged", marks=pytest.mark.slow)])
def test_a_bad_exposure_makes_no_turned_one_odd(setting, seed):
    """It draws a map of the plane to itself, which those show that are turned."""
    table, bad = lists(seed, **SETTINGS[setting])
    assert named(table) == bad


@pytest.mark.sets
@pytest.mark.filterwarnings("ignore:absolute positions are not known")
@pytest.mark.parametrize("setting", SETTINGS)
def test_bad_exposures_are_named_and_no_others(setting):
    """In 40 sets each."""
    right, wrong, asked = 0, 0, 0
    for seed in range(40):
        table, bad = lists(seed, **SETTINGS[setting])
        found = named(table)
        right, wrong, asked = right + len({*bad} & {*found}), wrong + bool({*found} - {*bad}), asked + len(bad)
    print(f"{setting}: {right} of {asked} named, sets with others named: {wrong} of 40")
    assert right >= 0.95 * asked
    assert wrong == 0


@pytest.mark.parametrize("maps", [0, 18])
def test_departures_of_one_distribution_have_any_probability(maps):
    """Nine departures, of which one alone tells a map; one that is odd takes away nothing from the others."""
    degrees, n = np.array([1, 1] + 6 * [2] + 8 * [3]), 9
    told, p = n if not maps else n - 1, []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        moved = np.tile(rng.normal(size=(len(degrees), maps)), (n, 1, 1))
        moved[0] = rng.normal(size=(len(degrees), maps))
        noise = rng.uniform(0.5, 2, (n, 1)) * np.full((n, len(degrees)), 1e-5)
        a = rng.normal(size=len(degrees)) + moved @ rng.normal(size=maps)
        a = a + rng.normal(size=noise.shape) * np.sqrt(noise + SINGLE**2)
        found = compared(a, noise, degrees, moved if maps else None)
        p.append(found.p)
        assert (found.dof > 0).sum() == told
        bad = 0.2 * rng.normal(size=len(degrees))
        a[4] += bad
        worse = compared(a, noise, degrees, moved if maps else None)
        assert np.argmin(worse.p) == 4
        assert worse.p[4] < 1e-6
        assert_allclose(worse.away[4] - found.away[4], bad, rtol=0.1, atol=0.01)
    p = np.array(p)[:, n - told :]
    for level in (0.3, 0.1, 0.03):
        assert abs(np.mean(p < level) / level - 1) < 0.3
