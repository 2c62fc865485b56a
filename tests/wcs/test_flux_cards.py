"""FLXSCALE in texts of headers, and fluxes of stars on one scale, against depths that numpy put into fluxes."""

import dataclasses
import logging

import numpy as np
import pytest
from astropy.io import fits

import legdistort as ld
from legdistort.cameras.star_scales import star_scales
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.attachment import attach

SHAPE, N_STARS = (600, 600), 80
TIMES, TRANSPARENCY = np.array([30.0, 30.0, 120.0, 60.0, 45.0]), np.array([1.0, 0.85, 0.95, 0.8, 1.0])
FEW = {"n_stars": 8, "seen": 1.0}  # of which the brighter half are compared
DEPTH = TIMES * TRANSPARENCY / np.exp(np.mean(np.log(TIMES * TRANSPARENCY)))


def solved(one, *, n_stars=N_STARS, seen=0.7, flux=True, outliers=0.05):
    """A solution, and the true fluxes of its stars: counts of exposures of unequal time and transparency."""
    rng = np.random.default_rng(3)
    matches = simulate_matches(n_stars=n_stars, n_exposures=len(DEPTH), degree=1, shape=SHAPE, seed=1).matches
    table = matches.table[rng.random(len(matches.table)) < seen]
    true = 10 ** rng.uniform(3, 5, n_stars)
    exposure = np.array([int(str(name).removeprefix("exp")) for name in table["exposure"]])
    if flux:
        table["flux"] = DEPTH[exposure] * true[np.asarray(table["star"])] * np.exp(rng.normal(0, 0.01, len(table)))
        table["flux"][rng.random(len(table)) < outliers] *= 4
    elif "flux" in table.colnames:
        table.remove_column("flux")
    solution = solve(dataclasses.replace(matches, table=table), degree=1)
    return dataclasses.replace(solution, sky=one.sky), true


@pytest.fixture(scope="module")
def one(geometry):
    return geometry(1, 2.0, shape=SHAPE, names=("frame",))


def frames(folder, names):
    for name in names:
        fits.writeto(folder / f"{name}.fits", np.zeros(SHAPE, "uint8"), fits.Header({"FLXSCALE": 7.0}))
    return [folder / f"{name}.fits" for name in names]


def cards(path):
    return fits.Header.fromtextfile(path)


def test_texts_bring_counts_to_one_scale(one, tmp_path, caplog):
    solution, _ = solved(one)
    paths = frames(tmp_path, solution.names)
    caplog.set_level(logging.INFO)
    attach(solution, paths, kind="head", out=tmp_path / "heads")
    scales = np.array([cards(tmp_path / "heads" / f"{name}.head")["FLXSCALE"] for name in solution.names])
    np.testing.assert_allclose(scales * DEPTH, 1, rtol=0.005)
    assert f"FLXSCALE {scales.min():.3g} to {scales.max():.3g} by the fluxes of {N_STARS} stars" in caplog.text
    attach(solution, paths[2], kind="head", out=tmp_path / "alone")  # not relative to those that are attached
    assert cards(tmp_path / "alone" / "exp02.head")["FLXSCALE"] == scales[2]
    assert f"texts of 1 of the {len(paths)} exposures of the solution" in caplog.records[-1].message
    attach(solution, paths[:1], kind="tpv", out=tmp_path / "copies")
    assert fits.getheader(tmp_path / "copies" / "exp00.fits")["FLXSCALE"] == 7.0


def test_one_exposure_alone_says_what_brings_it_to_the_scale_of_others(one, tmp_path, caplog):
    reference, _ = solved(one)
    table = reference.residuals[np.asarray(reference.residuals["exposure"]) == reference.names[0]]
    alone = ld.solve(ld.Matches.from_table(table, shape=SHAPE), reference=reference)
    attach(alone, frames(tmp_path, alone.names), kind="head", out=tmp_path / "heads")
    assert "FLXSCALE" not in cards(tmp_path / "heads" / f"{alone.names[0]}.head")
    assert "solve --base RESULTS brings it into their solution" in caplog.text


@pytest.mark.parametrize(
    ("known", "why"), [({"flux": False}, "the solution has no fluxes of stars"), (FEW, "no 5 common stars")]
)
def test_where_no_fluxes_tell_it_no_text_has_it(one, tmp_path, caplog, known, why):
    solution, _ = solved(one, **known)
    attach(solution, frames(tmp_path, solution.names), kind="head", out=tmp_path / "heads")
    assert not any("FLXSCALE" in cards(path) for path in (tmp_path / "heads").iterdir())
    said = [each.message for each in caplog.records if "no FLXSCALE in the texts" in each.message]
    assert len(said) == 1
    assert why in said[0]
    assert "-FSCALE_DEFAULT" in said[0]


def test_fluxes_of_stars_are_on_one_scale(one):
    """Whichever exposures see a star."""
    solution, true = solved(one, seen=0.5, outliers=0.0)
    stars = solution.stars
    np.testing.assert_allclose(stars["flux"] / true[np.asarray(stars["star"])], 1, rtol=0.04)
    assert stars["flux"].info.description.endswith("scaled to their mean depth by the fluxes of common stars")


def test_fluxes_that_nothing_compares_are_their_means(one):
    solution, _ = solved(one, **FEW)
    rows = solution.residuals[solution.residuals["used"]]
    star = solution.stars["star"][0]
    assert solution.stars["flux"][0] == pytest.approx(np.mean(rows["flux"][rows["star"] == star]))
    assert solution.stars["flux"].info.description == "mean over the exposures as they are, whatever their depths"


def test_exposures_in_a_chain_and_groups_of_detectors():
    """Neighbours alone have common stars; two detectors are joined by stars that cross, a third by none."""
    rng, n = np.random.default_rng(1), 30
    depth, sensitive = rng.normal(0, 0.5, n), np.array([0.0, 0.1, 0.4])
    star = (np.arange(n)[:, None] * 20 + np.arange(120)).ravel()
    exposure = np.repeat(np.arange(n), 120)
    detector = np.where(star % 3 == 2, 2, (star + exposure // 2) % 2)  # by turns on either of the first two
    logs = depth[exposure] + sensitive[detector] + rng.normal(5, 1, star.max() + 1)[star]
    found = star_scales(exposure, detector, star, np.exp(logs + rng.normal(0, 0.003, len(star))), n, 3)
    off = found.exposures + depth
    assert np.std(np.diff(off)) < 0.003
    assert found.exposures.mean() == pytest.approx(0, abs=1e-12)
    assert found.detectors[0] - found.detectors[1] == pytest.approx(0.1, abs=0.002)
    assert found.detectors[2] == 0
    assert np.isinf(found.detector_errors).tolist() == [False, False, True]
    apart = exposure < 15
    found = star_scales(exposure, detector, np.where(apart, star, star + 10**6), np.exp(logs), n, 3)
    assert (found.group == found.group[0]).tolist() == [i < 15 for i in range(n)]


def test_errors_are_those_of_the_factors():
    rng, off, errors = np.random.default_rng(2), [], []
    for _ in range(100):
        exposure, star = np.nonzero(rng.random((6, 100)) < 0.8)
        flux = np.exp(rng.normal(0, 1, 100)[star] + rng.normal(0, 0.03, len(star)))
        flux[rng.random(len(star)) < 0.03] *= 5
        found = star_scales(exposure, 0 * exposure, star, flux, 6)
        off.append(found.exposures)
        errors.append(found.errors)
    assert 0.75 < np.sqrt(np.mean(np.square(off)) / np.mean(np.square(errors))) < 1.15
