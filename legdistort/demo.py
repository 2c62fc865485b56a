"""A simulated night run through the whole pipeline and compared with its truth."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from .pipeline import check_results, run, write_summary
from .results import accuracy
from .simulation.example_files import published_prior
from .simulation.observations import simulate_exposures

_HELD_OUT_PER_SIDE = 20


def run_demo(*, out, small=False, camera=None, seed=0, overwrite=False, progress=False):
    """Simulate a GSAOI-like night, solve its frames and say how far the result is from the truth.

    The static distortion is that of a GSAOI detector (published polynomials), known beforehand as the prior; every
    exposure adds a dynamic distortion of its own and a header that is 0.3" off. With ``camera="gsaoi"`` all four
    detectors are simulated, in one file an exposure, and solved as one focal plane.

    Parameters
    ----------
    out : str or path
        Folder; gets ``frames/`` with the FITS files beside the results of `legdistort.run`.
    small : bool
        A night of a few seconds.
    camera : str, optional
        "gsaoi": its four detectors, the field of 85" on coarser pixels, dithered over the gaps.
    seed : int
    overwrite, progress : bool

    Returns
    -------
    Run
        Its summary has the figures of `compare_with_truth` added.
    """
    out = Path(out)
    check_results(out, overwrite)
    night = simulate_exposures(small=small, camera=camera, seed=seed, progress=progress)
    truth = night.truth
    out.mkdir(parents=True, exist_ok=True)
    paths = night.write(out / "frames")
    known = {"camera": truth.camera, "ext": "SCI"} if camera else {"prior": published_prior(truth.shape)}
    result = run(paths, out=out, **known, overwrite=overwrite, progress=progress)
    result.summary.update(compare_with_truth(result.solution, truth, seed=seed))
    write_summary(out / "summary.json", result.summary)
    return result


def compare_with_truth(solution, truth, *, seed=0):
    """How far a solution is from the truth, and how far its own errors say it should be.

    Returns
    -------
    dict
        ``b_px``: error of the star positions after the common map of the fitted degree (free of the gauge);
        ``b_bound_px``: its Cramer-Rao bound. ``b_abs_px``: error after a common shift, rotation and scale (pointing);
        ``b_abs_err_px``: reported for it. ``sigma_new_px``, ``sigma_new_expected_px``: scatter of corrected
        positions that the solution has not seen, measured and from the Fisher matrix.
    """
    true = nearest(solution.positions, truth.positions)
    names = list(solution.names)
    error = float(np.median(solution.observations["x_err"].value))
    new = np.concatenate([truth.grid(name, _HELD_OUT_PER_SIDE) for name in names[:: max(1, len(names) // 3)]])
    rng = np.random.default_rng(seed + 1)
    corrected = np.full((len(names), len(new), 2), np.nan)
    for i, name in enumerate(names):
        seen = np.flatnonzero(solution.supported(name, truth.distort(name, new)))
        noisy = truth.distort(name, new[seen]) + error * rng.normal(size=(len(seen), 2))
        corrected[i, seen] = solution.correct(name, noisy)
    measured = accuracy.scatter(corrected)
    expected = accuracy.expected_scatter(solution, new, error, seen=np.isfinite(corrected[..., 0]))
    good = np.isfinite(measured) & np.isfinite(expected)
    return {
        "b_px": accuracy.bias(solution.positions, true, removed=solution.degree),
        "b_bound_px": accuracy.expected_bias(solution, removed=solution.degree),
        "b_abs_px": accuracy.bias(solution.positions, true, removed="similarity"),
        "b_abs_err_px": accuracy.expected_bias(solution, removed="similarity", absolute=True),
        "sigma_new_px": float(np.sqrt(np.mean(measured[good] ** 2))),
        "sigma_new_expected_px": float(np.sqrt(np.mean(expected[good] ** 2))),
    }


def nearest(positions, candidates):
    """The candidate (n, 2) that belongs to every position, a common shift of some pixels allowed for."""
    tree, shift = cKDTree(candidates), np.zeros(2)
    good = np.isfinite(positions).all(axis=1)
    index = np.zeros(len(positions), dtype=int)
    for _ in range(20):
        index[good] = tree.query(positions[good] - shift)[1]
        shift = np.median(positions[good] - candidates[index[good]], axis=0)
    return candidates[index]
