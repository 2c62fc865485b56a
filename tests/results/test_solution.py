"""What every `Solution` keeps, whoever made it: it comes back from its file equal, and says the same."""

import copy
import dataclasses
import pickle
import warnings
from dataclasses import FrozenInstanceError, replace

import moving_stars
import numpy as np
import pytest
from astropy import units as u
from astropy.modeling import models
from astropy.table import QTable, Table

from legdistort import Matches, Prior, Solution, paper, solve
from legdistort.assessment import baselines
from legdistort.exceptions import LegdistortWarning
from legdistort.geometry import basis
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.results import in_tables
from legdistort.results.diagnostics import DegreeChoice, Diagnostics, UsedReference, Validation
from legdistort.results.estimate import Estimate, StoredUncertainty, plain_covariances
from legdistort.results.motions import StarMotions
from legdistort.results.settings import Settings
from legdistort.runtime.provenance import with_inputs
from legdistort.simulation import prediction
from legdistort.simulation.noiseless_solution import noiseless_solution
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches

FEW = simulate_matches(n_stars=14, n_exposures=6, degree=2, seed=3)
NIGHT = simulate_gsaoi_matches(small=True, seed=1)  # knows its sky


def mismatched(sim):
    """The same with some gross errors, an exposure that fits none of the others, and one left out beforehand."""
    table = sim.matches.table.copy()
    table["x"][::37] += 20 * u.pix
    astray = table["exposure"] == sim.matches.names[2]
    table["y"][astray] = np.random.default_rng(0).permutation(table["y"][astray].value) * u.pix
    known = {"shape": sim.matches.shapes, "poses": sim.matches.poses, "left_out": {"dark": "no star in it"}}
    return Matches.from_table(table, **known)


def catalogue(sim):
    positions = solve(sim.matches, degree=1).estimate.positions
    errors = {"x_err": np.full(len(positions), 0.02), "y_err": np.full(len(positions), 0.02)}
    return Table({"star": sim.matches.stars, "x": positions[:, 0] + 3, "y": positions[:, 1], **errors})


def detectors(sim):
    table = sim.matches.table.copy()
    table["detector"] = ["even" if int(name[3:]) % 2 == 0 else "odd" for name in table["exposure"]]
    return Matches.from_table(table, shape=sim.matches.shapes, poses=sim.matches.poses)


def predicted(**options):
    """The solution of `predict`, which its figures are made of."""
    made = []

    def keep(*args, **kwargs):
        made.append(noiseless_solution(*args, **kwargs))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prediction, "noiseless_solution", keep)
        prediction.predict(n_exposures=5, n_stars=40, sigma=0.05, seed=2, **options)
    return made[0][0]


def model():
    sides = {"x_domain": (-0.5, 2047.5), "y_domain": (-0.5, 2047.5)}
    series = models.Legendre2D(2, 2, **sides) & models.Legendre2D(2, 2, c2_2=0.3, fixed={"c2_2": True}, **sides)
    return models.Identity(2) + (models.Mapping((0, 1, 0, 1)) | series)


PRODUCERS = {
    "plain": lambda: solve(FEW.matches, degree=2),
    "prior with its error": lambda: solve(FEW.matches, degree=2, prior=Prior(FEW.truth.static, static_sigma=0.02)),
    "prior with widths": lambda: solve(FEW.matches, degree=2, prior=Prior(FEW.truth.static, sigma=0.5)),
    "widths found": lambda: solve(FEW.matches, prior=Prior(FEW.truth.static, sigma="evidence")),
    "widths found at degree 1": lambda: solve(FEW.matches, degree=1, prior=Prior(FEW.truth.static, sigma="evidence")),
    "widths found at degree 0": lambda: solve(FEW.matches, degree=0, prior=Prior(FEW.truth.static, sigma="evidence")),
    "widths by detector": lambda: solve(
        detectors(FEW),
        degree=2,
        prior={"odd": Prior(FEW.truth.static, sigma="evidence"), "even": Prior(FEW.truth.static, sigma=0.3)},
    ),
    "static fitted": lambda: solve(NIGHT.matches, static="fit"),
    "tied to a reference": lambda: solve(FEW.matches, degree=2, reference=catalogue(FEW)),
    "tied to one star": lambda: solve(FEW.matches, degree=2, reference=catalogue(FEW)[:1]),
    "degree chosen": lambda: solve(FEW.matches, degree="auto", prior=Prior(FEW.truth.static)),
    "model": lambda: solve(simulate_matches(n_stars=40, n_exposures=5, seed=5).matches, model=model()),
    "validated": lambda: solve(NIGHT.matches, degree=2, validate=0.2, clip=5),
    "published scheme": lambda: paper.solve(FEW.matches, degree=1, method="alternating"),
    "floor found": lambda: solve(NIGHT.matches, degree=1, errors="floor"),
    "errors scaled": lambda: solve(NIGHT.matches, degree=1, errors="scale"),
    "clipped": lambda: solve(mismatched(simulate_matches(n_stars=60, n_exposures=6, seed=4)), degree=2, clip=5),
    "robust": lambda: solve(mismatched(simulate_matches(n_stars=60, n_exposures=6, seed=4)), degree=2, loss="cauchy"),
    "published": lambda: paper.solve(FEW.matches, degree=2, max_iterations=30),
    "shifts": lambda: baselines.solve_shifts(FEW.matches),
    "static and shifts": lambda: baselines.solve_shifts(NIGHT.matches, prior=Prior(NIGHT.truth.static), weighted=True),
    "relative to one exposure": lambda: baselines.solve_relative(FEW.matches, degree=2),
    "relative to the mean": lambda: baselines.solve_relative(FEW.matches, degree=2, reference="mean", weighted=False),
    "predicted": lambda: predicted(dynamic=0.3),
    "predicted without scatter": lambda: predicted(),
    "predicted with widths": lambda: predicted(prior=Prior(np.zeros((2, 10)), sigma=0.5)),
    "with its inputs": lambda: with_inputs(solve(FEW.matches, degree=1), {"a b#1.fits": "0" * 64}),
}


#: Neighbours of the others.
SLOW = {
    "widths found at degree 1",
    "widths found at degree 0",
    "tied to one star",
    "degree chosen",
    "validated",
    "errors scaled",
    "robust",
    "published",
    "shifts",
    "relative to one exposure",
    "predicted without scatter",
    "predicted with widths",
}


@pytest.fixture(
    scope="module", params=[pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in PRODUCERS]
)
def produced(request):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)  # some of the sets tell little
        return PRODUCERS[request.param]()


def assert_same(a, b, where):
    """Equal to the last bit, dtype and type: numbers, text, arrays, tables, dicts, sequences and dataclasses."""
    if isinstance(a, QTable):
        assert a.colnames == b.colnames, where
        for name in a.colnames:
            if name == "sky":  # made of ra and dec
                continue
            assert getattr(a[name], "unit", None) == getattr(b[name], "unit", None), (where, name)
            assert_same(np.asarray(a[name]), np.asarray(b[name]), f"{where}.{name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype.kind == b.dtype.kind, where
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), where
    elif dataclasses.is_dataclass(a):
        assert type(a) is type(b), where
        for field in (each for each in dataclasses.fields(a) if each.compare):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, dict):
        assert set(a) == set(b), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key!r}]")
    elif isinstance(a, (list, tuple)):
        assert type(a) is type(b), where
        assert len(a) == len(b), where
        for k, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}[{k}]")
    else:
        assert a == b or (a != a and b != b), (where, a, b)


class TestEveryProducer:
    def test_file_and_words(self, produced, tmp_path):
        back = Solution.read(produced.write(tmp_path / "s.asdf"))
        for field in dataclasses.fields(Solution):
            if field.name not in ("estimate", "checksum"):
                assert_same(getattr(produced, field.name), getattr(back, field.name), field.name)
        for field in dataclasses.fields(Estimate):
            if field.name not in ("uncertainty", "form", "checked", "nights", "certified"):
                one, other = (getattr(each.estimate, field.name) for each in (produced, back))
                assert_same(one, other, f"estimate.{field.name}")
        assert back.checks == produced.checks
        assert_same(back.nights, produced.nights, "nights")
        for name in ("coefficients", "stars"):
            assert_same(getattr(produced.estimate.uncertainty, name), getattr(back.estimate.uncertainty, name), name)
        assert_same(produced.stars, back.stars, "stars")
        assert_same(produced.absolute_covariance(), back.absolute_covariance(), "absolute")
        for one, other in zip(produced.gauge.unknown, back.gauge.unknown, strict=True):
            assert_same(one, other, one.name)
        for words in (str, repr):
            assert words(back) == words(produced)
            assert words(back.gauge) == words(produced.gauge)
            assert words(back.diagnostics) == words(produced.diagnostics)
        assert in_tables.sky_sentence(back) == in_tables.sky_sentence(produced)
        assert back.diagnostics.summary() == produced.diagnostics.summary()
        again = back.write(tmp_path / "again.asdf")
        assert str(Solution.read(again)) == str(produced)

    def test_frozen(self, produced):
        for part, name in ((produced, "settings"), (produced.settings, "clip"), (produced.diagnostics, "validation")):
            with pytest.raises(FrozenInstanceError):
                setattr(part, name, None)
        assert isinstance(produced.settings, Settings)
        assert isinstance(produced.diagnostics, Diagnostics)
        assert set(produced.provenance) >= {"created", "versions"}

    def test_words_end_well(self, produced):
        for words in (
            *produced.diagnostics.in_words().values(),
            produced.gauge.sentence,
            in_tables.sky_sentence(produced),
        ):
            assert words == words.strip()
            assert words[-1] not in ",;:"

    def test_pickle(self, produced):
        assert_survives(produced, lambda solution: pickle.loads(pickle.dumps(solution)))


def assert_survives(solution, remake):
    """Every field of a solution and of its estimate: covariances as numbers, checks as they were made."""
    filled = replace(
        solution,
        sky=solution.sky or TangentPlane(1.0, 2.0, np.eye(2, 3)),
        left_out={"dark": "no stars"},
        provenance=solution.provenance | {"inputs": {"a.fits": "0" * 64}},
        _checksum="1" * 64,
        estimate=replace(solution.estimate, certified={view.name: view.distortion for view in solution}),
    )
    again = remake(filled)
    assert again is not filled
    for field in dataclasses.fields(Solution):
        if field.name != "estimate":
            assert_same(getattr(filled, field.name), getattr(again, field.name), field.name)
    for field in dataclasses.fields(Estimate):
        one, other = (getattr(each.estimate, field.name) for each in (filled, again))
        if field.name == "uncertainty":
            for part in dataclasses.fields(StoredUncertainty):
                if part.name not in ("star_unknowns", "drift_directions") or filled.estimate.motions is not None:
                    assert_same(getattr(one, part.name), getattr(other, part.name), part.name)
        elif field.name == "certified":
            assert list(one) == list(other) == list(filled.names)
            for name in one:
                assert_same(one[name].coefficients, other[name].coefficients, name)
                assert one[name].inverse.error == other[name].inverse.error
        elif field.name == "form":
            assert (one is None) == (other is None)
        elif field.name not in ("checked", "nights"):
            assert_same(one, other, f"estimate.{field.name}")
    assert again.checks == filled.checks
    assert_same(filled[filled.names[1]].errors, again[filled.names[1]].errors, "errors")
    assert repr(again) == repr(filled)


@pytest.mark.parametrize(
    "remake",
    [
        lambda s: pickle.loads(pickle.dumps(s)),
        pytest.param(copy.copy, marks=pytest.mark.sets),
        pytest.param(copy.deepcopy, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("what", ["motions", pytest.param("model", marks=pytest.mark.slow)])
def test_copies(what, remake):
    solution = solve(moving_stars.field(60).matches, motion="proper") if what == "motions" else PRODUCERS["model"]()
    assert_survives(solution, remake)
    again = remake(solution)
    assert_same(solution.stars, again.stars, "stars")
    assert_same(solution.nights, again.nights, "nights")
    if what == "motions":
        assert_same(solution.stars_at(2020.0), again.stars_at(2020.0), "stars later")
    else:
        assert repr(again["exp00"].model) == repr(solution["exp00"].model)
    assert str(again) == str(solution)


def test_names_are_printed_whole():
    matches = simulate_matches(n_stars=20, n_exposures=3, degree=1, seed=1).matches
    names = {old: f"{old}_of_a_night_with_a_name_of_forty_letters" for old in matches.names}
    table = matches.table.copy()
    table["exposure"] = [names[old] for old in table["exposure"]]
    printed = str(solve(Matches.from_table(table, shape=(2048, 2048)), degree=1))
    rows = [line for line in printed.splitlines() if line.startswith("exp0")]
    assert [row.split()[0] for row in rows] == list(names.values())
    assert len({len(row) for row in rows}) == 1


@pytest.mark.slow
def test_size_of_a_pickle():
    """Of 12,000 positions in 30 exposures; equations stay behind, and what was made from the solution."""
    matches = simulate_matches(n_exposures=30, n_stars=400, degree=1, seed=1).matches
    solution = solve(matches, degree=1, clip=None)
    assert len(solution.residuals) > 11500
    size = 2 * basis.n_modes(3)
    covariances = replace(plain_covariances(solution.estimate), coefficients=np.zeros((30 * size, 30 * size)))
    known = {"uncertainty": covariances, "checked": solution.checks}  # as degree 3 has them
    large = replace(solution, estimate=replace(solution.estimate, **known))
    assert len(pickle.dumps(large)) <= 4.6e6
    before = len(pickle.dumps(solution))
    _ = solution.stars, solution.checks, solution["exp00"].wcs, solution["exp01"].residuals
    assert len(pickle.dumps(solution)) == pytest.approx(before, rel=0.01)
    assert type(pickle.loads(pickle.dumps(solution)).estimate.uncertainty) is StoredUncertainty


@pytest.mark.slow
def test_size_of_a_pickle_of_degree_3():
    solution = solve(simulate_matches(n_exposures=60, n_stars=400, degree=3, seed=1).matches, degree=3)
    assert len(pickle.dumps(solution)) <= 16e6


def test_members_are_few():
    public = {name for name in dir(Solution) if not name.startswith("_")}
    public |= {field.name for field in dataclasses.fields(Solution)}
    assert len(public) <= 29, sorted(public)
    assert len([field.name for field in dataclasses.fields(Solution)]) <= 17


def test_absolute_errors_of_a_simpler_correction_stay_unknown(tmp_path):
    shifts = baselines.solve_shifts(FEW.matches)
    back = Solution.read(shifts.write(tmp_path / "s.asdf"))
    for solution in (shifts, back):
        words = "shift: the plane is the mean of all exposures; absolute errors are not available"
        assert solution.gauge.sentence == words
        assert str(solution.gauge) == words
        assert np.isnan(solution.stars["x_err_abs"]).all()


@pytest.mark.parametrize(
    ("widths", "words"),
    [
        ((), None),
        ((0.5,), "0.5 px at degree 1"),
        ((0.5, 0.25), "0.5, 0.25 px at degree 1, 2"),
        ((0.5, 0.25, 0.1), "0.5, 0.25, 0.1 px at degree 1, 2, ..."),
        ((0.5, 0.25, 0.1, 0.0), "0.5, 0.25, 0.1, 0 px at degree 1, 2, ..."),
        ({"a": (0.5,), "b": None, "c": (0.1, 0.2)}, "a 0.5 px at degree 1; c 0.1, 0.2 px at degree 1, 2"),
        ({"a": ()}, None),
    ],
)
def test_widths_in_words(widths, words):
    told = Diagnostics(widths=widths).in_words()
    assert told == ({} if words is None else {"widths": f"scatter of a coefficient, found from the exposures: {words}"})


def test_summary_is_plain():
    """Of what was not asked for nothing; of the rest what JSON takes."""
    assert Diagnostics().summary() == {}
    found = Diagnostics(
        error_scale=2.0,
        reference=UsedReference("gaia", 2020.0, 3, 0.1),
        widths=(0.1, 0.2),
        departure_ratio=1.5,
        selection=DegreeChoice(1, (0, 1), (2.0, 1.0), 10, (), False, "1, of 0 to 1"),
        validation=Validation(0.1, 3, 30, 0, 0.05, 0.05, 1.0),
    )
    summary = found.summary()
    assert list(summary) == ["widths", "departure_ratio", "selection", "validation"]
    assert summary["selection"]["degree"] == 1
    assert summary["validation"]["n_stars"] == 3
    assert replace(found, widths=None).summary().keys() == {"departure_ratio", "selection", "validation"}


@pytest.mark.parametrize(("n_epochs", "words"), [
    ([3, 3, 0], "proper motions of 2 stars over 4.00 yr; positions are those of 2014.0000"),
    ([3, 1, 0], "; 1 seen at a single epoch stays where it was then"),
    ([3, 2, 0], "; 1 seen at two epochs only, so that no observation checks the motion"),
    ([2, 2, 1], "stays where it was then; 2 seen at two epochs only, so that no observation checks the motions"),
])  # fmt: skip
def test_the_sentence_on_motions_counts_epochs(n_epochs, words):
    years, n = np.array([2012.0, 2014.0, 2016.0]), np.array(n_epochs)
    motions = StarMotions(("vx", "vy"), np.ones((3, 2)), 2014.0, years, np.ones(3), n, np.ones(3))
    assert motions.sentence.endswith(words)
