"""The tables of a catalogue."""

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy.spatial import cKDTree

from ..inputs.exposure_names import whole_name
from ..measurement.crowding import crowding
from ..measurement.flags import Flag
from ..results.new_positions import add_sky
from .agreement import BEYOND, displacements
from .measuring import covariances, map_covariances, star_flags

SAME = 0.5  # FWHM from a star of the solution: it is that star
_MAGNITUDE = 2.5 / np.log(10)
_NOWHERE = 1e9  # pixels: where stars without a position are


def stars_table(field, measured, solution, threshold, zero_point):
    """One row a star, brightest first; `legdistort.photometry.catalogue.Catalogue` explains the columns."""
    covariance, chi2 = covariances(field, threshold)
    relative, absolute = map_covariances(field)
    both = covariance[:, :2, :2]
    names = star_names(field.xy, solution, SAME * field.fwhm)
    table = QTable({"star": names})
    table["x"], table["y"] = (c * u.pix for c in field.xy.T)
    for suffix, each in (("err", both), ("map_err", relative), ("err_abs", both + absolute)):
        variance = np.maximum(np.einsum("naa->an", each), 0)
        table[f"x_{suffix}"], table[f"y_{suffix}"] = np.sqrt(variance) * u.pix
    table["xy_corr"] = both[:, 0, 1] / np.sqrt(both[:, 0, 0] * both[:, 1, 1])
    if solution.sky is not None:
        add_sky(table, solution.sky, field.xy, _planes(both + relative), _planes(both + absolute))
    table["flux"], table["flux_err"] = field.flux, np.sqrt(covariance[:, 2, 2])
    if zero_point is not None:
        table["mag"], table["mag_err"] = magnitudes(table["flux"], table["flux_err"], zero_point)
    table["flux_scatter"], table["n"] = flux_scatter(field, measured), measured.seen.sum(axis=0)
    trusted = np.array([layer.trusted for layer in field.layers])
    table["n_left_out"] = (measured.seen & ~trusted).sum(axis=0)
    table["snr"], table["chi2_dof"], table["sharpness"] = field.snr(), chi2, field.sharpness()[0]
    away = displacements(names, field.xy, np.einsum("naa->na", both), solution)
    displaced = away > BEYOND
    table["flags"] = star_flags(field, measured) | np.where(displaced, Flag.DISPLACED, 0)
    table.add_column(crowding(table, field.fwhm), name="crowding", index=len(table.columns) - 1)
    table.meta = summary(field, measured, solution, threshold, names.tolist())
    table.meta |= {"n_known": int(np.isfinite(away).sum()), "displaced": names[displaced].tolist()}
    return table[np.argsort(-table["flux"], kind="stable")]


def star_names(xy, solution, radius):
    """Those of the stars of the solution that lie at positions (n, 2), one each, and new ones after the highest."""
    known, positions = np.asarray(solution.estimate.star_names), solution.estimate.positions
    positions = np.where(np.isfinite(positions), positions, _NOWHERE)
    distance, row = cKDTree(positions).query(xy, distance_upper_bound=radius)
    nearest = cKDTree(xy).query(positions)[1]
    same = np.isfinite(distance)
    same[same] = nearest[row[same]] == np.flatnonzero(same)
    numbers = [int(name) for name in known.astype(str) if str(name).isdigit()]
    new = max(numbers, default=-1) + 1 + np.arange(np.count_nonzero(~same))
    names = np.empty(len(xy), dtype=known.dtype if known.dtype.kind in "iu" else object)
    names[same], names[~same] = known[row[same]], new if known.dtype.kind in "iu" else new.astype(str)
    return names if known.dtype.kind in "iu" else names.astype(str)


def magnitudes(flux, error, zero_point):
    """Magnitudes of fluxes (n,) and their errors; NaN where there is no light."""
    light = np.where(flux > 0, flux, np.nan)
    return zero_point - 2.5 * np.log10(light), _MAGNITUDE * error / light


def photometry_table(field, measured, names, rows, frames):
    """One row a star and image that sees it.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
    measured : `~legdistort.photometry.measuring.Measured`
    names : ndarray, shape (n,)
    rows : ndarray of int, shape (n,)
        Which stars these are.
    frames : dict
        Exposures by name.
    """
    star, image = np.nonzero(measured.seen.T[rows])
    own = [frames[layer.name] for layer in field.layers]
    table = QTable({"star": names[star], "exposure": np.array([whole_name(each) for each in own])[image]})
    if any(each.detector is not None for each in own):
        table["detector"] = np.array([str(each.detector) for each in own])[image]
    for name in ("flux", "flux_err", "flags"):
        table[name] = getattr(measured, name)[image, rows[star]]
    light = {layer.name: layer.transmission / layer.unit for layer in field.layers}
    table.meta["zero_points"] = {
        name: {"magnitude": float(2.5 * np.log10(t)), "error": float(_MAGNITUDE * error)}
        for (name, t), error in zip(light.items(), measured.zero_err, strict=True)
    }
    return table


def _planes(covariance):
    return np.stack([covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]])


def flux_scatter(field, measured):
    """Standard deviation of the fluxes of single images, weighted; (n,), NaN with a single one."""
    weight = 1 / measured.flux_err**2
    total, count = weight.sum(axis=0), measured.seen.sum(axis=0)
    square = (weight * (measured.flux - field.flux) ** 2).sum(axis=0) / np.maximum(total, 1e-300)
    return np.where(count > 1, np.sqrt(square * count / np.maximum(count - 1, 1)), np.nan)


def summary(field, measured, solution, threshold, names):
    """What the table of stars says of itself, in plain numbers."""
    known = set(np.asarray(solution.estimate.star_names).tolist())
    found = len(known & set(names))
    return {
        "threshold": float(threshold),
        "area": int(field.area),
        "noise_peaks": field.noise_peaks(threshold),
        "n_images": len(field.layers),
        "n_new": len(names) - found,
        "n_lost": len(known) - found,
        "n_rejected": measured.rejected,
        "frame": "reference plane" if solution.sky is None else "ICRS",
    }
