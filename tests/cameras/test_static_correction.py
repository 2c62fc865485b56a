"""Lists corrected for the static distortion of a camera alone: against drawn truth, in numpy, and bad lists."""

import json

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable, Table
from ldac_files import write_ldac
from numpy.polynomial import legendre
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, FoldError, InputError
from legdistort.geometry.tabulated.displacement_table import DisplacementTable
from legdistort.results import new_positions

SHAPE = (900, 1200)
#: Orders in x and y of the modes up to degree 3.
ORDERS = [(d - j, j) for d in range(4) for j in range(d + 1)]
STATIC = np.array(
    [[0, 0, 0, 1.5, -0.8, 0.4, 0.6, -0.3, 0.2, 0.5], [0, 0, 0, -0.7, 0.9, 1.1, -0.2, 0.4, 0.3, -0.6]], dtype=float
)
#: Two detectors side by side, the second turned by half a degree.
ANGLE = np.radians(0.5)
TURNED = np.array([[np.cos(ANGLE), np.sin(ANGLE), -1250.0], [-np.sin(ANGLE), np.cos(ANGLE), 15.0]])


def values(xy, shape, n=10):
    """Normalised Legendre modes (n, k) at pixels (k, 2)."""
    u, v = (2 * np.asarray(xy).T + 1) / np.array(shape[::-1])[:, None] - 1
    return np.array([
        np.sqrt((i + 0.5) * (j + 0.5)) * legendre.legval(u, np.eye(4)[i]) * legendre.legval(v, np.eye(4)[j])
        for i, j in ORDERS[:n]
    ])  # fmt: skip


def distort(q, coefficients, shape=SHAPE):
    return q + (coefficients @ values(q, shape, coefficients.shape[1])).T


def places(n, shape=SHAPE, seed=1):
    return np.random.default_rng(seed).uniform(30, np.array(shape[::-1]) - 30, (n, 2))


def listed(xy, error=None, **columns):
    table = Table({"x": xy[:, 0], "y": xy[:, 1]} | columns)
    if error is not None:
        table["x_err"] = table["y_err"] = np.full(len(xy), error)
    return table


def xy_of(table, suffix=""):
    return np.column_stack([table[f"{name}{suffix}"].to_value(u.pix) for name in "xy"])


def camera(**known):
    return ld.Camera("one", {"1": ld.Detector(SHAPE, static=STATIC, **known)})


def pair(**known):
    detectors = {
        "a": ld.Detector(SHAPE, static=STATIC, layout_sigma=0.04, static_sigma=0.03),
        "b": ld.Detector(SHAPE, layout=TURNED, static=-STATIC, layout_sigma=0.05, static_sigma=0.02),
    }
    return ld.Camera("pair", detectors, **known)


# -- positions


def test_a_single_detector_has_its_undistorted_pixels():
    q = places(30)
    made = camera().correct_table(listed(distort(q, STATIC), 0.02, star=np.arange(30)))
    assert_allclose(xy_of(made), q, atol=1e-8)
    assert_array_equal(made["star"], np.arange(30))
    assert made["x"].unit == made["x_err_abs"].unit == u.pix


def test_detectors_meet_in_the_focal_plane_without_its_common_map():
    common = np.zeros((2, 10))
    common[:, 3:6] = [[2.0, 1.0, -1.0], [0.5, -1.5, 1.0]]
    whole = pair(common_map=common, common_sigma=np.zeros((2, 10)))
    f = places(200, whole.field)
    on = {key: each.sees(distort(f, common, whole.field)) for key, each in whole.detectors.items()}
    lists, truth = [], []
    for key, here in on.items():
        detector, there = whole[key], distort(f[here], common, whole.field)
        q = there @ detector.layout[:, :2].T + detector.layout[:, 2]
        lists.append(listed(distort(q, detector.static), 0.01, detector=np.full(here.sum(), key)))
        truth.append(f[here])
    for each, seen in zip(lists, truth, strict=True):
        made = whole.correct_table(each)
        assert_allclose(xy_of(made), seen, atol=1e-7)
        assert_allclose(xy_of(made, "_detector"), np.column_stack([each["x"], each["y"]]))
    assert min(map(len, truth)) > 50


def test_a_prior_takes_its_table_off_too():
    nodes = np.random.default_rng(3).normal(0, 0.3, (2, 10, 13))
    bumps = DisplacementTable(nodes, first=(0.0, 0.0), step=(100.0, 100.0))
    q = places(25)
    prior = ld.Prior(STATIC, shape=SHAPE, table=bumps)
    made = prior.correct_table(listed(distort(q, STATIC) + bumps(q), 0.01))
    assert_allclose(xy_of(made), q, atol=1e-6)


# -- errors


def test_errors_of_a_detector_are_those_of_drawn_truth():
    """A night of two exposures of one place: they have the error of the static distortion in common."""
    rng, q, widths = np.random.default_rng(5), places(40), np.zeros((2, 10))
    widths[:, 3:] = 0.06
    scatter, error = np.where(widths > 0, 0.04, 0.0), 0.02
    known, off = camera(static_sigma=widths), []
    for _ in range(150):
        static = STATIC + widths * rng.normal(size=widths.shape)
        exposures = [static + scatter * rng.normal(size=widths.shape) for _ in range(2)]
        lists = [listed(distort(q, each) + error * rng.normal(size=q.shape), error) for each in exposures]
        made = [known.correct_table(each, sigma=scatter) for each in lists]
        off.append([xy_of(each) - q for each in made])
    off, made = np.array(off), made[0]
    assert np.mean((off[:, 0] / xy_of(made, "_err_abs")) ** 2) == pytest.approx(1, abs=0.06)
    assert np.mean((off[:, 0] - off[:, 1]) ** 2 / xy_of(made, "_err") ** 2) / 2 == pytest.approx(1, abs=0.06)
    more = np.mean(xy_of(made, "_err_abs") ** 2 - xy_of(made, "_err") ** 2)
    assert made.meta["static_error_px"] == pytest.approx(np.sqrt(more))
    assert made.meta["exposure_scatter_px"] == pytest.approx(made.meta["static_error_px"] * 2 / 3, rel=0.01)


def test_errors_of_several_detectors_are_those_of_drawn_truth():
    rng, common = np.random.default_rng(6), np.zeros((2, 10))
    common[:, 3:] = 0.05
    whole = pair(common_map=np.zeros((2, 10)), common_sigma=common)
    key, detector = "b", whole["b"]
    q = places(40)
    f = (q - detector.layout[:, 2]) @ np.linalg.inv(detector.layout[:, :2]).T
    off = {True: [], False: []}
    for with_common in off:
        for _ in range(150):
            low, high = (w * rng.normal(size=w.shape) for w in (detector.layout_sigma, detector.static_sigma))
            shift = common * rng.normal(size=common.shape) * with_common
            there = distort(distort(f, shift, whole.field) @ detector.layout[:, :2].T + detector.layout[:, 2], low)
            high[:, :3] = 0
            seen = distort(there, detector.static + high) + 0.02 * rng.normal(size=q.shape)
            made = whole.correct_table(listed(seen, 0.02, detector=np.full(40, key)))
            off[with_common].append(xy_of(made) - f)
    assert np.mean((np.array(off[True]) / xy_of(made, "_err_abs")) ** 2) == pytest.approx(1, abs=0.08)
    assert np.mean((np.array(off[False]) / xy_of(made, "_err")) ** 2) == pytest.approx(1, abs=0.08)
    assert np.all(xy_of(made, "_err") < xy_of(made, "_err_abs"))


def test_what_modes_of_a_detector_have_in_common_counts():
    """A shift of its place against x^2, and a shear against y^3, cancel over a half of it: drawn truth, in numpy."""
    rng, widths = np.random.default_rng(7), np.where(np.arange(10) < 3, 0.05, 0.04) * np.ones((2, 2, 1))
    root = np.diag(widths.ravel())
    for one, other in ((20, 23), (32, 39)):  # of detector b
        root[other] = 0.0
        root[other, one] = -0.04
    covariance, (a, b) = root @ root.T, pair().detectors.values()
    known = {"static_sigma": np.where(np.arange(10) < 3, 0, 0.04) * np.ones((2, 1)), "layout_sigma": 0.05}
    chips = {"a": ld.Detector(SHAPE, static=a.static, **known)}
    chips["b"] = ld.Detector(SHAPE, layout=b.layout, static=b.static, **known)
    whole = ld.Camera("pair", chips, covariance=covariance)
    assert whole.covariance is not None
    q, off = places(40), []
    f = (q - whole["b"].layout[:, 2]) @ np.linalg.inv(whole["b"].layout[:, :2]).T
    for _ in range(200):
        change = (root @ rng.normal(size=len(root))).reshape(2, 2, 10)[1]
        there = distort(q, change[:, :3])
        seen = distort(there, whole["b"].static + np.where(np.arange(10) < 3, 0, change))
        made = whole.correct_table(listed(seen, 1e-6, detector=np.full(40, "b")))
        off.append(xy_of(made) - f)
    ratio = np.mean(np.array(off) ** 2, axis=0) / xy_of(made, "_err") ** 2
    assert np.mean(ratio) == pytest.approx(1, abs=0.05)
    assert np.std(ratio) < 0.2
    apart = ld.Camera("pair", whole.detectors).correct_table(listed(seen, 1e-6, detector=np.full(40, "b")))
    assert np.min(xy_of(made, "_err") / xy_of(apart, "_err")) < 0.85


def test_without_errors_those_of_the_correction_alone():
    whole, some = (camera(static_sigma=0.05).correct_table(listed(places(9), e), sigma=0.1) for e in (0.03, None))
    assert_allclose(xy_of(whole, "_err") ** 2 - xy_of(some, "_err") ** 2, 0.03**2, rtol=0.05)
    assert_allclose(xy_of(whole, "_err_abs") ** 2 - xy_of(some, "_err_abs") ** 2, 0.03**2, rtol=0.05)


def test_shift_rotation_and_scale_are_of_the_pose():
    widths = np.zeros((2, 10))
    widths[:, 0] = 5.0
    made = camera(static_sigma=widths).correct_table(listed(places(9), 0.03))
    assert_array_equal(xy_of(made, "_err"), xy_of(made, "_err_abs"))


def test_what_is_not_known_has_no_error():
    """By widths and by a covariance: infinite shears are unknown everywhere but in their middle."""
    widths = np.full((2, 10), 0.05)
    widths[:, 1:3] = np.inf
    for known in ({"static_sigma": widths}, {"static_covariance": np.diag(widths.ravel() ** 2)}):
        made = camera(**known).correct_table(listed(places(9), 0.03))
        assert np.isnan(xy_of(made, "_err_abs")).all()
        assert np.isfinite(xy_of(made, "_err")).all()
        assert made.meta["static_error_px"] is None


def test_what_states_no_error_counts_as_exact():
    made = camera().correct_table(listed(places(9), 0.03))
    assert_array_equal(xy_of(made, "_err"), xy_of(made, "_err_abs"))
    assert made.meta["static_error_px"] == made.meta["exposure_scatter_px"] == 0


def test_a_prior_has_the_scatter_of_exposures():
    table = listed(places(9), 0.03)
    widths = np.full((2, 10), 0.1)
    known = ld.Prior(STATIC, shape=SHAPE, sigma=widths, static_sigma=0.05)
    expected = camera(static_sigma=0.05).correct_table(table, sigma=widths)
    made = known.correct_table(table)
    for name in ("x", "y_err", "xy_corr", "x_err_abs"):
        assert_array_equal(made[name], expected[name])


# -- bad lists


def test_off_the_detector():
    """A pixel beyond an edge is rounding, a few are stars at the edge, and more is another detector."""
    camera().correct_table(listed(np.array([[-1.4, 5.0], [1200.4, 900.4]])))
    near = np.array([[1.0, 1.0], [1200.6, 4.0]])
    words = (
        r"1 of 2 positions of the list lie off camera one, 1200 x 900 px: row 1, \(1200.6, 4.0\); the correction is ext"
    )
    with pytest.warns(AssumptionWarning, match=words):
        camera().correct_table(listed(near))
    with pytest.raises(InputError, match=r"3 of 3 .* off camera one, 1200 x 900 px: row 2, \(5.0, 1000.0\); is it the"):
        camera().correct_table(listed(np.array([[-3.0, 1.0], [1200.6, 4.0], [5.0, 1000.0]])))
    with pytest.raises(InputError, match="off camera pair, detector b, 1200 x 900 px"):
        pair().correct_table(listed(np.array([[1400.0, 1.0]]), detector=["b"]))


@pytest.mark.parametrize(
    ("known", "table", "words"),
    [
        (camera(), Table({"x": [1.0], "z": [1.0]}), "lacks the column y; it has x, z"),
        (camera(), Table({"x": [1.0], "y": [1.0], "x_err": [0.1]}), "lacks the column y_err"),
        (camera(), Table({"x": [1.0], "y": [np.nan]}), "y is not finite in 1 of 1 rows"),
        (camera(), 3, "the list must be a table, got int"),
        (camera(), listed(places(2), detector=["a", "b"]), "camera one has no detector 'a'; it has 1"),
        (pair(), listed(places(2), detector=["a", "c"]), "camera pair has no detector 'c'; it has a, b"),
        (pair(), listed(places(2)), r"no column detector, which of a, b .* \(--detector\)"),
        (ld.Camera.of_images([SHAPE]), listed(places(2)), "camera image states no static distortion"),
        (ld.Prior(None, static_sigma=1.0), listed(places(2)), "the prior states no static distortion"),
        (ld.Prior(STATIC), listed(places(2)), "the prior states no shape of its detector"),
    ],
)
def test_bad_lists(known, table, words):
    with pytest.raises(InputError, match=words):
        known.correct_table(table)


def test_a_fold_is_refused():
    folded = ld.Camera("one", {"1": ld.Detector(SHAPE, static=800 * STATIC)})
    with pytest.raises(FoldError):
        folded.correct_table(listed(places(2)))


# -- in the shell


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("lists")
    seen = ld.simulate_matches(
        degree=2, n_exposures=6, rotations=[0, 90] * 3, dither=300.0, sigma=0.01, static=2.0, dynamic=0.1, seed=4
    )
    solution = ld.solve(seen.matches, degree=2)
    solution.write(out / "solution.asdf")
    ld.combine_nights([solution], name="NIRC2").write(out / "camera.asdf")
    pair().write(out / "pair.asdf")
    listed(places(5), 0.02).write(out / "one.ecsv")
    listed(places(4, seed=2)).write(out / "two.ecsv")
    return out


def test_lists_of_a_camera(folder, capsys, tmp_path):
    words = ["correct", str(folder / "camera.asdf"), *(str(folder / f"{name}.ecsv") for name in ("one", "two"))]
    assert main([*words, "--out", str(tmp_path / "out.ecsv")]) == 0
    said = capsys.readouterr().out
    assert said.startswith("9 positions in ")
    assert "without the static distortion of camera NIRC2" in said
    assert "of 1 night, which is known to 0.0" in said
    assert "exposures scatter about it by 0." in said
    made = Table.read(tmp_path / "out.ecsv")
    assert made["exposure"].tolist() == ["one"] * 5 + ["two"] * 4
    nights = ld.CombinedNights.read(folder / "camera.asdf")
    expected = nights.prior(one_exposure=True).correct_table(Table.read(folder / "one.ecsv"))
    for name in ("x", "y", "x_err", "xy_corr", "y_err_abs"):
        assert_allclose(made[name][:5], expected[name].value, rtol=1e-12)
    assert main([*words, "--out", str(tmp_path / "out.csv"), "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["n_positions"] == 9
    assert figures["static_error_px"] == pytest.approx(made.meta["static_error_px"])


def test_a_list_of_one_of_several_detectors(folder, capsys, tmp_path):
    words = ["correct", str(folder / "pair.asdf"), str(folder / "one.ecsv"), "--out", str(tmp_path / "out.ecsv")]
    assert main([*words, "--detector", "b"]) == 0
    assert "camera pair (" in (said := capsys.readouterr().out)
    assert "), written 20" in said
    expected = pair().correct_table(listed(places(5), 0.02, detector=["b"] * 5))
    assert_allclose(Table.read(tmp_path / "out.ecsv")["x"], expected["x"].value)


def ldac(path, **tables):
    """Of a frame with extensions, by their names."""
    images = [{"EXTNAME": name} for name in tables]
    return write_ldac(path, *tables.values(), size=SHAPE[::-1], images=images)


def of_sextractor(xy, error):
    columns = {"XWIN_IMAGE": xy[:, 0] + 1, "YWIN_IMAGE": xy[:, 1] + 1}
    n = len(xy)
    return Table(columns | {"ERRAWIN_IMAGE": [error] * n, "ERRBWIN_IMAGE": [error] * n, "ERRTHETAWIN_IMAGE": [0.0] * n})


def test_lists_name_their_detectors_as_those_of_match(folder, tmp_path, monkeypatch, capsys):
    """An LDAC list of several images, in another order than the camera's; a list that is called as an image."""
    monkeypatch.chdir(tmp_path)
    xy = {"b": places(4, seed=5), "a": places(3, seed=6)}
    ldac("n1.ldac", **{key: of_sextractor(each, 0.02) for key, each in xy.items()})
    listed(xy["b"], 0.02).write("n1-b.ecsv")
    layouts, distortions = {key: pair()[key].layout for key in "ab"}, {"a": STATIC, "b": -STATIC}
    for name, keys in (("n1.ldac", "ba"), ("n1-b.ecsv", "b")):
        assert main(["correct", str(folder / "pair.asdf"), name, "--out", "out.ecsv", "--overwrite"]) == 0
        made = QTable.read("out.ecsv")
        assert made["detector"].tolist() == [key for key in keys for _ in xy[key]]
        for key in keys:
            layout, found = layouts[key], xy_of(made[made["detector"] == key])
            q = found @ layout[:, :2].T + layout[:, 2]
            assert_allclose(distort(q, distortions[key]), xy[key], atol=1e-6)
    assert main(["correct", str(folder / "pair.asdf"), "n1.ldac", "--detector", "a", "--out", "o.ecsv"]) == 1
    assert "n1.ldac: it has tables of 2 images, each a detector: leave --detector out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("pair.asdf one.ecsv", "one.ecsv: the list has no column detector, which of a, b of camera pair"),
        ("pair.asdf one.ecsv --detector c", "camera pair has no detector c; it has a, b"),
        ("gsaoi-2 one.ecsv --detector c", "--detector is for a camera: leave it out"),
        ("camera.asdf one.ecsv --epoch 2020", "--epoch is for a solution: leave it out"),
        ("solution.asdf one.ecsv --detector 1", "--detector is for the lists of a camera: leave it out"),
        (
            "solution.asdf one.ecsv",
            "by legdistort nights SOLUTION --out camera.asdf, then legdistort correct camera.asdf LIST",
        ),
        ("nothing.asdf one.ecsv", "nothing.asdf: no such file"),
        ("camera.asdf nothing.ecsv", "nothing.ecsv: no such file"),
    ],
)
def test_what_is_refused(words, said, folder, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(folder)
    assert main(["correct", *words.split(), "--out", str(tmp_path / "out.ecsv")]) == 1
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_camera_of_several_detectors_corrects_exposures_that_are_not_in_a_solution():
    """The command that writes its file, and the one that corrects, as for one detector."""

    class Solved:
        camera = pair()

        def __getitem__(self, name):
            raise InputError(f"no exposure {name} in the solution")

    words = r"no exposure e9 .*its file by legdistort camera SOLUTION --out camera.asdf, then legdistort correct cam"
    with pytest.raises(InputError, match=words):
        list(new_positions._parts(Solved(), Table({"exposure": ["e9"]})))


# -- one detector of a camera whose focal plane has a map that a reference told


def told(**known):
    common = np.zeros((2, 10))
    common[:, 3:] = np.random.default_rng(7).normal(0, 1.0, (2, 7))
    return pair(common_map=common, common_sigma=np.full((2, 10), 0.02), **known)


def test_a_prior_of_one_detector_has_the_common_map(tmp_path, capsys):
    """Pixels of the detector after one similarity, by numpy, but for products of both maps; the command says so."""
    whole = told()
    whole.write(tmp_path / "told.asdf")
    words = ["prior", str(tmp_path / "told.asdf"), "--ext", "b", "--out", str(tmp_path / "prior.asdf")]
    assert main(words) == 0
    rms = np.sqrt(np.mean(np.sum(whole.common_map**2, axis=1)) / 4)
    assert (
        f"with the map of the focal plane that a reference told ({rms:.3g} px rms per axis)" in capsys.readouterr().out
    )
    prior = ld.Prior.read(tmp_path / "prior.asdf")
    f = (places(300) - TURNED[:, 2]) @ np.linalg.inv(TURNED[:, :2]).T
    there = distort(f, whole.common_map, whole.field) @ whole["b"].layout[:, :2].T + whole["b"].layout[:, 2]
    seen = distort(there, whole["b"].static)
    design = np.stack([f @ [1, 1j], np.ones(len(f))], axis=1)
    without = ld.Prior(whole["b"].static, shape=SHAPE)
    off = [xy_of(each.correct_table(listed(seen))) @ [1, 1j] for each in (prior, without)]
    off = [np.abs(design @ np.linalg.lstsq(design, w, rcond=None)[0] - w).max() for w in off]
    assert off[0] < 0.02
    assert off[1] > 0.5


def test_its_errors_are_those_of_both(tmp_path):
    """The common map stepped by its errors, one mode after the other."""
    whole, free = told(), pair()
    free.write(tmp_path / "free.asdf")
    whole.write(tmp_path / "told.asdf")
    prior, alone = (ld.Prior.from_file(tmp_path / f"{name}.asdf", ext="a") for name in ("told", "free"))
    steps = []
    for axis, mode in np.ndindex(2, 10):
        moved = whole.common_map.copy()
        moved[axis, mode] += 0.02
        other = ld.Camera("pair", whole.detectors, field=whole.field, common_map=moved, common_sigma=whole.common_sigma)
        other.write(tmp_path / "moved.asdf", overwrite=True)
        steps.append((ld.Prior.from_file(tmp_path / "moved.asdf", ext="a").mean - prior.mean)[:, 3:].ravel())
    expected = np.sum(np.square(steps), axis=0) + alone.static_sigma[:, 3:].ravel() ** 2
    assert_allclose(prior.static_sigma[:, 3:].ravel(), np.sqrt(expected), rtol=0.02)
