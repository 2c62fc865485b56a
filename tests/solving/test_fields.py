"""Several fields of one detector, without a common star, solved together for what they have in common."""

import warnings

import dense_model
import drawn_sets
import field_sets
import header_layouts
import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort import paper
from legdistort.cli import main
from legdistort.exceptions import InputError, LegdistortWarning, MatchError
from legdistort.geometry.tangent_plane import TangentPlane

UNCERTAIN = ld.Prior(np.zeros((2, 10)), static_sigma=5.0)


def solved(data, **options):
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        return ld.solve(drawn_sets.as_matches(data), **{"degree": 3, "clip": None} | options)


def only(data, truth, number):
    """One of the fields by itself."""
    rows = truth["exposure_field"][data["exposure"]] == number
    used, star = np.unique(data["star"][rows], return_inverse=True)
    out = data | {name: data[name][rows] for name in ("xy", "err")} | {"star": star}
    mine = truth["exposure_field"] == number
    out |= {"exposure": np.unique(data["exposure"][rows], return_inverse=True)[1], "poses": data["poses"][mine]}
    return out, truth["stars"][used]


def columns_of(solution, *names):
    """Columns of the stars (n, k), by the number of the star."""
    order = np.argsort(solution.stars["star"].astype(int))
    return np.stack([np.asarray(solution.stars[name])[order] for name in names], axis=1)


def without_similarity(values, stars):
    (x, y), one, zero = (stars - stars.mean(axis=0)).T, np.ones(len(stars)), np.zeros(len(stars))
    columns = np.stack([np.r_[one, zero], np.r_[zero, one], np.r_[x, y], np.r_[-y, x]], axis=1)
    flat = values.T.ravel()
    return (flat - columns @ np.linalg.lstsq(columns, flat, rcond=None)[0]).reshape(2, -1).T


def without_map(values, stars, weight, degree=3):
    """What a weighted common map of a degree leaves of values (n, 2) at stars."""
    root = np.tile(np.sqrt(weight), 2)
    design = np.kron(np.eye(2), dense_model.basis(stars, degree, 2048)[0])
    flat = values.T.ravel()
    fit = np.linalg.lstsq(root[:, None] * design, root * flat, rcond=None)[0]
    return (flat - design @ fit).reshape(2, -1).T


def figures(seed, *, scatter, **options):
    """Squares of errors and stated ones, relative and absolute; those of the static and its bound; chi2/dof."""
    data, truth = field_sets.drawn_fields(seed, dynamic=scatter or 0.0)
    solution = solved(data, **options)
    xy, field = columns_of(solution, "x", "y"), columns_of(solution, "field")[:, 0] - 1
    assert np.array_equal(field, truth["field"])
    weight, out = np.bincount(data["star"], data["err"][:, 0] ** -2.0), np.zeros((2, 2))
    for number in (0, 1):
        mine = field == number
        stars, offset = truth["stars"][mine], xy[mine] - truth["stars"][mine]
        left = without_map(offset, stars, weight[mine]), without_similarity(offset, stars)
        stated = (columns_of(solution, f"x_err{kind}", f"y_err{kind}")[mine] for kind in ("", "_abs"))
        out += [[np.sum(each**2), np.sum(error**2)] for each, error in zip(left, stated, strict=True)]
    beyond = dense_model.rows(3)[1][2:]
    off = (solution.coefficients.reshape(len(solution.names), -1) @ beyond.T).mean(axis=0)
    off -= beyond @ truth["static"].ravel()
    bound = field_sets.static_bound(data, truth, scatter=scatter)
    return np.array([*out.ravel(), np.mean(off**2), np.trace(bound) / len(bound), solution.chi2 / solution.dof])


SETTINGS = {
    "static fit": {"scatter": None, "static": "fit"},
    "departures of 0.3 px, static unknown": {"scatter": 0.3, "prior": UNCERTAIN},
}


@pytest.mark.parametrize("name", SETTINGS)
def test_two_fields_once(name):
    relative, stated, absolute, stated_absolute, static, bound, chi2 = figures(3, **SETTINGS[name])
    assert 0.6 < relative / stated < 1.5
    assert 0.4 < absolute / stated_absolute < 1.8
    assert static < 1.6 * bound
    assert abs(chi2 - 1) < 0.12


@pytest.mark.parametrize("n_sets", [pytest.param(4, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.sets)])
@pytest.mark.parametrize("name", SETTINGS)
def test_two_fields_are_at_the_bound_and_calibrated(name, n_sets):
    wide = np.sqrt(20 / n_sets)  # by the standard errors
    relative, stated, absolute, stated_absolute, static, bound, chi2 = np.mean(
        [figures(seed, **SETTINGS[name]) for seed in range(n_sets)], axis=0
    )
    assert relative / stated == pytest.approx(1, abs=0.1 * wide)
    assert absolute / stated_absolute == pytest.approx(1, abs=0.2 * wide)
    assert np.sqrt(static / bound) < 1 + 0.1 * wide
    assert abs(chi2 - 1) < 0.03 * wide


def test_with_nothing_in_common_each_is_as_by_itself():
    """With static and scatter known exactly a field tells nothing of the other."""
    data, truth = field_sets.drawn_fields(5, dynamic=0.3)
    prior = ld.Prior(truth["static"], sigma=0.3)
    both = solved(data, prior=prior)
    for number in (0, 1):
        part, _ = only(data, truth, number)
        alone, mine = solved(part, prior=prior), truth["field"] == number
        error = columns_of(alone, "x_err", "y_err")
        moved = columns_of(both, "x", "y")[mine] - columns_of(alone, "x", "y")
        assert np.abs(without_similarity(moved, columns_of(alone, "x", "y")) / error).max() < 0.02
        for kind in ("x_err", "y_err", "x_err_abs", "y_err_abs"):
            assert_allclose(columns_of(both, kind)[mine], columns_of(alone, kind), rtol=0.01)


@pytest.mark.slow
def test_a_rolled_field_tells_the_shear_of_another():
    """Without rolls shears of the sky and of the detector are alike, unless another field tells the latter."""
    data, truth = field_sets.drawn_fields(1, dynamic=0.1)
    second = truth["exposure_field"] == 1
    flat, _ = field_sets.drawn_fields(1, dynamic=0.1, rolls=(0.0,), step=0.0, static_of=truth["static"])
    joined = {name: data[name] for name in ("n", "degree")}
    keep, of_flat = (second[data["exposure"]], ~second[flat["exposure"]])
    for name in ("xy", "err"):
        joined[name] = np.concatenate([flat[name][of_flat], data[name][keep]])
    star = np.concatenate([flat["star"][of_flat], data["star"][keep] + 10_000])
    joined["star"] = np.unique(star, return_inverse=True)[1]
    joined["exposure"] = np.concatenate([flat["exposure"][of_flat], data["exposure"][keep]])
    joined["poses"] = np.concatenate([flat["poses"][~second], data["poses"][second]])
    first, _ = only(joined, {"exposure_field": truth["exposure_field"], "stars": np.zeros((20_000, 2))}, 0)
    wide = ld.Prior(np.zeros((2, 10)), static_sigma=np.inf)
    alone, both = solved(first, prior=wide), solved(joined, prior=wide)
    assert "shear" in alone.gauge.unknown_names
    assert not np.isfinite(alone.stars["x_err_abs"]).all()
    assert not [name for name in both.gauge.unknown_names if "shear" in name]
    assert np.isfinite(both.stars["x_err_abs"]).mean() > 0.9


@pytest.mark.slow
def test_order_of_fields_does_not_matter():
    data, truth = field_sets.drawn_fields(2, dynamic=0.3)
    n_stars, n = len(truth["stars"]), len(data["poses"])
    turned = data | {"star": n_stars - 1 - data["star"], "exposure": n - 1 - data["exposure"]}
    turned["poses"] = data["poses"][::-1]
    one, two = solved(data, prior=UNCERTAIN), solved(turned, prior=UNCERTAIN)
    here, there = columns_of(one, "x", "y"), columns_of(two, "x", "y")[::-1]
    for number in (0, 1):
        mine = truth["field"] == number
        moved = without_similarity(there[mine] - here[mine], here[mine])
        assert np.abs(moved / columns_of(one, "x_err", "y_err")[mine]).max() < 1e-2
    assert_allclose(columns_of(two, "x_err_abs")[::-1], columns_of(one, "x_err_abs"), rtol=2e-3)


def test_a_worthless_field_changes_nothing():
    data, truth = field_sets.drawn_fields(4, dynamic=0.3)
    poor = truth["exposure_field"][data["exposure"]] == 1
    noise = np.random.default_rng(1).normal(size=data["xy"].shape)
    worse = data | {"xy": data["xy"] + 50 * poor[:, None] * noise, "err": np.where(poor[:, None], 50.0, data["err"])}
    prior = ld.Prior(truth["static"], sigma=0.3, static_sigma=0.5)
    alone, both = solved(only(data, truth, 0)[0], prior=prior), solved(worse, prior=prior)
    mine, error = truth["field"] == 0, columns_of(alone, "x_err", "y_err")
    moved = columns_of(both, "x", "y")[mine] - columns_of(alone, "x", "y")
    known = columns_of(alone, "x_err_abs", "y_err_abs")
    assert np.abs(without_similarity(moved, truth["stars"][mine]) / known).max() < 0.1
    assert np.abs(without_map(moved, truth["stars"][mine], error[:, 0] ** -2.0) / error).max() < 0.03
    assert_allclose(columns_of(both, "x_err")[mine], columns_of(alone, "x_err"), rtol=0.01)
    assert_allclose(columns_of(both, "x_err_abs")[mine], columns_of(alone, "x_err_abs"), rtol=0.01)


def test_written_and_read(tmp_path):
    data, _ = field_sets.drawn_fields(6, dynamic=0.3)
    solution = solved(data, prior=UNCERTAIN)
    solution.write(tmp_path / "s.asdf")
    read = ld.Solution.read(tmp_path / "s.asdf")
    for name in solution.stars.colnames:
        assert_allclose(np.asarray(read.stars[name], float), np.asarray(solution.stars[name], float), rtol=1e-9)
    view, again, q = solution["e12"], read["e12"], np.array([[100.0, 700.0], [1500.0, 30.0]])
    assert_allclose(view.correct(q), again.correct(q))
    assert "fields  2 without a common star" in str(read)


def test_a_reference_ties_every_field():
    data, truth = field_sets.drawn_fields(7, dynamic=0.3)
    matches, rng = drawn_sets.as_matches(data), np.random.default_rng(7)
    rough = matches.positions[np.argsort(matches.stars.astype(int))] - truth["stars"]
    shift = np.stack([1000 * np.round(np.median(rough[truth["field"] == k], axis=0) / 1000) for k in (0, 1)])
    sky = truth["stars"] + shift[truth["field"]]
    reference = Table({"star": np.arange(0, len(sky), 2)})
    reference["x"], reference["y"] = (sky[::2] + 0.01 * rng.normal(size=sky[::2].shape)).T
    reference["x_err"] = reference["y_err"] = 0.01
    solution = solved(data, prior=UNCERTAIN, reference=reference)
    off, stated = columns_of(solution, "x", "y") - sky, columns_of(solution, "x_err_abs", "y_err_abs")
    for number in (0, 1):
        mine = truth["field"] == number
        assert 0.6 < np.sum(off[mine] ** 2) / np.sum(stated[mine] ** 2) < 1.6
    of_first = reference[truth["field"][::2] == 0]
    with pytest.raises(InputError, match=r"no star of e08, e09.*every field"):
        solved(data, prior=UNCERTAIN, reference=of_first)


@pytest.mark.parametrize("motion", ["proper", "auto"])
def test_a_field_of_one_date_beside_one_in_which_stars_move(motion):
    data, truth = field_sets.drawn_fields(11, dynamic=0.1)
    rng, first = np.random.default_rng(11), truth["exposure_field"] == 0
    years = np.where(first, 2010.0 + 0.7 * np.arange(len(first)), 2013.5)
    own = np.where((truth["field"] == 0)[:, None], 0.1, 0.0) * rng.normal(size=(len(truth["field"]), 2))
    moved = own[data["star"]] * (years[data["exposure"]] - years[first].mean())[:, None]
    turned = np.einsum("nab,nb->na", data["poses"][data["exposure"], :, :2], moved)
    data |= {"xy": data["xy"] + turned, "epoch": years[data["exposure"]]}
    solution = solved(data, prior=ld.Prior(truth["static"]), motion=motion, motion_epoch=years[first].mean())
    assert abs(solution.chi2 / solution.dof - 1) < 0.15
    weight = np.bincount(data["star"], data["err"][:, 0] ** -2.0)
    xy, stated = columns_of(solution, "x", "y"), columns_of(solution, "x_err", "y_err")
    for number in (0, 1):
        mine = truth["field"] == number
        left = without_map(xy[mine] - truth["stars"][mine], truth["stars"][mine], weight[mine])
        assert 0.5 < np.sum(left**2) / np.sum(stated[mine] ** 2) < 1.6
    mine = truth["field"] == 0
    rates = columns_of(solution, "vx", "vy")
    left = without_map(rates[mine] - own[mine], truth["stars"][mine], weight[mine])
    assert 0.5 < np.sum(left**2) / np.sum(columns_of(solution, "vx_err", "vy_err")[mine] ** 2) < 1.6
    assert not np.isfinite(rates[~mine]).any()


@pytest.mark.slow
def test_the_layout_of_a_camera_is_found_from_all_fields():
    parts, truth = {}, {}
    for k, label in enumerate("ab"):
        columns, poses, stars, layout = field_sets.misplaced_field(k, label)
        of_header = {key: place + [[0, 0, 7.0 * k], [0, 0, 0]] for key, place in layout.items()}  # other in each field
        detectors = {
            key: ld.Detector((1024, 1024), layout=place, header_layout=of_header[key]) for key, place in layout.items()
        }
        camera = ld.Camera("four", detectors)
        parts[label] = ld.Matches.from_table(Table(columns), camera=camera, poses=poses)
        truth |= {f"{label}_{j}": place for j, place in enumerate(stars)}
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        both = ld.solve(ld.Matches.of_fields(parts), degree=2, layout="fit", clip=None)
        alone = ld.solve(parts["a"], degree=2, layout="fit", clip=None)
    assert abs(both.chi2 / both.dof - 1) < 0.15
    table = both.stars[np.isfinite(both.stars["x_err"])]
    for number in (1, 2):
        mine = table[table["field"] == number]
        xy, stars = np.stack([mine["x"].value, mine["y"].value], axis=1), np.stack([truth[s] for s in mine["star"]])
        left = without_map(xy - stars, stars, mine["x_err"].value ** -2.0, degree=2)
        stated = np.stack([mine["x_err"].value, mine["y_err"].value], axis=1)
        assert 0.6 < np.sum(left**2) / np.sum(stated**2) < 1.5
    rms = [
        np.sqrt(np.mean([np.square(d.place.errors[:2]) for d in s.camera.detectors.values()])) for s in (both, alone)
    ]
    assert rms[0] < 0.85 * rms[1]


@pytest.mark.slow
def test_fields_are_joined_by_name():
    data, truth = field_sets.drawn_fields(8, dynamic=0.3)
    parts = {name: drawn_sets.as_matches(only(data, truth, k)[0]) for k, name in enumerate(("M15", "M92"))}
    joined = ld.Matches.of_fields(parts)
    assert repr(joined).endswith("16 exposures of 2 fields>")
    assert {"M15_e00", "M92_e00"} < set(joined.names)
    assert {str(star).split("_")[0] for star in joined.stars} == {"M15", "M92"}
    for name, part in parts.items():  # only moved along
        for exposure, pose in part.poses.items():
            back = np.linalg.inv(pose[:, :2]) @ (joined.poses[f"{name}_{exposure}"] - pose)[:, 2]
            assert_allclose(back, 1000 * np.round(back / 1000), atol=1e-6)
    solution = solved(data, prior=UNCERTAIN)
    again = ld.solve(joined, degree=3, clip=None, prior=UNCERTAIN)
    assert_allclose(again.chi2, solution.chi2, rtol=1e-6)
    distinct = {"a": parts["M15"], "b": parts["M92"].keep(slice(None))}
    with pytest.raises(InputError, match="two at least"):
        ld.Matches.of_fields({"a": parts["M15"]})
    other = ld.Camera("other", {"1": ld.Detector((2048, 2048))})
    other = ld.Matches.from_table(parts["M92"].table, camera=other)
    with pytest.raises(InputError, match="differ in camera"):
        ld.Matches.of_fields(distinct | {"b": other})
    with pytest.raises(InputError, match="name of a file"):
        ld.Matches.of_fields({"a/b": parts["M15"], "c": parts["M92"]})


def test_columns_that_only_some_fields_have_are_named():
    data, truth = field_sets.drawn_fields(9)
    parts = {name: drawn_sets.as_matches(only(data, truth, k)[0]) for k, name in enumerate(("a", "b"))}
    with warnings.catch_warnings(action="error"):
        both = ld.Matches.of_fields(parts)
    table = parts["a"].table.copy()
    table["flux"], table["fwhm"] = 1.0, 3.0
    more = parts | {"a": ld.Matches.from_table(table, shape=parts["a"].shapes, poses=parts["a"].poses)}
    with pytest.warns(LegdistortWarning, match=r"are left out: flux, fwhm \(not in b\); add them there") as told:
        again = ld.Matches.of_fields(more)
    assert len(told) == 1
    assert again.table.colnames == both.table.colnames


def test_columns_with_and_without_a_unit_are_joined():
    data, truth = field_sets.drawn_fields(9)
    parts = [drawn_sets.as_matches(only(data, truth, k)[0]) for k in (0, 1)]

    def joined(*columns):
        fields = {}
        for label, part, column in zip("ab", parts, columns, strict=True):
            table = part.table.copy()
            value, unit = column
            table["more"] = np.full(len(table), value) if unit is None else np.full(len(table), value) * unit
            fields[label] = ld.Matches.from_table(table, shape=part.shapes, poses=part.poses)
        table = ld.Matches.of_fields(fields).table
        is_first = np.char.startswith(np.asarray(table["exposure"]).astype(str), "a_")
        return table["more"][is_first][0], table["more"][~is_first][0]

    none = u.dimensionless_unscaled
    assert joined((1.2, None), (3.4, none)) == (1.2, 3.4)  # as files have it, ASDF and ECSV
    assert joined((1.2, u.pix), (3, None)) == (1.2 * u.pix, 3 * u.pix)
    assert joined((1.0, u.arcsec), (1.0, u.deg)) == (1 * u.arcsec, 3600 * u.arcsec)
    with pytest.raises(InputError, match="column 'more' has text in b and numbers in a: make them alike, or leave it"):
        joined((1.2, u.pix), ("x", None))
    with pytest.raises(InputError, match="column 'more' is in pix in a and in arcsec in b: state the same unit"):
        joined((1.2, u.pix), (1.0, u.arcsec))


def test_refused_where_nothing_is_shared():
    data, truth = field_sets.drawn_fields(9)
    with pytest.raises(MatchError, match=r"2 groups with no star in common.*static='fit'"):
        solved(data)
    matches = drawn_sets.as_matches(data)
    with pytest.raises(InputError, match="of one field"):
        paper.solve(matches)
    plane = TangentPlane(10.0, 20.0, np.eye(2) * 1e-5)
    poses = {f"e{i:02d}": pose for i, pose in enumerate(data["poses"])}
    with pytest.raises(MatchError, match="overlap on the sky"):
        ld.Matches.from_table(matches.table, shape=(2048, 2048), poses=poses, sky=plane)
    rows = truth["exposure_field"][data["exposure"]] == 0
    assert not matches.keep(rows).fields.any()
    cut = rows & ~np.isin(data["exposure"], [0, 1]) | (rows & (data["star"] % 2 == data["exposure"] % 2))
    with pytest.raises(MatchError, match="groups with no star in common"):
        matches.keep(rows & (data["star"] % 2 == data["exposure"] % 2))
    assert matches.keep(cut).fields.max() == 0


@pytest.mark.slow
def test_on_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data, truth = field_sets.drawn_fields(10)
    for k, name in enumerate(("M15", "M92")):
        drawn_sets.as_matches(only(data, truth, k)[0]).table.write(f"{name}.ecsv")
    words = ["--shape", "2048", "2048", "--out", "r"]
    assert main(["solve", "M15.ecsv", "M92.ecsv", *words]) != 0
    assert "--static fit" in capsys.readouterr().err
    assert main(["solve", "M15.ecsv", "M15.ecsv", *words]) != 0
    assert "stands twice" in capsys.readouterr().err
    assert main(["solve", "M15.ecsv", "M92.ecsv", *words, "--static", "fit"]) == 0
    assert "fields  2 without a common star" in capsys.readouterr().out
    assert set(ld.Solution.read("r/solution.asdf").stars["field"]) - {0} == {1, 2}


def test_fields_of_a_camera_whose_detectors_share_no_star():
    """Dithers smaller than the gaps: nothing but the camera says how its detectors lie, in either field."""
    night = header_layouts.Night(8, off=0.0, dither=10.0, n=8, n_stars=200, size=0.0)
    camera = ld.Camera.from_exposures([each for each in night.exposures if each.exposure == "e0"])
    parts = {}
    for label, names in (("a", ("e0", "e1", "e2", "e3")), ("b", ("e4", "e5", "e6", "e7"))):
        table = night.table[np.isin(night.table["exposure"], names)]
        exposures = [each for each in night.exposures if each.exposure in names]
        parts[label] = ld.match(table, exposures=exposures, camera=camera)
    fields = ld.Matches.of_fields(parts)
    solution = ld.solve(fields, static="hold", layout="hold", degree=2)
    assert solution.gauge.n_fields == 2
    assert 0.8 < solution.chi2 / solution.dof < 1.2
    with pytest.raises(MatchError, match=r"4 groups with no star in common.* solved by itself.*leave dynamic"):
        ld.solve(parts["a"], dynamic="detector")
