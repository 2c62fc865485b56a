"""Cameras of several detectors: value objects, the focal plane, solutions over all detectors."""

import json
from dataclasses import replace

import asdf
import gsaoi_images
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from scipy import special
from two_chips import two_chips_small

import legdistort
from legdistort.cameras import camera as cameras
from legdistort.cameras import exchanged
from legdistort.cameras.star_scales import flux_factors
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.geometry import models
from legdistort.inputs.exposures import Exposure
from legdistort.reporting.page import render
from legdistort.results import in_tables
from legdistort.simulation import gsaoi_night
from legdistort.simulation.observations import simulate_gsaoi_matches
from legdistort.wcs import storage

SIGMA = 0.01


@pytest.fixture(scope="module")
def gsaoi():
    return legdistort.Camera.gsaoi()


@pytest.fixture(scope="module")
def night():
    return gsaoi_images.Night(n_exposures=8, n_stars=400)


@pytest.fixture(scope="module")
def table(night):
    return night.table(sigma=SIGMA)


@pytest.fixture(scope="module")
def solution(table, gsaoi):
    return legdistort.solve(legdistort.Matches.from_table(table, camera=gsaoi), degree=3)


def test_fluxes_of_detectors_are_on_one_scale(gsaoi):
    """Depths of exposures and sensitivities of detectors, as numpy puts them into counts, leave the fluxes of stars."""
    rng, night = np.random.default_rng(1), gsaoi_images.Night(n_exposures=8, n_stars=400, dither=15.0)
    table = night.table(sigma=SIGMA)
    number = np.unique(np.asarray(table["exposure"]), return_inverse=True)[1]
    ids, detector = np.unique(np.asarray(table["detector"]).astype(str), return_inverse=True)
    depth, sensitive = np.exp(rng.normal(0, 0.5, number.max() + 1)), np.array([1.0, 1.1, 0.9, 1.05])
    stars, star = np.unique(np.asarray(table["star"]), return_inverse=True)
    true = 10 ** rng.uniform(3, 5, len(stars))
    table["flux"] = depth[number] * sensitive[detector] * true[star] * np.exp(rng.normal(0, 0.01, len(table)))
    solution = legdistort.solve(legdistort.Matches.from_table(table, camera=gsaoi), degree=3)
    found = solution.stars
    ratio = found["flux"] / true[np.searchsorted(stars, found["star"])]
    np.testing.assert_allclose(ratio / np.median(ratio), 1, atol=0.04)
    factors = flux_factors(solution)
    parts = [(i, k, view) for i, whole in enumerate(solution) for k, view in enumerate(whole.parts)]
    product = [factors.of(view.name, view.detector) * depth[i] * sensitive[k] for i, k, view in parts]
    assert [view.detector for _, _, view in parts[:4]] == ids.tolist()
    np.testing.assert_allclose(product / np.median(product), 1, atol=0.005)


def test_lists_of_one_detector_in_the_shell(solution, table, tmp_path, monkeypatch, capsys):
    """By the label that the solution gives an image, or by --detector; the stars are those of the list."""
    monkeypatch.chdir(tmp_path)
    solution.write("night.asdf")
    name = str(solution.names[3])
    rows = table[(np.asarray(table["exposure"]) == name) & (np.asarray(table["detector"]).astype(str) == "2")]
    plain = rows["x", "y", "x_err", "y_err"]
    for path, more in ((f"{name}-2.ecsv", []), (f"{name}.ecsv", ["--detector", "2"])):
        plain.write(path)
        assert main(["correct", "night.asdf", path, *more, "--out", "out.ecsv", "--overwrite"]) == 0
        made = QTable.read("out.ecsv")
        assert len(made) == len(rows) > 20
        assert np.mean(np.asarray(made["star"]) == np.asarray(rows["star"])) > 0.9
    capsys.readouterr()
    assert main(["correct", "night.asdf", f"{name}.ecsv", "--out", "out.ecsv", "--overwrite"]) == 1
    said = capsys.readouterr().err
    assert f"{name}.ecsv: the list has no column detector, which of 1, 2, 3, 4 of camera" in said
    assert "--detector 1" in said


def pixels(n=12, size=gsaoi_images.SIZE):
    t = np.linspace(-0.5, size - 0.5, n)
    return np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)


def two_chips(**known):
    """Two detectors of 1000 x 500 px side by side with a gap of 20 px; the second is turned and has a distortion."""
    angle = np.radians(0.2)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    static = np.zeros((2, 10))
    static[0, 4], static[1, 7] = 1.5, -0.8
    layout = np.column_stack([turn, turn @ [-520.0, 3.0]])
    left = legdistort.Detector((1000, 500), layout=np.eye(2, 3))
    right = legdistort.Detector((1000, 500), layout=layout, static=static, **known)
    return legdistort.Camera("two chips", {"a": left, "b": right})


class TestCamera:
    def test_gsaoi_is_as_published(self, gsaoi):
        """All four detectors at once: one shift away from the published polynomials."""
        away = []
        for key, chip in gsaoi_images.CHIPS.items():
            xy = pixels()
            arcsec = gsaoi_images.to_arcsec(gsaoi_images.published()[chip], xy)
            away.append(gsaoi[key].to_focal_plane(xy) - arcsec / cameras.GSAOI_SCALE)
        away = np.concatenate(away)
        assert np.abs(away - away.mean(axis=0)).max() < 1e-5

    @pytest.mark.parametrize("key", ["a", "b"])
    def test_there_and_back(self, key):
        chip = two_chips()[key]
        xy = basis_pixels(chip)
        assert np.abs(chip.to_pixels(chip.to_focal_plane(xy)) - xy).max() < 1e-9

    def test_orders_0_and_1_belong_to_the_layout(self):
        """The same map, however it is divided between static distortion and layout."""
        static = np.zeros((2, 10))
        static[:, :3], static[0, 5], static[1, 8] = [[3.0, 2.0, -1.0], [-4.0, 0.5, 1.5]], 2.0, 1.0
        layout = np.array([[1.01, 0.02, 5.0], [-0.03, 0.98, -7.0]])
        detector = legdistort.Detector((300, 400), layout=layout, static=static)
        assert not detector.static[:, :3].any()
        f = basis_pixels(detector)
        q = f @ layout[:, :2].T + layout[:, 2]
        u, v = (q[:, 0] + 0.5) / 200 - 1, (q[:, 1] + 0.5) / 150 - 1
        legendre = np.polynomial.legendre.legvander2d(u, v, (3, 3)).reshape(-1, 4, 4)
        modes = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]
        norm = [np.sqrt((2 * i + 1) * (2 * j + 1)) / 2 for i, j in modes]
        expected = q + sum(
            s[None] * n * legendre[:, i, j, None] for s, n, (i, j) in zip(static.T, norm, modes, strict=True)
        )
        assert np.abs(detector.to_pixels(f) - expected).max() < 1e-9

    def test_the_focal_plane_begins_at_pixel_0(self):
        """Layouts in any coordinates give the same camera."""
        camera, there = two_chips(), np.array([7000.0, -300.0])
        moved = {
            key: legdistort.Detector(
                each.shape,
                layout=np.column_stack([each.layout[:, :2], each.layout[:, 2] - each.layout[:, :2] @ there]),
                static=each.static,
            )
            for key, each in camera.detectors.items()
        }
        again = legdistort.Camera("moved", moved)
        assert again.field == camera.field
        for key in "ab":
            assert np.allclose(again[key].layout, camera[key].layout, atol=1e-8)

    def test_prints(self, gsaoi):
        assert repr(gsaoi) == "<Camera GSAOI: 4 detectors in a focal plane of 4301 x 4276 px>"
        assert str(gsaoi).splitlines()[3].split() == ["2", "2048", "x", "2048", "1085.30", "1034.40", "0.0237",
                                                      "0.991644", "2.900"]  # fmt: skip
        unknown = {k: replace(each, layout_sigma=np.inf) for k, each in two_chips().detectors.items()}
        start = str(legdistort.Camera("start", unknown))
        assert start.endswith("errors of the layout: not known")
        assert "inf" not in start
        assert "+-" not in start
        assert str(two_chips(layout_sigma=0.1)).count("+-") == 3

    def test_file(self, gsaoi, tmp_path):
        known = two_chips(layout_sigma=0.1, static_sigma=0.02)
        for camera in (gsaoi, known):
            path = camera.write(tmp_path / f"{camera.name}.asdf")
            again = legdistort.Camera.read(path)
            assert (again.name, again.field, list(again.detectors)) == (
                camera.name,
                camera.field,
                list(camera.detectors),
            )
            for key, each in camera.detectors.items():
                for name in ("layout", "static", "layout_sigma", "static_sigma"):
                    assert np.array_equal(getattr(again[key], name), getattr(each, name)) or getattr(each, name) is None

    def test_other_files_are_refused(self, tmp_path):
        path = legdistort.Prior(np.zeros((2, 10))).write(tmp_path / "prior.asdf")
        with pytest.raises(InputError, match=r"prior.asdf holds no legdistort camera"):
            legdistort.Camera.read(path)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"layout": np.zeros((2, 3))}, "layout must be"),
            ({"layout": np.eye(3)}, "layout must be"),
            ({"shape": (1, 5)}, "shape must be"),
            ({"static": np.full((2, 10), np.nan)}, "coefficients must be finite"),
            ({"static_sigma": -1}, "static_sigma must be 0 or more"),
            ({"layout_sigma": [1, 2]}, "layout_sigma must be"),
            ({"static": legdistort.Prior(np.zeros((2, 10)), shape=(9, 9))}, "prior is for a detector of shape"),
        ],
    )
    def test_bad_detectors(self, change, words):
        given = {"shape": (300, 400), "layout": np.eye(2, 3)} | change
        with pytest.raises(InputError, match=words):
            legdistort.Detector(given.pop("shape"), **given)

    def test_bad_cameras(self):
        one = legdistort.Detector((100, 100), layout=np.eye(2, 3))
        near = legdistort.Detector((100, 100), layout=np.column_stack([np.eye(2), [-50, 0]]))
        with pytest.raises(InputError, match=r"detectors 1 and 2 of camera c lie on each other by 50 % of their area"):
            legdistort.Camera("c", {1: one, 2: near})
        with pytest.raises(InputError, match=r"detector 1 of camera c lies outside of the focal plane"):
            legdistort.Camera("c", {1: one}, field=(50, 200))
        with pytest.raises(InputError, match="detectors must be a dict"):
            legdistort.Camera("c", {})
        with pytest.raises(InputError, match="camera c has no detector '7'; it has 1"):
            legdistort.Camera("c", {1: one})["7"]
        with pytest.raises(InputError, match=r"common_sigma must be standard deviations \(2, n_modes\)"):
            legdistort.Camera("c", {1: one}, common_sigma=[1.0, -1.0])

    def test_picture(self, gsaoi):
        ax = gsaoi.plot()
        assert ax.get_title(loc="left") == "GSAOI: static distortion, up to 6.72 px, x 20"
        ax.figure.clear()


def basis_pixels(detector):
    ny, nx = detector.shape
    return pixels(size=1) * [nx, ny] + [(nx - 1) / 2, (ny - 1) / 2]


class TestFromExposures:
    """Headers written by hand, so that astropy is the judge of what they mean."""

    def header(self, number, *, sip=False, rotation=20.0):
        """A detector of 200 x 300 px, the second 210 px to the right of the first and turned by 1 degree more."""
        turn = np.radians(rotation + (number == 2))
        header = fits.Header({"NAXIS": 2, "NAXIS1": 200, "NAXIS2": 300, "EXTVER": number, "INSTRUME": "CAM"})
        suffix = "-SIP" if sip else ""
        header.update({"CTYPE1": f"RA---TAN{suffix}", "CTYPE2": f"DEC--TAN{suffix}", "CRVAL1": 10.0, "CRVAL2": 60.0})
        header["CRPIX1"], header["CRPIX2"] = (211.0, 150.0) if number == 1 else (-2.0, 150.0)
        scale = 0.02 / 3600
        header["CD1_1"], header["CD1_2"] = -scale * np.cos(turn), scale * np.sin(turn)
        header["CD2_1"], header["CD2_2"] = scale * np.sin(turn), scale * np.cos(turn)
        if sip and number == 2:
            header["A_ORDER"], header["B_ORDER"], header["A_2_0"], header["B_1_2"] = 2, 3, 1e-4, 2e-7
        return header

    @pytest.mark.parametrize("sip", [False, True])
    def test_same_sky(self, sip):
        headers = {k: self.header(k, sip=sip) for k in (1, 2)}
        exposures = [
            Exposure(f"f_{k}", np.zeros((300, 200)), wcs=WCS(header), header=header) for k, header in headers.items()
        ]
        camera = legdistort.Camera.from_exposures(exposures)
        assert camera.name == "CAM"
        assert list(camera.detectors) == ["1", "2"]
        xy = {k: pixels(size=1) * [200, 300] + [99.5, 149.5] for k in headers}
        f = np.concatenate([camera[k].to_focal_plane(xy[k]) for k in headers])
        ra, dec = np.concatenate([WCS(headers[k]).all_pix2world(xy[k], 0) for k in headers]).T
        plane = np.stack([(ra - 10) * np.cos(np.radians(dec)), dec - 60], axis=1) * 3600 / 0.02
        design = np.column_stack(
            [f, np.ones(len(f)), np.stack([f[:, 0] ** 2, f[:, 0] * f[:, 1], f[:, 1] ** 2], axis=1)]
        )
        left = plane - design @ np.linalg.lstsq(design, plane, rcond=None)[0]
        assert np.abs(left).max() < 2e-4  # of one plane; the rest of second order is the curvature of the sky
        assert abs(np.mean([np.linalg.det(each.layout[:, :2]) for each in camera.detectors.values()]) - 1) < 1e-2

    def test_without_names_of_detectors(self):
        header = self.header(1)
        exposures = [Exposure(n, np.zeros((300, 200)), wcs=WCS(header), header=header) for n in ("f", "g")]
        with pytest.raises(InputError, match="f, g do not distinguish their detectors by any of CCDCHIP"):
            legdistort.Camera.from_exposures(exposures)

    def test_of_several_exposures_it_is_said_who_takes_them(self):
        headers = {k: self.header(k) for k in (1, 2)}
        exposures = [
            Exposure(f"{e}_{k}", np.zeros((300, 200)), wcs=WCS(header), header=header, exposure=e, detector=str(k))
            for e in ("f", "g") for k, header in headers.items()
        ]  # fmt: skip
        with pytest.raises(InputError, match=r"these are 2 exposures \(f, g\), and a layout is .* Camera\.of_frames"):
            legdistort.Camera.from_exposures(exposures)
        assert list(legdistort.Camera.of_frames(exposures).detectors) == ["1", "2"]

    def test_of_gsaoi_with_binned_pixels_the_size_is_named(self):
        binned = Exposure("f_1", np.zeros((512, 512)), exposure="f", detector="1")
        with pytest.raises(InputError, match=r"if pixels are binned give Camera\.gsaoi\(size=512\)"):
            legdistort.Camera.gsaoi().check(binned)
        legdistort.Camera.gsaoi(size=512).check(binned)

    def test_without_wcs(self):
        with pytest.raises(InputError, match=r"f \(detector 1\) has no celestial WCS"):
            legdistort.Camera.from_exposures({1: Exposure("f", np.zeros((300, 200)))})


class TestSolution:
    def test_stars_are_at_the_bound(self, night, table, gsaoi):
        """The Cramer-Rao bound by plain powers, and errors that are true, after a common map; four draws of noise."""
        stars, numbers = np.unique(table["star"], return_inverse=True)
        exposure = np.unique(table["exposure"], return_inverse=True)[1]
        place = np.stack([night.focal[i][j] for i, j in zip(exposure, table["star"], strict=True)])
        place = place - place.mean(axis=0)
        best = gsaoi_images.bound(numbers, exposure, place, night.sky[stars], SIGMA, 3)
        left, pulls, ratios = [], [], []
        for seed in range(4):
            drawn = night.table(sigma=SIGMA, seed=seed)
            solution = legdistort.solve(legdistort.Matches.from_table(drawn, camera=gsaoi), degree=3)
            left.append(gsaoi_images.without_common_map(solution.estimate.positions, night.sky[stars], 3))
            errors = np.stack([solution.stars[name].value for name in ("x_err", "y_err")], axis=1)
            pulls.append(left[-1] / errors)
            ratios.append(solution.chi2 / solution.dof)
        assert np.sqrt(np.mean(np.square(left))) < 1.05 * best
        free = len(stars) / (len(stars) - 10)  # the map that is fitted here takes 10 of the stars' degrees of freedom
        assert free * np.mean(np.square(pulls)) == pytest.approx(1, abs=0.1)
        assert np.mean(ratios) == pytest.approx(1, abs=0.04)

    def test_what_the_camera_knows_is_absolute(self, solution, night):
        """Without any common map but shift, rotation and scale the error is that of the mean dynamic part."""
        numbers = solution.estimate.star_names
        absolute = np.stack([solution.stars[name].value for name in ("x_err_abs", "y_err_abs")], axis=1)
        z, w = solution.estimate.positions @ [1, 1j], night.sky[numbers] @ [1, 1j]
        design = np.stack([w, np.ones(len(w))], axis=1)
        left = np.abs(z - design @ np.linalg.lstsq(design, z, rcond=None)[0])
        assert np.isfinite(absolute).all()
        assert 0.3 < np.sqrt(np.mean(left**2) / np.mean(absolute**2) / 2) < 1.6  # one draw of some ten modes

    def test_a_detector_alone_knows_less(self, solution, night, table, gsaoi):
        """The distortion of the whole field takes four times the stars for the same unknowns."""
        rows = table[table["detector"] == "2"]
        rows = rows[np.bincount(rows["star"])[rows["star"]] >= 3]
        alone = legdistort.solve(legdistort.Matches.from_table(rows, camera=gsaoi), degree=3)
        both = np.isin(solution.estimate.star_names, alone.estimate.star_names)
        with_all = gsaoi_images.without_common_map(
            solution.estimate.positions[both], night.sky[solution.estimate.star_names[both]], 3
        )
        by_itself = gsaoi_images.without_common_map(alone.estimate.positions, night.sky[alone.estimate.star_names], 3)
        assert np.sqrt(np.mean(by_itself**2)) > 1.05 * np.sqrt(np.mean(with_all**2))

    @pytest.mark.parametrize("key", ["1", "2", "3", "4"])
    def test_wcs_of_a_detector(self, solution, night, key):
        """True pixels of stars lead to their positions, through the gwcs and back."""
        xy = night.pixels[0][key]
        numbers = np.flatnonzero(np.isin(np.arange(len(xy)), solution.estimate.star_names) & np.isfinite(xy[:, 0]))
        wcs = solution["frame00", key].wcs
        assert wcs.available_frames == ["detector", "undistorted", "focal_plane", "reference"]
        found = np.stack(wcs(*xy[numbers].T), axis=1)
        there = solution.estimate.positions[np.searchsorted(solution.estimate.star_names, numbers)]
        assert np.sqrt(np.mean((found - there) ** 2)) < SIGMA
        assert np.abs(np.stack(wcs.invert(*found.T), axis=1) - xy[numbers]).max() < 1e-5
        assert np.allclose(solution["frame00", key].correct(xy[numbers]), found, atol=1e-5)
        assert np.allclose(solution["frame00", key].distort(found), xy[numbers], atol=1e-5)

    def test_new_positions(self, solution, night, table):
        """Errors of positions that took no part are those of the stars but for the mean over the exposures."""
        xy = night.pixels[0]["3"]
        xy = xy[np.isfinite(xy[:, 0])][:20]
        there, relative, _ = solution["frame00", "3"].correct(xy, errors=np.full((20, 2), SIGMA))
        new = QTable({"exposure": ["frame00"] * 20, "detector": ["3"] * 20, "x": xy[:, 0], "y": xy[:, 1]})
        new["x_err"] = new["y_err"] = np.full(20, SIGMA)
        corrected = solution.correct_table(new)
        assert np.allclose(np.stack([corrected["x"].value, corrected["y"].value], axis=1), there)
        assert np.allclose(corrected["x_err"].value ** 2, relative[:, 0, 0])
        assert np.all(corrected["x_err"].value > 0.97 * SIGMA)
        floored = replace(solution, diagnostics=replace(solution.diagnostics, error_floor=0.05))
        more = floored["frame00", "3"].correct(xy, errors=np.full((20, 2), SIGMA)).relative
        assert np.allclose(floored.correct_table(new)["x_err"].value ** 2, more[:, 0, 0])
        assert np.allclose(more[:, 0, 0] - relative[:, 0, 0], 0.05**2, rtol=0.02)

    def test_file(self, solution, tmp_path):
        again = legdistort.Solution.read(solution.write(tmp_path / "solution.asdf"))
        assert list(again.camera.detectors) == list(solution.camera.detectors)
        xy = pixels(5)
        assert np.array_equal(again["frame01", "4"].correct(xy), solution["frame01", "4"].correct(xy))

    def test_matches_keep_the_camera(self, table, gsaoi):
        matches = legdistort.Matches.from_table(table, camera=gsaoi)
        fewer = matches.without({"frame03": "clouds"})
        assert fewer.camera is gsaoi
        rows = fewer.table["exposure"] == "frame00"
        first = matches.table["exposure"] == "frame00"
        assert np.array_equal(fewer.table["x"][rows], matches.table["x"][first])
        assert np.array_equal(matches.table["x_detector"].value, table["x"])

    @pytest.mark.parametrize(
        "known",
        [
            {},
            pytest.param({"static_sigma": 0.05}, marks=pytest.mark.slow),
            pytest.param({"static_sigma": None}, marks=pytest.mark.slow),
            {"static": None},
        ],
    )
    def test_one_detector_with_the_identity_is_a_plain_image(self, table, known, tmp_path):
        """To the last bit: its static distortion is the prior, and without one nothing is known."""
        rows = table[table["detector"] == "1"]
        rows = rows[np.bincount(rows["star"])[rows["star"]] >= 3]
        size = (gsaoi_images.SIZE, gsaoi_images.SIZE)
        static = np.zeros((2, 10))
        static[:, 1:6] = [[0.2, 0.1, 0.3, -0.2, 0.1], [0.1, -0.2, 0.1, 0.3, -0.3]]  # shear and tilt are part of a prior
        known = {"static": static} | known
        detector = legdistort.Detector(size, layout=np.eye(2, 3), **known)
        camera = legdistort.Camera("one", {"1": detector})
        assert not camera.has_focal_plane
        prior = None
        if known["static"] is not None:
            prior = legdistort.Prior(static, static_sigma=known.get("static_sigma"))
        one = legdistort.solve(legdistort.Matches.from_table(rows, camera=camera))
        usual = legdistort.solve(legdistort.Matches.from_table(rows, shape=size), prior=prior)
        assert one.chi2 == usual.chi2
        for name in ("coefficients", "poses"):
            np.testing.assert_equal(getattr(one, name), getattr(usual, name))
        for name in usual.stars.colnames:
            np.testing.assert_array_equal(one.stars[name], usual.stars[name])
        name = usual.names[0]
        assert one[name].wcs.available_frames == usual[name].wcs.available_frames
        xy = np.array([[10.0, 20.0], [400.0, 300.0]])
        np.testing.assert_array_equal(one[name].wcs(*xy.T), usual[name].wcs(*xy.T))
        np.testing.assert_array_equal(one[name, "1"].correct(xy), usual[name, "1"].correct(xy))
        again = legdistort.Solution.read(one.write(tmp_path / "one.asdf"))
        assert again.camera.name == "one"
        np.testing.assert_array_equal(again[name].correct(xy), usual[name].correct(xy))

    def test_stars_that_move(self, night, table, gsaoi):
        """Proper motions over all detectors, after a common map, with true errors."""
        exposure = np.array([int(name.removeprefix("frame")) for name in table["exposure"]])
        years = 2010 + 2 * (exposure % 3) + 0.004 * exposure
        motion = np.random.default_rng(3).normal(0, 0.02, (len(night.sky), 2))
        moving = table.copy()
        moving["x"] += motion[table["star"], 0] * (years - 2012)
        moving["y"] += motion[table["star"], 1] * (years - 2012)
        moving["epoch"] = years
        solution = legdistort.solve(legdistort.Matches.from_table(moving, camera=gsaoi), motion="proper")
        found, errors = (
            np.stack([solution.stars[f"v{axis}{suffix}"].value for axis in "xy"], axis=1) for suffix in ("", "_err")
        )
        good = np.all(errors < 0.02, axis=1)
        assert good.sum() > 200
        left = gsaoi_images.without_common_map(
            found[good] - motion[solution.estimate.star_names][good], night.sky[solution.estimate.star_names][good], 3
        )
        assert np.sqrt(np.mean((left / errors[good]) ** 2)) == pytest.approx(1, abs=0.12)


def misplaced(camera, *, shift, turn, seed=4, **known):
    """The camera with layouts wrong by up to so many pixels and degrees."""
    rng, detectors = np.random.default_rng(seed), {}
    for key, each in camera.detectors.items():
        angle, middle = np.radians(turn) * rng.uniform(-1, 1), (np.array(each.shape[::-1]) - 1) / 2
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        moved = rotation @ (each.layout[:, 2] - middle) + middle + rng.uniform(-shift, shift, 2)
        layout = np.column_stack([rotation @ each.layout[:, :2], moved])
        detectors[key] = legdistort.Detector(each.shape, layout=layout, static=each.static, **known)
    return legdistort.Camera(camera.name, detectors)


def apart(found, true):
    """Distances [pix] in the focal planes of two cameras, over all detectors, after one affine map."""
    xy = pixels(7)
    here, there = (np.concatenate([c[key].to_focal_plane(xy) for key in true.detectors]) for c in (found, true))
    design = np.column_stack([here, np.ones(len(here))])
    return np.hypot(*(there - design @ np.linalg.lstsq(design, there, rcond=None)[0]).T)


class TestFittedCamera:
    @pytest.mark.slow
    def test_layouts_that_are_wrong_by_10_px(self, gsaoi):
        """Stars at the bound with free layouts, true errors, and the layout as published, after one affine map."""
        night = gsaoi_images.Night(n_stars=470, dither=6.0)
        camera, left, pulls, layouts = misplaced(gsaoi, shift=10, turn=0.1), [], [], []
        for seed in range(3):
            table = night.table(sigma=SIGMA, seed=seed)
            solution = legdistort.solve(legdistort.Matches.from_table(table, camera=camera), layout="fit")
            left.append(
                gsaoi_images.without_common_map(solution.estimate.positions, night.sky[solution.estimate.star_names], 3)
            )
            errors = np.stack([solution.stars[name].value for name in ("x_err", "y_err")], axis=1)
            pulls.append(left[-1] / errors)
            layouts.append(apart(solution.camera, gsaoi))
            assert solution.chi2 == pytest.approx(solution.dof, rel=0.06)
        stars, number = np.unique(table["star"], return_inverse=True)
        exposure = np.array([int(name.removeprefix("frame")) for name in table["exposure"]])
        place = np.stack([night.focal[i][j] for i, j in zip(exposure, table["star"], strict=True)])
        place, detector = place - place.mean(axis=0), np.asarray(table["detector"]).astype(int) - 1
        best = gsaoi_images.bound(number, exposure, place, night.sky[stars], SIGMA, 3, detector=detector)
        assert np.sqrt(np.mean(np.square(left))) < 1.05 * best
        free = len(stars) / (len(stars) - 10)
        assert free * np.mean(np.square(pulls)) == pytest.approx(1, abs=0.12)
        sigma = np.mean([each.layout_sigma**2 for each in solution.camera.detectors.values()]) ** 0.5
        assert np.sqrt(np.mean(np.square(layouts))) < 3 * sigma  # of a mode over a detector, of which there are three
        assert solution.gauge.unknown_names == ("shear",)  # of all layouts together: no roll, no prior tells it
        assert np.isnan(solution.stars["x_err_abs"]).mean() > 0.9
        assert np.isfinite(solution.stars["x_err_known"]).all()

    @pytest.mark.slow
    def test_without_rolls(self, gsaoi):
        """Nothing but the common shear is undetermined by dithers over the gaps alone; the fit converges."""
        night = gsaoi_images.Night(n_exposures=8, n_stars=470, dither=6.0, turn=0.0)
        matches = legdistort.Matches.from_table(night.table(sigma=SIGMA), camera=misplaced(gsaoi, shift=3, turn=0.05))
        solution = legdistort.solve(matches, layout="fit")
        assert solution.status.startswith("converged")
        assert solution.chi2 == pytest.approx(solution.dof, rel=0.08)
        assert apart(solution.camera, gsaoi).max() < 0.1
        assert solution.gauge.unknown_names == ("shear",)

    @pytest.mark.slow
    def test_what_was_known_helps(self, gsaoi):
        """Uncertainties of layout and static are used without being asked for, and get smaller."""
        night = gsaoi_images.Night(n_exposures=6, n_stars=400, dither=6.0)
        camera = misplaced(gsaoi, shift=1, turn=0.01, layout_sigma=2.0, static_sigma=0.05)
        solution = legdistort.solve(legdistort.Matches.from_table(night.table(sigma=SIGMA), camera=camera))
        assert solution.chi2 == pytest.approx(solution.dof, rel=0.08)
        found = np.stack([each.layout_sigma for each in solution.camera.detectors.values()])
        assert np.all(found > 0)
        assert np.all(found <= 2.0)
        assert np.median(apart(solution.camera, gsaoi)) < 0.1
        again = legdistort.Camera.read(solution.camera.write("camera.asdf", overwrite=True))
        assert np.array_equal(again["1"].layout_sigma, solution.camera["1"].layout_sigma)

    @pytest.fixture(autouse=True)
    def _here(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)

    @pytest.mark.slow
    def test_detectors_that_share_no_star(self, gsaoi):
        """Without dithers over the gap, and without rolls, nothing tells how the detectors lie: a warning says so."""
        rows = gsaoi_images.Night(n_exposures=6, turn=0.0).table(sigma=SIGMA)
        first = {star: detector for detector, star in zip(rows["detector"], rows["star"], strict=True)}
        kept = rows[[first[star] == detector for detector, star in zip(rows["detector"], rows["star"], strict=True)]]
        kept = kept[np.bincount(kept["star"])[kept["star"]] >= 3]
        pair = kept[np.isin(kept["detector"], ["1", "3"])]
        matches = legdistort.Matches.from_table(pair, camera=gsaoi)
        words = r"2 unknowns of camera GSAOI are not determined by these exposures.*\(no star in common: 1 \| 3\)"
        with pytest.warns(AssumptionWarning, match=words):
            solution = legdistort.solve(matches, layout="fit")
        for key in "13":
            assert np.isinf(solution.camera[key].layout_sigma).any()
        assert solution.camera["2"].layout_sigma is None  # nothing was measured on it
        for name, lost in (("x_err_abs", np.isnan), ("x_err_known", np.isinf)):
            assert lost(solution.stars[name]).mean() > 0.9
        assert np.isfinite(solution.stars["x_err"]).all()
        xy = np.array([[300.0, 1700.0]])
        assert np.isnan(solution["frame00", "1"].correct(xy, errors=[[0.01, 0.01]]).absolute).all()
        assert "so that their places relative to each other are not determined" in in_tables.camera_sentence(solution)
        assert any(line.startswith("3 ") and "inf" in line for line in str(solution).splitlines())
        again = legdistort.Camera.read(solution.camera.write("camera.asdf"))
        assert np.array_equal(again["1"].layout_sigma, solution.camera["1"].layout_sigma)

    @pytest.mark.slow
    @pytest.mark.usefixtures("undrawn")
    def test_errors_of_places(self, gsaoi):
        """Centres and rotations in the printed table scatter by their errors, draw by draw; the report has them."""
        night, camera = gsaoi_images.Night(n_exposures=6, n_stars=350, dither=6.0), misplaced(gsaoi, shift=1, turn=0.01)
        places, errors = [], []
        for seed in range(8):
            solution = legdistort.solve(
                legdistort.Matches.from_table(night.table(sigma=SIGMA, seed=seed), camera=camera), layout="fit"
            )
            each = [detector.place for detector in solution.camera.detectors.values()]
            places.append([(place.x, place.y, place.rotation) for place in each])
            errors.append([place.errors for place in each])
        ratio = np.sqrt(np.var(places, axis=0, ddof=1) / np.mean(np.square(errors), axis=0))
        assert np.all((ratio > 0.3) & (ratio < 1.8))
        assert np.mean(ratio) == pytest.approx(1, abs=0.3)
        page = render(solution)
        assert "Detectors of camera GSAOI" in page
        assert f"{each[0].x:.4f} ± {each[0].errors[0]:.4f}" in page  # 0.0021

    @pytest.mark.slow
    def test_the_next_night_knows_what_this_one_did_not(self, gsaoi):
        """A camera found without rolls leaves the common shear unknown, also where it is taken as known later."""
        night = gsaoi_images.Night(n_exposures=6, n_stars=350, dither=6.0, turn=0.0)
        table = night.table(sigma=SIGMA)
        camera = legdistort.solve(legdistort.Matches.from_table(table, camera=gsaoi), layout="fit").camera
        assert np.isinf(camera.common_sigma[:, 1:3]).all()
        again = legdistort.Camera.from_meta(legdistort.Camera.read(camera.write("c.asdf")).to_meta())
        next_night = legdistort.Matches.from_table(table, camera=again)
        for layout in ("hold", "prior"):
            assert legdistort.solve(next_night, layout=layout).gauge.unknown_names == ("shear",)
        assert legdistort.solve(legdistort.Matches.from_table(table, camera=gsaoi)).gauge.unknown_names == ()

    @pytest.mark.slow
    def test_a_mismatch_does_not_move_the_camera(self, gsaoi):
        night = gsaoi_images.Night(n_stars=400, dither=6.0)
        table = night.table(sigma=SIGMA)
        table["x"][::60] += 3.0
        solution = legdistort.solve(
            legdistort.Matches.from_table(table, camera=misplaced(gsaoi, shift=5, turn=0.05)), layout="fit"
        )
        assert apart(solution.camera, gsaoi).max() < 0.05
        assert np.count_nonzero(~solution.residuals["used"]) < 0.03 * len(table)

    @pytest.mark.sets
    def test_static_distortions_from_nothing(self, gsaoi):
        """Self-calibration of a camera by large dithers and rolls; stars after a common map as if all were known."""
        night = gsaoi_images.Night(n_exposures=16, n_stars=600, dither=15.0, turn=0.8)
        bare = {key: legdistort.Detector(each.shape, layout=each.layout) for key, each in gsaoi.detectors.items()}
        matches = legdistort.Matches.from_table(night.table(sigma=SIGMA), camera=legdistort.Camera("bare", bare))
        solution = legdistort.solve(matches, degree=5, layout="fit", static="fit")
        assert solution.chi2 == pytest.approx(solution.dof, rel=0.06)
        left = gsaoi_images.without_common_map(solution.estimate.positions, night.sky[solution.estimate.star_names], 5)
        errors = np.stack([solution.stars[name].value for name in ("x_err", "y_err")], axis=1)
        assert np.mean((left / errors) ** 2) == pytest.approx(1, abs=0.15)


class TestBadInput:
    def test_tables(self, table, gsaoi):
        with pytest.raises(InputError, match="has no column detector, which of 1, 2, 3, 4 of camera GSAOI"):
            legdistort.Matches.from_table(table[[n for n in table.colnames if n != "detector"]], camera=gsaoi)
        other = table.copy()
        other["detector"] = np.char.add("CCD1", np.asarray(table["detector"]))
        with pytest.raises(InputError, match=r"camera GSAOI has no detector 'CCD11'; .* rename these in the column"):
            legdistort.Matches.from_table(other, camera=gsaoi)
        with pytest.raises(InputError, match=r"frame00 has positions on several detectors, 1 and 2: give the camera"):
            legdistort.solve(legdistort.Matches.from_table(table, shape=(2048, 2048)))
        with pytest.raises(InputError, match=r"must be .* got None"):
            legdistort.Matches.from_table(table)

    def test_positions_beside_their_detector(self, table, gsaoi):
        far = table.copy()
        far["x"][5] = 9000
        with pytest.warns(
            AssumptionWarning, match=r"1 positions lie outside their detector and are left out.*frame00\[1\]"
        ):
            matches = legdistort.Matches.from_table(far, camera=gsaoi)
        assert len(matches.table) == len(table) - 1

    def test_what_is_known_of_detectors_is_for_the_camera(self, table, gsaoi):
        matches = legdistort.Matches.from_table(table, camera=gsaoi)
        with pytest.raises(InputError, match="give what is known of its detectors to the camera"):
            legdistort.solve(matches, prior={"1": legdistort.Prior(np.zeros((2, 10)))})
        with pytest.raises(InputError, match=r"layout='prior' needs the uncertainty of every detector"):
            legdistort.solve(matches, layout="prior")
        with pytest.raises(InputError, match="layout must be"):
            legdistort.solve(matches, layout="free")

    def test_ids_are_for_cameras(self, table):
        rows = table[table["detector"] == "1"]
        rows = rows[np.bincount(rows["star"])[rows["star"]] >= 3]
        solution = legdistort.solve(
            legdistort.Matches.from_table(rows, shape=(2048, 2048)), prior=legdistort.Prior(np.zeros((2, 1)))
        )
        with pytest.raises(InputError, match="exposure frame00 has no detector '2'; it has 1"):
            solution["frame00", "2"]
        with pytest.raises(InputError, match="is for exposures with several detectors"):
            legdistort.solve(legdistort.Matches.from_table(rows, shape=(2048, 2048)), layout="fit")


class TestFiles:
    @pytest.mark.usefixtures("undrawn")
    def test_from_tables_to_wcs_in_the_shell(self, night, table, gsaoi, tmp_path, monkeypatch):
        """Lists without star numbers: matched over the gaps, solved, and a WCS for every detector of every exposure."""
        monkeypatch.chdir(tmp_path)
        table = table[np.isin(table["exposure"], [f"frame{i:02d}" for i in range(4)])]
        table = table[np.bincount(table["star"])[table["star"]] >= 3]
        for name in np.unique(table["exposure"]):
            rows = table[table["exposure"] == name]
            rows[["detector", "x", "y", "x_err", "y_err"]].write(f"{name}.ecsv")
        lists = sorted(str(path) for path in tmp_path.glob("*.ecsv"))
        gsaoi.write("camera.asdf")
        given = ["--camera", "camera.asdf", "--min-exposures", "3"]
        assert main(["match", *lists, *given, "--out", "matched.ecsv", "--quiet"]) == 0
        assert main(["solve", "matched.ecsv", "--out", "results", "--quiet"]) == 0
        solution = legdistort.Solution.read("results/solution.asdf")
        names = [f"{name}-{key}" for name in solution.names for key in gsaoi.detectors]
        assert sorted(path.stem for path in (tmp_path / "results" / "wcs").iterdir()) == sorted(names)
        assert len(solution.estimate.star_names) > 0.9 * len(np.unique(table["star"]))
        xy = 0.99 * pixels(6) + 10
        for key in gsaoi.detectors:
            here = solution["frame02", key].wcs
            path = f"results/wcs/frame02-{key}.asdf"
            with asdf.open(path) as file:
                stock = file["meta"]["wcs"]
                assert np.abs(np.array(stock(*xy.T)) - here(*xy.T)).max() < 1e-9
            ours = legdistort.read_wcs(path)
            assert np.abs(np.array(ours(*xy.T)) - here(*xy.T)).max() < 1e-9
            assert np.abs(np.array(ours.invert(*here(*xy.T))) - xy.T).max() < 1e-5
        assert "camera  GSAOI, detectors 1, 2, 3, 4" in str(solution)

    @pytest.mark.usefixtures("undrawn")
    def test_another_camera_has_another_focal_plane(self, table, gsaoi, tmp_path, monkeypatch):
        """What was matched with a layout is solved with another that is given, as if it had been matched with that."""
        monkeypatch.chdir(tmp_path)
        few = table[np.isin(table["exposure"], [f"frame{i:02d}" for i in range(4)])]
        moved = dict(gsaoi.detectors)
        moved["1"] = replace(moved["1"], layout=moved["1"].layout + [[0, 0, 3], [0, 0, -2]])
        other = replace(gsaoi, name="other", detectors=moved)
        other.write("other.asdf")
        with_first, with_other = (legdistort.Matches.from_table(few, camera=each) for each in (gsaoi, other))
        saved = with_first.table.copy()
        saved.meta |= with_first.to_meta()
        again = legdistort.Matches.from_table(saved, camera=other)
        for name in ("x", "y", "x_err", "y_err"):
            assert np.abs(again.table[name].value - with_other.table[name].value).max() < 1e-9
        same = legdistort.Matches.from_table(saved, camera=gsaoi)
        assert np.array_equal(same.table["x"], with_first.table["x"])

    def test_a_distortion_is_made_once_for_all_files(self, solution, tmp_path, monkeypatch):
        """Making a series takes longer than all else; the WCSs in memory share nothing."""
        made, series = [], models.legendre_series
        monkeypatch.setattr(models, "legendre_series", lambda *a, **k: made.append(1) or series(*a, **k))
        fresh = replace(solution, camera=replace(solution.camera, name="again"))
        for detector in fresh.camera.detectors.values():
            detector.distortion.__dict__.pop("shared_correction", None)
        for name in fresh.names[:3]:
            for key in "1234":
                storage.write_wcs(fresh[name, key], tmp_path / f"{name}-{key}.asdf")
        assert len(made) == 4 * (4 + 3)  # x and y, there and back, of four detectors and three exposures
        first, second = (fresh["frame00", key].wcs.get_transform("focal_plane", "reference") for key in "12")
        shared = {id(leaf) for leaf in models.leaves(first)} & {id(leaf) for leaf in models.leaves(second)}
        assert not shared

    def test_a_changed_wcs_is_refused(self, solution, tmp_path):
        """The certificates of both distortions, of the detector and of the focal plane, are checked."""
        tree = storage.wcs_tree(solution["frame00", "1"])
        for part in (tree["meta"], tree["meta"]["focal_plane"]):
            kept, part["inverse_error_px"] = part["inverse_error_px"], 9e-7
            path = tmp_path / "frame00_1.asdf"
            asdf.AsdfFile(tree).write_to(path)
            with pytest.raises(InputError, match="was certified"):
                legdistort.read_wcs(path)
            part["inverse_error_px"] = kept

    def test_bad_ids(self):
        with pytest.raises(InputError, match=r"ids of detectors become part of file names.*'a/b'"):
            legdistort.Camera("c", {"a/b": legdistort.Detector((100, 100), layout=np.eye(2, 3))})


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Six exposures of two detectors of 300 x 200 px, SCI, ERR and DQ of both in a file; the first lacks the second."""
    folder, rng = tmp_path_factory.mktemp("frames"), np.random.default_rng(5)
    camera = two_chips_small()
    ny, nx = camera.field
    sky, flux = rng.uniform(-20, [nx + 20, ny + 20], (90, 2)), 10 ** rng.uniform(3.5, 5, 90)
    for i in range(6):
        f = sky + rng.uniform(-40, 40, 2)
        u, v = (f / [nx, ny] * 2 - 1).T
        f = f + 0.2 * (np.outer(u**2, rng.normal(0, 1, 2)) + np.outer(u * v, rng.normal(0, 1, 2)))
        hdus = [fits.PrimaryHDU(header=fits.Header({"INSTRUME": "TWO", "DATE-OBS": f"2024-01-0{i + 1}T00:00:00"}))]
        for number, (key, chip) in enumerate(camera.detectors.items(), start=1):
            if i == 0 and number == 2:
                continue
            xy = chip.to_pixels(f)
            image = 100 + sum(s * gaussian(chip.shape, *at) for at, s in zip(xy, flux, strict=True))
            image = rng.poisson(image).astype(np.float32)
            header = sky_header(chip, f - sky, camera) | {"CCDCHIP": int(key), "EXTVER": number}
            planes = {"SCI": image, "ERR": np.sqrt(np.maximum(image, 1)), "DQ": np.zeros(chip.shape, dtype=np.int16)}
            planes["DQ"][50 + 10 * number, 60] = 4
            planes["SCI"][50 + 10 * number, 60] = 60000
            hdus += [fits.ImageHDU(plane, fits.Header(header), name=name) for name, plane in planes.items()]
        fits.HDUList(hdus).writeto(folder / f"exp{i}.fits")
    return folder, camera, sky


def gaussian(shape, x, y, fwhm=2.6):
    """Light of a star in every pixel, integrated over the pixels; zero far from it."""
    scale = fwhm / 2.3548 * np.sqrt(2)
    profiles = []
    for n, centre in ((shape[0], y), (shape[1], x)):
        edges = np.clip((np.arange(n + 1) - 0.5 - centre) / scale, -6, 6)
        profiles.append(np.diff(special.erf(edges)) / 2)
    return np.outer(*profiles)


def sky_header(chip, shift, camera):
    """A linear WCS that is right in the middle of a detector, to some pixels elsewhere: a start, no more."""
    y0, x0 = (np.array(chip.shape) - 1) / 2
    here = chip.to_focal_plane(np.array([[x0, y0]]))[0] - shift.mean(axis=0)
    slope = np.linalg.inv(chip.layout[:, :2]) * 0.05 / 3600 * [[-1], [1]]
    place = (here - np.array(camera.field[::-1]) / 2) * 0.05 / 3600 * [-1, 1]
    return {
        "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": x0 + 1, "CRPIX2": y0 + 1,
        "CRVAL1": 30.0 + place[0], "CRVAL2": place[1],
        "CD1_1": slope[0, 0], "CD1_2": slope[0, 1], "CD2_1": slope[1, 0], "CD2_2": slope[1, 1],
    }  # fmt: skip


class TestPrediction:
    def test_as_solved(self, gsaoi):
        """Errors predicted for stars, dithers and a camera are those of the solution of such positions."""
        night = gsaoi_images.Night(n_exposures=6, n_stars=350, turn=0.0, dynamic=0.0)
        table = night.table(sigma=SIGMA)
        solution = legdistort.solve(legdistort.Matches.from_table(table, camera=gsaoi), degree=3)
        planned = legdistort.predict(
            n_exposures=6,
            stars=solution.estimate.positions,
            sigma=SIGMA,
            poses=solution.poses,
            camera=gsaoi,
            min_exposures=3,
        )
        assert np.sum(planned.solution.stars["n"]) == np.sum(solution.stars["n"])
        found, expected = (s.stars["x_err"].value for s in (solution, planned.solution))
        assert np.allclose(found, expected, rtol=0.02)

    def test_more_detectors_tell_more(self, gsaoi):
        """In the shell; over the field of all detectors as over that of one, for as many stars a detector."""
        given = {"n_exposures": 8, "density": 50, "sigma": 0.02, "dithers": 200.0}
        whole = legdistort.predict(camera=gsaoi, **given)
        assert whole.b_abs < 1 or np.isnan(whole.b_abs)
        assert whole.sigma < legdistort.predict(prior=legdistort.Prior(np.zeros((2, 1))), **given).sigma
        shell = "predict --camera gsaoi --n-exposures 8 --density 50 --sigma 0.02 --dither 200"
        assert main(shell.split()) == 0

    def test_shape_and_camera(self, gsaoi):
        with pytest.raises(InputError, match="shape and camera both state the size of the field"):
            legdistort.predict(n_exposures=4, n_stars=50, sigma=0.01, shape=(2048, 2048), camera=gsaoi)
        with pytest.raises(InputError, match=r"camera must be a legdistort\.Camera, got str"):
            legdistort.predict(n_exposures=4, n_stars=50, sigma=0.01, camera="gsaoi")


class TestSimulation:
    def test_truth_is_as_published(self):
        """Pixels of the simulated stars on all detectors are those of the published polynomials, up to one shift."""
        truth, _ = gsaoi_night.draw_night(gsaoi_night.make_night(True, camera="gsaoi", dynamic_rms=0.0), 3)
        away, coarse = [], gsaoi_images.SIZE / 256
        for key, chip in gsaoi_images.CHIPS.items():
            xy = truth.on_detector("exp02", key, truth.positions)
            seen = np.isfinite(xy[:, 0])
            arcsec = gsaoi_images.to_arcsec(gsaoi_images.published()[chip], (xy[seen] + 0.5) * coarse - 0.5)
            away.append(arcsec / cameras.GSAOI_SCALE / coarse - truth.distort("exp02", truth.positions[seen]))
        away = np.concatenate(away)
        assert len(away) > 60
        assert np.abs(away - away.mean(axis=0)).max() < 1e-5

    @pytest.mark.slow
    def test_demo(self, tmp_path, capsys):
        """The demonstration with a camera: at the bound, in one mosaic as sharp as the frames."""
        out = tmp_path / "demo"
        assert main(["demo", "--camera", "gsaoi", "--small", "--out", str(out), "--quiet", "--json"]) == 0
        summary = json.loads(capsys.readouterr().out)
        assert summary["b_px"] < 1.3 * summary["b_bound_px"]
        assert summary["b_abs_px"] < 2 * summary["b_abs_err_px"]
        assert 0.97 < summary["fwhm_ratio"] < 1.03
        with fits.open(out / "frames" / "exp00.fits") as hdulist:
            assert [(hdu.name, hdu.ver, hdu.header["CCDCHIP"]) for hdu in hdulist[1:]] == [
                ("SCI", k, k) for k in (1, 2, 3, 4)
            ]
        assert len(list((out / "wcs").iterdir())) == 4 * summary["n_exposures"]

    def test_other_cameras_are_refused(self, tmp_path):
        with pytest.raises(InputError, match="camera must be 'gsaoi' or None, got 'wfc3'"):
            legdistort.simulate_exposures(camera="wfc3")
        with pytest.raises(InputError, match="camera is for images"):
            simulate_gsaoi_matches(camera="gsaoi")


@pytest.fixture(scope="module")
def measured(frames):
    """These exposures, and the stars measured on them."""
    exposures = legdistort.read_exposures(f"{frames[0]}/*.fits", ext="SCI")
    return exposures, legdistort.measure(exposures)


class TestFrames:
    def test_reading(self, frames):
        folder, _, _ = frames
        exposures = legdistort.read_exposures(f"{folder}/*.fits", ext="SCI")
        assert [e.name for e in exposures[:4]] == ["exp0-1", "exp1-1", "exp1-2", "exp2-1"]
        assert {(e.exposure, e.detector) for e in exposures[:3]} == {("exp0", "1"), ("exp1", "1"), ("exp1", "2")}
        for exposure in exposures[1:3]:  # the planes of its own detector
            assert np.argwhere(exposure.mask).tolist() == [[50 + 10 * int(exposure.detector), 60]]
            assert np.allclose(exposure.uncertainty**2, np.maximum(exposure.data, 1), rtol=1e-3, atol=6e4)
        opened = legdistort.open_exposures(f"{folder}/*.fits", ext="SCI")
        assert [e.name for e in opened] == [e.name for e in exposures]
        assert np.array_equal(opened[2].read().data, exposures[2].data)
        (one,) = legdistort.read_exposures(folder / "exp0.fits", ext=("SCI", 1))
        assert (one.name, one.detector) == ("exp0_SCI1", None)

    @pytest.mark.slow
    @pytest.mark.usefixtures("undrawn")
    def test_run_to_mosaic_and_headers(self, frames, tmp_path):
        """Frames to mosaic over the gap, and WCSs in all extensions; stars lie where they are."""
        folder, camera, sky = frames
        camera.write(tmp_path / "camera.asdf")
        paths = sorted(map(str, folder.glob("*.fits")))
        out = tmp_path / "out"
        given = ["--ext", "SCI", "--camera", str(tmp_path / "camera.asdf"), "--degree", "2", "--min-exposures", "3"]
        assert main(["run", *paths, *given, "--out", str(out), "--quiet"]) == 0
        solution = legdistort.Solution.read(out / "solution.asdf")
        assert solution.names == tuple(f"exp{i}" for i in range(6))
        assert 0.8 < solution.chi2 / solution.dof < 1.25
        left = to_nearest(solution.estimate.positions, sky)
        assert len(left) > 50
        assert np.sqrt(np.mean(left**2)) < 0.03
        again = ["match", str(out / "detections.ecsv"), "--min-exposures", "3", "--out", str(tmp_path / "again.ecsv")]
        assert main([*again, "--quiet"]) == 0  # with the camera of the run, not with that of the headers
        meta = QTable.read(tmp_path / "again.ecsv").meta["camera"]
        assert all(each["header_layout"] is not None for each in meta["detectors"])
        known = [each | {"header_layout": None} for each in meta["detectors"]]
        assert meta | {"detectors": known, "header_map": None} == camera.to_meta()
        mosaic = fits.getdata(out / "mosaic.fits")
        assert np.isfinite(mosaic[100:-100, 100:-100]).mean() > 0.97  # the gap of 15 px is filled
        assert main(["attach", str(out / "solution.asdf"), *paths[:2], "--out", str(tmp_path / "done"), "--quiet"]) == 0
        xy = 0.9 * pixels(5, 200) + 5
        for path in paths[:2]:
            with fits.open(tmp_path / "done" / path.rpartition("/")[2]) as hdulist:
                for hdu in hdulist:
                    if hdu.name in ("SCI", "ERR", "DQ"):
                        key = str(hdu.header["CCDCHIP"])
                        name = path.rpartition("/")[2].removesuffix(".fits")
                        found = WCS(hdu.header, hdulist).all_pix2world(xy, 0)
                        true = np.stack(solution[name, key].wcs(*xy.T), axis=1)
                        assert np.abs((found - true) * 3600 / 0.05).max() < 2e-3
                        series = solution.sky.to_sky(np.stack(solution[name, key].model.inverse(*xy.T), axis=1))
                        series = np.stack([series.ra.deg, series.dec.deg], axis=1)
                        assert np.abs(series - true).max() * 72000 < 1e-5

    @pytest.mark.slow
    def test_step_by_step_no_detector_is_missed(self, frames, tmp_path):
        """Tables name exposures and detectors, their meta data both in one; only what is dark is left out."""
        folder, camera, _ = frames
        camera.write(tmp_path / "camera.asdf")
        measured, matched = str(tmp_path / "measured.ecsv"), str(tmp_path / "matched.ecsv")
        assert main(["measure", f"{folder}/*.fits", "--ext", "SCI", "--out", measured, "--quiet"]) == 0
        given = ["--camera", str(tmp_path / "camera.asdf"), "--min-exposures", "3"]
        assert main(["match", measured, *given, "--out", matched, "--quiet"]) == 0
        assert QTable.read(matched).meta["left_out"] == {}
        table = QTable.read(measured)
        table[(table["exposure"] != "exp1") | (table["detector"] != "2")].write(measured, overwrite=True)
        assert main(["match", measured, *given, "--out", matched, "--quiet", "--overwrite"]) == 0
        assert QTable.read(matched).meta["left_out"] == {"exp1-2": "no star was detected in it"}

    def test_tables_of_runs_with_a_camera(self, frames, tmp_path, capsys):
        """What contradicts that camera is refused before anything is matched."""
        _, camera, _ = frames
        for k, each in enumerate((camera, replace(camera, name="other"))):
            table = QTable({"exposure": [f"exp{k}"], "detector": ["1"], "x": [1.0], "y": [1.0]})
            table["x_err"] = table["y_err"] = 0.1
            table.meta["camera"] = each.to_meta()
            table.write(tmp_path / f"t{k}.ecsv")
        paths, out = [str(tmp_path / f"t{k}.ecsv") for k in (0, 1)], ["--out", str(tmp_path / "m.ecsv"), "--quiet"]
        assert main(["match", *paths, *out]) == 1
        assert "the tables come from runs with different cameras: give the one that holds" in capsys.readouterr().err
        assert main(["match", paths[0], "--shape", "100", "100", *out]) == 1
        assert "--shape comes from the camera of the run: leave it out" in capsys.readouterr().err

    @pytest.mark.slow
    def test_one_file_for_every_detector(self, frames, tmp_path):
        """The same table of positions as from files with both."""
        folder, camera, _ = frames
        for path in folder.glob("*.fits"):
            with fits.open(path) as hdulist:
                for key in sorted({str(hdu.header["CCDCHIP"]) for hdu in hdulist[1:]}):
                    mine = [hdu.copy() for hdu in hdulist[1:] if str(hdu.header["CCDCHIP"]) == key]
                    fits.HDUList([hdulist[0].copy(), *mine]).writeto(tmp_path / f"{path.stem}_{key}_cal.fits")
        together = legdistort.measure(legdistort.read_exposures(sorted(folder.glob("exp[01].fits")), ext="SCI"))
        apart = legdistort.open_exposures(sorted(tmp_path.glob("exp[01]*.fits")))
        parted = legdistort.measure(camera.of_detectors(apart))
        assert set(parted["exposure"]) == {"exp0_cal", "exp1_cal"}
        for name in ("detector", "x", "y", "x_err"):
            assert np.array_equal(np.sort(parted[name]), np.sort(together[name]))
        assert [(each.exposure, each.detector) for each in apart][:2] == [("exp0_cal", "1"), ("exp1_cal", "1")]
        apart = [replace(each, exposure=None, detector=None) for each in apart]
        assert [each.exposure for each in camera.of_detectors(apart)] == ["exp0_cal", "exp1_cal", "exp1_cal"]
        with pytest.raises(InputError, match="names none of the detectors A, B"):
            legdistort.Camera("c", dict(zip("AB", camera.detectors.values(), strict=True))).of_detectors(apart)
        with pytest.raises(InputError, match="is of detector 1, which its name does not contain"):
            camera.of_detectors([replace(apart[0], name="frame")])

    def test_detectors_under_other_names_are_known_by_their_numbers(self, frames, tmp_path):
        """The camera counts them, as EXTVER does, and a keyword before that has a name: DETECTOR = 'H2RG-1'."""
        folder, camera, _ = frames
        for path in sorted(folder.glob("exp[01].fits")):
            with fits.open(path) as hdulist:
                for hdu in hdulist[1:]:
                    hdu.header["DETECTOR"] = f"H2RG-{hdu.header.pop('CCDCHIP')}"
                hdulist.writeto(tmp_path / path.name)
        known = legdistort.read_exposures(sorted(folder.glob("exp[01].fits")), ext="SCI")
        named = legdistort.read_exposures(sorted(tmp_path.glob("*.fits")), ext="SCI")
        assert {each.detector for each in named} == {"H2RG-1", "H2RG-2"}
        understood = camera.of_detectors(named)
        assert [(e.name, e.exposure, e.detector) for e in understood] == [
            (e.name, e.exposure, e.detector) for e in known
        ]

    @pytest.mark.slow
    def test_layout_by_headers(self, frames, measured):
        """Without a camera the headers say how the detectors lie; here they know nothing of the distortion."""
        _, camera, _ = frames
        exposures, table = measured
        matches = legdistort.match(table, exposures=exposures, min_exposures=3)
        found = matches.camera
        assert list(found.detectors) == ["1", "2"]
        middle = np.array([[99.5, 149.5]])
        apart = found["2"].to_focal_plane(middle) - found["1"].to_focal_plane(middle)
        true = camera["2"].to_focal_plane(middle) - camera["1"].to_focal_plane(middle)
        assert np.abs(np.linalg.norm(apart) - np.linalg.norm(true)) < 1
        assert matches.sky is not None

    def test_bad_cameras_in_the_shell(self, frames, tmp_path, capsys):
        """Each is refused before anything is measured, in a sentence that names file and camera."""
        folder, camera, _ = frames
        other = legdistort.Camera("WFC", dict(zip("AB", camera.detectors.values(), strict=True)))
        other.write(tmp_path / "other.asdf")
        (tmp_path / "text.asdf").write_text("detectors")
        for name, words in (
            (
                tmp_path / "other.asdf",
                "exp0-1 is of detector 1, and camera WFC has A, B: is it a camera of another ins",
            ),
            (tmp_path / "text.asdf", "text.asdf is not a readable ASDF file"),
            (tmp_path / "none.asdf", "none.asdf: no such file"),
            ("gsaoi", "exp0-1 has shape (300, 200), detector 1 of camera GSAOI (2048, 2048) (ny, nx): is it a camera"),
        ):
            given = ["--ext", "SCI", "--camera", str(name), "--out", str(tmp_path / "out"), "--quiet"]
            assert main(["run", f"{folder}/*.fits", *given]) == 1
            assert words in capsys.readouterr().err
            assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("known", [True, pytest.param(False, marks=pytest.mark.slow)])
    def test_a_file_with_more_extensions_than_others(self, frames, tmp_path, known):
        """A detector that the camera does not have is named; by headers alone it is one more."""
        folder, camera, _ = frames
        with fits.open(folder / "exp2.fits") as hdulist:
            extra = fits.ImageHDU(hdulist["SCI", 2].data[::-1], hdulist["SCI", 2].header, name="SCI", ver=3)
            extra.header["CCDCHIP"], extra.header["CRPIX1"] = 3, extra.header["CRPIX1"] - 215
            extra.header["GAIN"] = 1.0
            fits.HDUList([*(hdu.copy() for hdu in hdulist), extra]).writeto(tmp_path / "exp2.fits")
        paths = [*sorted(folder.glob("exp[0134].fits")), tmp_path / "exp2.fits"]
        exposures = legdistort.read_exposures(paths, ext="SCI")
        assert [e.name for e in exposures if e.exposure == "exp2"] == ["exp2-1", "exp2-2", "exp2-3"]
        if known:
            with pytest.raises(
                InputError, match=r"exp2-3 is of detector 3, and camera TWO has 1, 2: .* leave these ext"
            ):
                camera.of_detectors(exposures)
        else:
            table = legdistort.measure(exposures)
            with pytest.warns(AssumptionWarning, match="hardly a detection of detector 3 fits"):  # its image is turned
                matches = legdistort.match(table, exposures=exposures, min_exposures=3)
            assert list(matches.camera.detectors) == ["1", "2", "3"]

    def test_a_camera_of_another_instrument(self, measured, gsaoi):
        exposures, table = measured
        with pytest.raises(InputError, match="is it a camera of another instrument"):
            legdistort.match(table, exposures=exposures, camera=gsaoi, min_exposures=2)


def to_nearest(found, true):
    """Distances to the nearest true positions after a common similarity, of those that are close."""
    found = found[np.isfinite(found[:, 0])]
    for limit in (40, 3, 0.5):
        near = np.argmin(np.hypot(*(found[:, None] - true[None]).transpose(2, 0, 1)), axis=1)
        off = true[near] - found
        good = np.hypot(*(off - np.median(off, axis=0)).T) < limit
        z, w = found[good] @ [1, 1j], true[near][good] @ [1, 1j]
        a, b = np.linalg.lstsq(np.stack([z, np.ones(len(z))], axis=1), w, rcond=None)[0]
        moved = a * (found @ [1, 1j]) + b
        found = np.stack([moved.real, moved.imag], axis=1)
    return (true[near] - found)[good]


class TestExchanged:
    """Two detectors in each other's places: every exposure fits, but no star that crosses does."""

    @staticmethod
    def exchanged(camera, a, b):
        return legdistort.Camera(camera.name, camera.detectors | {a: camera[b], b: camera[a]})

    @pytest.mark.parametrize("pair", [("1", "2"), ("1", "3"), ("3", "4")])
    def test_solving(self, table, gsaoi, pair):
        words = (
            f"detectors {pair[0]} and {pair[1]} of camera GSAOI seem to be exchanged: .* exchange them in the camera"
        )
        matches = legdistort.Matches.from_table(table, camera=self.exchanged(gsaoi, *pair))
        with pytest.raises(InputError, match=words):
            legdistort.solve(matches)

    @pytest.mark.slow
    def test_matching(self):
        """Of detectors alike: all exposures match, and nothing else would tell; others are rightly tied, c and d."""
        rng, size = np.random.default_rng(1), 1000
        places = {"a": 0.0, "b": 1020.0, "c": 2040.0, "d": 3060.0}
        sky, rows = rng.uniform([-200, -200], [4260, 1200], (1600, 2)), []
        for i in range(6):
            f = sky + rng.uniform(-200, 200, 2)
            for key, first in places.items():
                xy = f - [first, 0] + rng.normal(0, SIGMA, f.shape)
                inside = np.all((xy > 0) & (xy < size - 1), axis=1)
                rows += [(f"f{i}", key, *each, SIGMA, SIGMA) for each in xy[inside]]
        table = QTable(rows=rows, names=["exposure", "detector", "x", "y", "x_err", "y_err"])
        chips = {
            key: legdistort.Detector((size, size), layout=[[1, 0, -first], [0, 1, 0]]) for key, first in places.items()
        }
        camera = legdistort.Camera("row", chips)
        assert legdistort.match(table, camera=camera).camera is camera
        for a, b in ("ab", "ac", "bc"):
            with pytest.raises(InputError, match=f"detectors {a} and {b} of camera row seem to be exchanged"):
                legdistort.match(table, camera=self.exchanged(camera, a, b))

    def test_layouts_that_are_wrong_by_pixels(self, gsaoi):
        """They are not taken for exchanged ones."""
        rows = gsaoi_images.Night(n_exposures=5, n_stars=470, dither=6.0).table(sigma=SIGMA)
        for camera in (gsaoi, misplaced(gsaoi, shift=10, turn=0.1)):
            exchanged.check_places(legdistort.Matches.from_table(rows, camera=camera))
