"""Terms: what displaces stars beside the distortion, found with everything else. The truth is made by numpy alone."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable, vstack
from astropy.wcs import WCS
from displaced_fields import SIZE, sky, squared_pull
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.geometry.zenith import stated_zenith
from legdistort.runtime import words
from legdistort.solving.terms.term import FIELDS, TERMS


def test_refraction_is_taken_off():
    """Stars are as precise as without it, and the number is right within its error."""
    bent, free = sky(1, refraction=0.02), sky(1)
    with_term, plain = bent.solve(terms="refraction"), free.solve()
    off, _ = bent.off(with_term)
    assert np.sqrt(np.mean(off**2)) < 1.05 * np.sqrt(np.mean(free.off(plain)[0] ** 2))
    assert np.sqrt(np.mean(bent.off(bent.solve())[0] ** 2)) > 2 * np.sqrt(np.mean(off**2))
    (row,) = with_term.terms
    assert abs(row["value"] - 0.02) < 4 * row["error"] < 0.01
    assert_allclose(with_term.chi2 / with_term.dof, 1, atol=0.12)
    assert "refraction: 0.0" in str(with_term)
    assert with_term.settings.terms == ("refraction",)


def test_errors_hold_that_of_the_term():
    """Along the direction in which colours displace stars in all exposures alike they grow by it."""
    free = sky(3)
    with_term, plain = free.solve(terms=ld.Term.named("refraction", sigma=np.inf)), free.solve()
    assert np.all(with_term.stars["x_err"] >= 0.99 * plain.stars["x_err"])
    (row,) = with_term.terms
    colour = np.array([free.table["colour"][free.table["star"] == j][0] for j in with_term.stars["star"]])
    zenith = np.mean(np.unique(free.table["tan_z"]))
    gain = np.sqrt(np.maximum(with_term.stars["y_err"].value ** 2 - plain.stars["y_err"].value ** 2, 0))
    assert np.corrcoef(gain, np.abs(colour - colour.mean()))[0, 1] > 0.8
    assert 0.2 < np.median(gain / np.abs(colour - colour.mean())) / (zenith * row["error"]) < 1.5
    assert_allclose(with_term.dof, plain.dof - 1, atol=0.01)


@pytest.mark.slow
def test_pixel_phase_is_taken_off():
    """Waves of 0.03 px, by where a star falls on its pixel."""
    bent = sky(2, phase=0.03)
    solution = bent.solve(terms=["pixel_phase"])
    off, error = bent.off(solution)
    assert_allclose(solution.chi2 / solution.dof, 1, atol=0.12)
    assert 0.6 < squared_pull(off, error) < 1.6 < 2.5 < squared_pull(*bent.off(bent.solve()))
    found = dict(zip(solution.terms["number"], solution.terms["value"], strict=True))
    expected = {
        f"{f} 1 {axis}": bent.amplitudes[k, m] for k, axis in enumerate("xy") for m, f in enumerate(("sin", "cos"))
    }
    for name, value in expected.items():
        assert abs(found[name] - value) < 0.1 * np.abs(bent.amplitudes).max()
    measured, kept = bent.table, solution.residuals
    assert_allclose(kept["x"], measured["x"])  # measured positions stay what they are
    assert_allclose(
        np.sqrt(np.mean(kept["x_terms"].value ** 2 + kept["y_terms"].value ** 2)), 0.03 * np.sqrt(2), rtol=0.1
    )


def test_a_term_takes_itself_away():
    """Where positions do not show it, nothing changes at all."""
    free = sky(4, years=8.0, n_exposures=12)
    plain = free.solve(motion="proper")
    solution = free.solve(motion="proper", terms=["refraction", "pixel_phase", "acceleration"])
    assert not solution.terms["size"].any()
    assert not solution.terms["value"].any()
    for name in ("x", "y", "x_err", "vx_err", "x_err_abs"):
        assert_allclose(solution.stars[name], plain.stars[name], rtol=1e-9)
    assert "refraction: the positions do not show it" in str(solution)
    alone = free.solve(motion="proper", terms="orbits")  # of which no star may have any
    assert len(alone.terms) == 0
    assert "orbits: the positions do not show it" in str(alone)


@pytest.mark.parametrize(
    ("term", "bent"),
    [
        pytest.param("acceleration", {"acceleration": 0.02}, marks=pytest.mark.slow),
        pytest.param("orbits", {"orbits": 3.0}, marks=pytest.mark.slow),
    ],
)
def test_stars_on_orbits_are_kept(term, bent):
    """They are named, and no other; their places at any time, and all others, are right within their errors."""
    field = sky(5, years=15.0, n_exposures=20, n_stars=40, **bent)
    solution = field.solve(motion="proper", motion_epoch=2008.0, terms=term)
    assert set(solution.terms["owner"]) == {str(j) for j in field.odd}
    assert np.all(np.isfinite(solution.stars["x"]))
    assert np.mean(solution.residuals["used"]) > 0.99
    for time in (2002.0, 2008.0, 2013.3):
        off, error = field.off(solution, field.paths(time - 2008.0), solution.stars_at(time))
        odd = np.isin(solution.stars["star"], field.odd)
        assert squared_pull(off[~odd], error[~odd]) < 1.6
        assert squared_pull(off[odd], error[odd]) < 4.0
    said = str(solution)
    assert f"{term}: 2 of 40 stars" in said, said
    with pytest.warns(AssumptionWarning, match="2 stars have no position.*--term orbits"):
        dropped = field.solve(motion="proper", motion_epoch=2008.0)
    assert np.isnan(dropped.stars["x"][np.isin(dropped.stars["star"], field.odd)]).all()


@pytest.mark.slow
def test_a_term_of_ones_own(tmp_path):
    """Modes of each exposure with a known covariance, as of a deformable mirror at altitude; and written and read."""
    pattern = lambda at: np.sin(2 * np.pi * np.asarray(at)[..., ::-1] / 700.0)  # noqa: E731
    strength = np.random.default_rng(0).normal(0, 0.05, 11)
    field = sky(6, extra=lambda i, at: strength[i] * pattern(at))

    def columns(observed):
        return pattern(observed.pixels.T).T[None]

    term = ld.Term("mirror", columns, ("mode",), owner="exposure", covariance=[[0.05**2]], sigma=1.0)
    solution = field.solve(terms=term)
    off, error = field.off(solution)
    assert 0.6 < squared_pull(off, error) < 1.5
    assert_allclose(solution.chi2 / solution.dof, 1, atol=0.12)
    rows = solution.terms
    assert list(rows["owner"]) == list(solution.names)
    pull = (rows["value"] - strength) / rows["error"]
    assert 0.2 < np.mean(pull**2) < 3
    read = ld.Solution.read(solution.write(tmp_path / "solution.asdf"))
    assert read.terms.colnames == rows.colnames
    assert_allclose(read.terms["value"], rows["value"])
    assert_allclose(read.stars["x_err"], solution.stars["x_err"])
    assert str(read).split("terms", 1)[1] == str(solution).split("terms", 1)[1]


def test_errors_are_scaled_with_the_others():
    field = sky(1, refraction=0.02)
    plain, scaled = (field.solve(terms="refraction", errors=errors) for errors in ("stated", "scale"))
    scale = scaled.diagnostics.error_scale
    assert_allclose(scaled.terms["error"], scale * plain.terms["error"])
    found, stated = (each.estimate.uncertainty for each in (scaled, plain))  # before maps are taken off
    assert_allclose(found.stars, scale**2 * stated.stars)
    assert_allclose(found.star_weights, stated.star_weights)


@pytest.mark.slow
def test_what_an_earlier_solution_took_off_is_there_again():
    field = sky(1, refraction=0.02)
    plain = field.solve()
    again = ld.Matches.from_table(field.solve(terms="refraction").residuals, shape=(SIZE, SIZE))
    assert_allclose(ld.solve(again, prior=field.prior).stars["x"], plain.stars["x"])


def test_a_sky_turns_the_parallactic_angle():
    """It counts from north through east where the plane lies on the sky, here with north to the right."""
    field = sky(7, refraction=0.02)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix = ["RA---TAN", "DEC--TAN"], [80.0, -30.0], [1024, 1024]
    scale = 0.02 / 3600
    wcs.wcs.cd = np.array([[0.0, scale], [scale, 0.0]])  # east up, north to the right
    matrix = np.column_stack([wcs.wcs.cd, -wcs.wcs.cd @ [1023, 1023]])
    turned = field.table.copy()
    turned["parallactic_angle"] = 90 * u.deg - turned["parallactic_angle"]  # of the same direction on the detector
    matches = ld.Matches.from_table(turned, shape=(SIZE, SIZE), sky=TangentPlane(80.0, -30.0, matrix))
    here, there = (ld.solve(m, prior=field.prior, terms="refraction").terms for m in (field.matches, matches))
    assert_allclose(there["value"], here["value"], rtol=1e-3)


def lifted(stars, zenith, constant):
    """Directions (n, 3) lifted towards the zenith by ``constant * tan z``: each is turned about a horizontal axis."""
    cos = stars @ zenith
    axis = np.cross(stars, zenith)
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    turn = (constant * np.sqrt(1 - cos**2) / cos)[:, None]
    return stars * np.cos(turn) + np.cross(axis, stars) * np.sin(turn)


def wide(seed, constant, *, n_stars=150, n_exposures=10, sigma=0.01):
    """Exposures of half a degree, pixels of an arcsecond, without distortion, up to 65 degrees from the zenith.

    Their table, and the plane on the sky: x to the west, y to the north.
    """
    rng, rows, radian = np.random.default_rng(seed), [], np.radians(1 / 3600)
    stars, away = rng.uniform(-300, SIZE + 300, (n_stars, 2)), np.array([-1, 1]) * radian
    for i in range(n_exposures):
        dither, z, q = rng.uniform(-100, 100, 2), rng.uniform(0.1, 1.13), rng.uniform(-np.pi, np.pi)
        seen = np.column_stack([(stars - SIZE / 2 - dither) * away, np.ones(n_stars)])
        zenith = np.array([np.sin(z) * np.sin(q), np.sin(z) * np.cos(q), np.cos(z)])
        seen /= np.linalg.norm(seen, axis=1)[:, None]
        seen, middle = (lifted(s, zenith, constant * radian) for s in (seen, np.array([[0.0, 0.0, 1.0]])))
        place = seen[:, :2] / seen[:, 2:] - middle[:, :2] / middle[:, 2:]  # the telescope points at what it sees
        xy = place / away + SIZE / 2 + rng.normal(0, sigma, (n_stars, 2))
        on = np.all((xy > 0) & (xy < SIZE - 1), axis=1)
        part = QTable({"exposure": [f"e{i:02d}"] * on.sum(), "star": np.flatnonzero(on)})
        part["x"], part["y"] = xy[on].T * u.pix
        part["x_err"] = part["y_err"] = np.full(on.sum(), sigma) * u.pix
        part["tan_z"], part["parallactic_angle"] = np.tan(z), np.degrees(q) * u.deg
        rows.append(part)
    plane = np.array([[-1.0, 0.0, SIZE / 2], [0.0, 1.0, -SIZE / 2]]) / 3600
    return ld.Matches.from_table(vstack(rows), shape=(SIZE, SIZE), sky=TangentPlane(80.0, -30.0, plane))


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")
def test_refraction_over_a_wide_field():
    """Exposures with poses alone, stars lifted by turns in space: with the term errors are those of no refraction."""
    how = {"degree": 3, "static": "fit", "exposure_degree": 0, "clip": None}
    bent, free = wide(21, 58.0), wide(21, 0.0)
    plain, found, none = (
        ld.solve(matches, **how, terms=terms)
        for matches, terms in ((bent, ()), (bent, "differential_refraction"), (free, "differential_refraction"))
    )
    assert plain.chi2 / plain.dof > 100
    assert found.chi2 / found.dof == pytest.approx(1, abs=0.1)
    (row,) = found.terms
    assert row["value"] == pytest.approx(58.0, abs=4 * row["error"])
    assert row["error"] < 0.3
    assert "differential_refraction: the positions do not show it" in str(none)
    assert np.median(found.stars["x_err"]) < 1.2 * np.median(none.stars["x_err"])


def test_refraction_over_a_field_needs_a_sky():
    with pytest.raises(InputError, match="differential_refraction needs to know where on the sky"):
        sky(7).solve(terms="differential_refraction")


HEADER = {"RA": 80.0, "DEC": -69.0, "DATE-OBS": "2015-01-10T03:00:00"}


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ({"AIRMASS": 2.0, "PARANGLE": 30.0}, (np.sqrt(3), 30.0)),
        ({"ZD": 45.0, "AIRMASS": 9.0, "PARANG": -20.0}, (1.0, -20.0)),
        ({"ELEVATIO": 60.0}, (np.tan(np.radians(30)), np.nan)),
        (HEADER | {"OBSGEO-L": -70.74, "OBSGEO-B": -30.24, "OBSGEO-H": 2700.0}, (0.804, 4.9)),
        (HEADER | {"OBSGEO-X": 1819093.6, "OBSGEO-Y": -5208392.5, "OBSGEO-Z": -3195000.0}, (0.804, 4.9)),
        (HEADER, (np.nan, np.nan)),
        ({"AIRMASS": 0.0, "PARANGLE": "n/a"}, (np.nan, np.nan)),
    ],
)
def test_zenith_of_headers(header, expected):
    """By hand: the hour angle from the sidereal time, of the equinox of date (0.3 degrees of precession left out)."""
    assert_allclose(stated_zenith(header), expected, atol=0.4, rtol=5e-3)


@pytest.mark.parametrize(
    ("terms", "said"),
    [
        ("refractoin", "there is no term 'refractoin': give 'refraction'"),
        (3, "terms must be names or Term objects in a list, got int"),
        ([3], "terms must be names or Term objects, got int"),
        (["pixel_phase", "pixel_phase"], "the term 'pixel_phase' is given twice"),
        (ld.Term("a", lambda _: np.zeros(3), ("n",)), r"columns of term a should give an array of shape \(1, 2,"),
        (ld.Term("a", lambda seen: seen.pixels[None] * np.nan, ("n",)), "not finite, the first for exposure e00"),
    ],
)  # fmt: skip
def test_what_is_no_term_is_refused(terms, said):
    with pytest.raises(InputError, match=said):
        sky(1, n_stars=20, n_exposures=4).solve(terms=terms)


def test_what_a_term_lacks_is_named():
    field = sky(1, n_stars=20, n_exposures=4)
    del field.table["tan_z"], field.table["colour"]
    with pytest.raises(
        InputError, match="term refraction: the table of positions lacks the columns colour, tan_z; give"
    ):
        field.solve(terms="refraction")
    with pytest.raises(InputError, match="terms do not go with validate"):
        field.solve(terms="pixel_phase", validate=0.2)


def test_the_command_knows_all_terms():
    assert set(words.TERMS) == {*TERMS, *FIELDS}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"owner": "night"}, "owner of term a must be"),
        ({"sigma": -1.0}, "sigma of term a must be a positive number, inf, or None, got -1.0"),
        ({"numbers": ()}, "needs a name, columns"),
        ({"covariance": np.eye(3)}, r"covariance of term a must be a symmetric \(1, 1\) matrix"),
        ({"covariance": [[-1.0]]}, "must be positive definite"),
    ],
)
def test_a_term_is_checked(given, said):
    with pytest.raises(InputError, match=said):
        ld.Term(**{"name": "a", "columns": lambda observed: observed.pixels[None], "numbers": ("n",)} | given)


@pytest.mark.parametrize(
    ("bent", "terms", "n_sets"),
    [
        pytest.param({"refraction": 0.02}, ["refraction"], 20, marks=pytest.mark.sets),
        pytest.param({"phase": 0.03}, ["pixel_phase"], 20, marks=pytest.mark.sets),
        pytest.param({"refraction": 0.02, "phase": 0.03}, ["refraction", "pixel_phase"], 5, marks=pytest.mark.slow),
        pytest.param({"refraction": 0.02, "phase": 0.03}, ["refraction", "pixel_phase"], 20, marks=pytest.mark.sets),
        pytest.param({}, ["refraction", "pixel_phase"], 5, marks=pytest.mark.slow),
        pytest.param({}, ["refraction", "pixel_phase"], 20, marks=pytest.mark.sets),
    ],
)
def test_errors_are_calibrated(bent, terms, n_sets):
    """Squared pull 1 +- 0.1 over 20 sets; what is not there is not found; what is, is right within its error."""
    pulls, found = [], []
    for seed in range(n_sets):
        field = sky(100 + seed, **bent)
        solution = field.solve(terms=terms)
        off, error = field.off(solution)
        pulls.append((np.sum(off**2), np.sum(error**2)))
        found.append([bool(each.size) for each in solution.diagnostics.terms])
    assert_allclose(np.divide(*np.sum(pulls, axis=0)), 1, atol=0.1 * np.sqrt(20 / n_sets))
    there = np.mean(found, axis=0)
    assert np.all(there == 1) if bent else np.all(there <= max(0.1, 1 / n_sets))


@pytest.mark.slow
def test_accelerations_in_one_word():
    """The same as motions and the term, beside other terms too."""
    bent = sky(11, acceleration=0.02, n_stars=30, n_exposures=12, years=15.0)
    word, both = bent.solve(motion="acceleration"), bent.solve(motion="proper", terms="acceleration")
    assert len(word.terms) >= 2
    for name in ("x", "y", "x_err", "x_err_abs", "vx", "vx_err"):
        assert_allclose(word.stars[name], both.stars[name], rtol=0, atol=0)
    assert word.chi2 == both.chi2
    assert str(word.settings) == str(both.settings)
    for terms, expected in (
        ("pixel_phase", ("pixel_phase", "acceleration")),
        ([ld.Term.named("acceleration", sigma=0.02)], ("acceleration",)),
    ):
        solution = bent.solve(motion="acceleration", terms=terms)
        assert (solution.settings.motion, solution.settings.terms) == ("proper", expected)
    with pytest.raises(InputError, match="'proper', 'parallax', 'acceleration', 'auto', got"):
        bent.solve(motion="accelerations")


@pytest.mark.parametrize(
    ("bent", "n_sets"),
    [
        pytest.param({"acceleration": 0.01}, 3, marks=pytest.mark.slow),
        pytest.param({"acceleration": 0.01}, 8, marks=pytest.mark.sets),
        pytest.param({"orbits": 3.0}, 8, marks=pytest.mark.sets),
    ],
)
def test_orbits_are_calibrated(bent, n_sets):
    """Every star on one is named in every set, false names are rare, and places at three times have right errors."""
    named, false, others, odd_ones, wide = 0, 0, [], [], np.sqrt(8 / n_sets)
    for seed in range(n_sets):
        field = sky(200 + seed, years=15.0, n_exposures=24, n_stars=40, **bent)
        solution = field.solve(motion="proper", motion_epoch=2008.0, terms=list(bent))
        owners, odd = set(solution.terms["owner"]), np.isin(solution.stars["star"], field.odd)
        named += len(owners & {str(j) for j in field.odd})
        false += len(owners - {str(j) for j in field.odd})
        for time in (2002.0, 2008.0, 2013.3):
            off, error = field.off(solution, field.paths(time - 2008.0), solution.stars_at(time))
            others.append((np.sum(off[~odd] ** 2), np.sum(error[~odd] ** 2)))
            odd_ones.append((np.sum(off[odd] ** 2), np.sum(error[odd] ** 2)))
    assert named == 2 * n_sets
    assert false <= 1
    assert_allclose(np.divide(*np.sum(others, axis=0)), 1, atol=0.15 * wide)
    assert_allclose(np.divide(*np.sum(odd_ones, axis=0)), 1, atol=0.5 * wide)
