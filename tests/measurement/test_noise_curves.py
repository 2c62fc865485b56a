"""Noise curves against the Cramer-Rao bound, and as errors of the stars of simulated and real frames."""

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.stats import biweight_scale
from astropy.table import QTable
from caller_warnings import warns_here

import legdistort as ld
from legdistort.cli import parser
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs.exposures import Exposure
from legdistort.measurement import injection
from legdistort.measurement.flags import UNUSABLE
from legdistort.measurement.noise_curves import NoiseCurves
from legdistort.results import accuracy
from legdistort.simulation.rendering import Moffat, add_noise, render

SKY, GAIN, READ_NOISE = 100.0, 2.0, 10.0
PSF = Moffat(4.5, 2.8)
N_POSITIONS = 60  # of every flux of the curves that are looked at


def observe(xy, flux, rng, *, size=512, psf=PSF):
    noiseless = render((size, size), xy, flux, psf=psf, sky=SKY)
    return add_noise(noiseless, rng, gain=GAIN, read_noise=READ_NOISE).astype(np.float32)


def field(seed, *, n=40, size=512, psf=PSF):
    rng = np.random.default_rng(seed)
    xy, flux = rng.uniform(10, size - 10, (n, 2)), np.geomspace(1e3, 5e5, n)
    return Exposure(f"field{seed}", observe(xy, flux, rng, size=size, psf=psf), gain=GAIN)


def bound(flux, psf=PSF, half=14):
    """Cramer-Rao bound per axis of a position with flux, width, beta and background free, by differences.

    Position and ellipticity decouple from the others for a centred round star."""
    grid = np.arange(-half, half + 1) + (np.arange(5) - 2)[:, None] / 5

    def model(p):
        fine = Moffat(p[2], p[3])(grid.T.ravel()[None] - p[0], grid.T.ravel()[:, None])
        return p[1] * fine.reshape(2 * half + 1, 5, 2 * half + 1, 5).mean(axis=(1, 3)) + p[4]

    p = np.array([0.0, flux, psf.fwhm, psf.beta, SKY])
    root = np.sqrt(model(p) / GAIN + (READ_NOISE / GAIN) ** 2)
    steps = np.diag(1e-4 * np.maximum(1, np.abs(p)))
    jac = np.array([((model(p + s) - model(p - s)) / (2 * s.sum()) / root).ravel() for s in steps])
    return float(np.sqrt(np.linalg.inv(jac @ jac.T)[0, 0]))


@pytest.fixture(scope="module")
def grid():
    """A frame of isolated stars, and their true positions."""
    rng = np.random.default_rng(8)
    xy = np.stack(np.meshgrid(*[np.arange(13) * 48 + 40.0] * 2), axis=-1).reshape(-1, 2)
    xy, flux = xy + rng.uniform(-4, 4, xy.shape), rng.permutation(np.geomspace(1500, 3e5, len(xy)))
    return Exposure("grid", observe(xy, flux, rng, size=680), gain=GAIN), xy


@pytest.fixture(scope="module")
def curves(grid):
    return ld.calibrate_noise(grid[0], n_positions=N_POSITIONS, seed=3)


def test_curve_is_the_cramer_rao_bound(curves):
    table = curves.table
    limit = np.array([bound(flux) for flux in table["flux"]])
    bright = (table["flux"] > 3e3) & (table["found"] > 0.97)  # fainter fits are no longer linear
    assert np.count_nonzero(bright) >= 8
    measured = np.sqrt((table["x_rms"].value ** 2 + table["y_rms"].value ** 2) / 2)
    n = 2 * N_POSITIONS * np.count_nonzero(bright)
    # the spread of one level is known to 6.5 %, the mean over all levels to 2.3 %
    assert np.sqrt(np.mean((measured / limit)[bright] ** 2)) == pytest.approx(1, abs=0.02 + 2 / np.sqrt(2 * n))
    law = curves.sigma(table["flux"])
    np.testing.assert_allclose(law[bright], limit[bright], rtol=0.12)  # two numbers of an axis, from 60 each


def test_both_regimes_show(curves):
    (law,) = curves.laws
    low, high = law["knee"] / 30, law["knee"] * 30
    for flux, slope in ((low, -1.0), (high, -0.5)):
        step = np.log(curves.sigma(1.1 * flux) / curves.sigma(flux)) / np.log(1.1)
        assert step == pytest.approx(slope, abs=0.03)
    assert curves.sigma(low, axis="x") == pytest.approx(law["x_a"] / low, rel=0.03)
    assert curves.sigma(high, axis="y") == pytest.approx(law["y_b"] / np.sqrt(high), rel=0.03)
    assert curves.table["flux"].min() < law["knee"] < curves.table["flux"].max()


def test_errors_stated_by_fits_are_those_that_were_made(curves):
    good = curves.table[curves.table["found"] > 0.97]
    ratio = np.concatenate([good["x_ratio"], good["y_ratio"]])
    assert np.mean(ratio) == pytest.approx(1, abs=0.04)
    for axis in "xy":
        bias = (good[f"{axis}_bias"] / good[f"{axis}_sigma"]).value
        assert np.abs(bias).max() < 4 * 1.25 / np.sqrt(N_POSITIONS)
    found = curves.table["found"]
    assert found[0] < 1.0 or curves.table["flux"][0] > 700
    assert (found[3:] > 0.97).all()


@pytest.mark.slow
def test_wide_stars_are_known_less_well():
    widths = [3.5, 4.5, 6.0]
    curves = ld.calibrate_noise(field(2), fwhm=widths, fluxes=[1e4, 1e5], n_positions=60)
    for flux in (1e4, 1e5):
        sigma = [float(curves.sigma(flux, fwhm=width)) for width in widths]
        assert sigma == sorted(sigma)
        np.testing.assert_allclose(sigma, [bound(flux, Moffat(w, 2.8), half=20) for w in widths], rtol=0.2)
    between = curves.sigma(1e4, fwhm=4.0)
    assert curves.sigma(1e4, fwhm=3.5) < between < curves.sigma(1e4, fwhm=4.5)
    assert curves.sigma(1e4) == curves.sigma(1e4, fwhm=4.5)  # nearest to the stars of the frame
    with pytest.raises(InputError, match=r"fwhm 7.0 lies outside the widths calibrated for field2, 3.5 to 6 pixels"):
        curves.sigma(1e4, fwhm=7.0)


def test_seeds_reproduce_and_inputs_stay():
    exposure = field(3, n=12, size=300)
    before = exposure.data.copy()
    options = {"fluxes": [1e4, 1e5], "n_positions": 10}
    one, two, other = (ld.calibrate_noise(exposure, seed=seed, **options).table for seed in (5, 5, 6))
    assert (one["x_rms"] == two["x_rms"]).all()
    assert (one["x_rms"] != other["x_rms"]).all()
    np.testing.assert_array_equal(exposure.data, before)
    both = ld.calibrate_noise([field(1, n=12, size=300), exposure], seed=5, **options)
    assert (both.table["x_rms"][both.table["exposure"] == "field3"] == one["x_rms"]).all()  # whoever else is there


def test_file_round_trip(curves, tmp_path):
    curves.write(tmp_path / "noise.ecsv")
    again = NoiseCurves.read(tmp_path / "noise.ecsv")
    flux = np.geomspace(500, 1e6, 20)
    np.testing.assert_array_equal(again.sigma(flux), curves.sigma(flux))
    assert again.table.meta == curves.table.meta
    assert repr(again) == repr(curves)
    with pytest.raises(InputError, match="exists already"):
        curves.write(tmp_path / "noise.ecsv")
    (tmp_path / "text").write_text("no table")
    with pytest.raises(InputError, match="is no ECSV table"):
        NoiseCurves.read(tmp_path / "text")
    with pytest.raises(InputError, match="does not exist"):
        NoiseCurves.read(tmp_path / "nothing")
    QTable({"a": [1]}).write(tmp_path / "other.ecsv")
    with pytest.raises(InputError, match="no column 'exposure'; make one with calibrate_noise"):
        NoiseCurves.read(tmp_path / "other.ecsv")


def test_positions_lie_in_free_sky():
    rng = np.random.default_rng(0)
    mask = np.zeros((300, 400), dtype=bool)
    mask[:, 200:230] = True
    taken = rng.uniform(0, 400, (60, 2))
    exposure = Exposure("e", np.zeros((300, 400)), mask=mask)
    xy = injection.free_positions(exposure, taken, 3.0, n=500, rng=rng)
    assert 20 < len(xy) < 500
    assert np.hypot(*(xy[:, None] - taken[None]).T).min() > injection.AWAY * 3.0
    apart = np.hypot(*(xy[:, None] - xy[None]).T)
    assert apart[~np.eye(len(xy), dtype=bool)].min() > injection.APART * 3.0
    assert not (np.abs(xy[:, 0] - 214.5) < 15 + 6).any()  # a box of 2 FWHM is free of bad pixels
    assert (xy >= 6).all()
    assert (xy <= [393, 293]).all()


def test_light_put_in_is_what_was_asked():
    exposure = Exposure("e", np.zeros((200, 200)), uncertainty=np.full((200, 200), 3.0))
    stars = injection.MoffatStars(injection.moffat.shape(4.5, beta=2.8))
    xy, flux = np.array([[60.3, 70.8], [120.0, 130.49]]), np.array([1e5, 3e4])
    clean = injection.inject(exposure, xy, flux, stars, photon=0.0, rng=None)
    true = render((200, 200), xy, flux, psf=PSF)
    np.testing.assert_allclose(clean.data, true, atol=0.03 * flux.max() * PSF.peak * 0.02)
    noisy = injection.inject(exposure, xy, flux, stars, photon=0.5, rng=np.random.default_rng(0))
    lit = true > 50
    assert np.std((noisy.data - true)[lit] / np.sqrt(0.5 * true[lit])) == pytest.approx(1, abs=0.1)
    np.testing.assert_allclose(noisy.uncertainty**2, 9 + 0.5 * clean.data, rtol=1e-5)


@pytest.mark.parametrize("errors", ["injected", pytest.param("scaled", marks=pytest.mark.slow)])
def test_errors_by_the_curve_are_true(grid, curves, errors):
    exposure, xy = grid
    plain = ld.measure(exposure)
    table = curves.apply(plain, errors)
    assert table.colnames == plain.colnames
    good = (plain["flags"] & UNUSABLE) == 0
    ratio = (table["x_err"] / plain["x_err"]).value[good]
    assert np.median(ratio) == pytest.approx(1, abs=0.08)
    assert not (ratio == 1).any()
    if errors == "injected":  # a function of the flux alone
        assert (np.diff(table["x_err"].value[plain["flux"] > 0]) > 0).all()
    found = np.column_stack([table["x"].value, table["y"].value])[good]
    error = np.column_stack([table["x_err"].value, table["y_err"].value])[good]
    nearest = np.hypot(*(found[:, None] - xy[None]).T).T.argmin(axis=1)
    assert biweight_scale(((found - xy[nearest]) / error).ravel()) == pytest.approx(1, abs=0.12)


@pytest.mark.slow
def test_measure_takes_its_errors_from_the_curve(tmp_path, monkeypatch):
    monkeypatch.setattr(injection, "N_FLUXES", 4)  # three curves are made, which need only be the same
    exposure = field(7, n=12, size=330, psf=Moffat(2.5, 2.8))
    plain, curves = ld.measure(exposure), ld.calibrate_noise(exposure)
    table = ld.measure(exposure, errors="injected")
    assert (table["x"] == plain["x"]).all()
    assert (table["x_err"] == curves.apply(plain, "injected")["x_err"]).all()
    assert (table["x_err"] != plain["x_err"]).any()
    fits.writeto(tmp_path / "field7.fits", exposure.data, fits.Header({"GAIN": GAIN}))
    words = ["measure", str(tmp_path / "field7.fits"), "--quiet", "--out", str(tmp_path / "stars.ecsv")]
    assert parser.main([*words, "--position-errors", "scaled"]) == 0
    assert (QTable.read(tmp_path / "stars.ecsv")["x_err"] == curves.apply(plain, "scaled")["x_err"]).all()


def test_missing_gain_is_estimated_and_said():
    exposure = replace(field(4, size=340), gain=None)
    with warns_here(AssumptionWarning, match=r"photon noise of injected stars is estimated .* field4 [12]\.") as said:
        curves = ld.calibrate_noise(exposure, fluxes=[1e5, 3e5], n_positions=10)
    assert len(said) == 1
    assert curves.table.meta["photon"]["field4"] == pytest.approx(1 / GAIN, rel=0.3)
    given = ld.calibrate_noise(exposure, fluxes=[1e5, 3e5], n_positions=10, measuring={"gain": GAIN})
    assert given.table.meta["photon"]["field4"] == 1 / GAIN


@pytest.mark.slow
def test_uncertainty_plane_tells_the_photon_noise():
    exposure = field(5, n=20, size=340)
    clean = np.maximum(exposure.data, 0)
    with_plane = replace(exposure, gain=None, uncertainty=np.sqrt(clean / GAIN + (READ_NOISE / GAIN) ** 2))
    with warns_here(AssumptionWarning, match="photon noise of injected stars"):
        curves = ld.calibrate_noise(with_plane, fluxes=[1e5, 3e5], n_positions=10)
    assert curves.table.meta["photon"]["field5"] == pytest.approx(1 / GAIN, rel=0.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fluxes": [0.0, 10.0]}, r"fluxes must be positive numbers, in units of the data, got \[0.0, 10.0\]"),
        ({"fluxes": []}, "fluxes must be positive"),
        ({"fluxes": [np.nan]}, "fluxes must be positive"),
        ({"fwhm": 0.1}, r"fwhm must be a number between 0.5 and 200 pixels, got 0.1"),
        ({"fwhm": [3, -1]}, "fwhm must be a number between"),
        ({"n_positions": 3}, "n_positions must be an integer of at least 10, got 3"),
        ({"seed": -1}, "seed must be an integer, 0 or above, got -1"),
        ({"measuring": {"threshold": 0.1}}, "threshold must be a number of at least 2"),
        ({"measuring": {"treshold": 3}}, "measuring has no option 'treshold'; it takes fwhm, threshold, "),
    ],
)
def test_bad_arguments(options, message):
    with pytest.raises(InputError, match=message):
        ld.calibrate_noise(field(1, n=12, size=300), **options)


def test_frames_that_do_not_serve():
    rng = np.random.default_rng(1)
    empty = Exposure("empty", rng.normal(100, 5, (200, 200)), gain=GAIN)
    with pytest.raises(InputError, match="empty: no star above 5 times the noise shows how wide stars are; give fwhm"):
        ld.calibrate_noise(empty)
    curves = ld.calibrate_noise(empty, fwhm=4.0, fluxes=[3e3, 1e4, 1e5], n_positions=10)
    assert curves.table.meta["fwhm"] == {"empty": None}
    assert np.isfinite(curves.sigma(1e4))
    with pytest.raises(InputError, match="nor stars that would determine the photon noise; give gain"):
        ld.calibrate_noise(replace(empty, gain=None), fwhm=4.0)
    packed = np.stack(np.meshgrid(*[np.arange(8.0, 200, 11)] * 2), axis=-1).reshape(-1, 2)
    full = Exposure("full", observe(packed, np.full(len(packed), 5e4), rng, size=200), gain=GAIN)
    with pytest.raises(InputError, match=r"full: no space for injected stars of FWHM .* px: only \d+ places lie 3"):
        ld.calibrate_noise(full)
    with pytest.raises(InputError, match="field1: stars saturate before they are detected"):
        ld.calibrate_noise(replace(field(1, n=12, size=300), saturation=SKY + 25))
    with pytest.raises(InputError, match="errors must be one of 'fit', 'injected', 'scaled', got 'best'"):
        ld.measure(field(1, n=12, size=300), errors="best")
    faint = ld.calibrate_noise(field(1, n=12, size=300), fluxes=[20.0, 30.0], n_positions=10)
    with pytest.raises(InputError, match="field1: too few injected stars were found for a noise curve; raise fluxes"):
        faint.sigma(1e3)
    with pytest.raises(InputError, match="no noise curve for exposure 'else'; there are field1"):
        faint.sigma(1e3, exposure="else")


def test_picture_has_both_regimes(curves):
    ax = curves.plot()
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == [f"FWHM {curves.laws['fwhm'][0].value:.2f} px", "∝ 1 / flux: sky, detector", "∝ 1 / √flux: photons"]
    assert ax.get_xscale() == ax.get_yscale() == "log"
    assert "px" in ax.get_ylabel()
    assert "units" in ax.get_xlabel()
    ax.figure.clear()


def test_command(tmp_path, capsys):
    exposure = field(6, n=12, size=300)
    header = fits.Header({"GAIN": GAIN})
    fits.writeto(tmp_path / "a.fits", exposure.data, header)
    out, picture = tmp_path / "noise.ecsv", tmp_path / "noise.png"
    words = ["noise", str(tmp_path / "a.fits"), "--fwhm", "4", "5", "--n-positions", "10", "--fluxes", "1e4", "1e5"]
    assert parser.main([*words, "--out", str(out), "--plot", str(picture), "--quiet", "--json"]) == 0
    laws = json.loads(capsys.readouterr().out)["laws"]
    assert [law["fwhm"] for law in laws] == [4, 5]
    curves = NoiseCurves.read(out)
    assert curves.exposures == ["a"]
    assert list(curves.table["flux"][:2]) == [1e4, 1e5]
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert parser.main([*words, "--out", str(out), "--quiet"]) == 1
    assert "exists already" in capsys.readouterr().err


@pytest.mark.sets
@pytest.mark.filterwarnings("ignore::legdistort.exceptions.AssumptionWarning")  # the headers tell no gain
def test_scatter_of_real_stars_follows_the_curve(microobservatory):
    """Twelve real, undersampled, drifting frames: solved, and the scatter of every star beside its curve."""
    exposures, detections = microobservatory
    curves = ld.calibrate_noise(exposures, fluxes=np.geomspace(30, 3000, 5), n_positions=20)
    matches = ld.match(detections, exposures=exposures)
    assert len(matches.names) == 12
    solution = ld.solve(matches, degree=2, clip=5.0)
    corrected = accuracy.corrected_positions(solution)
    n = np.isfinite(corrected[:, :, 0]).sum(axis=0)
    used = solution.residuals[solution.residuals["used"]]
    star = np.searchsorted(solution.estimate.star_names, used["star"])
    names = np.asarray(used["exposure"])
    variance = np.zeros(len(used))
    for name in solution.names:
        variance[names == name] = curves.sigma(used["flux"][names == name], exposure=name) ** 2
    expected = np.sqrt(np.bincount(star, variance, len(n)) / np.maximum(n, 1))
    flux = np.bincount(star, used["flux"], len(n)) / np.maximum(n, 1)
    with np.errstate(divide="ignore"):
        scatter = accuracy.scatter(corrected) * np.sqrt(n / (n - 1))
    good = np.flatnonzero((n >= 6) & np.isfinite(scatter))
    bins = np.array_split(good[np.argsort(flux[good])], 12)
    floor = np.median(scatter[bins[-1]])
    assert 0.01 < floor < 0.025  # pixels of 5.2 arcsec: where the undersampled profile is not a Moffat function
    seen, curve = (np.array([np.median(values[b]) for b in bins]) for values in (scatter, expected))
    above = curve > floor
    assert np.count_nonzero(above) >= 8
    assert (np.abs(np.log(seen[above] / curve[above])) < np.log(1.5)).all()
    assert seen[0] > 6 * seen[-1]  # a range worth the name
    both = np.hypot(curve, floor)
    assert (np.abs(np.log(seen / both)) < np.log(1.5)).all()  # curve and floor together describe all
