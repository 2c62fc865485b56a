"""Relative errors of star positions, reported against true: ``python tests/benchmarks/relative_errors_table.py``.

Sets as those of ``calibration_table.py``, of several degrees and very precise, so that the parts of second order show.
Squared over expected pull, (true over reported error)^2 summed over the stars against what the reported covariance
leads to expect once the same fields are fitted and taken off; both should be 1:

- after the exact directions of a common map (`Gauge.directions`), followed to second order
  (`legdistort.results.accuracy.relative_offsets`): a solution that does not know the static distortion is pixels off
  along them;
- after a plain polynomial map of the fitted degree, the absolute covariance taken. Without a prior the static
  distortion is unknown, and so is its part of second order, which no such map takes off.

The last column is the second without the part of second order in what is expected.
"""

import warnings

import calibration_table as sets
import numpy as np

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.results import accuracy

PRIORS = ("none", "exact", "stated")
DEGREES = (3, 5, 6)


def polynomials(xy, degree):
    """Displacements (2 n, k), x first, by maps of a total degree of positions (n, 2)."""
    x, y = (2 * (xy - xy.min(axis=0)) / np.ptp(xy, axis=0) - 1).T
    values = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.kron(np.eye(2), np.linalg.qr(np.stack(values, axis=1))[0])


def squared_pull(wrong, covariance, fields):
    """Sum of squared pulls over the expected one, once a combination of fields (n, k) is taken off both.

    For errors (n,) with a covariance (n, n).
    """
    errors = np.sqrt(np.diag(covariance))
    taken = np.linalg.svd(fields / errors[:, None], full_matrices=False)
    taken = taken[0][:, taken[1] > 1e-9 * taken[1][0]]
    pulls, expected = wrong / errors, covariance / np.outer(errors, errors)
    pulls = pulls - taken @ (taken.T @ pulls)
    return np.sum(pulls**2) / (np.trace(expected) - np.sum((expected @ taken) * taken))


def one(seed, degree, kind, **simulating):
    """Squared pulls of one set: after the directions; after a plain map, with and without the part of second order."""
    sets.DEGREE = degree  # of the true distortions, and of the prior
    matches, sky, common = sets.simulated(seed, **{"n_stars": 150, "sigma": 0.003} | simulating)
    rng = np.random.default_rng(1_000_000 + seed)
    widths = np.where(np.arange((degree + 1) * (degree + 2) // 2) < 3, 0.0, 0.3)
    priors = {"none": None, "exact": sets.as_prior(common, rng), "stated": sets.as_prior(common, rng, widths)}
    solution = ld.solve(matches, degree=degree, prior=priors[kind])
    true, good = sky[np.asarray(solution.stars["star"])], np.isfinite(solution.estimate.positions[:, 0])
    wrong, both = (solution.estimate.positions - true)[good].T.ravel(), np.tile(good, 2)
    noise = solution.estimate.uncertainty.star_matrix[np.ix_(both, both)]
    directions = solution.gauge.directions[good].transpose(1, 0, 2).reshape(len(wrong), -1)
    plain = polynomials(true[good], degree)
    whole = noise + directions @ solution.gauge.absolute_covariance @ directions.T
    relative = accuracy.relative_offsets(solution, true)[good].T.ravel()
    settings = ((relative, noise, directions), (wrong, whole, plain), (wrong, noise, plain))
    return [squared_pull(*setting) for setting in settings]


def row(kind, degree, n_sets, **simulating):
    """Mean squared pulls over many sets: after the directions; after a plain map; the latter if it were all noise."""
    before = sets.DEGREE
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LegdistortWarning)
            return np.mean([one(seed, degree, kind, **simulating) for seed in range(n_sets)], axis=0)
    finally:
        sets.DEGREE = before


def main():
    arguments = sets.command_line(__doc__)
    print(f"{'prior':8s} {'degree':>6s} {'exposures':>9s} {'directions':>11s} {'plain map':>10s} {'without 2nd':>12s}")
    for kind in PRIORS:
        for degree in DEGREES:
            for n in arguments.exposures if arguments.only in f"{kind}, {degree}" else []:
                figures = row(kind, degree, arguments.sets, n_exposures=n)
                print(
                    f"{kind:8s} {degree:6d} {n:9d} {figures[0]:11.3f} {figures[1]:10.3f} {figures[2]:12.3f}", flush=True
                )


if __name__ == "__main__":
    main()
