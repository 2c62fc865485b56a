"""Poses of exposures from matched positions alone, and what is known of given ones."""

from collections.abc import Mapping
from numbers import Real
from pathlib import Path

import numpy as np
from astropy.table import Table

from ..exceptions import InputError, MatchError
from ..geometry import pair_agreement, similarity
from ..geometry.detector_modes import detector_corners
from ..runtime.checks import check_is_file
from .star_lists import formats

#: Exposures whose stars typically lie farther from their means than this part of their extent are compared in pairs.
_FAR = 0.01
#: Errors that poses may have, and their units.
POSE_ERRORS = {"shift": "px", "rotation": "deg", "scale": "relative"}


def check_pose_sigma(errors):
    """Errors of poses, ``{name: number}`` for those of `POSE_ERRORS` that are finite; None if there is none.

    Raises
    ------
    InputError
        As `check_place_errors`, and where that of shifts is missing.
    """
    out = check_place_errors(errors, "pose_sigma")
    if out and "shift" not in out:
        raise InputError(
            f"pose_sigma has {' and '.join(out)} without shift, and says nothing of where the reference plane lies: "
            "state the error of shifts too"
        )
    return out


def check_place_errors(errors, argument):
    """Errors of places that are finite, ``{name: number}`` for names of `POSE_ERRORS`; None if there is none.

    Raises
    ------
    InputError
        For another name, unit or type of this `argument`, and for what is no standard deviation.
    """
    if errors is None:
        return None
    if not isinstance(errors, Mapping) or not set(errors) <= set(POSE_ERRORS):
        raise InputError(
            f"{argument} must be a dict of the errors of shift [px], rotation [deg] and scale, got {errors!r}: give, "
            "for example, {'shift': 0.1, 'rotation': 0.01}"
        )
    out = {name: _number(argument, name, value) for name, value in errors.items()}
    return {name: value for name, value in out.items() if np.isfinite(value)} or None


def _number(argument, name, value):
    """An error of a pose in its unit."""
    if isinstance(value, bool) or not isinstance(value, Real) or not value >= 0:
        raise InputError(
            f"{argument}: the error of {name} must be a number [{POSE_ERRORS[name]}], 0 or more, got {value!r}"
        )
    return float(value)


def given_starts(start):
    """Start positions as they are given: ``{exposure: (xshift, yshift, rotation)}``, pixels and degrees.

    Parameters
    ----------
    start : Mapping, `~astropy.table.Table`, or path of a table
        ``{exposure: (xshift, yshift)}``, or with a rotation; columns ``exposure``, ``xshift``, ``yshift``, and perhaps
        ``rotation``.

    Raises
    ------
    InputError
        Naming the exposure or column at fault.
    """
    if isinstance(start, str | Path):
        check_is_file(start)
        return _starts_of(formats.read(Path(start))[0], str(start))
    if isinstance(start, Table):
        return _starts_of(start, "the table of start positions")
    if not isinstance(start, Mapping):
        raise InputError(
            f"start must be a dict {{exposure: (xshift, yshift)}}, a table or its file, got {type(start).__name__}"
        )
    return {str(name): _start(name, each) for name, each in start.items()}


def _starts_of(table, label):
    named = {name.lower(): name for name in table.colnames}
    missing = [name for name in ("exposure", "xshift", "yshift") if name not in named]
    if missing:
        raise InputError(
            f"{label} has no column {missing[0]}: start positions have exposure, xshift, yshift [px], and perhaps "
            f"rotation [deg]; it has {', '.join(table.colnames)}"
        )
    columns = [table[named[name]] for name in ("xshift", "yshift", "rotation") if name in named]
    names = [str(name) for name in table[named["exposure"]]]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{label} has exposure {twice} twice: leave one out")
    return {name: _start(name, each) for name, *each in zip(names, *columns, strict=True)}


def _start(name, values):
    try:
        found = [float(getattr(each, "value", each)) for each in values]
    except (TypeError, ValueError):
        found = []
    if not (len(found) in (2, 3) and np.all(np.isfinite(found))):
        raise InputError(
            f"the start position of {name} must be (xshift, yshift) [px] or (xshift, yshift, rotation [deg]), got "
            f"{values!r}"
        )
    return (*found, 0.0)[:3]


def star_means(xy, star, n_stars):
    """Mean position (n_stars, 2) of every star; NaN where a star has none."""
    total = np.bincount(star, minlength=n_stars)
    sums = np.column_stack([np.bincount(star, xy[:, k], n_stars) for k in (0, 1)])
    with np.errstate(invalid="ignore"):
        return sums / total[:, None]


def moves_apart(poses, shapes, fields):
    """By how much to move every field along x for none to overlap on the reference plane, (n_fields, 2), pixels.

    Zero, if they do not. The first stays, and lengths are whole thousands.

    Parameters
    ----------
    poses : list of ndarray, each (2, 3)
    shapes : list of (ny, nx)
    fields : ndarray of int, shape (n_exposures,)
        Number of the field of every exposure.
    """
    corners = similarity.apply_inverses(np.array(poses), detector_corners(shapes))
    ends = [corners[fields == field].reshape(-1, 2) for field in range(fields.max() + 1)]
    low, high = (np.array([getattr(each, name)(axis=0) for each in ends]) for name in ("min", "max"))
    overlap = np.all((low[:, None] < high) & (low < high[:, None]), axis=2)
    moves, end = np.zeros(low.shape), high[0, 0]
    if np.count_nonzero(overlap) > len(ends):
        for field in range(1, len(ends)):
            moves[field, 0] = 1000 * np.ceil((end - low[field, 0]) / 1000 + 0.5)
            end = high[field, 0] + moves[field, 0]
    return moves


def estimate_poses(exposure, star, xy, *, names=None):
    """Poses of all exposures from matched positions alone.

    The exposure with the most stars becomes the reference plane; the others are tied one after the
    other, each to all that already stand, the best connected first, then all are refined together.
    Exposures that contradict most others get a pose as well, but zero weight in those of the others.

    Parameters
    ----------
    exposure, star : ndarray of int, shape (n,)
    xy : ndarray, shape (n, 2)
    names : sequence of str, optional
        For messages.

    Returns
    -------
    list of ndarray, each (2, 3)

    Raises
    ------
    MatchError
        Naming an exposure that shares fewer than two stars with all the others.
    """
    n_exposures = exposure.max() + 1
    names = range(n_exposures) if names is None else names
    rows = [np.flatnonzero(exposure == i) for i in range(n_exposures)]
    weighted = np.ones(n_exposures, dtype=bool)
    found = _tie(rows, exposure, star, xy, weighted, names)
    if _far_off(found, rows, star, xy):
        weighted[list(pair_agreement.compare(exposure, star, xy).against)] = False
        if not weighted.all():
            found = _tie(rows, exposure, star, xy, weighted, names)
    return found


def _tie(rows, exposure, star, xy, weighted, names):
    """Poses from the positions of exposures that have weight."""
    weighted, n_stars = weighted.copy(), star.max() + 1
    sums, counts, n_shared = np.zeros((n_stars, 2)), np.zeros(n_stars), np.zeros(len(rows))

    def add(i, positions):
        """Have the stars of an exposure in the means, and the others know how many of these are theirs."""
        before = counts > 0
        np.add.at(sums, star[rows[i]], positions)
        np.add.at(counts, star[rows[i]], 1)
        if (fresh := (counts > 0) & ~before).any():
            n_shared[:] += np.bincount(exposure, fresh[star], len(rows))

    first = int(np.argmax([len(r) * weight for r, weight in zip(rows, weighted, strict=True)]))
    found = {first: similarity.identity()}
    add(first, xy[rows[first]])
    while len(found) < len(rows):
        order = n_shared + len(star) * weighted  # those with weight come first
        order[list(found)] = -1
        best = int(np.argmax(order))
        r = rows[best][counts[star[rows[best]]] > 0]
        if len(r) < 2 or np.all(np.ptp(xy[r], axis=0) == 0):
            raise MatchError(
                f"exposure {names[best]} shares {len(r)} star{'s' * (len(r) != 1)} with the other exposures; its shift "
                "and rotation need at least 2: give poses, or leave it out, without= (--without); the layout in a "
                "solution of the others may tie it, camera= (--camera)"
            )
        mean = sums[star[r]] / counts[star[r], None]
        found[best] = similarity.robust_similarity(mean, xy[r])
        off = np.hypot(*(similarity.apply(found[best], mean) - xy[r]).T)
        weighted[best] &= np.median(off) <= 0.05 * np.ptp(xy[r], axis=0).max()
        if weighted[best]:
            add(best, similarity.apply(similarity.invert(found[best]), xy[rows[best]]))
    return _refine_poses([found[i] for i in range(len(rows))], rows, star, xy, weighted)


def _refine_poses(pose_list, rows, star, xy, weighted, n_sweeps=3):
    """Refit every pose to the mean of those with weight, the first one's plane fixed by the mean of their poses."""
    ends = np.array([xy.min(axis=0), xy.max(axis=0)])
    for _ in range(n_sweeps):
        mean = _means(pose_list, rows, star, xy, weighted)
        refined = []
        for pose, r in zip(pose_list, rows, strict=True):
            known = r[np.isfinite(mean[star[r], 0])]  # two at least: it was tied to them
            refined.append(similarity.robust_similarity(mean[star[known]], xy[known]) if len(known) > 1 else pose)
        old, new = (
            np.concatenate([similarity.apply(similarity.invert(pair[i]), ends) for i in np.flatnonzero(weighted)])
            for pair in (pose_list, refined)
        )
        common = similarity.robust_similarity(old, new)
        pose_list = [similarity.compose(pose, common) for pose in refined]
    return pose_list


def _means(pose_list, rows, star, xy, weighted):
    """Mean position (n_stars, 2) of every star in the exposures with weight."""
    used = np.flatnonzero(weighted)
    back = np.concatenate([similarity.apply(similarity.invert(pose_list[i]), xy[rows[i]]) for i in used])
    return star_means(back, star[np.concatenate([rows[i] for i in used])], star.max() + 1)


def _far_off(pose_list, rows, star, xy):
    """Whether the stars of some exposure typically lie far from their means."""
    mean = _means(pose_list, rows, star, xy, np.ones(len(rows), dtype=bool))
    for pose, r in zip(pose_list, rows, strict=True):
        off = np.hypot(*(similarity.apply(pose, mean[star[r]]) - xy[r]).T)
        if np.median(off) > _FAR * np.ptp(xy[r], axis=0).max():
            return True
    return False
