"""Differences of distortion maps and of nights; maps, nights and their truth are made by numpy alone."""

import json
from dataclasses import replace

import four_detectors
import gwcs
import numpy as np
import pytest
from astropy import coordinates as coord
from astropy.io import fits
from astropy.modeling.models import (
    AffineTransformation2D,
    Identity,
    Legendre2D,
    Mapping,
    Pix2Sky_TAN,
    Polynomial2D,
    RotateNative2Celestial,
    Scale,
    Shift,
)
from astropy.table import Table
from gwcs import coordinate_frames as cf
from matplotlib import pyplot
from matplotlib.quiver import QuiverKey
from night_sets import SIZE, Nights, field
from numpy.testing import assert_allclose
from rolled_night import modes, night

import legdistort as ld
from legdistort.cli import main
from legdistort.exceptions import InputError

SHAPE = (SIZE, SIZE)


def static(seed):
    return field(np.random.default_rng(1000 + seed), 1.5)


def solved(seed, of=None, **how):
    """A night of a detector whose map is that of the seed, or another."""
    known = {key: how.pop(key) for key in ("prior", "static") if key in how}
    table = night(seed, static(seed) if of is None else of, **how)
    return ld.solve(ld.Matches.from_table(table, shape=SHAPE), degree=3, **known)


def old(seed, **widths):
    return ld.Prior(modes(static(seed)), shape=SHAPE, **widths)


def test_a_map_does_not_differ_from_itself():
    prior = old(1, static_sigma=0.01)
    same = ld.difference(prior, prior)
    assert same.rms == same.chi2 == 0
    assert same.p == 1
    assert same.dof == 16
    assert same.agrees
    assert "is still right" in same.sentence
    nothing = ld.difference(old(1), old(1))
    assert nothing.agrees is None
    assert "neither states an error" in nothing.sentence
    assert np.isnan(nothing.modes["error"]).all()


def test_arrows_of_nothing_do_not_look_like_something():
    """Digits that a file rounds were drawn as arrows of a twentieth of the detector."""
    prior = old(1)
    ax = ld.difference(prior, ld.Prior(prior.mean * (1 + 1e-9), shape=SHAPE)).plot()
    assert "arrows x 10000" in ax.get_title(loc="left")
    (arrows,) = ax.collections
    assert np.hypot(arrows.U, arrows.V).max() < 1e-3 * SIZE
    pyplot.close(ax.figure)


def test_modes_that_do_not_differ_are_counted_and_not_listed():
    prior = old(1, static_sigma=0.01)
    mean = prior.mean.copy()
    mean[0, 4] += 0.02
    mean[1, 6] += 3e-5
    lines = str(ld.difference(prior, ld.Prior(mean, static_sigma=0.01, shape=SHAPE))).splitlines()
    listed = [line.split()[1:5] for line in lines if line.startswith("1 ")]
    assert ["x", "L1(x)", "L1(y)", "0.0201"] in listed
    assert all(abs(float(each[3])) >= 1e-4 for each in listed)
    n = 18 - len(listed)  # of 10 modes an axis, without shifts
    assert 10 < n < 18
    assert lines[-1] == f"{n} others differ by no more than 0.00005 px, and by no more than 1 sigma"
    assert str(ld.difference(prior, prior)).splitlines()[-2:] == [
        "Difference: coefficients of the second map less those of the first, undistorted to detector pixels.",
        "18 modes differ by no more than 0.00005 px, and by no more than 1 sigma",
    ]


def test_the_sign_and_the_length_of_arrows_are_stated():
    """Second minus first; one arrow has a round length that is written beside it, in the scale of the others."""
    prior = old(1)
    found = ld.difference(prior, ld.Prior(prior.mean * 1.5, shape=SHAPE))
    assert_allclose(found.coefficients["1"][:, 3:], 0.5 * prior.mean[:, 3:], atol=0.02)
    assert "coefficients of the second map less those of the first" in str(found)
    assert "px rms per axis" in found.sentence
    ax = found.plot()
    assert "second minus first" in ax.get_title(loc="left")
    (arrows,), (key,) = ax.collections, [each for each in ax.get_children() if isinstance(each, QuiverKey)]
    scale = float(ax.get_title(loc="left").rpartition("arrows x ")[2].split()[0])
    length, unit = key.text.get_text().split()
    assert unit == "px"
    assert scale * float(length) == pytest.approx(key.U)
    assert 0.4 * np.hypot(arrows.U, arrows.V).max() < key.U <= np.hypot(arrows.U, arrows.V).max()
    pyplot.close(ax.figure)


def test_a_night_does_not_differ_from_itself():
    solution = solved(2)
    same = ld.difference(solution, solution)
    assert same.rms < 1e-6
    assert same.shared == solution.names
    assert same.agrees is None


def test_a_bend_is_found_with_its_stated_error():
    extra = np.zeros((2, 10))
    extra[0, 4], extra[1, 7] = 0.1, -0.06  # L1(x) L1(y) along x, L2(x) L1(y) along y
    bent = ld.Prior(modes(static(3)) + extra, shape=SHAPE, static_sigma=0.01)
    found = ld.difference(old(3, static_sigma=0.01), bent)
    assert_allclose(
        found.coefficients["1"][:, 3:], extra[:, 3:], atol=2e-3
    )  # less a similarity of 1.5 px times its slope
    assert_allclose(found.errors["1"][:, 3:], 0.01 * np.sqrt(2), rtol=1e-9)
    assert_allclose(found.chi2, (0.1**2 + 0.06**2) / 0.02**2 * 2, rtol=0.05)
    assert found.agrees is False
    assert "mostly in L1(x) L1(y) along x (+0.1 +- 0.014 px a coefficient)" in found.sentence


@pytest.mark.parametrize("shape", [(512, 700), (700, 512)])
def test_shift_turn_scale_and_parity_do_not_matter(shape):
    """A map that ends in a plane of its own: mirrored, turned by 70 degrees, in units of 0.03 px."""
    coefficients = modes(static(4) / 3)
    ny, nx = shape

    def other(x, y):
        q = x + 1j * y
        for _ in range(20):
            u, v = (2 * q.real + 1) / nx - 1, (2 * q.imag + 1) / ny - 1
            shift = [sum(c * p for c, p in zip(row, plain(u, v), strict=True)) for row in coefficients]
            q = x - shift[0] + 1j * (y - shift[1])
        w = 30 * np.exp(1.2j) * q.conj()
        return w.real + 77, w.imag - 5

    def plain(u, v):
        norm = np.sqrt((2 * np.arange(4) + 1) / 2)
        eye = [np.polynomial.legendre.Legendre.basis(k) for k in range(4)]
        return [norm[d - k] * norm[k] * eye[d - k](u) * eye[k](v) for d in range(4) for k in range(d + 1)]

    made = ld.Prior.from_model(other, shape=shape, direction="detector_to_reference", degree=3)
    found = ld.difference(ld.Prior(coefficients, shape=shape, static_sigma=0.01), made)
    assert found.rms < 1e-3
    assert found.agrees


@pytest.mark.parametrize(
    "known",
    ["nothing", pytest.param("old", marks=pytest.mark.slow), pytest.param("wrong", marks=pytest.mark.slow), "fit"],
)
def test_what_a_night_was_solved_with_does_not_count(known):
    how = {"nothing": {}, "old": {"prior": old(5)}, "wrong": {"prior": ld.Prior(1.3 * modes(static(5)))},
           "fit": {"static": "fit"}}[known]  # fmt: skip
    right, off = ld.difference(old(5), solved(5, **how)), static(5)
    assert right.agrees
    assert right.rms < 0.01
    assert (right.dof, right.n_undetermined) == (16, 0)
    off[0, 1, 2] += 0.05
    wrong = ld.difference(old(5), solved(5, of=off, **how))
    assert wrong.agrees is False
    assert wrong.sigmas > 5
    assert "mostly in L1(x) L2(y) along x" in wrong.sentence
    error = wrong.errors["1"][0, 8]
    assert abs(wrong.coefficients["1"][0, 8] - modes(off - static(5))[0, 8]) < 4 * error


def test_undetermined_directions_do_not_count():
    """Without rolls nothing tells z^2 and i z^2 of the detector from those of the sky."""
    off = static(6)
    square = np.zeros((2, 4, 4))  # z^2: x^2 - y^2 and 2 x y
    square[0, 2, 0], square[0, 0, 2], square[1, 1, 1] = 2 / 3, -2 / 3, 2.0
    solution = solved(6, of=off + 0.3 * square, turns=(0,))
    found = ld.difference(old(6), solution)
    assert found.n_undetermined >= 2
    assert found.agrees
    assert f"{found.n_undetermined} directions (shear, degree 2) are not determined and do not count" in found.sentence
    turned = ld.difference(old(6), solved(6, of=off + 0.3 * square))
    assert turned.agrees is False


def test_detectors_of_cameras_are_compared_one_by_one():
    def camera(name, extra=0.0, sigma=0.01):
        left, right = modes(static(7)), modes(static(8))
        left[:, :3] = right[:, :3] = 0
        right[1, 5] += extra
        beside = np.array([[1.0, 0, -1100], [0, 1, 0]])
        chips = {"a": ld.Detector(SHAPE, static=left, static_sigma=sigma),
                 "b": ld.Detector(SHAPE, layout=beside, static=right, static_sigma=sigma)}  # fmt: skip
        return ld.Camera(name, chips)

    assert ld.difference(camera("one"), camera("two")).agrees
    found = ld.difference(camera("one"), camera("two", extra=0.2))
    assert found.agrees is False
    assert found.labels == ("one", "two")
    assert "L0(x) L2(y) along y of detector b (+0.2 +- 0.014" in found.sentence
    with pytest.raises(
        InputError, match=r"camera one has detectors a, b, .* has 1: compare maps of the same detectors"
    ):
        ld.difference(camera("camera one"), old(7))


def test_maps_of_other_kinds_and_of_other_detectors():
    box = {"x_domain": (-0.5, 99.5), "y_domain": (-0.5, 79.5)}
    series = Legendre2D(2, 2, c2_0=0.2, **box) & Legendre2D(2, 2, c1_1=0.1, **box)
    model = Identity(2) + (Mapping((0, 1, 0, 1)) | series)
    prior = ld.Prior.from_model(model, shape=(80, 100), direction="reference_to_detector", static_sigma=0.01)
    assert ld.difference(prior, ld.Prior.from_model(model, shape=(80, 100), direction="reference_to_detector")).agrees
    with pytest.raises(InputError, match="does not state what it does: give direction"):
        ld.difference(prior, model)
    with pytest.raises(InputError, match=r"is for \(80, 100\) \(ny, nx\), .* for \(1024, 1024\)"):
        ld.difference(prior, old(1))
    with pytest.raises(InputError, match=r"neither .* states the shape of its detector: give Prior"):
        ld.difference(ld.Prior(np.zeros((2, 6))), ld.Prior(np.zeros((2, 6))))
    with pytest.raises(InputError, match="the second map states only the size of a distortion"):
        ld.difference(prior, ld.Prior(None, static_sigma=1.0))


@pytest.mark.slow
def test_the_command_compares_files(tmp_path, capsys):
    solution = solved(9)
    solution.write(tmp_path / "night.asdf")
    old(9).write(tmp_path / "old.asdf")
    old(10).write(tmp_path / "other.asdf")
    ld.Camera("chip", {"1": ld.Detector(SHAPE, static=old(9))}).write(tmp_path / "camera.asdf")
    for name in ("old", "camera"):
        assert main(["difference", str(tmp_path / f"{name}.asdf"), str(tmp_path / "night.asdf"), "--strict"]) == 0
        assert f"{name}.asdf is still right: " in capsys.readouterr().out
    line = ["difference", str(tmp_path / "other.asdf"), str(tmp_path / "night.asdf"), "--json", "--strict"]
    assert main([*line, "--plot", str(tmp_path / "d.png")]) == 3
    figures = json.loads(capsys.readouterr().out)
    assert figures["agrees"] is False
    assert figures["rms_px"] > 0.5
    assert len(figures["modes"]) == 18
    assert (tmp_path / "d.png").stat().st_size > 10_000


def four(seed, extra=0.0):
    """The camera of `four_detectors.matches("static", seed)` as it is, with x y of detector 1 off by some pixels."""
    rng, norm = np.random.default_rng(seed), np.sqrt((2 * np.arange(3) + 1) / 2)
    rng.uniform(size=(160, 2)), rng.normal(size=4), rng.normal(size=(4, 2))
    bends, chips = rng.normal(size=(4, 2, 3)), {}
    for k, bent in enumerate(bends):  # by x^2, x y and y^2: x^2 is 2/3 P_2 + 1/3
        plain = np.zeros((2, 6))
        plain[:, 3:] = bent * [2 / 3 / (norm[2] * norm[0]), 1 / norm[1] ** 2, 2 / 3 / (norm[2] * norm[0])]
        plain[0, 4] += extra * (k == 1)
        corner = np.array([k % 2, k // 2]) * (four_detectors.SIZE + four_detectors.GAP)
        layout = np.column_stack([np.eye(2), -corner])
        chips[str(k)] = ld.Detector((four_detectors.SIZE,) * 2, layout=layout, static=plain)
    return ld.Camera("as made", chips)


@pytest.mark.slow
def test_a_night_of_a_camera_is_compared_detector_by_detector():
    matches = four_detectors.matches("static", 1)
    night = ld.solve(matches, static="fit", layout="fit", degree=2)
    right, wrong = ld.difference(four(1), night), ld.difference(four(1, extra=0.2), night)
    assert right.agrees
    assert right.n_undetermined == 9  # of a common map of the plane, shear and quadratic, and how it changes the scale
    assert right.undetermined == ("shear",)
    ax = right.plot()
    assert "9 directions are not determined, and not drawn" in ax.get_title(loc="left")
    pyplot.close(ax.figure)
    assert 0.002 < right.rms < 0.02
    assert wrong.sigmas > 8
    assert "mostly in L1(x) L1(y) along x of detector 1 (-0.1" in wrong.sentence
    with pytest.raises(InputError, match=r"static distortions of camera FOUR as given, .* solve it with static='fit'"):
        ld.difference(four(1), ld.solve(four_detectors.matches("layout", 1), layout="fit", degree=2))


def tied(seed, error=0.05):
    """A night of the camera of `four`, tied to the truth of 40 stars with errors."""
    rng, extent = np.random.default_rng(seed), 2 * (four_detectors.SIZE + four_detectors.GAP)
    stars, noise = rng.uniform(-400, extent + 340, (160, 2)), np.random.default_rng(1000 + seed)
    rows = noise.choice(160, 40, replace=False)
    xy = stars[rows] + error * noise.normal(size=(40, 2))
    known = Table(
        {"star": rows.astype(str), "x": xy[:, 0], "y": xy[:, 1], "x_err": 40 * [error], "y_err": 40 * [error]}
    )
    matches = four_detectors.matches("static", seed, n=6, n_stars=160)
    return ld.solve(matches, static="fit", layout="fit", degree=2, reference=known)


@pytest.mark.slow
def test_what_a_reference_tells_of_a_camera_counts():
    """What all detectors share, exposures can take over: a shear and a quadratic map, with a reference all is told."""
    night = tied(2)
    bent = four(2)
    for key, chip in bent.detectors.items():
        more = chip.static.copy()
        more[0, 3] += 0.15
        bent.detectors[key] = ld.Detector(chip.shape, layout=chip.layout, static=more)
    right, wrong = ld.difference(four(2), night), ld.difference(ld.Camera("bent", bent.detectors), night)
    assert right.n_undetermined == 0
    assert right.agrees
    assert wrong.rms == pytest.approx(0.15 / np.sqrt(8), rel=0.25)
    assert wrong.sigmas > 5


@pytest.mark.slow
def test_the_camera_of_a_night_is_that_night_in_a_file_too(tmp_path):
    """A map that all detectors share is with the exposures; the camera that a reference tied states it too."""
    night = tied(2)
    night.write(tmp_path / "night.asdf")
    night.camera.write(tmp_path / "camera.asdf")
    assert np.abs(night.coefficients.mean(axis=0)[:, 3:]).max() > 0.02
    paths = [tmp_path / "camera.asdf", tmp_path / "night.asdf"]
    for pair in (paths, paths[::-1]):
        found = ld.difference(*pair)
        assert found.agrees
        assert found.rms < 1e-7
        assert found.n_undetermined == 0
    chips = dict(night.camera.detectors)
    chips["1"] = replace(chips["1"], static=chips["1"].static + np.eye(2, 6, 3) * 0.2)
    assert ld.difference(replace(night.camera, detectors=chips), night).sigmas > 8


@pytest.mark.slow
def test_modes_that_a_night_was_given_and_did_not_fit_do_not_count():
    matches, chips = four_detectors.matches("static", 1), {}
    for key, chip in matches.camera.detectors.items():
        chips[key] = ld.Detector(chip.shape, layout=chip.layout, static=np.zeros((2, 15)))
    camera = ld.Camera("of degree 4", chips, matches.camera.field)
    night = ld.solve(
        ld.Matches.from_table(matches.camera.on_detectors(matches.table), camera=camera, poses=matches.poses),
        static="fit", layout="fit", degree=2,
    )  # fmt: skip
    found = ld.difference(four(1), night)
    assert found.coefficients["0"].shape == (2, 6)
    assert found.agrees


def test_a_header_that_states_no_size_has_that_of_the_other_map(tmp_path):
    """Whichever comes first, as a text ``.head`` has none."""
    header = fits.Header({"CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "CRVAL1": 10.0, "CRVAL2": -30.0})
    header.update({"CRPIX1": 256.5, "CRPIX2": 256.5, "CD1_1": -1e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-5})
    header.update({"PV1_1": 1.0, "PV1_4": 0.5, "PV2_1": 1.0})
    path = tmp_path / "night.head"
    path.write_text(header.tostring(sep="\n", endcard=True, padding=False) + "\n")
    known = ld.Prior.from_file(path, shape=(512, 512))
    for pair in ((known, path), (path, known)):
        found = ld.difference(*pair)
        assert found.rms < 1e-9
        assert set(found.shapes.values()) == {(512, 512)}
    assert main(["difference", str(path), str(path)]) == 1
    with pytest.raises(InputError, match=r"nowhere.head"):
        ld.difference(tmp_path / "nowhere.head", known)


def test_a_file_that_names_its_detector_is_compared_with_that_of_a_camera(tmp_path):
    header = fits.Header({"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRVAL1": 10.0, "CRVAL2": -30.0})
    header.update({"CRPIX1": 256.5, "CRPIX2": 256.5, "CD1_1": -1e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-5})
    header.update({"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 2e-6, "B_1_1": 1e-6, "DETECTOR": "b"})
    path, other = tmp_path / "named.fits", tmp_path / "other.fits"
    fits.PrimaryHDU(np.zeros((512, 512), "f4"), header).writeto(path)
    del header["DETECTOR"]
    fits.PrimaryHDU(np.zeros((512, 512), "f4"), header).writeto(other)
    beside = np.array([[1.02, 0, -600], [0, 1, 0]])  # the shear of a layout is a part of the map
    static = ld.Prior.from_file(path).mean.copy()
    chips = {"a": ld.Detector((512, 512)), "b": ld.Detector((512, 512), layout=beside, static=static)}
    found = ld.difference(path, ld.Camera("pair", chips))
    assert found.left_out == ("a",)
    assert list(found.shapes) == ["b"]
    assert found.sentence.endswith("(detector b; without a)")
    sheared = np.abs(found.coefficients["b"]) > 1e-2
    assert np.argwhere(sheared).tolist() == [[0, 1], [1, 2]]
    assert found.coefficients["b"][0, 1] == pytest.approx(0.01 * 256 / (0.5 * np.sqrt(3)), rel=0.03)
    with pytest.raises(InputError, match=r"has 1, pair|of the same detectors: a file whose header names the detector"):
        ld.difference(other, ld.Camera("pair", chips))


def test_gwcs_that_end_in_other_frames_are_compared_on_the_sky():
    """The shear of a camera's pixels stands before the plane of one, and after that of the other."""
    bent = Mapping((0, 1, 0, 1)) | (Polynomial2D(2, c1_0=1, c2_0=1e-6) & Polynomial2D(2, c0_1=1, c1_1=2e-6))
    sheared = AffineTransformation2D([[1.01, 0.003], [0.003, 0.99]], [-256, -256]) | Scale(0.1) & Scale(0.1)
    to_sky = (Scale(1 / 3600) & Scale(1 / 3600)) | Pix2Sky_TAN() | RotateNative2Celestial(10.0, -30.0, 180.0)
    pixels, sky = (cf.Frame2D(name="detector"), cf.CelestialFrame(name="world", reference_frame=coord.ICRS()))
    shape = {"bounding_box": ((-0.5, 511.5), (-0.5, 511.5))}

    def made(name, first, second):
        plane = cf.Frame2D(name=name, unit=("arcsec", "arcsec") if name == "v2v3" else ("pix", "pix"))
        steps = [(pixels, first), (plane, second), (sky, None)] if second else [(pixels, first), (plane, None)]
        out = gwcs.WCS(steps)
        out.bounding_box = shape["bounding_box"]
        return out

    one, two = made("undistorted", bent, sheared | to_sky), made("v2v3", bent | sheared, to_sky)
    assert ld.difference(one, two).rms < 1e-4
    assert ld.difference(one, made("v2v3", Shift(0) & Shift(0) | sheared, to_sky)).rms > 0.02
    with pytest.raises(InputError, match=r"frame 'undistorted', .* 'v2v3', .*: compare priors .* one frame"):
        ld.difference(one, made("v2v3", bent | sheared, None))


@pytest.mark.sets
def test_chances_of_the_detectors_of_a_camera_are_even():
    chances = [
        ld.difference(four(s), ld.solve(four_detectors.matches("static", s), static="fit", layout="fit", degree=2)).p
        for s in range(20)
    ]
    assert min(chances) > 0.002
    assert 0.3 < np.mean(chances) < 0.7


@pytest.mark.parametrize("n_sets", [pytest.param(6, marks=pytest.mark.slow), pytest.param(12, marks=pytest.mark.sets)])
def test_chances_are_even_where_nights_scatter(n_sets):
    """Six nights, the last two of which are turned. Were their exposures independent, p would be 1e-5 in one of ten."""
    chances = {"nights": [], "one": []}
    for seed in range(n_sets):
        nights = Nights(seed, nights=6, per=3, n_stars=100, nightly=0.04)
        known = ld.Prior(modes(nights.static), shape=SHAPE)
        for name, each in chances.items():
            if name == "one":
                nights.table["block"] = 0
            each.append(ld.difference(known, ld.solve(ld.Matches.from_table(nights.table, shape=SHAPE))).p)
    assert min(chances["nights"]) > 1e-4
    assert 0.25 < np.mean(chances["nights"]) < 0.75
    assert min(chances["one"]) < 1e-4
    assert np.mean(chances["one"]) < 0.15


@pytest.mark.parametrize(
    "how",
    [
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"turns": (0,), "single": 0.03}, marks=pytest.mark.sets),
        pytest.param({"turns": (0, 180), "exposures": 8}, marks=pytest.mark.sets),
    ],
)
def test_chances_are_even_and_five_sigma_are_found(how):
    """20 nights: p is anything, and a camera that is off by 5 sigma in a direction that is determined is found."""
    chances, found = [], 0
    for seed in range(20):
        solution = solved(seed, **how)
        right = ld.difference(old(seed), solution)
        chances.append(right.p)
        m = (0, 7)
        wrong = modes(static(seed))
        wrong[m] += 6 * right.errors["1"][m] * np.sign(-right.coefficients["1"][m])
        found += ld.difference(ld.Prior(wrong, shape=SHAPE), solution).p < 0.01
    assert min(chances) > 1e-4
    assert np.count_nonzero(np.array(chances) < 0.05) <= 4
    assert 0.3 < np.mean(chances) < 0.7
    assert 0.15 < np.std(chances) < 0.4
    assert found >= 18
