"""Stars of a catalogue among those of exposures that go deeper; truth from numpy."""

import numpy as np
import pytest
from astropy.table import Table

from legdistort.exceptions import InputError
from legdistort.inputs.references.catalogue import read_reference
from legdistort.matching.cross_identification import identify

SIZE = 1000.0


def catalogue(xy):
    table = Table({"x": xy[:, 0], "y": xy[:, 1]})
    table["x_err"] = table["y_err"] = 0.1
    return read_reference(table)


def deep(seed, *, n=600, n_known=40, shift=(-13.0, 18.0), chance=False):
    """Positions (n, 2) of exposures, the catalogue, and which of its rows is which of them; -1 for none.

    The catalogue covers more than the field, and some of its stars in the field are not among the positions.
    """
    rng = np.random.default_rng(seed)
    positions, known = rng.uniform(0, SIZE, (n, 2)), rng.uniform(-200, SIZE + 200, (n_known, 2))
    rows = np.full(n_known, -1)
    if not chance:
        rows[: n_known // 2] = rng.permutation(n)[: n_known // 2]
        known[: n_known // 2] = positions[rows[: n_known // 2]] + shift + 0.3 * rng.normal(size=(n_known // 2, 2))
    return positions, catalogue(known), rows


@pytest.mark.parametrize("seed", range(6))
def test_a_common_shift_of_a_short_catalogue_is_found_among_many_stars(seed):
    positions, reference, rows = deep(seed)
    found = identify(reference, np.arange(len(positions)), positions)
    right = rows >= 0
    assert set(rows[right]) - set(found.rows) == set()
    assert len(found.rows) <= np.count_nonzero(right) + 3
    wanted = reference.xy[[np.flatnonzero(rows == row)[0] for row in rows[right]]]
    have = found.xy[[np.flatnonzero(found.rows == row)[0] for row in rows[right]]]
    np.testing.assert_array_equal(have, wanted)


@pytest.mark.parametrize("seed", [16, 23])
def test_fluxes_that_mislead_do_no_harm(seed):
    """Of another band, say: with these alone nothing was found."""
    positions, reference, rows = deep(seed)
    rng = np.random.default_rng(100 + seed)
    table = Table({"x": reference.xy[:, 0], "y": reference.xy[:, 1], "flux": 10 ** rng.uniform(2, 5, len(rows))})
    table["x_err"] = table["y_err"] = 0.1
    flux = 10 ** rng.uniform(2, 5, len(positions))
    found = identify(read_reference(table), np.arange(len(positions)), positions, flux=flux)
    assert set(rows[rows >= 0]) <= set(found.rows)


def none_found(seeds, **setting):
    for seed in seeds:
        positions, reference, _ = deep(seed, chance=True, **setting)
        with pytest.raises(InputError, match="another field"):
            identify(reference, np.arange(len(positions)), positions)


@pytest.mark.parametrize("n_known", [15, 40])
def test_a_catalogue_of_other_stars_is_not_found(n_known):
    none_found(range(2), n_known=n_known)


@pytest.mark.parametrize(
    ("n_sets", "n_known"),
    [
        pytest.param(6, 40, marks=pytest.mark.slow),
        *(pytest.param(100, n_known, marks=pytest.mark.sets) for n_known in (15, 40, 100)),
    ],
)
def test_a_catalogue_of_other_stars_is_never_found(n_sets, n_known):
    none_found(range(n_sets), n_known=n_known)
