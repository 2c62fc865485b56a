"""Errors of new positions, reported against true: ``python tests/benchmarks/new_positions_table.py``.

Of the sets of ``calibration_table.py`` every second star is kept out of the solution, and its positions in every
exposure are corrected with it. Relative: mean of (error / reported error)^2, once one cubic map of all new positions
and the unknown directions are fitted and taken off. Absolute: mean square of the errors over that reported, once the
similarity of the stars is taken off, or none with a reference. Both should be 1.
"""

import warnings

import calibration_table as sets
import numpy as np

import legdistort as ld
from legdistort.exceptions import LegdistortWarning
from legdistort.results import new_positions

#: Arguments of `calibration_table.simulated`, and prior.
SETTINGS = {
    "no prior, 0.02 px": ({}, "none"),
    "prior, exact, 0.02 px": ({}, "exact"),
    "prior, exact, 0.003 px": ({"sigma": 0.003}, "exact"),
    "prior with static_sigma, 0.02 px": ({}, "stated"),
    "prior, exact, rolls": ({"rolls": True}, "exact"),
    "40 reference stars, prior, exact": ({}, "tied"),
}


def kept_out(seed, **simulating):
    """Matches of half of the stars, the table of the others, true positions and the static distortion."""
    matches, sky, common = sets.simulated(seed, **{"n_stars": 140} | simulating)
    new = np.random.default_rng(seed).permutation(np.unique(matches.table["star"]))[::2]
    out = np.isin(matches.table["star"], new)
    shape = (sets.SIZE, sets.SIZE)
    return ld.Matches.from_table(matches.table[~out], shape=shape, poses=matches.poses), matches.table[out], sky, common


def solving(kind, matches, sky, common, seed):
    """Arguments of `legdistort.solve`."""
    rng = np.random.default_rng(1_000_000 + seed)
    if kind == "none":
        return {}
    prior = sets.as_prior(common, rng, sets.WIDTHS if kind == "stated" else None)
    if kind != "tied":
        return {"prior": prior}
    return {"prior": prior, "reference": sets.catalogue(sky, matches.table["star"], 40, rng)}


def cubic_fields(xy):
    """Displacements (2 n, 20), x first, by cubic maps of positions (n, 2)."""
    x, y = ((xy - xy.mean(axis=0)) / np.ptp(xy)).T
    return np.kron(np.eye(2), np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1))


def unknown_fields(solution, table):
    """Displacements (2 n, 1), x first, of the corrected positions by every unknown direction."""
    moved = np.zeros((len(solution.gauge.unknown), len(table), 2))
    for i, name in enumerate(solution.names):
        mine = np.asarray(table["exposure"]) == name
        pixels = np.column_stack([table["x"].value, table["y"].value])[mine]
        by_modes = new_positions.response(solution[name], solution[name].distortion.invert(pixels))[0]
        for k, each in enumerate(solution.gauge.unknown):
            moved[k, mine] = by_modes @ each.coefficients[i].ravel()
    return [each.T.reshape(-1, 1) for each in moved]


def one(seed, simulating, kind):
    """Mean squared pull, and absolute errors true and reported, mean squares; NaN where these are not known."""
    matches, table, sky, common = kept_out(seed, **simulating)
    solution = ld.solve(matches, **solving(kind, matches, sky, common, seed))
    new = solution.correct_table(table)
    true = sky[np.asarray(new["star"])]
    wrong = np.r_[new["x"].value - true[:, 0], new["y"].value - true[:, 1]]
    errors, absolute = (np.r_[new[f"x_{s}"].value, new[f"y_{s}"].value] for s in ("err", "err_abs"))
    fields = np.hstack([cubic_fields(true), *unknown_fields(solution, table)]) / errors[:, None]
    relative = np.sum(sets.without(wrong / errors, fields) ** 2) / (len(wrong) - fields.shape[1])
    if solution.gauge.tie is None:
        stars = sky[np.asarray(solution.estimate.star_names)]
        offset = (solution.estimate.positions - stars).T.ravel()
        amount = np.linalg.lstsq(sets.similarity_fields(stars), offset, rcond=None)[0]
        wrong = wrong - sets.similarity_fields(true, centre=stars.mean(axis=0)) @ amount
    return relative, np.mean(wrong**2), np.mean(absolute**2)


def row(name, n_sets, **changed):
    """Ratios of true to reported squares over many sets, relative and absolute."""
    simulating, kind = SETTINGS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        values = [one(seed, simulating | changed, kind) for seed in range(n_sets)]
    relative, true, reported = np.mean(values, axis=0)
    return relative, true / reported


def main():
    arguments = sets.command_line(__doc__)
    print(f"{'setting':36s} {'exposures':>9s} {'relative':>9s} {'absolute':>9s}")
    for name in SETTINGS:
        for n in arguments.exposures if arguments.only in name else []:
            relative, absolute = row(name, arguments.sets, n_exposures=n)
            print(f"{name:36s} {n:9d} {relative:9.3f} {absolute:9.3f}", flush=True)


if __name__ == "__main__":
    main()
