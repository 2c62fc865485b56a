"""The paper reproduced (docs/paper): the published numbers, with tolerances from the number of outcomes."""

import importlib
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from legdistort.exceptions import LegdistortWarning
from legdistort.geometry import basis
from legdistort.results import accuracy

PAPER = Path(__file__).parents[2] / "docs" / "paper"
WIDE = 4  # standard errors


@pytest.fixture(scope="module")
def paper():
    """``paper("simulations")``: a module of docs/paper."""
    sys.path.insert(0, str(PAPER))
    yield importlib.import_module
    sys.path.remove(str(PAPER))


def half_unit(printed):
    """Half a unit of the last digit of a printed number."""
    return 0.5 * 10.0 ** -len(printed.partition(".")[2])


def assert_published(slope, printed):
    """A slope with its standard error agrees with a printed number, as far as that is printed."""
    value, error = slope
    assert abs(value - float(printed)) < half_unit(printed) + WIDE * error, f"{value:.3f} +- {error:.3f}, not {printed}"


# --- pieces -----------------------------------------------------------------------------------------------------


def test_slopes_and_their_errors(paper):
    rng = np.random.default_rng(0)
    levels = np.array([0.03, 0.07, 0.14, 0.28])
    made = [
        paper("simulations").Propagation(
            levels, 0.3 * levels[:, None, None] * rng.rayleigh(1 / np.sqrt(2), (4, 100, 1))
        )
        for _ in range(200)
    ]
    values, errors = np.array([p.slope(0) for p in made]).T
    assert values.mean() == pytest.approx(0.3, abs=0.003)
    assert values.std() == pytest.approx(errors.mean(), rel=0.2)


def test_energy_of_x4_lies_in_the_constant_and_in_x2(paper):
    c = paper("simulations").x4_coefficients()
    u = np.linspace(-1, 1, 5)
    assert np.allclose(2 / 3 * c @ basis.values(4, u, 0 * u), u**4)  # the norm of x^4 on the square is 2/3
    assert np.sum(c[[0, 3]] ** 2) == pytest.approx(1 - (8 / 35) ** 2, abs=1e-12)


def test_outcome_without_noise_has_no_error(paper):
    b, _, sigma, grid = paper("simulations").noiseless()
    assert b < 2e-3
    assert sigma < grid * 1.01 < 2e-5


def test_families_on_a_real_map(paper):
    families = paper("families")
    u, v, shift, size = families.maps(None)["GSAOI detector 2"]
    legendre = families.fit(u, v, shift, size, "Legendre")
    powers = families.fit(u, v, shift, size, "powers of pixels")
    splines = families.fit(u, v, shift, size, "cubic B-splines")
    assert legendre.needed(0.01) == powers.needed(0.01) == 10
    assert splines.needed(0.01) == 16
    assert legendre.condition.max() < 1.25
    assert powers.condition[2] > 1e9
    assert np.allclose(legendre.residual[:3], powers.residual[:3], rtol=1e-3, atol=1e-6)


def test_direction_of_the_nirc2_map(paper, shared_data, monkeypatch):
    """Map and Drizzle polynomial, by the same observatory, agree; they are added to detector pixels."""
    monkeypatch.setenv("LEGDISTORT_DATA", str(shared_data))
    families = paper("families")
    source = importlib.import_module("legdistort.priors.from_files").read_source
    central = source(families.nirc2_files(shared_data)).stated()
    folder = shared_data / "static_distortion" / "nirc2_kai"
    whole = source(folder / "nirc2_narrow_ACS.coeffs.txt").stated(shape=(1024, 1024))
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0, 512, 16.0), np.arange(0, 512, 16.0)))
    shifts = [
        np.stack(central.on_plane()(x, y)) - [x, y],
        np.stack(whole.on_plane()(x + 256, y + 256)) - [x + 256, y + 256],
    ]
    design = np.column_stack([np.ones_like(x), x, y])
    first, second = (s.T - design @ np.linalg.lstsq(design, s.T, rcond=None)[0] for s in shifts)
    for axis in (0, 1):
        assert np.corrcoef(first[:, axis], second[:, axis])[0, 1] > 0.9
    assert np.std(first - second) < 0.3 * np.std(first)


# --- the pages --------------------------------------------------------------------------------------------------


def test_table_is_that_of_the_results():
    parts = json.loads((PAPER / "results.json").read_text(encoding="utf-8"))
    assert list(parts) == ["model", "noise", "aliasing", "twin", "beyond"]
    rows = [row for part in parts.values() for row in part]
    lines = (PAPER / "table.md").read_text(encoding="utf-8").splitlines()[2:]
    assert len(lines) == len(rows) > 40
    for line, row in zip(lines, rows, strict=True):
        assert line == f"| {row['where']} | {row['what']} | {row['paper']} | {row['ours']} | {row['remark']} |"


def test_every_figure_is_on_a_page_and_small():
    shown = set()
    for page in PAPER.glob("*.md"):
        shown |= set(re.findall(r"\]\(\.\./images/paper/(\w+\.png)\)", page.read_text(encoding="utf-8")))
    there = {path.name for path in (PAPER.parent / "images" / "paper").iterdir()}
    assert shown == there
    for path in (PAPER.parent / "images" / "paper").iterdir():
        assert path.stat().st_size < 150_000, path.name


# --- the numbers ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def usual(paper):
    return paper("simulations").propagate(n=25, n_grid=50)


@pytest.mark.slow
def test_simulation_2(usual):
    assert_published(usual.slope(0), "0.3")
    assert_published(usual.slope(2), "1.2")
    at = list(usual.levels).index(0.14)
    error = usual.curves[at] / np.sqrt(2 * 25)  # an outcome's mean square scatters at most as much as its mean
    assert abs(usual.curves[at, 0] - 0.05) < 0.005 + WIDE * error[0]
    assert abs(usual.curves[at, 2] - 0.16) < 0.005 + WIDE * error[2]
    straight = usual.curves / usual.levels[:, None]
    assert np.all(np.abs(straight[:, [0, 2]] / straight[:, [0, 2]].mean(axis=0) - 1) < WIDE * 0.1)


@pytest.mark.parametrize(
    "n", [pytest.param(n, marks=pytest.mark.slow if n in (2, 50) else pytest.mark.sets) for n in (2, 10, 50, 100)]
)
def test_simulation_3(paper, n):
    found = paper("simulations").propagate(n=12, n_exposures=n, n_grid=20)
    slope, error = found.slope(0)
    assert error < 0.08 * slope
    assert abs(slope * np.sqrt(n) - 1) < WIDE * error * np.sqrt(n) + 0.03  # b = sigma / sqrt(n_im) to within 3 %


@pytest.mark.parametrize(
    ("n", "printed"),
    [pytest.param(100, "1.0", marks=pytest.mark.slow), pytest.param(200, "1.0", marks=pytest.mark.sets)],
)
def test_simulation_4(paper, usual, n, printed):
    found = paper("simulations").propagate(n=12, n_stars=n, n_grid=50)
    assert_published(found.slope(2), printed)
    assert_published(found.slope(0), "0.3")
    rule, (slope, error) = np.sqrt(0.9 * (1 + 10 / n)), found.slope(2)
    assert abs(slope / rule - 1) < WIDE * error + 0.02
    assert found.slope(2)[0] < usual.slope(2)[0]


@pytest.mark.slow
def test_simulation_5(paper):
    simulations = paper("simulations")
    errors, _ = simulations.simulation_5("monomial")
    energy = np.mean(errors**2, axis=0)
    assert energy.sum() == pytest.approx(1 - (8 / 35) ** 2, abs=0.01)
    assert energy[0, [0, 3]].sum() > 0.99 * energy.sum()
    errors, _ = simulations.simulation_5("legendre")
    energy = np.mean(errors**2, axis=0).sum()
    assert energy < 3 * 10 / 1000  # a part in n_stars for every mode
    errors, b = simulations.simulation_5("common")
    assert np.mean(errors**2, axis=0).sum() < 1e-3
    assert b == pytest.approx(1 / np.sqrt(8), abs=WIDE * 0.35 / np.sqrt(2 * 1000))  # norm 1 over the square, per axis


@pytest.mark.slow
def test_starting_point(paper):
    simulations = paper("simulations")
    off = simulations.propagate(n=10, levels=(0.14,), zero_mean=False, n_grid=0).curves[0]
    unknown = simulations.propagate(n=10, levels=(0.14,), static_known=False, n_grid=0).curves[0]
    zero = simulations.propagate(n=10, levels=(0.14,), n_grid=0).curves[0]
    assert off[0] > 5 * zero[0]
    assert unknown[0] > 3 * off[0]
    for other in (off, unknown):
        assert other[1] == pytest.approx(zero[1], rel=0.1)


@pytest.mark.sets
@pytest.mark.filterwarnings("ignore::legdistort.exceptions.LegdistortWarning")
def test_twin_of_the_gems_data(paper, tmp_path):
    """The sizes drawn for 11 exposures are known to 15 %, the mean over n stars to std / sqrt(n)."""
    assert issubclass(LegdistortWarning, UserWarning)
    gems = paper("gems")
    twin = gems.observe(tmp_path)
    table = twin.matches.table
    counts = [np.count_nonzero(table["exposure"] == name) for name in twin.matches.names]
    assert 61 - 2 * np.sqrt(61) < min(counts) <= max(counts) < 78 + 2 * np.sqrt(78)
    published = {"shift": 0.83, "static + shift": 0.41, "relative polynomial": 0.24, "all distortions solved": 0.20}
    means = []
    for name, solution in gems.correct(twin).items():
        s = accuracy.scatter_summary(solution)
        assert abs(s["mean"] - published[name]) < 3 * np.hypot(0.15 * s["mean"], s["std"] / np.sqrt(s["n_stars"])), name
        means.append(s["mean"])
    assert means == sorted(means, reverse=True)
