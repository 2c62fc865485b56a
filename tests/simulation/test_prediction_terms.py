"""Predictions with terms, against a dense Gaussian process in numpy and against solutions of simulated sets."""

from itertools import pairwise

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable, Table
from displaced_fields import displaced_by, sky
from numpy.testing import assert_allclose
from oracle import modes
from screens import screens

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import InputError, SolveError
from legdistort.results import accuracy

SHAPE, SIGMA, DEGREE = (2048, 2048), 0.02, 1
ORDERS = list(modes(DEGREE))


def planned(n_exposures=4, n_stars=16):
    """Stars, and poses with dithers and rolls, so that all stars lie on all detectors."""
    rng = np.random.default_rng(5)
    poses = {}
    for k in range(n_exposures):
        c, s = np.cos(0.3 * k), np.sin(0.3 * k)
        turn = np.array([[c, -s], [s, c]])
        poses[f"e{k}"] = np.column_stack([turn, (np.eye(2) - turn) @ [1023.5, 1023.5] + rng.normal(0, 40, 2)])
    return rng.uniform(500, 1500, (n_stars, 2)), poses


def series(q):
    """Products of Legendre polynomials at places (n, 2), (n, n_modes)."""
    x, y = (2 * q.T + 1) / 2048 - 1
    one = np.eye(DEGREE + 1)
    return np.stack([np.polynomial.legendre.legval(x, one[i]) * np.polynomial.legendre.legval(y, one[j])
                     for i, j in ORDERS], axis=1)  # fmt: skip


def covariance(at, size, length, ratio=1.0, angle=0.0):
    """Of a field of smoothness 3/2 at places (n, 2), (2 n, 2 n): minus second derivatives of that of its potential."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    metric = np.diag([ratio**-0.5, ratio**0.5]) @ [[c, s], [-s, c]] / length
    d = (at[:, None] - at[None]) @ metric.T
    w = np.hypot(*np.moveaxis(d, 2, 0))[..., None, None]
    inner = (1 + w) * np.eye(2) - d[..., :, None] * d[..., None, :]  # in units of w, times exp(-w)
    made = size**2 * length**2 * np.einsum("ca,ijcd,db->iajb", metric, inner * np.exp(-w), metric)
    return made.reshape(2 * len(at), -1)


def dense(stars, poses, new, *, field=None, columns=None, sigma=None):
    """Rms error of the stars beyond a common map, and scatter of new positions (n,), all unknowns in one matrix.

    Unknown are stars, coefficients, the field of every exposure at stars and new places, and numbers of a term.
    """
    n, e, m, g = len(stars), len(poses), len(ORDERS), len(new)
    k = 0 if columns is None else columns.shape[1]
    f = 0 if field is None else 2 * (n + g)
    size = 2 * n + e * (2 * m + f) + k
    precision = 1e-8 * np.eye(size)
    wrong = np.zeros((e, 2 * g, size))
    for i, pose in enumerate(poses.values()):
        q, there = (xy @ pose[:, :2].T + pose[:, 2] for xy in (stars, new))
        own = 2 * n + i * (2 * m + f)
        design = np.zeros((2 * n, size))
        design[:, : 2 * n] = np.kron(np.eye(n), pose[:, :2])
        design[:, own : own + 2 * m] = np.kron(series(q), np.eye(2))
        back = np.kron(np.eye(g), np.linalg.inv(pose[:, :2]))
        wrong[i, :, own : own + 2 * m] = back @ np.kron(series(there), np.eye(2))
        if field is not None:
            rows = slice(own + 2 * m, own + 2 * m + f)
            design[:, rows] = np.eye(2 * n, f)
            wrong[i, :, rows] = back @ np.eye(2 * g, f, 2 * n)
            precision[rows, rows] += np.linalg.inv(covariance(np.concatenate([q, there]), *field))
        if columns is not None:
            design[:, size - k :] = columns[i].transpose(2, 1, 0).reshape(2 * n, k)
        precision += design.T @ design / SIGMA**2
    if sigma is not None:
        precision[size - k :, size - k :] += np.eye(k) / sigma**2
    error = np.linalg.inv(precision)
    maps = np.kron(series(stars), np.eye(2))
    left = np.eye(2 * n) - maps @ np.linalg.pinv(maps)
    relative = left @ error[: 2 * n, : 2 * n] @ left
    apart = wrong - wrong.mean(axis=0)
    squares = np.einsum("ias,st,iat->a", apart, error, apart) / e + SIGMA**2 * (1 - 1 / e)
    return np.sqrt(np.trace(relative) / (2 * n)), np.sqrt(squares.reshape(-1, 2).mean(axis=1))


def forecast(stars, poses, **how):
    """A prediction, rms error of its stars beyond a common map, and scatter where its map is well inside."""
    p = ld.predict(n_exposures=len(poses), stars=stars, poses=poses, sigma=SIGMA, degree=DEGREE, n_grid=14, **how)
    grid = np.stack(np.meshgrid(p.x, p.y), axis=-1)
    inside = (np.abs(grid - 1023.5) < 600).all(axis=-1)
    return p, accuracy.expected_bias(p.solution, removed=DEGREE), grid[inside], p.error_map[inside]


@pytest.mark.parametrize("field", [(0.1, 300.0), (0.05, 150.0, 2.0, 35.0), (1.0, 700.0)])
def test_turbulence_is_that_of_a_dense_gaussian_process(field):
    """Errors of stars and of new positions, which the field of one exposure and what all share determine together."""
    stars, poses = planned()
    sizes = dict(zip(("size", "length", "ratio", "angle"), field, strict=False))
    p, b, places, scatter = forecast(stars, poses, terms=ld.Term.named("turbulence", **sizes))
    least, expected = dense(stars, poses, places, field=field)
    assert_allclose(b, least, rtol=1e-3)
    assert_allclose(scatter, expected, rtol=2e-3)
    plain, plain_scatter = dense(stars, poses, places)
    assert least > 1.3 * plain
    assert_allclose(p.b, b, rtol=0.1)  # with the plane held by the convention of the gauge
    assert np.sqrt(np.mean(scatter**2)) > 1.3 * np.sqrt(np.mean(plain_scatter**2))


def test_terms_with_numbers_are_those_of_a_dense_fit():
    """Waves of the fraction of a pixel, and refraction, of stated sizes."""
    stars, poses = planned()
    rng = np.random.default_rng(1)
    colour, tan_z, angle = rng.normal(size=len(stars)), rng.uniform(0.3, 1.5, 4), rng.uniform(-60, 60, 4)
    waves, zenith = [], []
    for i, pose in enumerate(poses.values()):
        turned = 2 * np.pi * (stars @ pose[:, :2].T + pose[:, 2] + 0.5).T
        made = np.array([f(k * turned) for k in (1, 2) for f in (np.sin, np.cos)])
        waves.append((made[:, None] * np.eye(2)[:, :, None]).reshape(8, 2, -1))
        towards = pose[:, :2] @ [np.sin(np.radians(angle[i])), np.cos(np.radians(angle[i]))]
        zenith.append(tan_z[i] * towards[:, None] * (colour - colour.mean()))
    waves, zenith = np.array(waves), np.array(zenith)[:, None]
    _, b, places, scatter = forecast(stars, poses, terms=ld.Term.named("pixel_phase", sigma=0.03))
    least, expected = dense(stars, poses, places, columns=waves, sigma=0.03)
    plain, _ = dense(stars, poses, places)
    assert least > 1.05 * plain
    assert_allclose(b, least, rtol=1e-4)
    assert_allclose(scatter, expected, rtol=1e-4)
    table = Table({"x": stars[:, 0], "y": stars[:, 1], "colour": colour})
    seen = {"tan_z": tan_z, "parallactic_angle": angle * u.deg}
    _, b, places, scatter = forecast(table, poses, terms=[ld.Term.named("refraction", sigma=np.inf)], **seen)
    least, expected = dense(stars, poses, places, columns=zenith)
    assert least > 1.002 * plain
    assert_allclose(b, least, rtol=1e-4)
    assert_allclose(scatter, expected, rtol=1e-4)


def test_a_field_that_is_far_smaller_than_the_noise_changes_nothing():
    stars, poses = planned()
    small = ld.Term.named("turbulence", size=1e-5, length=200)
    plain, turbulent = (forecast(stars, poses, dynamic=0.3, terms=terms)[0] for terms in ((), small))
    for name in ("b", "b_abs", "sigma", "sigma_field"):
        assert getattr(turbulent, name) == pytest.approx(getattr(plain, name), rel=1e-4)
    assert_allclose(turbulent.solution.stars["x_err"], plain.solution.stars["x_err"], rtol=1e-3)


@pytest.mark.slow
def test_absolute_errors_grow_with_the_field_and_fall_with_exposures():
    """And what is stated of the scatter of the series beside adds to it."""
    exact = ld.Prior(np.zeros((2, 1)))
    given = {"n_stars": 40, "sigma": SIGMA, "degree": 2, "n_grid": 5, "prior": exact}

    def absolute(n, size, **more):
        return ld.predict(
            n_exposures=n, terms=ld.Term.named("turbulence", size=size, length=400), **given, **more
        ).b_abs

    sizes = [absolute(6, size) for size in (0.05, 0.1, 0.2)]
    assert all(after > 1.7 * before for before, after in pairwise(sizes))
    assert absolute(24, 0.1) == pytest.approx(sizes[1] / 2, rel=0.1)
    known = [absolute(6, 0.1, dynamic=0.4), ld.predict(n_exposures=6, dynamic=0.4, **given).b_abs]
    assert known[0] == pytest.approx(np.hypot(known[1], sizes[1]), rel=0.02)
    assert np.isnan(ld.predict(n_exposures=6, **given, terms=ld.Term.named("pixel_phase", sigma=0.01)).b_abs)


@pytest.mark.slow
def test_it_is_said_and_kept():
    p = ld.predict(n_exposures=8, n_stars=40, sigma=SIGMA, dithers=60.0, n_grid=6,
                   terms=ld.Term.named("turbulence", size=0.1, length=300))  # fmt: skip
    assert "turbulence: a random field of each exposure, 0.1 over lengths of 300, pix" in str(p)
    table = p.alternatives()
    assert [tuple(row) for row in table["n_exposures", "degree"]] == [(8, 3), (8, 2), (8, 4), (4, 3), (16, 3)]
    assert np.all(np.asarray(table["sigma"]) > 1.5 * SIGMA)
    xy = np.array([[1000.0, 900.0]])
    known = p.solution["exp03"].correct(xy, errors=np.zeros((1, 2)))  # of any exposure, at any place
    assert 0.02 < np.sqrt(known.relative[0, 0, 0]) < 0.1


GOOD = {"n_exposures": 4, "n_stars": 30, "sigma": SIGMA, "degree": 2, "n_grid": 5}
FIELD = ld.Term.named("turbulence", size=0.1, length=300)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"terms": "turbulence"}, r"finds no sizes: give turbulence its own, .*--term turbulence=0.1:200"),
        ({"terms": "pixel_phase"}, r"finds no sizes: give pixel_phase its own, .*sigma=0.03\)"),
        ({"terms": "acceleration"}, "which stars have the term acceleration is not known"),
        ({"terms": "rough_static"}, "leave rough_static out"),
        ({"terms": [FIELD, FIELD]}, "'turbulence' is given twice"),
        ({"terms": 3}, "terms must be names or Term objects in a list, got int"),
        ({"terms": FIELD, "spectrum": {2: 0.1, 3: 0.1}}, "cut the spectrum at degree 2"),
        ({"terms": FIELD, "static_spectrum": {3: 0.1}}, "cut the spectrum at degree 2"),
        ({"terms": ld.Term.named("refraction", sigma=0.02)}, "refraction needs colour, tan_z, parallactic_angle: give"),
        ({"tan_z": [1.0, 1.0, 1.0, 1.0]}, "tan_z is for terms that need it"),
        (
            {"terms": ld.Term.named("refraction", sigma=0.02), "tan_z": [1.0]},
            "tan_z must be a number for each of the 4",
        ),
    ],
)
def test_what_cannot_be_forecast_is_said(how, message):
    with pytest.raises(InputError, match=message):
        ld.predict(**GOOD | how)


def test_sizes_that_are_none_are_said():
    for sizes, message in (
        ({"size": 0.1}, "give both, or neither"),
        ({"size": -0.1, "length": 3}, "size of turbulence must be a positive number"),
        ({"size": 0.1, "length": 30, "ratio": 0.5}, "ratio of turbulence is that of its long axis to its short one"),
        ({"size": 0.1, "length": 30, "angle": np.nan}, "angle of turbulence"),
        ({"sigma": 0.1}, "term turbulence has no sigma: it has name, unit, owner, size, length"),
    ):
        with pytest.raises(InputError, match=message):
            ld.Term.named("turbulence", **sizes)
    with pytest.raises(SolveError, match="leave out pixel_phase, or turbulence"):
        ld.predict(**GOOD, terms=[ld.Term.named("pixel_phase", sigma=0.03), FIELD])
    with pytest.raises(InputError, match="solve finds the sizes of turbulence: give its name alone"):
        ld.solve(ld.simulate_matches(n_stars=30, n_exposures=4).matches, terms=FIELD)
    with pytest.raises(SolveError, match="at most"):
        ld.predict(**GOOD | {"n_stars": 3000}, terms=FIELD)


@pytest.mark.slow
def test_command(capsys):
    asked = ["predict", "--n-exposures", "4", "--n-stars", "30", "--sigma", "0.02", "--degree", "1", "--term"]
    assert main([*asked, "turbulence=0.1:300:1.5:2:30"]) == 0
    said = capsys.readouterr().out
    term = ld.Term.named("turbulence", size=0.1, length=300, smoothness=1.5, ratio=2, angle=30)
    p = ld.predict(n_exposures=4, n_stars=30, sigma=0.02, degree=1, terms=term)
    assert str(p) in said
    assert main([*asked, "pixel_phase=0.03:2"]) == 1
    assert "--term pixel_phase has 2 sizes: it takes sigma" in capsys.readouterr().err
    for words, message in (("turbulence", "is not of the form NAME=SIZE"), ("orbits=3", "orbits is none of")):
        with pytest.raises(SystemExit):
            main([*asked, words])
        assert message in capsys.readouterr().err


# --- solutions of simulated sets


def found_field(solution):
    """The field that a solution found, as a term of a prediction."""
    found = dict(zip(map(str, solution.terms["number"]), map(float, solution.terms["value"]), strict=True))
    found["ratio"] = found.pop("axis ratio")
    return ld.Term.named("turbulence", **found)


def over_stated(prediction, solution):
    """Rms errors of stars, and of new positions in two exposures, that were forecast over those stated."""
    xy = np.random.default_rng(0).uniform(300, 1700, (200, 2))
    ratios = []
    for name in ("x_err", "y_err"):
        squares = [np.mean(each.stars[name].value ** 2) for each in (prediction.solution, solution)]
        ratios.append(np.sqrt(squares[0] / squares[1]))
    for name in solution.names[2:4]:
        known = [each[name].correct(xy, errors=np.full(xy.shape, 0.01)) for each in (prediction.solution, solution)]
        squares = [np.mean(np.einsum("nkk->n", each.relative)) for each in known]
        ratios.append(np.sqrt(squares[0] / squares[1]))
    return ratios


@pytest.mark.parametrize(
    ("rms", "width"), [pytest.param(0.1, 50.0, marks=pytest.mark.slow), pytest.param(0.5, 10.0, marks=pytest.mark.sets)]
)
def test_turbulence_that_is_forecast_is_what_solve_states(rms, width):
    """Of screens by numpy; and the scatter of stars that took no part is the one forecast."""
    squares = []
    for seed in (700, 701, 702):
        field, others = displaced_by(seed, screens(11, seed, rms=rms, width=width), 65)
        solution = field.solve(terms="turbulence")
        p = ld.predict(n_exposures=11, stars=solution.stars, poses=solution.poses, sigma=0.01, prior=field.prior,
                       terms=found_field(solution), n_grid=60)  # fmt: skip
        assert_allclose(over_stated(p, solution), 1, atol=0.03)
        corrected, table = np.full((11, len(field.stars), 2), np.nan), others.table
        for i, name in enumerate(solution.names):
            rows = table["exposure"] == name
            seen = np.column_stack([table["x"][rows].value, table["y"][rows].value])
            corrected[i, np.asarray(table["star"][rows])] = solution[name].to_reference(seen)
        new = np.isfinite(corrected).all(axis=(0, 2))
        mean = corrected[:, new].mean(axis=0)
        column, row = (np.abs(np.subtract.outer(mean[:, k], axis)).argmin(axis=1) for k, axis in enumerate((p.x, p.y)))
        squares.append((np.mean(accuracy.scatter(corrected[:, new]) ** 2), np.mean(p.error_map[row, column] ** 2)))
    measured, stated = np.sqrt(np.mean(squares, axis=0))
    assert stated / measured == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_the_mean_of_the_fields_is_in_the_absolute_errors():
    """Exposures without a distortion but for screens: forecast, stated, and true beyond a similarity."""
    squares = []
    for seed in range(4):
        rng, names = np.random.default_rng(seed), [f"e{i}" for i in range(8)]
        stars, drawn, parts, poses = rng.uniform(150, 1898, (60, 2)), screens(8, seed, rms=0.1), [], {}
        for i, name in enumerate(names):
            shift = rng.normal(0, 100, 2) * (i > 0)
            at = stars + shift
            seen = at + drawn[i](at) + rng.normal(0, 0.01, at.shape)
            on = np.flatnonzero(((seen > 0) & (seen < 2047)).all(axis=1))
            parts.append(QTable({"exposure": [name] * len(on), "star": on}))
            parts[-1]["x"], parts[-1]["y"] = seen[on].T * u.pix
            parts[-1]["x_err"] = parts[-1]["y_err"] = np.full(len(on), 0.01) * u.pix
            poses[name] = np.column_stack([np.eye(2), shift])
        table = QTable({name: np.concatenate([part[name] for part in parts]) for name in parts[0].colnames})
        exact = ld.Prior(np.zeros((2, 10)))
        solution = ld.solve(ld.Matches.from_table(table, shape=SHAPE, poses=poses), prior=exact, terms="turbulence")
        p = ld.predict(n_exposures=8, stars=solution.stars, poses=solution.poses, sigma=0.01, prior=exact, n_grid=5,
                       terms=found_field(solution))  # fmt: skip
        true = stars[np.asarray(solution.stars["star"])]
        off = accuracy.bias(solution.estimate.positions, true, removed="similarity")
        squares.append(np.square([p.b_abs, accuracy.expected_bias(solution, absolute=True), off]))
    forecast, stated, true = np.sqrt(np.mean(squares, axis=0))
    assert forecast / stated == pytest.approx(1, abs=0.1)
    assert forecast / true == pytest.approx(1, abs=0.2)


@pytest.mark.slow
def test_numbers_that_are_forecast_cost_what_solve_states():
    """Errors of stars with refraction and pixel phase, of the sizes that were found, over those of sets without."""
    for seed, how, name in ((800, {"refraction": 0.02}, "refraction"), (801, {"phase": 0.03}, "pixel_phase")):
        field = sky(seed, **how)
        solution, still = field.solve(terms=name), sky(seed).solve()
        stars, known = solution.stars, {"prior": field.prior, "poses": solution.poses, "sigma": 0.01, "n_grid": 5}
        plain = ld.predict(n_exposures=11, stars=stars, **known)
        if name == "refraction":
            first = {str(row["star"]): row["colour"] for row in field.table}
            stars["colour"] = [first[str(star)] for star in stars["star"]]
            rows = [np.flatnonzero(field.table["exposure"] == each)[0] for each in solution.names]
            known |= {each: field.table[each][rows] for each in ("tan_z", "parallactic_angle")}
        term = ld.Term.named(name, sigma=solution.diagnostics.terms[0].size)
        p = ld.predict(n_exposures=11, stars=stars, terms=term, **known)
        size = [np.hypot(*(each.stars[axis].value for axis in ("x_err", "y_err")))
                for each in (p.solution, plain.solution, solution, still)]  # fmt: skip
        assert_allclose(np.median(size[0] / size[1]), np.median(size[2] / size[3]), rtol=0.01)
        assert 0.9 < np.median(size[0] / size[2]) < 1.1
        assert p.b > plain.b
