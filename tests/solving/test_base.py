"""Exposures that come into a finished solution: as if all had been solved together from the beginning."""

import warnings

import drawn_sets
import field_sets
import header_layouts
import numpy as np
import pytest
from astropy.table import Table
from two_chips import two_chips_small

import legdistort as ld
from legdistort.assessment import baselines
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError, LegdistortWarning, MatchError
from legdistort.geometry.similarity import apply, fit_similarity

SHAPE = (2048, 2048)
TURN = np.array([[0.6, -0.8, 500.0], [0.8, 0.6, -30.0]])


def parts(table, late, **known):
    """Matches of the exposures of a table but for some, and of these alone on a plane and with numbers of their own."""
    is_late = np.isin(table["exposure"], late)
    new = table[is_late]
    stars, star = np.unique(np.asarray(new["star"]), return_inverse=True)
    new["star"] = np.random.default_rng(len(stars)).permutation(len(stars))[star]
    known = {"shape": SHAPE} | known
    return ld.Matches.from_table(table[~is_late], **known), ld.Matches.from_table(new, **known)


def simulated(seed=1, n=8, **words):
    words = {"n_stars": 40, "sigma": 0.02, "rotations": [0, 90] * (n // 2), "dither": 150.0, "dynamic": 0.3} | words
    return ld.simulate_matches(n_exposures=n, seed=seed, **words)


def off(one, two, degree=3):
    """Rms of positions from those of another solution, shift, rotation and scale aside, in absolute errors; the largest
    in relative ones, a map of the degree aside; and the largest parts by which errors differ."""  # fmt: skip
    one, two = one.stars, two.stars
    motions = "vx" in two.colnames
    a, b = (np.column_stack([each["x"].value, each["y"].value]) for each in (one, two))
    moved = apply(fit_similarity(a, b), a) - b
    x, y = ((b - b.mean(axis=0)) / np.ptp(b)).T
    design = np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])
    weight = 1 / two["x_err"].value[:, None]
    left = moved - design @ np.linalg.lstsq(design * weight, moved * weight, rcond=None)[0]
    if motions:
        rates = np.column_stack([(one[name] - two[name]).value for name in ("vx", "vy")])
        rates -= design @ np.linalg.lstsq(design * weight, rates * weight, rcond=None)[0]
        assert np.max(np.abs(rates) / two["vx_err"].value[:, None]) < 2e-3
    pairs = [(one[name] / two[name]).value for name in ("x_err", "y_err", "x_err_abs", "y_err_abs")]
    return (
        np.sqrt(np.mean(moved**2) / np.mean(two["x_err_abs"].value ** 2)),
        np.max(np.abs(left) * weight),
        np.nanmax(np.abs(np.array(pairs) - 1)),
    )


EVIDENCE = ld.Prior(np.zeros((2, 1)), sigma="evidence", source="nothing")


@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"static": "fit", "dynamic": 0.0},
        {"loss": "cauchy", "clip": None},
        {"errors": "floor"},
        pytest.param({"prior": EVIDENCE}, marks=pytest.mark.slow),
        {"motion": "proper", "epochs": np.linspace(2010, 2016, 8), "words": {"motion": 0.01}},
    ],
    ids=lambda asked: "-".join(asked) or "plain",
)
def test_equals_all_at_once(asked):
    asked = dict(asked)
    words = {name: asked.pop(name) for name in ("dynamic", "epochs") if name in asked} | asked.pop("words", {})
    sim = simulated(**words)
    table, names = sim.matches.table, sim.matches.names
    old, new = parts(table, names[-1:])
    again = {name: asked[name] for name in ("prior",) if name in asked}  # of which a solution has a description
    found = ld.solve(new, base=ld.solve(old, **asked), **again)
    whole = ld.solve(ld.Matches.from_table(table, shape=SHAPE), **asked)
    assert found.names == whole.names
    absolute, relative, errors = off(found, whole)
    assert absolute < 0.01
    assert relative < 1e-3
    assert errors < 1e-3
    assert found.chi2 == pytest.approx(whole.chi2, rel=1e-4)
    for name in ("static", "loss", "clip", "errors", "motion", "degree"):
        assert getattr(found.settings, name) == getattr(whole.settings, name)


def test_one_after_the_other_and_from_files(tmp_path):
    sim = simulated(seed=2, degree=2)
    table, names = sim.matches.table, sim.matches.names
    old, new = parts(table, names[-3:])
    base = ld.solve(old, degree=2)
    base.write(tmp_path / "solution.asdf")
    at_once, found = ld.solve(new, base=base), tmp_path
    for name in names[-3:]:
        one = new.keep(new.table["exposure"] == name)
        found = ld.solve(one, base=found)
        found = ld.Solution.read(found.write(tmp_path / f"{name}.asdf"))
    assert found.settings.degree == 2
    assert max(off(found, at_once, 2)) < 1e-3
    added = found.provenance["added"]
    assert [list(each["exposures"]) for each in added] == [[name] for name in names[-3:]]
    assert added[0]["base"] == ld.Solution.read(tmp_path).checksum
    assert len({mark for each in added for marks in each["exposures"].values() for mark in marks}) == 24


@pytest.mark.slow
def test_options_of_the_base_give_way():
    old, new = parts(simulated().matches.table, ["exp07"])
    found = ld.solve(new, base=ld.solve(old, degree=2, clip=4.0), degree=3)
    assert (found.settings.degree, found.settings.clip) == (3, 4.0)


def test_a_size_of_the_static_distortion_stays():
    """A number is all that there is to keep of it."""
    old, new = parts(simulated().matches.table, ["exp07"])
    known = ld.Prior(None, static_sigma=5.0)
    base = ld.solve(old, prior=known)
    found, given = ld.solve(new, base=base), ld.solve(new, base=base, prior=known)
    assert found.settings.prior == base.settings.prior
    assert found.chi2 == given.chi2


@pytest.mark.parametrize(
    "known",
    [
        pytest.param(ld.Prior(None, sigma="evidence").with_sigma("evidence", degree=1), marks=pytest.mark.slow),
        ld.Prior(None, sigma="evidence").with_sigma(0.02, degree=1),
        ld.Prior(None, static_sigma=2.0, sigma=0.02),
    ],
    ids=["evidence", "scatter", "size and scatter"],
)
def test_the_widths_of_a_prior_stay(known):
    """Without a mean widths are all that there is to keep of a prior, as the command line has it for --prior-sigma."""
    old, new = parts(simulated(n=4, dynamic=0.02).matches.table, ["exp03"])
    base = ld.solve(old, prior=known, degree=1, clip=None)
    found, given = ld.solve(new, base=base), ld.solve(new, base=base, prior=known)
    assert found.settings.prior == base.settings.prior
    assert found.chi2 == given.chi2


def test_new_stars_join_if_two_exposures_see_them():
    table = simulated().matches.table
    late, seen = ["exp06", "exp07"], np.unique(table["star"])
    hidden = np.isin(table["star"], seen[:4]) & ~np.isin(table["exposure"], late)
    once = (table["star"] == seen[0]) & (table["exposure"] == "exp06")
    table = table[~hidden & ~once]
    old, new = parts(table, late)
    base = ld.solve(old)
    found = ld.solve(new, base=base)
    before, after = np.asarray(base.stars["star"]), np.asarray(found.stars["star"])
    assert set(before) == set(seen[4:])
    assert after.tolist() == [*before, before.max() + 1, before.max() + 2, before.max() + 3]
    named = table.copy()
    named["star"] = [f"S{star}" for star in named["star"]]
    is_late = np.isin(named["exposure"], late)
    old, new = (ld.Matches.from_table(named[rows], shape=SHAPE) for rows in (~is_late, is_late))
    found = ld.solve(new, base=ld.solve(old))
    assert set(found.stars["star"]) == {f"S{star}" for star in seen[1:]}  # the first is seen once


def test_plane_stays():
    """To what exposures that come in tell of it, however they are turned."""
    sim = simulated(seed=3, dynamic=0.02)
    old, new = parts(sim.matches.table, ["exp07"])
    base = ld.solve(old)
    turned = ld.Matches.from_table(new.table, shape=SHAPE, poses={"exp07": TURN})
    found = ld.solve(turned, base=base)
    one, two = base.stars, found.stars
    shift = np.hypot(np.median(one["x"] - two["x"]), np.median(one["y"] - two["y"]))
    assert shift.value < 0.5 * np.median(one["x_err_abs"].value)


def test_of_a_camera():
    rng = np.random.default_rng(4)
    camera, stars = two_chips_small(), rng.uniform([-20, -20], [450, 320], (90, 2))
    rows = []
    for i in range(6):
        angle = np.radians(90.0 * (i % 2) + 0.3 * i)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        focal = (stars - [215, 150]) @ turn.T + [215, 150] + rng.uniform(-25, 25, 2)
        for key, chip in camera.detectors.items():
            q = focal @ chip.layout[:, :2].T + chip.layout[:, 2]
            xy = chip.distortion(q) + rng.normal(0, 0.02, q.shape)
            inside = np.all((q > 0) & (q < np.array(chip.shape)[::-1] - 1), axis=1)
            rows += [(f"e{i}", key, j, *xy[j], 0.02, 0.02) for j in np.flatnonzero(inside)]
    table = Table(rows=rows, names=("exposure", "detector", "star", "x", "y", "x_err", "y_err"))
    old, new = parts(table, ["e5"], shape=None, camera=camera)
    found = ld.solve(new, base=ld.solve(old, degree=2))
    whole = ld.solve(ld.Matches.from_table(table, camera=camera), degree=2)
    assert max(off(found, whole, 2)[1:]) < 1e-3
    fitted = ld.solve(old, degree=2, layout="fit")
    known = ld.Matches.from_table(new.camera.on_detectors(new.table.copy()), camera=fitted.camera)
    with pytest.raises(InputError, match="camera TWO as the solution found it, whose own exposures would count twice"):
        ld.solve(known, base=fitted)
    plain = ld.Matches.from_table(simulated().matches.table, shape=SHAPE)
    with pytest.raises(InputError, match=r"is of camera TWO \(detectors 1, 2\), .* match them as those of"):
        ld.solve(plain, base=found)


def test_fields():
    """Exposures of one field join that, those of another are one of their own."""
    data, truth = field_sets.drawn_fields(5, 3, n=5, n_stars=60)
    table = drawn_sets.as_matches(data).table
    field = truth["exposure_field"]
    name = dict(zip(range(len(field)), np.unique(table["exposure"]), strict=True))
    late = [name[4], *(name[i] for i in np.flatnonzero(field == 2))]
    known = {"static": "fit", "clip": None}
    shape = (data["n"], data["n"])
    old, new = parts(table, late, shape=shape)
    assert old.fields.max() == 1
    with pytest.warns(AssumptionWarning, match=rf"no star of exposure {name[10]}.* is one of the solution: another"):
        found = ld.solve(new, base=ld.solve(old, **known))
    whole = ld.solve(ld.Matches.from_table(table, shape=shape), **known)
    assert len(found.stars) == len(whole.stars)
    assert np.unique(found.stars["field"]).tolist() == [1, 2, 3]
    assert found.chi2 == pytest.approx(whole.chi2, rel=1e-6)
    _, other = parts(table, late[1:], shape=shape)
    with (
        pytest.warns(AssumptionWarning, match="no star of exposure"),
        pytest.raises(MatchError, match="2 groups with no star in common"),
    ):
        ld.solve(other, base=ld.solve(old.keep(np.isin(old.table["exposure"], [name[i] for i in range(4)]))))


def test_refused(tmp_path):
    table = simulated().matches.table
    old, new = parts(table, ["exp07"])
    base = ld.solve(old)
    whole = ld.solve(new, base=base)

    def refused(words, matches=new, base=base, **asked):
        with pytest.raises(InputError, match=words), warnings.catch_warnings(action="ignore"):
            ld.solve(matches, base=base, **asked)

    refused("base must be a Solution, its file or its folder, got int", base=3)
    refused("exposure exp07 is in the solution already: leave it out; another one needs", base=whole)
    renamed = new.table.copy()
    renamed["exposure"] = "again"
    again = ld.Matches.from_table(renamed, shape=SHAPE)
    refused("exposure again is in the solution already, as exp07: its positions are the same", again, whole)
    refused("is a simpler correction", base=baselines.solve_shifts(old))
    refused("nothing can be added to the base, the stars that it kept", base=ld.solve(old, validate=0.2))
    posed = ld.Matches.from_table(old.table, shape=SHAPE, poses=old.poses)
    refused("nothing can be added to the base, the poses", base=ld.solve(posed, pose_sigma={"shift": 1.0}))
    with_prior = ld.solve(old, prior=EVIDENCE)
    refused(r"solved with a prior, of which it keeps a description alone: give it again, prior= \(--prior\)$",
            base=with_prior)  # fmt: skip
    elsewhere = new.table.copy()
    for seed, axis in enumerate("xy"):
        elsewhere[axis] = np.random.default_rng(seed).uniform(0, 2000, len(elsewhere)) * elsewhere[axis].unit
    elsewhere["star"] += 1000
    with pytest.raises(MatchError, match="no star of exposure exp07 is one of the solution, and no other exposure is"):
        ld.solve(ld.Matches.from_table(elsewhere, shape=SHAPE), base=base)
    tied = ld.solve(old, reference=base)
    refused("solved with a reference, of which", base=tied)
    both = ld.solve(old, reference=base, prior=dict.fromkeys(old.names, ld.Prior(np.zeros((2, 10)))))
    refused(r"with a prior and a reference, .*: give both again, prior= \(--prior\), reference= \(--ref", base=both)
    assert len(ld.solve(new, base=tied, reference=base).names) == 8


@pytest.mark.slow
def test_command(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table = simulated(dynamic=0.05).matches.table
    for name in np.unique(table["exposure"]):
        mine = table[table["exposure"] == name]["x", "y", "x_err", "y_err"]
        mine.write(f"{name}.csv")
    first = [f"exp0{i}.csv" for i in range(7)]
    assert main(["match", *first, "--shape", "2048", "2048", "--out", "m.ecsv"]) == 0
    assert main(["match", "exp07.csv", "--shape", "2048", "2048", "--out", "one.ecsv"]) == 0
    assert "--base" in capsys.readouterr().err
    assert main(["solve", "m.ecsv", "--degree", "2", "--out", "results"]) == 0
    assert main(["solve", "one.ecsv", "--base", "results", "--out", "results", "--overwrite"]) == 0
    assert "8 exposures" in capsys.readouterr().out
    assert ld.Solution.read("results").settings.degree == 2
    assert main(["solve", "one.ecsv", "--base", "results", "--out", "results", "--overwrite"]) == 1
    assert "exp07 is in the solution already" in capsys.readouterr().err
    assert len(ld.Solution.read("results").names) == 8


def test_columns_that_some_lack():
    old, new = parts(simulated().matches.table, ["exp07"])
    more = new.table.copy()
    more["colour"] = 1.0
    with pytest.warns(LegdistortWarning, match=r"are left out: colour \(not in the solution\)"):
        ld.solve(ld.Matches.from_table(more, shape=SHAPE), base=ld.solve(old))


@pytest.mark.slow
def test_a_late_exposure_whose_headers_have_the_detectors_wrong_comes_in():
    """By 25 px, of another roll than most; its stars were taken for their neighbours, and the layout failed."""
    night = header_layouts.Night(5, off=25.0, n=7, n_stars=200, sigma=0.02, rolls=(0.0, 0.0, 0.0, 0.0, 0.0, 90.0, 90.0))
    late = night.table["exposure"] == "e6"
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        base = ld.solve(ld.match(night.table[~late], exposures=night.exposures[:-4]), degree=3)
        new = ld.match(night.table[late], exposures=night.exposures[-4:])
        found = ld.solve(new, base=base)
    true = np.asarray(found.residuals["true"])
    star = np.asarray(found.residuals["star"])
    assert all(len(set(true[star == each])) == 1 for each in set(star[found.residuals["exposure"] == "e6"]))
    assert np.count_nonzero(found.residuals["exposure"] == "e6") > 0.8 * np.count_nonzero(late)
    assert night.pulls(found)[0] < 1.5
