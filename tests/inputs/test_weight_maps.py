"""Weight maps beside frames: pixels without weight are bad, and noise is what the map says, whatever its words."""

import logging

import numpy as np
import pytest
from astropy.io import fits
from astropy.stats import mad_std

import legdistort as ld
from legdistort.cli.parser import main
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs.table_files import read_table
from legdistort.measurement.earlier import EarlierRun

GAIN, SKY, FWHM = 4.0, 300.0, 3.5


def frame(rng, stars, flux, noise):
    """Gaussian stars on a flat sky with that noise by pixel, and photon noise of their light."""
    y, x = np.mgrid[: noise.shape[0], : noise.shape[1]]
    light, s = np.zeros(noise.shape), FWHM / 2.3548
    for (a, b), f in zip(stars, flux, strict=True):
        light += f / (2 * np.pi * s**2) * np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * s**2))
    return SKY + rng.poisson(light * GAIN) / GAIN + rng.normal(0, noise)


def stripes(shape):
    """Noise of 6 and 16 in turn, in stripes of 3 pixels that no mesh of the sky resolves."""
    return np.where(np.arange(shape[1]) // 3 % 2, 16.0, 6.0) * np.ones(shape)


def write(path, data, weights=None, suffix=".weight.fits", **cards):
    fits.PrimaryHDU(data.astype(np.float32), fits.Header({"GAIN": GAIN} | cards)).writeto(path, overwrite=True)
    if weights is not None:
        fits.writeto(path.with_name(path.name.removesuffix(".fits") + suffix), weights.astype("f4"), overwrite=True)
    return path


@pytest.mark.parametrize(
    ("words", "values"),
    [
        (None, lambda noise: 7 / noise**2),
        ("map_weight,.w.fits", lambda noise: 1e-9 / noise**2),
        ("MAP_VARIANCE", lambda noise: 1e4 * noise**2),
        ("MAP_RMS,.rms.fits", lambda noise: noise),
    ],
)
def test_noise_is_that_of_the_map_and_of_the_photons(tmp_path, words, values):
    rng, noise = np.random.default_rng(1), stripes((200, 200))
    stars, flux = rng.uniform(20, 180, (6, 2)), np.full(6, 3e4)
    weights = np.array(values(noise))
    weights[:, 90:94] = np.nan if words and "RMS" in words else 0
    suffix = words.partition(",")[2] if words and "," in words else ".weight.fits"
    path = write(tmp_path / "a.fits", frame(rng, stars, flux, noise), weights, suffix)
    for read in (ld.read_exposures, ld.open_exposures):
        exposure = read(path, weight_maps=words)[0].read()
        assert (exposure.mask == np.isin(np.arange(200), range(90, 94))).all()
        good, light = ~exposure.mask, np.maximum(exposure.data - SKY, 0)
        ratio = exposure.uncertainty[good] / np.sqrt(noise**2 + light / GAIN)[good]
        assert np.abs(ratio - 1).max() < 0.05
        assert exposure.stated.mask == ("without weight", f"a{suffix}")
    plain = ld.read_exposures(path, weight_maps="none")[0]
    assert plain.uncertainty is None
    assert not plain.mask.any()


@pytest.mark.slow
def test_positions_are_better_and_their_errors_true(tmp_path):
    rng, noise = np.random.default_rng(5), stripes((500, 500))
    grid = np.stack(np.meshgrid(np.arange(20, 490, 24), np.arange(20, 490, 24)), axis=-1).reshape(-1, 2)
    stars = grid + rng.uniform(-1, 1, grid.shape)
    path = write(tmp_path / "a.fits", frame(rng, stars, np.full(len(stars), 2500.0), noise), 1 / noise**2)

    def off(words):
        (exposure,) = ld.read_exposures(path, weight_maps=words)
        table = ld.measure(exposure, psf="moffat", profile="shared")
        xy = np.stack([table["x"].value, table["y"].value], axis=1)
        near = np.argmin(((xy[:, None] - stars) ** 2).sum(axis=-1), axis=1)
        error = np.stack([table["x_err"].value, table["y_err"].value], axis=1)
        use = (((xy - stars[near]) ** 2).sum(axis=1) < 1) & (table["flags"] == 0)
        assert use.sum() > 250
        return (xy - stars[near])[use], error[use]

    with_map, error = off(None)
    without, _ = off("none")
    assert mad_std(with_map) < 0.85 * mad_std(without)
    assert 0.85 < mad_std(with_map / error) < 1.2


def test_a_map_of_zeros_and_ones_is_a_mask(tmp_path):
    rng = np.random.default_rng(2)
    good = rng.uniform(size=(60, 60)) > 0.01
    path = write(tmp_path / "a.fits", rng.normal(100, 5, (60, 60)), good.astype(float))
    exposure = ld.read_exposures(path)[0]
    assert (exposure.mask == ~good).all()
    assert exposure.uncertainty is None


def test_each_detector_has_the_extension_of_its_own(tmp_path):
    rng = np.random.default_rng(3)
    planes = [fits.ImageHDU(rng.normal(100, 5, (40, 40)).astype("f4"), name="SCI", ver=i) for i in (1, 2)]
    maps = [fits.ImageHDU((np.arange(40) != i) * np.ones((40, 1)), name="SCI", ver=i) for i in (2, 1)]
    fits.HDUList([fits.PrimaryHDU(), *planes]).writeto(tmp_path / "a.fits")
    fits.HDUList([fits.PrimaryHDU(), *maps]).writeto(tmp_path / "a.weight.fits")
    for i, exposure in enumerate(ld.open_exposures(tmp_path / "a.fits", ext="SCI"), start=1):
        assert (np.flatnonzero(exposure.read().mask.all(axis=0)) == [i]).all()


def test_what_is_wrong_with_a_map_is_said_with_both_names(tmp_path):
    data = np.random.default_rng(4).normal(100, 5, (50, 50))
    a = write(tmp_path / "a.fits", data, np.ones((50, 40)))
    b = write(tmp_path / "b.fits", data + 1)
    with pytest.raises(
        InputError, match=r"weight map \S*a\.weight\.fits .*\(50, 40\), the image \S*a\.fits \(50, 50\)"
    ):
        ld.read_exposures(a)
    with pytest.raises(InputError, match=r"b\.fits has no weight map: there is no \S*b\.weight\.fits"):
        ld.read_exposures(b, weight_maps="MAP_WEIGHT")
    with pytest.raises(InputError, match=r"weight_maps .* MAP_VARIANCE, MAP_RMS"):
        ld.read_exposures(b, weight_maps="MAP_FLAT")
    write(tmp_path / "a.fits", data, np.ones((50, 50)))
    opened = ld.open_exposures(a)[0]
    fits.writeto(tmp_path / "a.weight.fits", np.zeros((50, 50)), overwrite=True)
    with pytest.raises(InputError, match=r"a\.weight\.fits has changed"):
        opened.read()


def test_maps_among_the_frames_are_no_frames_and_are_said_once(tmp_path, caplog):
    rng = np.random.default_rng(6)
    for name in "abc":
        write(tmp_path / f"{name}.fits", rng.normal(100, 5, (40, 40)), np.ones((40, 40)))
    with caplog.at_level(logging.INFO, "legdistort"):
        opened = ld.open_exposures(str(tmp_path / "*.fits"))
    assert [each.name for each in opened] == ["a", "b", "c"]
    (said,) = [record.message for record in caplog.records if "weight" in record.message]
    assert said == "weight maps are read as MAP_WEIGHT: a.weight.fits, b.weight.fits, c.weight.fits"


def test_noise_of_a_map_without_a_gain_is_not_used_and_that_is_said(tmp_path):
    data = np.random.default_rng(7).normal(100, stripes((60, 60)))
    path = write(tmp_path / "a.fits", data, stripes((60, 60)), GAIN=0.0)
    with pytest.warns(AssumptionWarning, match="no gain is stated, so that of the weight map only pixels without"):
        assert ld.read_exposures(path, weight_maps="MAP_RMS")[0].uncertainty is None


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (lambda noise: 7 / noise**2, "more than 5 times"),  # weights
        (lambda noise: noise**2, "less than 1/5 of"),  # variances
        (lambda noise: 3 * noise, None),  # of pixels that share their noise
    ],
)
def test_a_map_that_is_none_of_the_noise_is_doubted(tmp_path, values, words, capsys):
    rng, noise = np.random.default_rng(8), stripes((200, 200))
    stars = rng.uniform(20, 180, (60, 2))
    path = write(tmp_path / "a.fits", frame(rng, stars, np.full(60, 3e4), noise), values(noise), ".r.fits")
    assert main(["show", str(path), "--weight-maps", "MAP_RMS,.r.fits"]) == 0
    printed = " ".join("".join(capsys.readouterr()).split())
    if words is None:
        assert "MAP_RMS:" not in printed.replace("read as MAP_RMS:", "")
        return
    assert f"doubtful: the pixels scatter by {words} what the weight map states as MAP_RMS" in printed
    with pytest.warns(AssumptionWarning, match=f"a: the pixels scatter by {words} what the weight map states"):
        ld.open_exposures(path, weight_maps="MAP_RMS,.r.fits")


def test_the_shell_passes_the_words_and_a_later_run_reads_the_same(tmp_path, capsys):
    rng, noise = np.random.default_rng(8), stripes((160, 160))
    path = write(
        tmp_path / "a.fits", frame(rng, rng.uniform(15, 145, (15, 2)), np.full(15, 2e4), noise), noise, ".r.fits"
    )
    table = tmp_path / "d.ecsv"
    assert main(["measure", str(path), "--weight-maps", "MAP_RMS,.r.fits", "--psf", "moffat", "--out", str(table)]) == 0
    assert "weight maps are read as MAP_RMS: a.r.fits" in capsys.readouterr().err
    earlier = EarlierRun(tmp_path, read_table(table))
    assert earlier.reading["weight_maps"] == "MAP_RMS,.r.fits"
    assert set(earlier.table.meta["inputs"]) >= {"a.fits", "a.r.fits"}
    assert main(["show", str(path), "--weight-maps", "MAP_RMS"]) == 1
    assert "there is no" in capsys.readouterr().err
