"""Fluxes at given places: of stars whose positions are known, and upper limits for what is not there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from scipy.spatial import cKDTree

from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..inputs import column_contract
from ..inputs.table_files import read_table
from .measuring import by_image, image_flags, star_flags
from .tables import SAME, flux_scatter, magnitudes, summary

#: Standard deviations above its flux, or above none, up to which a star might be.
LIMIT = 3.0
_ROUNDS = 2  # the fluxes of each image are linear; those of all together weigh them
_BEGIN = 1e-2  # of the median flux: a star needs some light for its image to say how well it sees it
_NAMED = 5


def given_places(positions, solution):
    """Names (n,) and places (n, 2) in the reference plane of a table of positions, or its file.

    Parameters
    ----------
    positions : `~astropy.table.Table`, str or path
        Columns ``x``, ``y`` [pix, reference plane], or ``ra``, ``dec`` [deg, ICRS] where the solution has a sky;
        perhaps ``star``, else rows are numbered from 0.
    solution : Solution

    Raises
    ------
    InputError
        Without such columns, for a position that is not finite, and for a name that stands twice.
    """
    label = positions if isinstance(positions, (str, Path)) else "positions"
    table = read_table(positions) if isinstance(positions, (str, Path)) else positions
    table = column_contract.as_table(table, "positions")
    if {"x", "y"} <= set(table.colnames):
        xy = np.column_stack([column_contract.values(table, name, u.pix) for name in "xy"])
    elif {"ra", "dec"} <= set(table.colnames) and solution.sky is not None:
        ra, dec = (column_contract.values(table, name, u.deg) for name in ("ra", "dec"))
        xy = solution.sky.from_sky(SkyCoord(np.nan_to_num(ra), np.clip(np.nan_to_num(dec), -90, 90), unit="deg"))
        xy[~np.isfinite(ra + dec)] = np.nan
    else:
        sky = "" if solution.sky is not None else " (the solution does not know the sky, so that ra, dec do not do)"
        raise InputError(f"{label} has no columns x, y{sky}, and no ra, dec; it has {', '.join(table.colnames)}")
    names = column_contract.labels(table, "star") if "star" in table.colnames else np.arange(len(table))
    bad = np.flatnonzero(~np.isfinite(xy).all(axis=1))
    if len(bad):
        raise InputError(f"{label}: the position of star {names[bad[0]]} (row {bad[0]}) is not finite; leave it out")
    if len(np.unique(names)) < len(names):
        raise InputError(f"{label}: a name in column star stands twice; each star has one position")
    return names, xy


def at_places(field, measured, names, xy):
    """Fluxes at fixed places, those of all other stars free: `Measured` of all, names, and the rows of the given ones.

    A star that was found within half a FWHM of a given place gives way to it.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
        With the stars that were found; afterwards with the given ones too.
    measured : Measured
    names : ndarray, shape (n,)
    xy : ndarray, shape (n, 2)

    Raises
    ------
    InputError
        If no image sees one of the places.
    """
    if len(field.xy):
        field.remove(cKDTree(xy).query(field.xy)[0] < SAME * field.fwhm)
    first, begin = len(field.flux), _BEGIN * np.median(field.flux) if len(field.flux) else 1.0
    field.add(xy, np.full(len(xy), begin))
    seen = np.isfinite(by_image(field, first + np.arange(len(xy)))[1]).any(axis=0)
    if not seen.all():
        off = some_of([str(name) for name in names[~seen]], _NAMED)
        if not seen.any():
            raise InputError(f"no exposure shows one of the positions (star {off}): are they of this field?")
        warn(f"no exposure shows the place of star {off}, where stars determined its map: left out", AssumptionWarning)
        field.remove(np.append(np.zeros(first, dtype=bool), ~seen))
    names, rows = names[seen], first + np.arange(np.count_nonzero(seen))
    for _ in range(_ROUNDS):
        flux, error = by_image(field)
        weight = 1 / error**2
        total = weight.sum(axis=0)
        field.flux = np.where(total > 0, (weight * flux).sum(axis=0) / np.maximum(total, 1e-300), field.flux)
        field.refresh()
    none = np.zeros(len(field.flux), dtype=bool)
    return replace(measured, flux=flux, flux_err=error, flags=image_flags(field), varying=none), names, rows


def forced_table(field, measured, names, rows, solution, threshold, zero_point):
    """One row a given place, in their order; `legdistort.photometry.catalogue.Catalogue` explains the columns."""
    xy, flux = field.xy[rows], field.flux[rows]
    weight = (1 / measured.flux_err[:, rows] ** 2).sum(axis=0)
    error = np.sqrt(np.maximum(field.core_chi2()[rows], 1) / weight)
    table = QTable({"star": names})
    table["x"], table["y"] = (c * u.pix for c in xy.T)
    if solution.sky is not None:
        places = solution.sky.to_sky(xy)
        table["ra"], table["dec"] = places.ra, places.dec
    table["flux"], table["flux_err"] = flux, error
    table["flux_limit"] = np.maximum(flux, 0) + LIMIT * error
    if zero_point is not None:
        table["mag"], table["mag_err"] = magnitudes(flux, error, zero_point)
        table["mag_limit"] = magnitudes(table["flux_limit"], error, zero_point)[0]
    table["flux_scatter"] = flux_scatter(field, measured)[rows]
    table["n"], table["snr"] = measured.seen[:, rows].sum(axis=0), flux / error
    table["flags"] = star_flags(field, measured)[rows]
    table.meta = summary(field, measured, solution, threshold, np.asarray(names).tolist()) | {"forced": True}
    return table
