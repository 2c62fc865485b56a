"""Rows of lists that other programs made which lie on bad pixels of their frames: columns that pass for stars."""

import logging

import numpy as np
from astropy import units as u

from ...exceptions import MatchError
from ..exposure_files import ExposureFile
from ..exposure_names import whole_name

log = logging.getLogger(__name__)


def without_bad_places(table, exposures):
    """The table without rows whose pixel the frame calls bad: no weight, a flag, NaN. How many is said once.

    Names of exposures become texts.

    What `legdistort.measure` found (column ``crowding``) is taken as it is: it knew of bad pixels, and has flags.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Columns ``exposure``, ``x``, ``y``, perhaps ``detector``.
    exposures : list of Exposure or ExposureFile

    Raises
    ------
    MatchError
        If nothing is left.
    """
    table["exposure"] = table["exposure"].astype(str)
    if "crowding" in table.colnames or not len(table):
        return table
    bad, names = np.zeros(len(table), dtype=bool), np.asarray(table["exposure"])
    pixel = np.column_stack([np.rint(table[axis].to_value(u.pix)) for axis in ("y", "x")]).astype(int)
    for exposure in exposures:
        mine = names == whole_name(exposure)
        if exposure.detector is not None and "detector" in table.colnames:
            mine &= np.asarray(table["detector"]).astype(str) == exposure.detector
        rows = np.flatnonzero(mine & np.all((pixel >= 0) & (pixel < exposure.shape), axis=1))
        if len(rows) and (mask := _mask(exposure)) is not None:
            bad[rows] = mask[tuple(pixel[rows].T)]
    if not bad.any():
        return table
    if bad.all():
        raise MatchError(
            f"all {len(table)} detections lie on pixels that the frames call bad: a flag that only describes what is "
            "there is to be named as good, dq_good= (--dq-good) where the frames are read; of maps that are no "
            "weights none is read with weight_maps='none' (--weight-maps none)"
        )
    log.info(
        "%d of %d detections lie on bad pixels of the frames (no weight, a flag, NaN), and are left out",
        np.count_nonzero(bad), len(table),
    )  # fmt: skip
    return table[~bad]


def _mask(exposure):
    """Bad pixels (ny, nx) of a frame; None for a gwcs that has none."""
    if isinstance(exposure, ExposureFile) and exposure.pixels == exposure.checksum:
        return None
    return exposure.read().mask
