"""What is to be said of measured frames: defects that stay on the detector, masks that hide stars, trailed stars."""

import numpy as np
from scipy.spatial import cKDTree

from ..exceptions import AssumptionWarning, some_of, warn
from ..inputs.frames.weight_maps import NO_WEIGHT
from .camera_gain import camera
from .flags import PERSISTS, TRAILED, UNUSABLE, Flag
from .profiles import moffat
from .profiles.defects import are_points

_SAME = 0.5  # pixels within which a defect is found again
_MOST = 0.6  # of the exposures
_FEWEST = 3  # exposures in which it is found, at least
_COMPARED = 100  # exposures, of more evenly chosen ones, in which it is looked for
_BRIGHTEST = 30  # rows of an exposure by which it is told whether the sky moves
_BRIGHT = 20.0  # standard deviations of the sky, of peaks of stars that a mask hides
_BESIDE = 0.1  # of its peak that a star has on both sides of it, and below and above: columns and rows have not
_HIDDEN = 5  # such peaks from which on it is said
_CROSS = (0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)  # a pixel, then those on both sides, below and above


def flag_what_stays(tables, exposures):
    """Flag rows that are found on the same pixel in most exposures of a detector while the sky moves.

    What is ten times fainter does not count: an image of a star that persists, not the star, is a defect.

    Parameters
    ----------
    tables : list of `~astropy.table.QTable`
        Of the exposures; their flags are changed.
    exposures : list of Exposure or ExposureFile
    """
    detectors = {}
    for table, exposure in zip(tables, exposures, strict=True):
        detectors.setdefault((exposure.detector, *camera(exposure)[:-2]), []).append(table)
    for alike in detectors.values():
        if len(alike) >= _FEWEST:
            _flag_fixed(alike)


def _flag_fixed(tables):
    xy = [np.column_stack([table["x"].value, table["y"].value]) for table in tables]
    flux = [np.asarray(table["flux"]) for table in tables]
    step = -(-len(xy) // _COMPARED)
    places, least, compared = np.concatenate(xy), PERSISTS * np.concatenate(flux), xy[::step]
    n = np.zeros(len(places), dtype=int)
    for each, light in zip(compared, flux[::step], strict=True):  # its own too
        if len(each):
            distance, row = cKDTree(each).query(places, distance_upper_bound=_SAME)
            n += np.isfinite(distance) & (np.append(light, 0)[row] >= least)
    fixed = np.split(n >= max(_FEWEST, _MOST * len(compared)), np.cumsum([len(each) for each in xy])[:-1])
    bright = np.concatenate(
        [
            stays[np.flatnonzero((table["flags"] & UNUSABLE) == 0)[:_BRIGHTEST]]
            for table, stays in zip(tables, fixed, strict=True)
        ]
    )
    if not len(bright) or bright.mean() > 0.5:  # the sky has not moved: stars stay too
        return
    for table, stays in zip(tables, fixed, strict=True):
        stays &= (table["flags"] & Flag.DEFECT) == 0  # a star may lie on a pixel that is left out
        table["flags"][stays] |= Flag.HOT | Flag.DEFECT


def hides_most(exposure, frame, centres):
    """Whether the mask of an exposure hides more bright stars than it leaves.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
    frame : `~legdistort.measurement.detection.Frame`
        Made of it.
    centres : ndarray of int, shape (n, 2)
        Stars found.
    """
    hidden = exposure.mask & np.isfinite(exposure.data)
    if not hidden.any() or min(hidden.shape) < 3:
        return False
    limit = _BRIGHT * np.sqrt(np.median(frame.variance[frame.good][::16]))
    y, x = np.nonzero(hidden[1:-1, 1:-1])
    above = exposure.data[y + 1, x + 1] - frame.sky[y + 1, x + 1] > limit
    y, x = y[above] + 1, x[above] + 1
    value, highest = exposure.data[y, x], np.ones(len(x), dtype=bool)
    for k, (dy, dx) in enumerate(np.ndindex(3, 3)):
        other = exposure.data[y + dy - 1, x + dx - 1]
        highest &= (value > other) if k < 4 else (value >= other)
    x, y = x[highest], y[highest]
    light = np.stack([exposure.data[y + dy, x + dx] - frame.sky[y + dy, x + dx] for dx, dy in _CROSS])
    extended = (light[1:] > _BESIDE * light[0]).all(axis=0)
    peaks = np.column_stack([x, y])[extended]
    stars = np.count_nonzero(~are_points(exposure.data - frame.sky, np.zeros(len(peaks)), peaks))
    seen = np.count_nonzero(frame.signal[centres[:, 1], centres[:, 0]] > limit)
    return stars > max(seen, _HIDDEN - 1)


def warn_of_hidden(exposures):
    """Warn of exposures of which the mask hides most bright stars; a weight map alone is named as one."""
    found = {True: [], False: []}
    for each in exposures:
        found[each.stated is not None and each.stated.mask.value == NO_WEIGHT].append(each.name)
    if found[False]:
        warn(
            f"{some_of(found[False], 3)}: most bright stars lie on pixels that the plane of flags calls bad; if a flag "
            "only describes what is there, name it as good: dq_good= (--dq-good)",
            AssumptionWarning,
        )
    if found[True]:
        warn(
            f"{some_of(found[True], 3)}: most bright stars lie on pixels without weight in the weight map; if it is "
            "none, or of another frame, leave it out: weight_maps='none' (--weight-maps none)",
            AssumptionWarning,
        )


def warn_of_trails(shapes):
    """Warn of exposures of which the stars are trailed.

    Parameters
    ----------
    shapes : dict
        ``{name: shape (4,)}`` of the stars of exposures.
    """
    found = {}
    for name, shape in shapes.items():
        wide, narrow, angle = moffat.axes(shape)
        if wide > TRAILED * narrow:
            found[name] = f"{name}: {wide:.1f} by {narrow:.1f} pixels, at {angle:.0f} degrees from x to y"
    if found:
        warn(
            f"the stars are trailed ({some_of(list(found.values()), 3)}): positions are less exact along the trail; "
            "leave such exposures out if others are sharp",
            AssumptionWarning,
        )
