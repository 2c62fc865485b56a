"""Headers that have one detector of a camera elsewhere than it lies: it is named, and has no part in the sky."""

import json
import re
import warnings
from dataclasses import replace

import header_layouts
import numpy as np
import pytest

import legdistort as ld
from legdistort.cameras import header_layout
from legdistort.exceptions import AssumptionWarning, FoldError, LegdistortWarning, SolveError
from legdistort.reporting.summary import summarise
from legdistort.solving import camera_fit
from legdistort.solving.checks import solution_checks

SIZE, STEP = 640, 680
ODD = 35.0, -28.0, 0.8


def turned(degrees, scale=1.0):
    angle = np.radians(degrees)
    return scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def place(middle, degrees):
    """Plane -> pixels of a detector whose middle lies there, and which is turned."""
    return np.column_stack([turned(degrees), np.full(2, (SIZE - 1) / 2) - turned(degrees) @ middle])


def camera(n_x, n_y, wrong, *, plane=None, known=True):
    """Detectors in a grid; headers have them `wrong` (n, 3) by x, y [pix] and degrees, in a plane that is `plane`."""
    middles = [np.array([i, j]) * STEP for i in range(n_x) for j in range(n_y)]
    plane = np.eye(2, 3) if plane is None else plane  # focal plane -> plane of the headers
    back = np.linalg.inv(plane[:, :2])
    detectors = {}
    for k, (middle, (dx, dy, angle)) in enumerate(zip(middles, wrong, strict=True)):
        stated = place(middle + [dx, dy], angle)
        linear = stated[:, :2] @ back
        stated = np.column_stack([linear, stated[:, 2] - linear @ plane[:, 2]])
        sigma = None if known else np.inf
        detectors[f"{k}"] = ld.Detector(
            (SIZE, SIZE), layout=place(middle, 0.0), header_layout=stated, layout_sigma=sigma
        )
    return ld.Camera("grid", detectors)


@pytest.mark.parametrize("parity", [1, -1])
def test_the_odd_one_is_found_and_measured_by_the_others(parity):
    wrong = np.zeros((4, 3))
    wrong[2] = ODD
    plane = np.column_stack([turned(31.0, 2e-4) @ np.diag([1, parity]), [3.0, -2.0]])
    headers = camera(2, 2, wrong, plane=plane).headers
    assert headers.odd == ("2",)
    np.testing.assert_allclose(headers.shifts, wrong[:, :2], atol=1e-6)
    np.testing.assert_allclose(headers.rotations, wrong[:, 2], atol=1e-6)
    words = r"detector 2 45 px \(\+35 in x, -28 in y of the focal plane \+- \S+, turned by 0.80 \+- \S+ deg\)"
    assert re.search(words, headers.sentence("the stars put it"))


@pytest.mark.parametrize(("n_x", "n_y"), [(2, 2), pytest.param(3, 3, marks=pytest.mark.slow)])
def test_errors_of_how_far_it_is_off_are_those_of_drawn_headers(n_x, n_y):
    """Variances of what is stated, over those of what others have wrong, drawn at 1 px and 0.05 degrees."""
    rng, off, stated = np.random.default_rng(5), [], []
    for _ in range(60):
        wrong = rng.normal(0, [1.0, 1.0, 0.05], (n_x * n_y, 3))
        wrong[2] += np.multiply(ODD, 10)
        headers = camera(n_x, n_y, wrong).headers
        assert "2" in headers.odd
        k = headers.names.index("2")
        off.append([*(headers.shifts[k] - np.multiply(ODD, 10)[:2]), headers.rotations[k] - 10 * ODD[2]])
        stated.append(headers.errors[k])
    off, stated = np.square(off).mean(axis=0), np.square(stated).mean(axis=0)
    assert off[:2].mean() / stated[0] == pytest.approx(1, abs=0.4)
    assert off[2] / stated[1] == pytest.approx(1, abs=0.4)
    assert np.isnan(camera(3, 1, [(0, 0, 0), (0, 0, 0), ODD]).headers.errors).all()


def spoilt(made, key, matrix):
    """The camera with the header of a detector as if its pixels were first multiplied by `matrix` about the middle."""
    layout, middle = made[key].header_layout, np.full(2, (SIZE - 1) / 2)
    back = np.linalg.inv(matrix)
    wrong = np.column_stack([back @ layout[:, :2], back @ (layout[:, 2] - middle) + middle])
    return replace(made, detectors={**made.detectors, key: replace(made[key], header_layout=wrong)})


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (1.02 * np.eye(2), r"turned by -?0.0\d \+- \S+ deg, its pixels 1.020 times as large as they are"),
        (np.diag([-1, 1]), "mirrored, x reversed"),
        (np.diag([1, -1]), "mirrored, y reversed"),
        (np.array([[0, 1], [1, 0]]), "mirrored, x and y exchanged"),
        (-np.eye(2), r"turned by -?1(?:80.0|79.9)\d \+- \S+ deg"),
        (1.2 * turned(-10.0), r"turned by 10.0\d \+- \S+ deg, its pixels 1.200 times as large as they are"),
    ],
    ids=["2 %", "x", "y", "xy", "180", "20 % and 10 deg"],
)
def test_what_is_wrong_of_a_header_is_told(matrix, words):
    """The others agree to a pixel and 0.02 degrees."""
    wrong = np.random.default_rng(3).normal(0, [0.5, 0.5, 0.01], (4, 3))
    headers = spoilt(camera(2, 2, wrong), "2", matrix).headers
    assert headers.odd == ("2",)
    assert re.search(rf"detector 2 \d px \(.*{words}\) from where the stars", headers.sentence("the stars put it"))
    np.testing.assert_allclose(headers.shifts, wrong[:, :2] - wrong[[0, 1, 3], :2].mean(axis=0), atol=1.0)


def test_scales_that_differ_all_over_the_field_contradict_nothing():
    """Those of one chip by 1 %, of two others by half of it: a distortion that headers do not have."""
    made = camera(2, 2, np.zeros((4, 3)))
    for key, scale in (("1", 1.005), ("2", 1.005), ("3", 1.01)):
        made = spoilt(made, key, scale * np.eye(2))
    assert made.headers.odd == ()


def spread(layout, factor):
    """The layout with pixels of another size, about the middle of its detector."""
    middle = np.full(2, (SIZE - 1) / 2)
    return np.column_stack([factor * layout[:, :2], factor * (layout[:, 2] - middle) + middle])


def stated(scales):
    """Detectors in a row where headers have them, with pixels of these sizes."""
    made = {}
    for k, scale in enumerate(scales):
        layout = np.column_stack([np.eye(2), np.full(2, (SIZE - 1) / 2) - [k * STEP, 0]])
        made[f"{k}"] = ld.Detector((SIZE, SIZE), layout=spread(layout, 1 / scale), layout_sigma=np.inf)
    return made


@pytest.mark.parametrize(
    ("scales", "odd"),
    [
        ((1, 1.02, 1, 1), {"1": 1.02}),
        ((1, 1, 0.985), {"2": 0.985}),
        ((1.006, 0.995, 1.02, 1), {}),  # a distortion of the field, perhaps
        ((1, 1.05, 1, 1), {}),  # dithers tell that
        ((1, 1.02), {}),
        ((1, 1, 1.02, 1.02), {}),
    ],
)
def test_pixels_of_another_size_are_those_of_the_others_to_begin_with(scales, odd):
    """About the middle of the detector, which stays where the header has it."""
    before = stated(scales)
    after, found = header_layout.with_usual_scales(before)
    assert found == pytest.approx(odd)
    middle = np.full((1, 2), (SIZE - 1) / 2)
    for key, each in after.items():
        np.testing.assert_allclose(each.to_focal_plane(middle), before[key].to_focal_plane(middle), atol=1e-9)
        size = np.sqrt(np.linalg.det(each.layout[:, :2]) / np.linalg.det(before[key].layout[:, :2]))
        assert size == pytest.approx(odd.get(key, 1))


@pytest.mark.slow
def test_one_header_of_pixels_of_another_size_has_no_part_in_the_scale_of_the_sky():
    """By 2 %: the scale was 0.31 % off, with no word on it, since a bend of all detectors together hides which is."""
    night = header_layouts.Night(3, off=0.5, n=7, n_stars=260, own=0.3, static=0.3, rolls=(0, 0, 0, 30, 90))
    for each in night.exposures:
        if each.detector == "3":
            middle, wcs = np.full((1, 2), (header_layouts.SIZE - 1) / 2), each.wcs
            wcs.wcs.crpix = middle[0] + 1 + (wcs.wcs.crpix - middle[0] - 1) / 1.02
            wcs.wcs.cd = wcs.wcs.cd * 1.02
    with pytest.warns(AssumptionWarning, match=r"detector 3 1.020 times as large as .*--layout-sigma of solve"):
        matches = ld.match(night.table, exposures=night.exposures)
    solution = ld.solve(matches, static="fit")
    right = night.sky[night.true_stars(solution)] * [-1, 1] * header_layouts.ARCSEC / 3600
    found = np.column_stack([solution.stars["ra"].value * np.cos(np.radians(-20.0)), solution.stars["dec"].value])
    z, w = ((each - each.mean(axis=0)) @ [1, 1j] for each in (right, found))
    assert abs(np.vdot(z, w) / np.vdot(z, z)) == pytest.approx(1, abs=1.5e-3)
    told = float(re.search(r"error of its scale, which is ([\d.e-]+) of it at\s+least", str(solution))[1])
    assert np.radians(0.01) < told < 3e-3


@pytest.mark.parametrize(
    ("matrix", "words"),
    [(1.03 * np.eye(2), "pixels of the one 1.030 times as large"), (np.diag([1, -1]), "the one mirrored against")],
)
def test_of_two_nobody_can_say_which_has_its_pixels_wrong(matrix, words):
    headers = spoilt(camera(2, 1, np.zeros((2, 3))), "1", matrix).headers
    assert headers.is_undecided
    assert words in headers.sentence("the stars have them")


def test_two_odd_ones_of_nine():
    wrong = np.random.default_rng(1).normal(0, [1, 1, 0.1], (9, 3))
    wrong[[3, 7], 0] += 40.0
    assert camera(3, 3, wrong).headers.odd == ("3", "7")


def test_of_two_nobody_can_say_which_is_wrong():
    headers = camera(2, 1, [(0, 0, 0), (45, 0, 0)]).headers
    assert headers.odd == ()
    assert headers.is_undecided
    assert headers.scatter == pytest.approx(45, abs=1e-6)
    assert "headers of detectors 0 and 1 have these 45 px otherwise" in headers.sentence("the stars have them")
    assert not camera(2, 1, [(0, 0, 0), (10, 0, 0)]).headers.is_undecided


def test_a_layout_that_is_not_known_contradicts_nothing():
    assert camera(2, 2, [(0, 0, 0), (0, 0, 0), ODD, (0, 0, 0)], known=False).headers.odd == ()
    assert ld.Camera.gsaoi().headers is None


@pytest.mark.parametrize(("n_x", "n_y"), [(3, 1), (2, 2), pytest.param(3, 3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("n_sets", [15, pytest.param(150, marks=pytest.mark.sets)])
def test_headers_that_are_all_alike_wrong_have_no_odd_one(n_x, n_y, n_sets):
    rng = np.random.default_rng(2)
    odd = [camera(n_x, n_y, rng.normal(0, [5, 5, 0], (n_x * n_y, 3))).headers.odd for _ in range(n_sets)]
    assert sum(map(bool, odd)) <= 0.04 * n_sets + 1


@pytest.fixture(scope="module")
def night():
    return header_layouts.Night(3, off=1.0, n=7, n_stars=250, odd=ODD)


@pytest.fixture(scope="module")
def matches(night):
    return ld.match(night.table, exposures=night.exposures)


def sky_error(night, solution):
    """Mean distance [pix] of the stars on the sky from where right headers have them, those of exposures averaged."""
    xi, eta = (night.sky[night.true_stars(solution)] - header_layouts.MIDDLE).T * header_layouts.ARCSEC / 3600
    off_x = (solution.stars["ra"].value - 150.0) * np.cos(np.radians(-20.0)) + xi
    off_y = solution.stars["dec"].value + 20.0 - eta
    return np.hypot(np.mean(off_x), np.mean(off_y)) * 3600 / header_layouts.ARCSEC


OPTIONS = {}, {"static": "fit"}, {"layout_sigma": {"shift": 2.0, "rotation": 0.2}}


@pytest.mark.parametrize(
    "options",
    [pytest.param(each, marks=pytest.mark.sets if k % 2 else pytest.mark.slow) for k, each in enumerate(OPTIONS)],
    ids=str,
)
def test_it_has_no_vote_on_the_sky_whatever_is_fitted(night, matches, options):
    """A quarter of 45 px otherwise; the headers of seven exposures are 3 px off, each."""
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = ld.solve(matches, **options)
        assert sky_error(night, solution) < 4.0
        check = next(check for check in solution.checks if check.name == "camera")
        assert check.state in ("warn", "fail")
        assert "the headers have detector 3 " in check.sentence
        assert check.value == pytest.approx(45, abs=6) or check.state == "fail"
        printed = str(solution)
        figures = {each["name"]: each for each in json.loads(json.dumps(summarise(solution)))["detectors"]}
    assert "from the headers of all detectors but 3" in printed
    assert figures["3"]["header_x_off_px"] == pytest.approx(ODD[0], abs=8)
    assert figures["3"]["header_turned_deg"] == pytest.approx(ODD[2], abs=0.3)
    assert np.hypot(figures["1"]["header_x_off_px"], figures["1"]["header_y_off_px"]) < 8


@pytest.mark.slow
def test_it_has_none_where_detectors_are_taken_one_by_one(night, matches):
    """With its vote the sky was 12 px off, its scale by 0.35 %: every detector has poses of its own."""
    with pytest.warns(AssumptionWarning, match=r"headers have detector 3 4\d px \(.* agree to .* by those that agree"):
        solution = ld.solve(matches, dynamic="detector")
    assert sky_error(night, solution) < 4.0
    right = night.sky[night.true_stars(solution)] * [-1, 1] * header_layouts.ARCSEC / 3600
    found = np.column_stack([solution.stars["ra"].value * np.cos(np.radians(-20.0)), solution.stars["dec"].value])
    z, w = ((each - each.mean(axis=0)) @ [1, 1j] for each in (right, found))
    factor = np.vdot(z, w) / np.vdot(z, z)
    assert abs(factor) == pytest.approx(1, abs=3e-3)
    assert np.degrees(np.angle(factor)) == pytest.approx(0, abs=0.1)


@pytest.mark.slow
def test_it_has_none_where_the_camera_is_given(night, tmp_path):
    """As exact: the headers of the frames are compared with it, and stay with the solution through its file."""
    places = zip(header_layouts.KEYS, night.places, strict=True)
    shape = header_layouts.SIZE, header_layouts.SIZE
    exact = ld.Camera("four", {key: ld.Detector(shape, layout=layout) for key, layout in places})
    solution = ld.solve(ld.match(night.table, exposures=night.exposures, camera=exact))
    assert sky_error(night, solution) < 4.0
    check = next(check for check in solution.checks if check.name == "camera")
    assert check.state == "warn"
    assert "from where camera four has it, which was given" in check.sentence
    pointing = replace(solution.diagnostics.pointing, detectors={"3": 45.0})
    both = replace(solution, diagnostics=replace(solution.diagnostics, pointing=pointing))
    beside = solution_checks.pointing_check(both, check).sentence
    assert "how headers have the detectors to each other with how the given layouts have them, this one where" in beside
    assert beside.endswith("of the first --layout fit tells, of the sky nothing but a reference tells (--reference)")
    assert "check camera" not in solution_checks.pointing_check(both, replace(check, state="pass")).sentence
    again = ld.Solution.read(solution.write(tmp_path / "solution.asdf"))
    assert again.camera.headers.odd == ("3",)


def test_right_headers_pass():
    night = header_layouts.Night(3, off=1.0, n=7, n_stars=250)
    solution = ld.solve(ld.match(night.table, exposures=night.exposures))
    check = next(check for check in solution.checks if check.name == "camera")
    assert check.state == "pass"
    assert solution.camera.headers.odd == ()
    assert replace(solution.camera["3"], header_layout=None).header_layout is None


def test_a_layout_that_is_held_and_wrong_is_the_cause(matches):
    """The detector and by how much; with the option that finds it, and no other cure anywhere."""
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        solution = ld.solve(matches, layout="hold")
    checks = {check.name: check for check in solution.checks}
    assert checks["camera"].state == "fail"
    assert "stars contradict it: detector 3 lies" in checks["camera"].sentence
    assert checks["camera"].value == pytest.approx(np.hypot(*ODD[:2]), abs=5)
    assert checks["camera"].cure == "--layout fit instead of --layout hold"
    wrong = [check for check in solution.checks if check.state in ("warn", "fail") and check.name != "camera"]
    assert wrong
    assert {check.cure for check in wrong} == {"see camera first, which is the cause"}


@pytest.mark.parametrize("seed", [40, pytest.param(61, marks=pytest.mark.sets)])
@pytest.mark.parametrize("odd", [(22.0, -24.0, 0.0), pytest.param((0.0, 0.0, 0.0), marks=pytest.mark.slow)])
def test_a_star_or_two_show_it(seed, odd):
    """If all that cross are far off; and what is held, or stated, is then not named as a cure of the few ties."""
    night = header_layouts.Night(seed, off=0.1, dither=36.0, n=6, n_stars=260, odd=odd, size=0.05)
    table = night.table.copy()
    table.rename_column("true", "star")
    star, detector = np.asarray(table["star"]), np.asarray(table["detector"])
    crossing = [s for s in np.unique(star) if "3" in set(detector[star == s]) and len(set(detector[star == s])) > 1]
    table = table[(np.bincount(star)[star] > 1) & ~np.isin(star, crossing[1:])]
    matches = ld.Matches.from_table(table, camera=ld.Camera.of_frames(night.exposures))
    with warnings.catch_warnings(action="ignore", category=LegdistortWarning):
        held, found = ({c.name: c for c in ld.solve(matches, layout=how).checks}["camera"] for how in ("hold", "fit"))
    assert (held.state == "fail") == any(odd)
    assert ("--layout fit instead of --layout hold" in held.cure) == any(odd)
    assert held.value == (pytest.approx(np.hypot(*odd[:2]), abs=2) if any(odd) else None)
    assert "(--reference)" in found.cure
    assert ("--layout hold" not in found.cure) == any(odd)


@pytest.mark.slow
def test_static_distortions_cannot_make_up_for_it(matches, monkeypatch):
    """Where they fold in the attempt, it is said what they could not make up for."""
    in_camera, calls = camera_fit.in_camera, []

    def folds_at_first(*given):
        calls.append(given)
        if len(calls) == 1:
            raise FoldError("the distortion cannot be inverted; too few stars there?")
        return in_camera(*given)

    monkeypatch.setattr(camera_fit, "in_camera", folds_at_first)
    words = r"cannot be inverted\): .*detector 3 lies 4\d px from where it has it; give layout='fit' \(--layout fit\)"
    with pytest.raises(SolveError, match=words):
        ld.solve(matches, layout="hold", static="fit")
