"""Distortions in the headers of frames as the prior."""

import re
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table, vstack
from astropy.wcs import WCS, DistortionLookupTable
from caller_warnings import warns_here

import legdistort as ld
from legdistort import pipeline
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.table_files import read_table
from legdistort.priors.from_headers import describe, header_distortions
from legdistort.priors.prior import HeaderPrior
from legdistort.wcs.attachment import attach

SHAPE = (256, 256)
SCALE = 1e-5  # degrees a pixel
SIP = {
    "A_ORDER": 3,
    "A_2_0": 2e-4,
    "A_0_2": -1e-4,
    "A_3_0": 4e-7,
    "A_1_2": 4e-7,
    "B_ORDER": 3,
    "B_1_1": 1.5e-4,
    "B_2_0": 5e-5,
    "B_0_3": 4e-7,
    "B_2_1": 4e-7,
}


def pixels(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).normal(100, 5, shape).astype("float32")


def header(k, *, sip=SIP, **more):
    """That of exposure k: dithered and turned a little, its reference pixel off the centre."""
    rng = np.random.default_rng(k)
    angle, (dx, dy) = rng.uniform(-0.1, 0.1), rng.uniform(-40, 40, 2) * SCALE
    c, s = SCALE * np.cos(angle), SCALE * np.sin(angle)
    kind = "-SIP" if sip else ""
    cards = {"CTYPE1": f"RA---TAN{kind}", "CTYPE2": f"DEC--TAN{kind}", "CRPIX1": 100.5, "CRPIX2": 140.5}
    cards |= {"CRVAL1": 150 + dx, "CRVAL2": 2 + dy, "CD1_1": -c, "CD1_2": s, "CD2_1": s, "CD2_2": c}
    return fits.Header(cards | dict(sip or {}) | more)


def exposure(k, **known):
    made = header(k, **known)
    return Exposure(f"e{k}", pixels(k), wcs=WCS(made), header=made)


def told_of(exposures):
    return describe(header_distortions(exposures))


def positions(n=6, n_stars=180):
    """Detections through the SIP of the headers, fluxes numbering the stars; and where the stars are, degrees."""
    rng = np.random.default_rng(1)
    sky = np.array([150, 2.0]) + rng.uniform(-180, 180, (n_stars, 2)) * SCALE
    tables = []
    for k in range(n):
        xy = WCS(header(k)).all_world2pix(sky, 0)
        seen = np.flatnonzero(np.all((xy > 5) & (xy < 250), axis=1))
        tables.append(Table({"exposure": np.full(len(seen), f"e{k}"), "x": xy[seen, 0], "y": xy[seen, 1]}))
        tables[-1]["x_err"] = tables[-1]["y_err"] = 0.001
        tables[-1]["flux"] = 1000.0 + seen
    return vstack(tables), sky


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    return ld.simulate_exposures(small=True, seed=3).write(tmp_path_factory.mktemp("night"))


@pytest.fixture(scope="module")
def sip_night(night, tmp_path_factory):
    """The frames with a SIP distortion in their headers."""
    frames, folder = [], tmp_path_factory.mktemp("sip")
    for path in night:
        content, cards = fits.getdata(path), fits.getheader(path)
        cards["CTYPE1"], cards["CTYPE2"] = "RA---TAN-SIP", "DEC--TAN-SIP"
        cards.update({"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-5, "B_0_2": 1e-5})
        frames.append(folder / path.name)
        fits.writeto(frames[-1], content, cards)
    return frames


def test_the_prior_of_headers_is_that_of_the_file(tmp_path):
    exposures = [exposure(k) for k in range(3)]
    prior = ld.Prior.from_headers(exposures, degree=3, sigma=0.1, static_sigma=0.2)
    assert isinstance(prior, ld.Prior)  # the same SIP in all of them: one static distortion
    assert prior.truncation < 1e-3
    assert ld.Prior.from_model(exposures[0].wcs, shape=SHAPE, degree=prior.degree - 1).truncation > 1e-3
    assert prior.degree > 3
    assert (prior.sigma == 0.1).all()
    assert (prior.static_sigma == 0.2).all()
    fits.writeto(tmp_path / "e0.fits", pixels(), header(0))
    same = ld.Prior.from_file(tmp_path / "e0.fits", degree=prior.degree)
    np.testing.assert_allclose(prior.mean, same.mean, atol=1e-9)
    (read,) = ld.open_exposures(tmp_path / "e0.fits")
    np.testing.assert_allclose(ld.Prior.from_headers([read]).mean, same.mean, atol=1e-9)


def test_the_degree_of_a_series_from_headers():
    """Three at least, unless another is asked for; a fit may leave it open by a word."""
    weak = [exposure(0, sip={"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-7, "B_0_2": 1e-7})]
    assert ld.Prior.from_headers(weak).degree == 3
    assert HeaderPrior().read(weak, "auto").degree == 3
    assert [HeaderPrior(sigma=0.1).read(weak, degree).degree for degree in (2, 4)] == [2, 4]


def test_a_distortion_of_a_hundredth_of_a_pixel_is_one():
    def found(a_2_0):
        return header_distortions([exposure(0, sip={"A_ORDER": 2, "B_ORDER": 2, "A_2_0": a_2_0})])

    rate = found(1e-4)["e0"].size / 1e-4
    assert found(0.008 / rate) == {}
    assert found(0.013 / rate)["e0"].size == pytest.approx(0.013, rel=0.02)


def test_the_kind_of_a_distortion_is_named():
    tpv = header(0, sip=None)
    tpv.update({"CTYPE1": "RA---TPV", "CTYPE2": "DEC--TPV", "PV1_1": 1.0, "PV2_1": 1.0, "PV1_4": 100.0})
    told = describe(header_distortions([Exposure("a", pixels(), wcs=WCS(tpv)), exposure(0, sip=None)]))
    assert re.fullmatch(r"TPV, up to \d.* px over the detector", told)
    assert describe(header_distortions([exposure(0)])).startswith("SIP, up to")
    table = WCS(header(0, sip=None))
    shifts = np.zeros((3, 3), "f4")
    shifts[1, 1] = 2.0
    table.cpdis1 = DistortionLookupTable(shifts, (1, 1), (1, 1), (SHAPE[1] / 2, SHAPE[0] / 2))
    assert describe(header_distortions([Exposure("a", pixels(), wcs=table)])).startswith("look-up tables, up to")


@pytest.mark.slow
def test_headers_that_differ_give_each_its_own():
    small = {key: value if key.endswith("ORDER") else 0.9 * value for key, value in SIP.items()}
    for change, one in ((1e-4, True), (1e-3, False)):  # of 4 pixels, so 0.0004 and 0.004
        hardly = SIP | {"A_2_0": SIP["A_2_0"] * (1 + change)}
        assert isinstance(ld.Prior.from_headers([exposure(0), exposure(1, sip=hardly)]), ld.Prior) == one
    priors = ld.Prior.from_headers([exposure(0), exposure(1, sip=small)])
    assert list(priors) == ["e0", "e1"]
    ratio = priors["e1"].rms / priors["e0"].rms
    np.testing.assert_allclose(ratio, 0.9, rtol=0.02)
    with pytest.raises(InputError, match="the headers of e2 have no distortion, and those of the others differ"):
        ld.Prior.from_headers([exposure(0), exposure(1, sip=small), exposure(2, sip=None)])


@pytest.mark.slow
def test_series_end_at_the_highest_degree_of_sip():
    steep = {"A_ORDER": 9, "B_ORDER": 9, "A_9_0": 5e-18, "B_0_9": 5e-18}
    prior = ld.Prior.from_headers([exposure(0, sip=steep)])
    assert prior.degree == 9
    assert prior.truncation > 1e-3


def test_headers_without_a_distortion():
    for wcs in (WCS(header(0, sip=None)), None):
        with pytest.raises(InputError, match="no header has a distortion that could be the prior"):
            ld.Prior.from_headers([Exposure("a", pixels(), wcs=wcs)])
    with warns_here(AssumptionWarning, match="the headers of e1 have no distortion; they are given that"):
        prior = ld.Prior.from_headers([exposure(0), exposure(1, sip=None)])
    assert isinstance(prior, ld.Prior)


@pytest.mark.slow
def test_the_gwcs_beside_an_image_goes_before_its_header(tmp_path):
    table, _ = positions()
    exposures = [exposure(k) for k in range(6)]
    matches = ld.match(table, exposures=exposures)
    solution = ld.solve(matches, prior=ld.Prior.from_headers(exposures), degree=3)
    fits.writeto(tmp_path / "e0.fits", pixels())
    attach(solution, tmp_path / "e0.fits", in_place=True, kind=None)
    (frame,) = ld.open_exposures(tmp_path / "e0.fits")
    assert frame.has_gwcs
    assert told_of([frame]).startswith("gwcs, up to ")
    prior = ld.Prior.from_headers([frame])
    exact = solution.coefficients[0]
    n = min(prior.mean.shape[1], exact.shape[1])
    np.testing.assert_allclose(prior.mean[:, 3:n], exact[:, 3:n], atol=2e-3)


def test_the_size_is_that_over_the_detector():
    """Measured without the package: what no similarity of the pixels explains."""
    y, x = np.mgrid[0:256:32j, 0:256:32j].reshape(2, -1) * 255 / 256
    wcs = WCS(header(0))
    px, py = (wcs.sip_pix2foc(np.column_stack([x, y]), 0) - wcs.sip_pix2foc(np.array([[0.0, 0.0]]), 0)).T
    design = np.column_stack([px + 1j * py, np.ones(len(px))])
    best = np.linalg.lstsq(design, x + 1j * y, rcond=None)[0]
    size = np.abs(design @ best - (x + 1j * y)).max()
    words = told_of([exposure(0), exposure(1, sip=None)])
    assert words.startswith("SIP, up to ")
    assert float(words.split()[3]) == pytest.approx(size, rel=0.1)
    for factor, told in ((0.5, False), (2, True)):
        tiny = {key: v if key.endswith("ORDER") else v * factor * 0.01 / size for key, v in SIP.items()}
        assert (told_of([exposure(0, sip=tiny)]) is not None) == told


@pytest.mark.slow
def test_a_distortion_that_is_not_used_is_said():
    table, _ = positions()
    exposures = [exposure(k) for k in range(6)]
    matches = ld.match(table, exposures=exposures)
    words = r"the headers have a distortion \(SIP, up to [\d.]+ px over the detector\) that is not used; --prior "
    with warns_here(AssumptionWarning, match=f"^{words}header takes it as the static distortion"):
        ld.solve(matches, degree=3)
    with warns_here(AssumptionWarning, match=words):
        ld.solve(matches, degree=3, prior=ld.Prior([[0.0], [0.0]], sigma=5.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error", AssumptionWarning)
        ld.solve(matches, degree=3, prior=ld.Prior.from_headers(exposures))
        ld.solve(ld.match(table, exposures=[exposure(k, sip=None) for k in range(6)]), degree=3)


UNUSED = "the headers have a distortion .SIP, up to .* that is not used"


def state_of(solution):
    return next(check.state for check in solution.checks if check.name == "header distortion")


@pytest.fixture(scope="module")
def unused():
    """Matches of frames whose headers have a distortion, one of them of positions that scatter by far more."""
    table, _ = positions()
    own = np.flatnonzero(table["exposure"] == "e5")
    for name, noise in zip("xy", np.random.default_rng(5).normal(0, 1.5, (2, len(own))), strict=True):
        table[name][own] += noise
    return ld.match(table, exposures=[exposure(k) for k in range(6)], tolerance=8)


@pytest.mark.parametrize(
    "road",
    [
        pytest.param("validate", marks=pytest.mark.slow),
        pytest.param("dropped", marks=pytest.mark.slow),
        "file",
    ],
)
def test_a_distortion_that_is_not_used_is_said_on_every_road(road, unused, tmp_path):
    matches, options = unused if road == "dropped" else unused.without({"e5": "by hand"}), {}
    if road == "validate":
        options = {"validate": 0.2}
    elif road == "file":
        pipeline.write_matched(tmp_path / "m.ecsv", matches, {})
        table = read_table(tmp_path / "m.ecsv")
        matches = ld.Matches.from_table(table, **ld.Matches.read_meta(table.meta))
    with pytest.warns(AssumptionWarning) as caught:
        solution = ld.solve(matches, **options)
    said = [str(each.message) for each in caught]
    assert re.search(UNUSED, said[0])
    assert [word.startswith("exposure e5 is left out") for word in said[1:]] == [True] * (road == "dropped")
    assert set(solution.left_out) == {"e5"}
    assert state_of(solution) == "warn"


@pytest.mark.slow
def test_commands_one_after_the_other_say_it(tmp_path, sip_night, capsys):
    found, matched, out = (str(tmp_path / name) for name in ("found.ecsv", "matched.ecsv", "out"))
    assert main(["measure", *map(str, sip_night[:4]), "--out", found, "--psf", "moffat", "--quiet"]) == 0
    assert main(["match", found, "--out", matched, "--quiet"]) == 0
    assert "that is not used" not in capsys.readouterr().err
    assert main(["solve", matched, "--out", out, "--degree", "2", "--quiet"]) == 0
    assert re.search(UNUSED, capsys.readouterr().err)
    assert state_of(ld.Solution.read(tmp_path / "out" / "solution.asdf")) == "warn"


@pytest.mark.slow
def test_the_sky_is_that_of_the_headers():
    """With their distortion as prior, stars are where the headers say, reference pixel off the centre or not."""
    table, sky = positions()
    exposures = [exposure(k) for k in range(6)]
    matches = ld.match(table, exposures=exposures)
    solution = ld.solve(matches, degree=3, prior=ld.Prior.from_headers(exposures))
    fluxes = dict(zip(matches.table["star"], matches.table["flux"], strict=True))
    truth = sky[[int(fluxes[star] - 1000) for star in solution.estimate.star_names]]
    found = solution.sky.to_sky(solution.estimate.positions)
    off = np.column_stack([(found.ra.deg - truth[:, 0]) * np.cos(np.radians(2)), found.dec.deg - truth[:, 1]]) / SCALE
    assert np.abs(off).max() < 0.02


@pytest.mark.slow
def test_run_takes_the_prior_of_the_headers(tmp_path, night, sip_night, monkeypatch):
    frames, given = sip_night, {}
    monkeypatch.setattr(pipeline, "solve", lambda matches, **options: given.update(options) or pytest.skip("solved"))
    for prior, sigma in (("header", None), (HeaderPrior(sigma=0.3), 0.3)):
        with pytest.raises(pytest.skip.Exception):
            ld.run(frames, out=tmp_path / "out", prior=prior, degree=2)
        assert list(given["prior"]) == [path.stem for path in frames]  # reference pixels move with the dithers
        assert all(each.rms.min() > 0.1 for each in given["prior"].values())
        assert sigma is None or all((each.sigma == sigma).all() for each in given["prior"].values())
    line = ["run", *map(str, frames), "--out", str(tmp_path / "out"), "--quiet", "--prior", "header"]
    with pytest.raises(pytest.skip.Exception):
        main([*line, "--prior-sigma", "0.2", "--degree", "2"])
    assert all((each.sigma == 0.2).all() for each in given["prior"].values())
    monkeypatch.setattr(pipeline, "measure_with_psfs", lambda *_, **__: pytest.fail("measured"))
    with pytest.raises(InputError, match="no header has a distortion"):
        ld.run(night, out=tmp_path / "out", prior="header")
    with pytest.raises(InputError, match="prior must be a Prior"):
        ld.run(frames, out=tmp_path / "out", prior="headers")


def test_the_prior_of_headers_is_for_one_detector(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "measure_with_psfs", lambda *_, **__: pytest.fail("measured"))
    for k in range(4):
        parts = [
            fits.ImageHDU(np.random.default_rng((k, ver)).normal(size=(64, 64)).astype("f4"), name="SCI", ver=ver)
            for ver in (1, 2)
        ]
        for ver, part in enumerate(parts, start=1):
            part.header["CCDCHIP"] = ver
        fits.HDUList([fits.PrimaryHDU(), *parts]).writeto(tmp_path / f"f{k}.fits")
    with pytest.raises(InputError, match=r"is for frames of one detector: static='fit' \(--static fit\) finds"):
        ld.run(f"{tmp_path}/*.fits", ext="SCI", out=tmp_path / "out", prior="header")


def test_the_prior_of_headers_needs_frames(capsys):
    line = ["predict", "--n-exposures", "4", "--n-stars", "50", "--sigma", "0.02", "--prior", "header", "--quiet"]
    assert main(line) == 1
    told = capsys.readouterr().err
    assert "--prior header is for run" in told
    assert "legdistort prior FRAME --out prior.asdf, and give --prior prior.asdf" in told
