"""Nights of a camera with several detectors, added to one; nights and their truth are made by numpy alone."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table, vstack
from numpy.polynomial import legendre
from numpy.testing import assert_allclose

import legdistort as ld
from legdistort.assessment.nights.camera_changes import CameraChanges
from legdistort.assessment.nights.night_data import Night
from legdistort.cli import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.plots import memory_plots
from legdistort.solving import camera_fit

SIZE, GAP = 512, 30
STEP = SIZE + GAP


def drawn(seed, n=2, static=1.0):
    """Turns (n,), moves (n, 2) and bends (n, 2, 3) by x^2, x y, y^2 over a detector, of n detectors side by side."""
    rng = np.random.default_rng(9000 + seed)
    return rng.normal(0, 0.001, n), rng.normal(0, 1, (n, 2)), static * rng.normal(size=(n, 2, 3))


def quadratic(u, v):
    return np.stack([u**2, u * v, v**2], axis=-1)


def to_pixels(f, k, of):
    """Where detector k sees what lies at f (m, 2) in the focal plane."""
    turn, move, bend = of
    q = f - [k * STEP, 0]
    q = q + turn[k] * np.stack([-q[:, 1], q[:, 0]], axis=1) + move[k]
    return q + quadratic(*(2 * (q.T + 0.5) / SIZE - 1)) @ bend[k].T


def night(seed, of, *, n_stars=200, exposures=6, sigma=0.02, nightly=0.0, plane=0.3, odd=0.0, year=2020.0):
    """Matches of a night, whose detectors and focal plane are bent by amounts of their own."""
    rng, rows, poses = np.random.default_rng(seed), [], {}
    turn, move, bend = of
    bend, warp = bend + nightly * rng.normal(size=bend.shape), plane * rng.normal(size=(2, 3))
    move = move + nightly * rng.normal(size=move.shape)
    bend[-1, 0, 1] += odd
    stars = rng.uniform(-250, [len(turn) * STEP + 250, STEP + 250], (n_stars, 2))
    for i in range(exposures):
        shift = rng.normal(0, 150, 2) * (i > 0)
        poses[f"e{i}"] = np.column_stack([np.eye(2), shift])
        f = stars + shift
        f = f + quadratic(*(f / STEP - [len(turn) / 2, 0.5]).T) @ warp.T
        for k in range(len(turn)):
            q = to_pixels(f, k, (turn, move, bend))
            for j in np.flatnonzero(((q > 0) & (q < SIZE - 1)).all(axis=1)):
                rows.append((f"e{i}", str(k), j, *(q[j] + sigma * rng.normal(size=2)), sigma, sigma, year))
    table = Table(rows=rows, names=["exposure", "detector", "star", "x", "y", "x_err", "y_err", "epoch"])
    return table, poses


def camera(n=2, **how):
    chips = {str(k): np.column_stack([np.eye(2), [-k * STEP, 0]]) for k in range(n)}
    return ld.Camera("PAIR", {k: ld.Detector((SIZE, SIZE), layout=v, **how) for k, v in chips.items()})


def solved(table, poses, given=None, **how):
    matches = ld.Matches.from_table(table, camera=given or camera(len(set(table["detector"]))), poses=poses)
    return ld.solve(matches, degree=2, **({"layout": "fit", "static": "fit"} | how))


def campaign(seed, n, *, odd=None, detectors=2, **how):
    of = drawn(seed, detectors)
    words = [{"year": 2014 + i / 2, "odd": 0.5 * (i == odd)} | how for i in range(n)]
    return [solved(*night(100 * seed + i, of, **each)) for i, each in enumerate(words)]


def modes(displacement, u, v):
    """Normalised Legendre modes (2, 6) of degree 2 of a displacement (m, 2) at u, v (m,), by least squares."""
    i, j = np.array([0, 1, 0, 2, 1, 0]), np.array([0, 0, 1, 0, 1, 2])
    norm = np.sqrt((2 * np.arange(3) + 1) / 2)
    values = (legendre.legvander2d(u, v, (2, 2)) * np.outer(norm, norm).ravel())[:, 3 * i + j]
    return np.linalg.lstsq(values, displacement, rcond=None)[0].T


def off_truth(found, of):
    """Modes (n, 2, 6) by which detectors are off, and those of the quadratic maps (12, n, 2, 6) that all can share."""
    t = np.linspace(-0.95, 0.95, 12)
    u, v = (each.ravel() for each in np.meshgrid(t, t))
    off, shared = [], []
    for k, chip in enumerate(found.detectors.values()):
        f = np.stack([(u + 1) * SIZE / 2 - 0.5 + k * STEP, (v + 1) * SIZE / 2 - 0.5], axis=1)
        off.append(modes(f - chip.to_focal_plane(to_pixels(f, k, of)), u, v))
        x, y = (f / STEP - [len(found.detectors) / 2, 0.5]).T
        monomials = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
        each = np.array([modes(np.outer(m, np.eye(2)[a]), u, v) for a in range(2) for m in monomials])
        shared.append(each)
    return np.array(off), np.stack(shared, axis=1)


def squared_pull(found, covariance, of):
    """Squares of what is no map of the plane over their variances, and their number."""
    off, shared = off_truth(found, of)
    inside = np.linalg.svd(shared.reshape(len(shared), -1))[2][len(shared) :]
    away = inside @ off.ravel()
    return away @ np.linalg.solve(inside @ covariance @ inside.T, away), len(away)


def alone(combined):
    """The camera without the scatter of a further night, and the covariance of its modes."""
    found, covariance = combined.static()
    first, detectors = combined.nights[0].camera, {}
    for k, (key, chip) in enumerate(first.detectors.items()):
        low = np.zeros((2, 6))
        low[:, :3] = found[k, :, :3]
        moved = ld.Detector(chip.shape, layout=chip.layout, static=low).layout  # orders 0 and 1 go into the layout
        static = chip.static + np.where(np.arange(6) < 3, 0, found[k])
        detectors[key] = ld.Detector(chip.shape, layout=moved, static=static)
    return ld.Camera("PAIR", detectors, first.field), covariance


@pytest.fixture(scope="module")
def two():
    return campaign(1, 2, exposures=4)


def measured(chips):
    """A night that knows all modes of two detectors alike."""
    counts = {"date": None, "n_exposures": 5, "n_stars": 50, "n_nights": 1, "scatter": np.zeros(3), "nightly": None}
    known = {"around": None, "information": 1e4 * np.eye(24), "pull": np.zeros(24), "dof": np.inf}
    return Night("night", **counts, **known, camera=ld.Camera("PAIR", chips))


def test_maps_of_the_focal_plane_are_no_changes():
    """A similarity, and 0.5 px of x^2 along y, by numpy: what is left is of second order."""
    plain = camera().detectors
    first = measured({key: replace(each, layout=each.layout + [[0, 0, 40], [0, 0, 90]]) for key, each in plain.items()})
    turn, bent = np.array([[0.9999, -0.0141, 5.0], [0.0141, 0.9999, -7.0]]), {}
    t = np.linspace(-1, 1, 12)
    u, v = (each.ravel() for each in np.meshgrid(t, t))
    q = np.stack([(u + 1) * SIZE / 2 - 0.5, (v + 1) * SIZE / 2 - 0.5], axis=1)
    for key, each in first.camera.detectors.items():
        x = (q[:, 0] - each.layout[0, 2]) / STEP
        static = modes(0.5 * np.outer(x**2, [0, 1]), u, v)
        layout = np.column_stack([turn[:, :2], each.layout[:, 2] + turn[:, 2]])
        bent[key] = ld.Detector((SIZE, SIZE), layout=layout, static=static)
    frame = CameraChanges(first.camera, 6)
    around, information, _ = frame.seen(measured(bent))
    assert np.abs(around).max() < 2e-3
    assert np.linalg.matrix_rank(information, tol=1e-3) == 24 - 12
    odd = dict(bent)
    odd["1"] = replace(bent["1"], static=bent["1"].static + 0.1 * np.eye(2, 6, 4))
    around = frame.seen(measured(odd))[0]
    assert around @ information @ around > 1e4 * 0.05**2


@pytest.mark.slow
def test_nights_of_two_detectors_make_one_camera(two, tmp_path):
    combined = ld.combine_nights(two, name="PAIR")
    assert combined.has_focal_plane
    assert repr(combined) == "<CombinedNights: PAIR, degree 2, 2 nights, 0 odd>"
    assert combined.scatter.shape == (3,)
    assert "(degree 0)" in str(combined)
    found, covariance = combined.static()
    assert found.shape == (2, 2, 6)
    assert covariance.shape == (24, 24)
    assert set(combined.modes()["detector"]) == {"0", "1"}
    assert len(combined.modes()) == 12
    with pytest.raises(InputError, match=r"camera PAIR has several detectors, .*: take its camera, camera\(\)"):
        combined.prior()
    path = combined.write(tmp_path / "camera.asdf")
    again, read = ld.CombinedNights.read(path), ld.Camera.read(path)
    assert_allclose(again.static()[0], found, atol=1e-12)
    assert read["1"].layout_covariance.shape == (6, 6)
    assert read["1"].static_covariance.shape == (12, 12)
    assert_allclose(read["1"].static_sigma, np.sqrt(np.diag(read["1"].static_covariance)).reshape(2, 6))
    assert 0 < read["1"].static_sigma[:, 3:].min() < read["1"].static_sigma.max() < 0.1
    assert np.isinf(read.common_sigma).all()


@pytest.mark.slow
def test_the_plane_of_a_night_is_a_convention(two):
    """Shifted, turned and bent, with the same detectors in it."""
    night = two[1]
    known = ld.combine_nights(two)
    turn = np.array([[np.cos(0.01), -np.sin(0.01), 5.0], [np.sin(0.01), np.cos(0.01), -7.0]])
    back = np.linalg.inv(turn[:, :2])
    chips = {}
    for key, chip in night.camera.detectors.items():
        layout = np.column_stack(
            [chip.layout[:, :2] @ back, chip.layout[:, 2] - chip.layout[:, :2] @ back @ turn[:, 2]]
        )
        chips[key] = replace(chip, layout=layout)
    moved = replace(night, camera=replace(night.camera, detectors=chips, field=(800, 1300)))
    assert_allclose(ld.combine_nights([two[0], moved]).static()[0], known.static()[0], atol=2e-3)
    assert np.abs(off_truth(moved.camera, drawn(1))[0]).max() > 4


@pytest.mark.slow
def test_what_cannot_be_added_is_refused(two):
    with pytest.raises(InputError, match="solution 2 has an exposure that solution 1 has too"):
        ld.combine_nights([two[0], two[0]])
    with pytest.raises(InputError, match=r"solution 1 is of camera PAIR .* leave the covariate out"):
        ld.combine_nights(two, covariate="TEMP")
    single = ld.Prior(np.eye(2, 6, 3), static_sigma=0.1, shape=(SIZE, SIZE))
    with pytest.raises(InputError, match=r"several cameras, solution 1 \(detectors 0 of 512 x 512, 1 .*, map 3 \(one"):
        ld.combine_nights([*two, single])


@pytest.fixture(scope="module")
def third():
    """Table and poses of a night, and its solution with everything of the camera fitted."""
    given = night(102, drawn(1), exposures=4, year=2015.0)
    return given, solved(*given)


def same_camera(found, known, *, part):
    """Whether two combinations differ by less than a part of the errors, and these by less than it."""
    (values, covariance), (others, theirs) = found.static(), known.static()
    error, other = (np.sqrt(np.diag(each)) for each in (covariance, theirs))
    assert np.all(np.abs(values - others).ravel() < part * other + 1e-9)
    assert_allclose(error, other, rtol=part, atol=1e-9)


def without_errors(known):
    """The camera of a solution, as if it were exact."""
    none = dict.fromkeys(("layout_sigma", "layout_covariance", "static_sigma", "static_covariance"))
    chips = {key: replace(chip, **none) for key, chip in known.detectors.items()}
    return replace(known, detectors=chips, common_sigma=None, covariance=None)


@pytest.mark.parametrize("how", ["layout None", "layout held", "all held", "nominal held", "prior"])
@pytest.mark.filterwarnings("ignore:. unknowns of camera PAIR are not determined")
@pytest.mark.filterwarnings("ignore:.*checks")
@pytest.mark.slow
def test_a_night_counts_by_its_own_data(two, third, how, recwarn):
    """Whatever was held, or known beforehand, it counts as the same night with all of the camera fitted."""
    (table, poses), free = third
    stated = {
        key: ld.Detector((SIZE, SIZE), layout=each.layout, layout_sigma=np.inf)
        for key, each in camera().detectors.items()
    }
    given, words = {
        "layout None": (ld.Camera("PAIR", stated), {"layout": None}),
        "layout held": (without_errors(two[0].camera), {"layout": "hold"}),
        "all held": (without_errors(two[0].camera), {"layout": "hold", "static": "hold"}),
        "nominal held": (camera(), {"layout": "hold", "static": "hold"}),
        "prior": (ld.combine_nights(two).camera(), {"layout": None, "static": None}),
    }[how]
    other = solved(table, poses, given, **words)
    recwarn.clear()
    same_camera(ld.combine_nights([*two, other]), ld.combine_nights([*two, free]), part=0.01)
    assert not recwarn


@pytest.mark.filterwarnings("ignore:. unknowns of camera PAIR are not determined")
@pytest.mark.slow
def test_nights_of_one_solution_count_one_by_one(two, third):
    """Each is what it is where it is solved by itself; one of a single exposure is left out."""
    of, tables, poses = drawn(1), [], {}
    given = [night(100 + i, of, exposures=4, year=2014 + i / 2) for i in range(2)]
    for i, (table, those) in enumerate([*given, third[0], night(103, of, exposures=1, year=2016.0)]):
        table = table.copy()
        table["exposure"] = [f"n{i}{name}" for name in table["exposure"]]
        table["star"] += 1000 * i
        poses |= {f"n{i}{name}": pose for name, pose in those.items()}
        tables.append(table)
    together = solved(vstack(tables), poses)
    with pytest.warns(AssumptionWarning, match=r"^2016-01-01 of solution 1 left out: one exposure alone"):
        found = ld.combine_nights(together)
    assert [each.name for each in found.nights] == [
        f"{y} of solution 1" for y in ("2014-01-01", "2014-07-02", "2015-01-01")
    ]
    same_camera(found, ld.combine_nights([*two, third[1]]), part=0.01)
    with (
        pytest.warns(AssumptionWarning),
        pytest.raises(InputError, match=r"2015-01-01 of solution 2 has an exposure that solution 1 has too"),
    ):
        ld.combine_nights([third[1], together])


@pytest.mark.parametrize(("seed", "number", "most"), [(2, 0, 13), (0, 1, 20)])
@pytest.mark.slow
def test_a_camera_settles_where_the_focal_plane_is_hardly_determined(seed, number, most, monkeypatch):
    """Half steps to the end took 18 steps, and directions that are determined in every other step 27."""
    steps, step = [], camera_fit.camera_step
    monkeypatch.setattr(camera_fit, "camera_step", lambda *given: steps.append(step(*given)) or steps[-1])
    solved(*night(100 * seed + number, drawn(seed), year=2014 + number / 2, nightly=0.02))
    assert steps[-1].length < 0.01
    assert len(steps) <= most


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.ConvergenceWarning")
@pytest.mark.slow
def test_nights_add_as_one_solution_of_all():
    of = drawn(1)
    nights = [night(100 + i, of, year=2014 + i / 2, plane=0) for i in range(3)]
    combined = ld.combine_nights([solved(*each) for each in nights])
    fields = {f"N{i}": ld.Matches.from_table(t, camera=camera(), poses=p) for i, (t, p) in enumerate(nights)}
    joint = ld.solve(ld.Matches.of_fields(fields), degree=2, layout="fit", static="fit")
    one, covariance = alone(combined)
    (off, shared), (other, _) = off_truth(one, of), off_truth(joint.camera, of)
    inside = np.linalg.svd(shared.reshape(len(shared), -1))[2][len(shared) :]
    apart = inside @ (off - other).ravel()
    assert apart @ np.linalg.solve(inside @ covariance @ inside.T, apart) / len(apart) < 0.3**2
    assert np.abs(other).max() > 0.01


@pytest.mark.slow
def test_a_night_is_compared_with_the_camera_of_others(tmp_path):
    nights = campaign(1, 4, nightly=0.02)
    combined = ld.combine_nights(nights[:3])
    combined.write(tmp_path / "camera.asdf")
    words = " ".join(str(combined).split())
    assert words.startswith("Camera PAIR: static distortion of degree 2 from 18 exposures of 3 nights.")
    assert ld.difference(tmp_path / "camera.asdf", nights[3]).agrees
    assert ld.difference(combined, nights[0]).shared == nights[0].names
    one, other = (ld.difference(each, nights[3]) for each in (combined, combined.camera()))
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-6)  # modes that counted as independent had another


def test_coefficients_of_all_detectors_are_drawn(monkeypatch):
    """Two rows a detector, a panel each order; nights that hardly tell have no point; those that change most."""
    monkeypatch.setattr(memory_plots, "_MOST", 2)
    rng, nights = np.random.default_rng(1), []
    for i in range(3):
        chips = {}
        for key, chip in camera(3).detectors.items():
            static = np.where(np.arange(6) < 3, 0, rng.normal(0, 0.05, (2, 6)) + 0.5 * i * (key == "2"))
            chips[key] = replace(chip, static=static)
        night = replace(measured(chips), name=f"n{i}", date=2020.0 + i)
        information = 1e4 * np.eye(36) if i < 2 else 1e-2 * np.eye(36)
        nights.append(replace(night, information=information, pull=np.zeros(36)))
    sizes = {"scatter": np.full(3, 0.05), "oddness": np.ones(3)}
    found = ld.CombinedNights(tuple(nights), shape=(SIZE, SIZE), name="ROW", **sizes)
    words = " ".join(str(found).split())
    assert "relative to each other, after one map of degree 2 of all together, which exposures take over (not" in words
    assert "what a reference told of that map in a night is no part of this camera, but of that which" in words
    assert "a bend of all together by 1 px rms, which a reference would tell (--reference), shifts single ones" in words
    assert str(replace(found, name="camera")).startswith("Camera: static distortion of degree 2 from ")
    fig = found.plot()
    assert len(fig.axes) == 2 * 2 * 6
    assert fig.axes[-6].get_ylabel() == "detector 2\nalong y [pix]"
    assert [ax.get_title(loc="left") for ax in fig.axes[:3]] == ["L0 L0", "L1 L0", "L0 L1"]
    *_, last = fig.axes[-12:-6]  # of detector 2 along x, y^2
    points = [each.lines[0].get_xydata()[0] for each in last.containers]
    values = found.static()[0]
    assert [x for x, _ in points] == [2020, 2021]
    assert points[1][1] == pytest.approx(found.seen_by(1)[0][2, 0, 5])
    assert abs(points[1][1] - points[0][1]) > 0.2
    assert last.lines[0].get_ydata()[0] == pytest.approx(values[2, 0, 5])
    assert fig.axes[-1].get_xlabel() == "year"


@pytest.mark.slow
def test_the_command(two, tmp_path, capsys):
    for i, each in enumerate(two):
        each.write(tmp_path / f"night{i}.asdf")
    first, whole = tmp_path / "first.asdf", tmp_path / "camera.asdf"
    assert main(["nights", str(tmp_path / "night0.asdf"), "--out", str(first), "--name", "PAIR", "--quiet"]) == 0
    picture = tmp_path / "a.png"
    line = ["nights", str(first), str(tmp_path / "night1.asdf"), "--out", str(whole), "--plot", str(picture), "--quiet"]
    assert main(line) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "detector axis x_degree" in capsys.readouterr().out
    assert_allclose(
        ld.CombinedNights.read(whole).static()[0], ld.combine_nights(two, name="PAIR").static()[0], atol=1e-9
    )
    table = night(7, drawn(1), exposures=4)[0]
    table.write(tmp_path / "list.csv")
    line = ["correct", str(whole), str(tmp_path / "list.csv"), "--out", str(tmp_path / "undistorted.csv")]
    assert main(line) == 0
    matches = ld.Matches.from_table(table, camera=ld.Camera.read(whole), poses=night(7, drawn(1), exposures=4)[1])
    assert ld.solve(matches, degree=2).camera["1"].layout_sigma[:, 0].max() < 0.05  # a prior of the next night


@pytest.mark.filterwarnings("ignore::legdistort.exceptions.ConvergenceWarning")
@pytest.mark.parametrize(
    ("words", "n_sets"),
    [
        pytest.param({"n": 4, "nightly": 0.02}, 20, marks=pytest.mark.sets),
        pytest.param({"n": 4, "nightly": 0.02}, 4, marks=pytest.mark.slow),
        pytest.param({"n": 5, "nightly": 0.02, "odd": 2}, 8, marks=pytest.mark.sets),
        pytest.param({"n": 3, "nightly": 0.02, "detectors": 4}, 4, marks=pytest.mark.sets),
    ],
    ids=str,
)
def test_a_camera_of_nights_is_calibrated(words, n_sets):
    """Squares of what layouts and static distortions are off by, but for a map that detectors share, over variances."""
    pull = count = named = 0
    for seed in range(n_sets):
        combined = ld.combine_nights(campaign(seed, **words))
        each = squared_pull(*alone(combined), drawn(seed, words.get("detectors", 2)))
        pull, count = pull + each[0], count + each[1]
        named += combined.odd == ((f"solution {words['odd'] + 1}",) if "odd" in words else ())
    few = np.sqrt(20 / n_sets) - 1
    print(f"squared pull {pull / count:.2f}, {named} of {n_sets} named as they are")
    assert 0.8 - 0.2 * few < pull / count < 1.2 + 0.2 * few
    assert named >= n_sets - 1
