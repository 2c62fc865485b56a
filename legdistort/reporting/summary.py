"""A solution in figures, as ``summary.json`` has them."""

from dataclasses import asdict

import numpy as np

from ..results import accuracy, in_tables
from ..runtime import provenance
from ..runtime.trees.codec import to_tree


def summarise(solution, *, timings=None):
    """Figures of a solution as plain numbers and strings, as ``--json`` prints them.

    ``rms_px``: unweighted rms residual per axis, used observations. ``sigma_px``: the paper's sigma (section 3.4) over
    the fitted stars, per axis; None of one exposure.
    """
    found, square = solution.diagnostics, accuracy.scatter(accuracy.corrected_positions(solution)) ** 2
    return {
        "n_exposures": len(solution.names),
        "n_stars": int(np.count_nonzero(np.isfinite(solution.estimate.positions[:, 0]))),
        "n_observations": int(np.count_nonzero(solution.residuals["used"])),
        "chi2": float(solution.chi2),
        "dof": int(solution.dof),
        "rms_px": float(np.sqrt(np.mean(in_tables.rms(solution) ** 2))),
        "sigma_px": float(np.sqrt(np.nanmean(square))) if np.isfinite(square).any() else None,
        "checks": [to_tree(check) for check in solution.checks],
        "gauge": solution.gauge.sentence,
        "unknown": list(solution.gauge.unknown_names),
        "sky": in_tables.sky_sentence(solution),
        "reference": found.reference and asdict(found.reference),
        "max_inverse_error_px": float(in_tables.largest_inverse_error(solution)),
        "left_out": dict(solution.left_out),
        "command": provenance.command_line(),
        **found.summary(),
        "timings": rounded(timings or {}),
    }


def rounded(timings):
    """Seconds by step, to milliseconds."""
    return {step: round(seconds, 3) for step, seconds in timings.items()}
