"""Stars of a catalogue among those of exposures that go deeper; truth from numpy."""

import numpy as np
import pytest
from astropy.table import Table
from caller_warnings import warns_here

from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry.tangent_plane import TangentPlane
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


def on_sky(xy, *, scale, angle, flip=-1, point=(161.25, -59.68)):
    """RA and Dec [deg] of positions (n, 2) by the gnomonic projection, and the matrix of their plane."""
    a, scale = np.radians(angle), scale / 3600
    turn = scale * np.array([[flip, 0], [0, 1]]) @ [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    matrix = np.column_stack([turn, -turn @ [SIZE / 2, SIZE / 2]])
    xi, eta = np.radians(xy @ turn.T + matrix[:, 2]).T
    ra, dec = np.radians(point)
    down = np.cos(dec) - eta * np.sin(dec)
    lon = ra + np.arctan2(xi, down)
    lat = np.arctan((np.sin(dec) + eta * np.cos(dec)) * np.cos(lon - ra) / down)
    return np.degrees([lon, lat]), matrix


def celestial(sky):
    return read_reference(
        Table({"ra": sky[0], "dec": sky[1], "ra_error": [5.0] * len(sky[0]), "dec_error": [5.0] * len(sky[0])})
    )


@pytest.mark.parametrize(
    ("wrong", "far"),
    [
        ({"scale": 0.026, "angle": 0.0}, 0.0),
        ({"scale": 0.04, "angle": 90.0}, 0.0),
        ({"scale": 0.04, "angle": 0.0, "flip": 1}, 0.0),
        ({"scale": 0.04, "angle": 0.0, "point": (161.3, -59.68)}, 0.05 * 3600 * np.cos(np.radians(59.68))),
    ],
    ids=["scale", "turned", "mirrored", "another place"],
)
def test_a_sky_that_the_stars_contradict_does_not_hide_a_reference(wrong, far):
    rng = np.random.default_rng(1)
    positions = rng.uniform(0, SIZE, (90, 2))
    sky, matrix = on_sky(positions, scale=0.04, angle=0.0)
    right, stated = TangentPlane(161.25, -59.68, matrix), on_sky(positions, **wrong)[1]
    stated = TangentPlane(*wrong.get("point", (161.25, -59.68)), stated)
    reference = celestial(sky[:, rng.permutation(90)[:60]])
    with warns_here(AssumptionWarning, match=r"contradict the reference: by 60 of its stars the field is") as told:
        found = identify(reference, np.arange(90), positions, sky=stated)
    assert len(found.rows) == 60
    np.testing.assert_allclose(found.xy, positions[found.rows], atol=1e-3)
    corners = SIZE * np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
    assert found.sky.to_sky(corners).separation(right.to_sky(corners)).arcsec.max() < 1e-4
    assert float(str(told[0].message).split(" arcsec from where")[0].split()[-1]) == pytest.approx(
        far, rel=0.01, abs=2.0
    )


def test_of_another_field_no_pattern_is_believed():
    rng = np.random.default_rng(2)
    sky, matrix = on_sky(rng.uniform(0, SIZE, (60, 2)), scale=0.04, angle=0.0)
    with pytest.raises(InputError, match="nor is their pattern found in it, whatever the headers state: another field"):
        identify(celestial(sky), np.arange(90), rng.uniform(0, SIZE, (90, 2)), sky=TangentPlane(161.25, -59.68, matrix))
