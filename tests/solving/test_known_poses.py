"""Poses that are known with errors: the plane is theirs, and absolute errors include shift, rotation and scale."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from numpy.polynomial.legendre import legval2d
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import InputError

SIZE, DEGREE, NOISE = 1024, 3, 0.01
ORDERS = np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1))
INFINITE, EXACT = (dict.fromkeys(("shift", "rotation", "scale"), each) for each in (np.inf, 0.0))


def distortion(rng, size):
    """Legendre coefficients (2, 4, 4), unnormalised, of a cubic map without shift, rotation and scale."""
    out = rng.normal(0, size, (2, *ORDERS.shape)) * ((ORDERS <= DEGREE) & (ORDERS > 1)) / (1 + ORDERS)
    a, b = rng.normal(0, size / 2, 2)
    out[0, 1, 0], out[1, 0, 1], out[0, 0, 1], out[1, 1, 0] = a, -a, b, b
    return out


def turned(errors, rng):
    """Similarity (2, 3) about the middle of the detector with errors of shift [px], rotation [deg], scale."""
    shift, rotation, scale = errors
    z = (1 + scale * rng.normal()) * np.exp(1j * np.radians(rotation * rng.normal()))
    m, middle = np.array([[z.real, -z.imag], [z.imag, z.real]]), (SIZE - 1) / 2 * np.ones(2)
    return np.column_stack([m, middle - m @ middle + shift * rng.normal(size=2)])


def composed(second, first):
    return np.column_stack([second[:, :2] @ first[:, :2], second[:, :2] @ first[:, 2] + second[:, 2]])


def exposures(seed, errors=(0.0, 0.0, 0.0), *, n=8, n_stars=150, static=0.0, single=0.2, dither=150.0, roll=0.0):
    """Table of matched positions, poses with errors (those of the detector last), and the true stars."""
    rng = np.random.default_rng(seed)
    sky, fixed = rng.uniform(-150, SIZE + 150, (n_stars, 2)), distortion(rng, static)
    rows, poses = [], {}
    for i in range(n):
        shift = np.column_stack([np.eye(2), rng.uniform(-dither, dither, 2)])
        pose = composed(turned((0, roll, 1e-4), rng), shift)
        q = sky @ pose[:, :2].T + pose[:, 2]
        maps = fixed + distortion(rng, single)
        xy = q + legval2d(*((2 * q + 1) / SIZE - 1).T, maps.transpose(1, 2, 0)).T + rng.normal(0, NOISE, q.shape)
        seen = np.flatnonzero(np.all((xy > 0) & (xy < SIZE - 1), axis=1))
        rows += [(f"e{i}", j, *xy[j], NOISE, NOISE) for j in seen]
        poses[f"e{i}"] = composed(turned(errors, rng), pose)
    return Table(rows=rows, names=["exposure", "star", "x", "y", "x_err", "y_err"]), poses, sky


def solved(seed, errors, *, prior=None, options=None, **setting):
    """Solution, errors (n, 2) of its stars, and what is stated of them: absolute, with shift, rotation and scale."""
    table, poses, sky = exposures(seed, errors, **setting)
    stated = dict(zip(INFINITE, errors, strict=True))
    matches = ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses, pose_sigma=stated)
    solution = ld.solve(matches, **{"degree": DEGREE, "prior": prior} | (options or {}))
    stars = solution.stars
    off = np.column_stack([stars[c].value for c in "xy"]) - sky[np.asarray(stars["star"])]
    return solution, off, np.column_stack([stars[f"{c}_err_abs"].value for c in "xy"])


def square_pull(n_sets, errors, **how):
    """Mean squared error of the stars over what is stated of it."""
    sums = np.zeros(2)
    for seed in range(n_sets):
        _, off, stated = solved(seed, errors, **how)
        assert np.isfinite(stated).all()
        sums += np.sum(off**2), np.sum(stated**2)
    return sums[0] / sums[1]


NOTHING = ld.Prior(np.zeros((2, 1)))
SELF = {"static": "fit", "exposure_degree": 0}


@pytest.mark.parametrize(
    ("n_sets", "errors", "how"),
    [
        pytest.param(40, (0.0, 0.0, 0.0), {"prior": NOTHING}, marks=pytest.mark.sets),
        pytest.param(15, (0.1, 0.01, 1e-4), {"prior": NOTHING}, marks=pytest.mark.slow),
        pytest.param(40, (0.1, 0.01, 1e-4), {"prior": NOTHING}, marks=pytest.mark.sets),
        pytest.param(15, (0.0, 0.0, 0.0), {"static": 1.0}, marks=pytest.mark.slow),
        pytest.param(60, (0.0, 0.0, 0.0), {"static": 1.0}, marks=pytest.mark.sets),
        pytest.param(60, (0.1, 0.01, 1e-4), {"static": 1.0}, marks=pytest.mark.sets),
        pytest.param(60, (0.1, 0.0, 1e-4), {"static": 1.0, "roll": 40.0}, marks=pytest.mark.sets),
        pytest.param(
            60,
            (0.02, 0.01, 1e-5),
            {"static": 1.0, "single": 0.0, "roll": 40.0, "options": SELF},
            marks=pytest.mark.sets,
        ),
        pytest.param(60, (5.0, 0.5, 1e-3), {"prior": NOTHING, "dither": 20.0}, marks=pytest.mark.sets),
    ],
)
def test_absolute_errors_are_calibrated(n_sets, errors, how):
    """Nothing is taken off: shift, rotation and scale are those of the poses, as well as these are known."""
    assert square_pull(n_sets, errors, **how) == pytest.approx(1, abs=0.2 * max(1, np.sqrt(40 / n_sets)))


def test_infinite_is_today():
    """Start values, to the last bit; also where only some errors are stated so."""
    table, poses, _ = exposures(1)
    made = [
        ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses, pose_sigma=each))
        for each in (None, INFINITE, {"shift": np.inf}, {})
    ]
    for each in made[1:]:
        assert each.settings.pose_sigma is None
        for column in ("x", "y", "x_err", "x_err_abs"):
            assert_array_equal(each.stars[column], made[0].stars[column])


def without_similarity(off, sky):
    """Errors (n, 2) without shift, rotation and scale."""
    z, w = ((each - each.mean(axis=0)) @ [1, 1j] for each in (sky, off))
    left = w - z * (z.conj() @ w) / (z.conj() @ z).real
    return np.column_stack([left.real, left.imag])


def test_few_stars_gain():
    """Few stars do not tell rotations and scales of exposures well, and with them what dithers show of the plane."""
    sums = np.zeros(3)
    for seed in range(12):
        table, poses, sky = exposures(seed, n_stars=16, single=0.0, n=6)
        matches = ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses)
        for k, sigma in enumerate([None, {"shift": 0.02, "rotation": 0.001, "scale": 1e-5}, EXACT]):
            solution = ld.solve(matches, degree=1, prior=NOTHING, pose_sigma=sigma)
            true = sky[solution.estimate.star_names]
            sums[k] += np.sum(without_similarity(solution.estimate.positions - true, true) ** 2)
    assert sums[2] < 0.8 * sums[0]
    assert sums[1] < sums[0]


def stars_of(seed, sigma):
    """Table of stars where exact poses are stated with errors."""
    table, poses, _ = exposures(seed)
    return ld.solve(
        ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses), degree=DEGREE, prior=NOTHING, pose_sigma=sigma
    ).stars


def test_between_exact_and_infinite():
    """Errors grow with those of the poses; at the ends are exact poses, and start values but for shift and so on."""
    factors = np.array([1e-6, 0.01, 0.1, 1.0, 1e3])
    made = [stars_of(2, {"shift": f, "rotation": 0.1 * f, "scale": 1e-3 * f}) for f in factors]
    for column in ("x_err", "y_err", "x_err_abs", "y_err_abs"):
        assert np.all(np.diff([np.median(each[column].value) for each in made]) > 0)
    exact, free = (stars_of(2, dict.fromkeys(INFINITE, sigma)) for sigma in (0.0, np.inf))
    assert_allclose(made[0]["x"].value, exact["x"].value, atol=1e-4)
    assert_allclose(made[0]["x_err_abs"], exact["x_err_abs"], rtol=1e-3)
    first, last = (np.column_stack([each["x"].value, each["y"].value]) for each in (free, made[-1]))
    assert_allclose(without_similarity(last - first, first), 0, atol=2e-3)
    assert_allclose(made[-1]["x_err"], free["x_err"], rtol=1e-2)


def test_what_is_wrong_is_said():
    table, poses, _ = exposures(3, n=4, n_stars=60)
    shape = {"shape": (SIZE, SIZE)}
    matches = ld.Matches.from_table(
        table, **shape, poses=poses, pose_sigma={"shift": 1 * u.pix, "rotation": 36 * u.arcsec}
    )
    assert matches.pose_sigma == pytest.approx({"shift": 1.0, "rotation": 0.01})
    for wrong, message in (
        ({"shift": -1}, "error of shift must be a number .px., 0 or more, got -1"),
        ({"shift": 1 * u.m}, "shift must be in pix"),
        ({"scale": 0.1}, "scale without shift, and says nothing of where the reference plane lies"),
        ({"turn": 0.1}, "must be a dict of the errors of shift"),
        (0.1, "must be a dict of the errors of shift"),
    ):
        with pytest.raises(InputError, match=message):
            ld.solve(matches, pose_sigma=wrong)
    with pytest.raises(InputError, match=r"give these .poses=., or leave pose_sigma out"):
        ld.Matches.from_table(table, **shape, pose_sigma=EXACT)
    catalogue = Table({"star": [1, 2], "x": [1.0, 2], "y": [1.0, 2], "x_err": [1.0, 1], "y_err": [1.0, 1]})
    for options, message in (
        ({"degree": 0}, "needs degree 1 at least"),
        ({"reference": catalogue}, "both say where the reference plane lies"),
        ({"motion": "proper"}, "does not go with pose_sigma"),
    ):
        with pytest.raises(InputError, match=message):
            ld.solve(matches, **options)


@pytest.mark.parametrize(
    "options",
    [
        {"degree": "auto"},
        {"loss": "huber"},
        {"validate": 0.2},
        {"errors": "floor"},
        {"prior": NOTHING.with_sigma("evidence", degree=DEGREE)},
        {"prior": ld.Prior(None, static_sigma=2.0)},
    ],
    ids=str,
)
def test_it_goes_with(options):
    """Other options: finite absolute errors of stars, and of new positions."""
    table, poses, _ = exposures(3, (0.1, 0.01, 1e-4), n=6, n_stars=150, single=0.05)
    sigma = {"shift": 0.1, "rotation": 0.01, "scale": 1e-4}
    solution = ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses, pose_sigma=sigma), **options)
    assert np.isfinite(solution.stars["x_err_abs"]).all()
    assert "shift, rotation, scale" in str(solution.gauge)
    assert solution.chi2 == pytest.approx(solution.dof, rel=0.2)
    new = solution["e0"].correct([[500.0, 500.0]], errors=[[0.01, 0.01]])
    assert all(np.isfinite(each).all() for each in new[1:])


@pytest.mark.slow
def test_it_is_kept(tmp_path):
    """In the matches' file, in the solution and its file, and by the command line."""
    table, poses, _ = exposures(4, n=4, n_stars=60)
    sigma = {"shift": 0.1, "rotation": 0.01}
    matches = ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses, pose_sigma=sigma)
    again = ld.Matches.from_table(matches.table, **ld.Matches.read_meta(matches.to_meta()))
    assert again.pose_sigma == sigma
    solution = ld.solve(again, degree=2)
    assert solution.settings.pose_sigma == sigma
    assert "the poses, which are known" in str(solution.gauge)
    assert "apart from the pointing" not in solution.gauge.sentence
    assert not solution.gauge.unknown_names
    solution.write(tmp_path / "solution.asdf")
    read = ld.Solution.read(tmp_path / "solution.asdf")
    assert read.gauge.poses_known
    assert_array_equal(read.stars["x_err_abs"], solution.stars["x_err_abs"])
    assert read.settings == solution.settings
    matches.table.meta.update(matches.to_meta())
    matches.table.write(tmp_path / "matched.ecsv")
    call = ["solve", str(tmp_path / "matched.ecsv"), "--degree", "2", "--quiet", "--out", str(tmp_path / "exact")]
    assert main([*call, "--pose-sigma", "shift=0,rotation=0,scale=0"]) == 0
    exact = ld.Solution.read(tmp_path / "exact")
    assert exact.settings.pose_sigma == EXACT
    assert np.all(exact.stars["x_err_abs"] < solution.stars["x_err_abs"])


def test_poses_that_contradict_the_exposures():
    """Errors that are ten times larger than stated are said; those that are as stated are not."""
    errors = 0.1, 0.01, 1e-4
    table, poses, _ = exposures(5, errors)
    matches = ld.Matches.from_table(table, shape=(SIZE, SIZE), poses=poses)
    for factor in (1.0, 0.1):
        sigma = {name: factor * error for name, error in zip(EXACT, errors, strict=True)}
        with warnings.catch_warnings(record=True, action="always") as caught:
            ld.solve(matches, prior=NOTHING, pose_sigma=sigma)
        said = [str(each.message) for each in caught]
        assert any("state larger errors (pose_sigma, --pose-sigma)" in each for each in said) == (factor < 1), said
