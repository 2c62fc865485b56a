"""How well the model of the stars explains their light: frames and tables made by numpy alone."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable
from photutils.psf import ImagePSF

import legdistort as ld
from legdistort.assessment.model_misfits import model_misfits
from legdistort.assessment.run_checks import image_check
from legdistort.inputs.exposures import Exposure

SIZE, FWHM, BETA = 320, 4.0, 3.0
PIXELS = 17**2  # in the box around a star of this width


def profile(x, y, fwhm=FWHM):
    alpha = fwhm / 2 / np.sqrt(2 ** (1 / BETA) - 1)
    return (1 + (x**2 + y**2) / alpha**2) ** -BETA


def frame(name, rng, *, jump=0.0, fwhm=FWHM):
    """An exposure of 25 stars whose light falls to equal parts on two places that are so many pixels apart in x."""
    at = np.stack(np.meshgrid(*[np.arange(30, SIZE, 60)] * 2), axis=-1).reshape(-1, 2) + rng.uniform(-4, 4, (25, 2))
    y, x = np.mgrid[:SIZE, :SIZE]
    image = np.full((SIZE, SIZE), 500.0)
    for (cx, cy), height in zip(at, np.geomspace(3000, 30000, 25), strict=True):
        near = np.s_[max(int(cy) - 25, 0) : int(cy) + 26, max(int(cx) - 25, 0) : int(cx) + 26]
        for shift in (-jump / 2, jump / 2):
            image[near] += height / 2 * profile(x[near] - cx - shift, y[near] - cy, fwhm)
    return Exposure(name, rng.poisson(image).astype(np.float32), gain=1.0, read_noise=0.0, saturation=1e6)


def measured(exposures, psf="moffat"):
    found = ld.measure(exposures, psf=psf)
    return found[found["flags"] == 0]


def alike(n=6):
    """What makes the rest of the check pass."""
    from legdistort.assessment.stack_quality import Quality

    return Quality(9, FWHM, 0.05, 0.1, 0.01, exposures={f"e{i}": (4.0 + 0.01 * i, 0.05, 20.0) for i in range(n)})


def check_of(table):
    return image_check(alike(), model_misfits(table))


def listed(rng, n_exposures, n_stars, misfit=0.0, *, spread=1.0, model="moffat"):
    """A table of stars of which chi2 has noise, and what a misfit (n_exposures,) in parts of the light adds to it."""
    n = n_exposures * n_stars
    which = np.repeat(np.arange(n_exposures), n_stars)
    snr, dof = 20 * np.exp(spread * rng.exponential(1.0, n)), PIXELS - 5
    chi2 = rng.chisquare(dof, n) / dof + np.broadcast_to(misfit, n_exposures)[which] ** 2 * snr**2 / dof
    error = FWHM / np.sqrt(8 * np.log(2)) / snr * np.sqrt(np.maximum(1, chi2 - 3 * np.sqrt(2 / dof))) * u.pix
    named = {"exposure": [f"e{i:02d}" for i in which], "x_err": error, "y_err": error, "fwhm": np.full(n, FWHM) * u.pix}
    return QTable(named | {"chi2": chi2, "flags": np.zeros(n, dtype=int), "psf": [model] * n})


def test_a_misfit_is_found_as_it_is():
    true = np.array([0.0, 0.05, 0.1, 0.3])
    found = model_misfits(listed(np.random.default_rng(1), 4, 200, true))
    assert list(found) == ["e00", "e01", "e02", "e03"]
    np.testing.assert_allclose([each.square for each in found.values()], true**2, rtol=0.05, atol=1e-4)


def test_noise_and_what_all_exposures_have_in_common_pass():
    rng, odd = np.random.default_rng(2), 0
    for _ in range(100):
        n, common = rng.integers(4, 30), rng.choice([0.0, 0.15])
        table = listed(rng, n, rng.integers(5, 60), common * rng.uniform(0.8, 1.2, n))
        odd += check_of(table).state != "pass"
    assert odd == 0


@pytest.mark.parametrize(("spread", "least"), [(0.0, 0.85), (1.0, 0.5)])
def test_the_errors_of_misfits_are_right_or_too_large(spread, least):
    """Right where all stars are alike, and too large where the brightest tell more than the others."""
    tables = [listed(np.random.default_rng(s), 10, 24, spread=spread) for s in range(20)]
    found = [each.square / each.error for table in tables for each in model_misfits(table).values()]
    assert least < np.std(found) < 1.1


def test_a_guiding_jump_is_named_and_a_doubled_frame_is_no_reason_to_doubt_the_others():
    rng = np.random.default_rng(3)
    frames = [frame(f"e{i}", rng, jump=FWHM if i == 2 else 0.0, fwhm=FWHM * (1 + 0.02 * i)) for i in range(5)]
    check = check_of(measured(frames))
    assert (check.name, check.state) == ("images", "fail")
    assert "bright stars deviate from their model by more of their light than the usual" in check.sentence
    assert " in e2 (" in check.sentence
    assert "e3" not in check.sentence
    assert "leave it out" in check.cure


@pytest.mark.slow
def test_a_psf_of_other_frames_is_seen_and_their_own_passes():
    rng, (y, x) = np.random.default_rng(4), np.mgrid[-48:49, -48:49] / 4
    frames = [frame(f"e{i}", rng) for i in range(2)]

    def said(fwhm):
        image = profile(x, y, fwhm)
        return check_of(measured(frames, psf=ImagePSF(16 * image / image.sum(), oversampling=4)))

    assert said(FWHM).state == "pass"
    wrong = said(1.5 * FWHM)
    assert wrong.state == "fail"
    assert "bright stars deviate from their PSF (ImagePSF) by" in wrong.sentence
    assert "--psf auto" in wrong.cure


def test_nothing_is_asked_of_tables_without_the_columns_of_a_measurement():
    table = listed(np.random.default_rng(5), 4, 20, np.array([0, 0, 0.5, 0]))
    assert check_of(table).state == "fail"
    table.remove_column("chi2")
    assert model_misfits(table) == {}
    assert check_of(table).state == "pass"
