"""How far the static distortions that were fitted depart from those that were given."""

import numpy as np

from ...geometry import detector_modes


def static_departures(given, fit, scale):
    """What was fitted less what was given, in pixels, ``{detector: (rms, its error)}``, rms per axis over the detector.

    Shift, rotation and scale of every detector are left out. The error is the rms of those of the coefficients; where
    these are not at hand there is the rms alone.

    Parameters
    ----------
    given : Matches
        As they were given, with their camera.
    fit : Fit
    scale : float
        Factor on the errors of the fit.

    Returns
    -------
    dict or None
        None where no static distortion was fitted, or none was given.
    """
    if given.camera.has_focal_plane:
        return _of_camera(given.camera, fit, scale)
    problem = fit.problem
    if fit.options.static != "fit" or not np.any(problem.prior_mean):
        return None
    out, table = {}, fit.matches.table
    for number in np.unique(problem.detectors):
        mine = np.flatnonzero(problem.detectors == number)
        name = "1"
        if "detector" in table.colnames:
            name = str(table["detector"][np.asarray(table["exposure"]) == problem.names[mine[0]]][0])
        change = (fit.result.state.coefficients - problem.prior_mean)[mine].mean(axis=0)
        rows = detector_modes.dynamic_basis(problem.shapes[mine[0]], change.shape[1])
        out[name] = (_rms(rows @ change.ravel()),)
    return out


def _of_camera(before, fit, scale):
    """That of the detectors of a camera, modes of orders 2 and more."""
    errors, out = fit.camera_errors, {}
    if errors is None:
        return None
    for key, free in zip(before.detectors, errors.free, strict=True):
        old, new = before[key].static, fit.matches.camera[key]
        if not free[:, 3:].any() or not np.any(old):
            continue
        change = new.static.copy()
        change[:, : old.shape[1]] -= old
        known = np.isfinite(new.static_sigma).all()
        out[key] = (_rms(change), scale * _rms(new.static_sigma)) if known else (_rms(change),)
    return out or None


def _rms(coefficients):
    """Displacement by coefficients, rms per axis over the detector, pixels."""
    return float(np.sqrt(np.sum(coefficients**2) / 8))  # b_m has mean square 1/4
