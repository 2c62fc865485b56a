"""From adaptive-optics frames to positions: ``python tests/benchmarks/ao_night.py FOLDER [--psf ...] [--method ...]``.

Eight dithered exposures of 1024 x 1024 pixels, each with a PSF of its own, are measured, matched and solved with the
true static distortion and degree 3. Printed: the part of the star images that the solution uses, the error of the
star positions over what the Cramer-Rao bounds of the same images predict, chi2/dof, and by thirds of brightness the
residuals over those of a solution whose positions have exactly these bounds for errors. Frames stay in FOLDER.
"""

import argparse
import pickle
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import ao_images as ao

import legdistort as ld
from legdistort.assessment.truth import nearest
from legdistort.geometry.gsaoi import gsaoi_static
from legdistort.results import accuracy
from legdistort.simulation import rendering
from legdistort.simulation.observations import matches_from

CELLS = ["symmetric-0.3", "elongated-0.3", "coma-0.3", "symmetric-0.1", "psfao-0"]
METHODS = {"default": {}, "moffat": {"psf": "moffat"}, "effective": {"psf": "effective"}}
SIZE, N = 1024, 8
#: Star images fainter than this, flux over its bound, or nearer to the edge [pix] are not counted.
FAINTEST, MARGIN = 10.0, 12.0


def night(folder, cell, seed):
    """Paths of the frames, their truth, and the bounds (N, n_stars, 2, 2) of positions and ratios (N, n_stars)."""
    place = folder / f"{cell}-{seed}"
    if not (place / "bounds.pickle").exists():
        kind, strehl = cell.rsplit("-", 1)
        rng = np.random.default_rng([seed, 8])
        psfs = [ao.make_psf(kind, float(strehl), rng) for _ in range(N)]
        made = ld.simulate_exposures(
            n_exposures=N, size=SIZE, n_stars=80, dither=60.0, psf=psfs, sigma_range=(0.003, 0.1), seed=seed
        )
        paths, truth = made.write(place), made.truth
        covariance, snr = np.full((N, 80, 2, 2), np.nan), np.zeros((N, 80))
        for i, (name, psf) in enumerate(zip(truth.names, psfs, strict=True)):
            xy = truth.distort(name, truth.positions)
            inside = ((xy > MARGIN) & (xy < SIZE - 1 - MARGIN)).all(axis=1)
            model = rendering.as_psf(psf, truth.shape)
            expected = rendering.render(truth.shape, xy, truth.flux, psf=model, sky=ao.SKY)
            covariance[i, inside], error = rendering.position_covariance(
                xy[inside], truth.flux[inside], expected, psf=model, gain=ao.GAIN, read_noise=ao.READ_NOISE, half=16
            )
            snr[i, inside] = truth.flux[inside] / error
        (place / "bounds.pickle").write_bytes(pickle.dumps((paths, truth, covariance, snr)))
    return pickle.loads((place / "bounds.pickle").read_bytes())


def thirds(solution, flux):
    """Rms residual of the used observations in thirds of the stars' fluxes [pix]."""
    rows = solution.residuals[solution.residuals["used"]]
    edges = np.quantile(flux, [1 / 3, 2 / 3])
    third = np.digitize(np.asarray(rows["true_flux"]), edges)
    off = np.column_stack([rows["dx"].value, rows["dy"].value])
    return [np.sqrt(np.mean(off[third == k] ** 2)) for k in range(3)]


def with_flux(solution, truth):
    """The solution, with the true flux of its star in every observation, and the true positions of its stars."""
    true = nearest(solution.estimate.positions, truth.positions)
    star = np.array([np.flatnonzero((truth.positions == one).all(axis=1))[0] for one in true])
    index = np.searchsorted(solution.estimate.star_names, solution.residuals["star"])
    solution.residuals["true_flux"] = truth.flux[star[index]]
    return solution, true, star


def show(folder, cell, name, seeds):
    """One row of the table."""
    figures = []
    for seed in range(seeds):
        paths, truth, covariance, snr = night(folder, cell, seed)
        prior = ld.Prior.from_model(
            gsaoi_static(2, size=SIZE), shape=(SIZE, SIZE), direction="detector_to_reference", degree=5
        )
        exposures = ld.read_exposures(paths)
        matches = ld.match(ld.measure(exposures, **METHODS[name]), exposures=exposures)
        solution, true, star = with_flux(ld.solve(matches, prior=prior, degree=3), truth)
        seen = snr > FAINTEST
        seen &= seen.sum(axis=0) >= 4
        used = solution.residuals[solution.residuals["used"]]
        pair = np.zeros_like(seen)
        rows = star[np.searchsorted(solution.estimate.star_names, used["star"])]
        pair[[truth.names.index(exposure) for exposure in used["exposure"]], rows] = True
        sigma = np.sqrt(np.nan_to_num(np.einsum("nsaa->nsa", covariance), nan=1.0))
        ideal = matches_from(truth, seen, sigma, np.random.default_rng(seed), sky=truth.sky)
        bound, _, _ = with_flux(ld.solve(ideal, prior=prior, degree=3), truth)
        common = np.isin(star, np.flatnonzero(seen.any(axis=0)))
        figures.append(
            [
                100 * np.count_nonzero(pair & seen) / np.count_nonzero(seen),
                accuracy.bias(solution.estimate.positions[common], true[common], removed=3),
                accuracy.expected_bias(bound, removed=3),
                solution.chi2 / solution.dof,
                *np.divide(thirds(solution, truth.flux), thirds(bound, truth.flux)),
            ]
        )
    kept, error, predicted, chi2, *wider = np.mean(figures, axis=0)
    print(
        f"{cell:14s} {name:10s} used {kept:5.1f} %, positions {error:.4f} px, {error / predicted:5.2f} x the bound, "
        f"chi2/dof {chi2:5.2f}, residuals by brightness {wider[0]:.2f} {wider[1]:.2f} {wider[2]:.2f}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--psf", nargs="+", default=CELLS)
    parser.add_argument("--method", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--nights", type=int, default=2)
    given = parser.parse_args()
    for cell in given.psf:
        for name in given.method:
            show(given.folder, cell, name, given.nights)
            sys.stdout.flush()
