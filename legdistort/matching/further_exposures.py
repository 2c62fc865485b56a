"""Further exposures of the field, or of the camera, of a finished solution: the matches of all of them."""

import itertools
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ..exceptions import AssumptionWarning, InputError, MatchError, some_of, warn
from ..geometry.distortion import Distortion
from ..geometry.similarity import apply, invert, robust_similarity
from ..inputs.repetitions import copies
from ..inputs.start_poses import star_means
from .cross_identification import same_stars
from .fields import stacked
from .matches import Matches, Observations

#: What a solution adds to the table that it was made from.
_ADDED = "dx", "dy", "used"
#: Further exposures that see a star which the solution does not have, from which on it joins.
_CONFIRMED = 2
#: Times the typical distance of stars that are the same, within which one is that is nearest to another.
_FAR = 10.0
#: Stars from which a pose is found.
_FEWEST = 3


def with_further(solution, matches):
    """The matches of a solution and of further exposures, whose stars are found among its own.

    The plane and the names of the stars are those of the solution. A star that it does not have joins if two of the
    further exposures see it. Exposures of which no star is found are another field of the same camera.

    Parameters
    ----------
    solution : Solution
    matches : Matches
        Their camera, as it is stated, is that of all.

    Returns
    -------
    Matches

    Raises
    ------
    InputError
        For an exposure that the solution has already, for another camera, and for that which the solution found.

    Warns
    -----
    AssumptionWarning
        Naming exposures that are another field.
    """
    _check_camera(solution, matches.camera)
    before = solution.residuals.copy(copy_data=False)
    before.remove_columns(_ADDED)
    before, after = solution.camera.on_detectors(before), matches.camera.on_detectors(matches.table.copy())
    _check_new(Observations.of(before), Observations.of(after))
    seen = Observations.of(solution.residuals)
    mean = _mean_distortions(solution, seen, matches)
    placed = replace(matches, table=solution.camera.in_focal_plane(after), camera=solution.camera)
    names, joins, poses = _on_its_plane(solution, seen, placed, mean)
    star = matches.observations.star
    after, names = after[joins[star]], names[star][joins[star]]
    after["star"] = np.array(names.tolist())
    table = stacked({"the solution": before, "the exposures that come in": after})
    camera = matches.camera
    begun = dict(zip(solution.names, solution.coefficients, strict=True))
    return Matches.from_table(
        table,
        shape=None if camera.has_focal_plane else solution.estimate.shapes | matches.shapes,
        camera=camera if camera.is_known else None,
        poses=solution.poses | poses,
        sky=solution.sky,
        left_out={name: why for name, why in solution.left_out.items() if name not in poses} | matches.left_out,
        epoch=None if "epoch" in table.colnames else solution.diagnostics.epoch,
        header_distortion=matches.header_distortion,
        pointing=solution.diagnostics.pointing,
        allow_copies=True,
        start=begun | mean,
    )


def _check_camera(solution, given):
    """Raise `InputError` unless detectors of both cameras go by the same names; for the camera that was found, too.

    Its errors are by the exposures of the solution, which would be believed twice.
    """
    known = solution.camera
    if known.has_focal_plane != given.has_focal_plane or set(known.detectors) != set(given.detectors):
        raise InputError(
            f"the solution is of camera {known.name} (detectors {', '.join(known.detectors)}), and the exposures that "
            f"come in are of {given.name} ({', '.join(given.detectors)}): match them as those of the solution were"
        )
    errors = [error for each in known.detectors.values() for error in (each.layout_sigma, each.static_sigma)]
    is_found = any(error is not None for error in errors) or (known.common_map is not None and solution.gauge.tie)
    if known.has_focal_plane and is_found and all(_is_alike(known[key], given[key]) for key in known.detectors):
        raise InputError(
            f"the exposures that come in have the camera {known.name} as the solution found it, whose own exposures "
            "would count twice: match them as those of the solution were, with the camera that these were given, or, "
            "if their files told how the detectors lie, without any (leave out camera=, --camera)"
        )


def _is_alike(one, two):
    """Whether two detectors have the same layout and static distortion, to the last bit."""
    return np.array_equal(one.layout, two.layout) and np.array_equal(one.static, two.static)


def _check_new(before, after):
    """Raise `InputError` for an exposure that is there already, by its name or by its positions to the last bit."""
    for name in after.names:
        if name in before.names:
            raise InputError(
                f"exposure {name} is in the solution already: leave it out; another one needs another name"
            )
    exposure = np.concatenate([before.exposure, len(before.names) + after.exposure])
    for copy, original in copies(exposure, np.concatenate([before.xy, after.xy])).items():
        if original < len(before.names) <= copy:
            name, known = after.names[copy - len(before.names)], before.names[original]
            raise InputError(
                f"exposure {name} is in the solution already, as {known}: its positions are the same to the last bit; "
                "leave it out"
            )


def _on_its_plane(solution, seen, matches, mean):
    """How the solution calls stars of matches (n_stars,), whether they join (n_stars,), and poses from its plane."""
    own, q = matches.observations, _undistorted(matches, mean)
    of_field = np.zeros(len(seen.stars), dtype=int)
    of_field[seen.star] = seen.fields[seen.exposure]
    known, given = (
        (seen.stars, solution.estimate.positions, seen.flux),
        (own.stars, _places(solution, matches), own.flux),
    )
    found, poses = np.full(len(own.stars), -1), dict(matches.poses)
    located = np.zeros(len(own.stars), dtype=bool)
    joins = np.bincount(own.star) >= _CONFIRMED
    for number in range(own.fields.max() + 1):
        names = [own.names[i] for i in np.flatnonzero(own.fields == number)]
        mine = np.unique(own.star[own.fields[own.exposure] == number])
        tried = [_same(given, mine, known, np.flatnonzero(of_field == each)) for each in range(of_field.max() + 1)]
        rows, theirs = max(tried, key=lambda pair: len(pair[0]))
        if len(rows):
            found[rows], located[mine] = theirs, True
        else:
            if len(names) == 1:
                raise MatchError(
                    f"no star of exposure {names[0]} is one of the solution, and no other exposure is of its field: "
                    "nothing can be learnt from it. Is it of another field, or scale? A camera alone corrects its "
                    "positions: legdistort nights SOLUTION --out camera.asdf, then legdistort correct camera.asdf LIST"
                )
            joins[mine] = True
            warn(
                f"no star of exposure {some_of(names, 6)} is one of the solution: another field of its camera, or not "
                "found in it",
                AssumptionWarning,
            )
    poses |= _refined(own, q, solution.estimate.positions[found], found >= 0)
    same = (found := _more(solution, own, q, poses, found, located)) >= 0
    names = own.stars.astype(object)
    names[same] = seen.stars[found[same]]
    names[joins & ~same] = _fresh(seen.stars, own.stars[joins & ~same])
    return names, joins | same, poses


def _mean_distortions(solution, seen, matches):
    """For every further exposure the mean of what its detector has in the solution, ``{name: (2, n_modes)}``."""
    before, out = _detectors(seen), {}
    for name, detector in _detectors(matches.observations).items():
        alike = [k for k, other in enumerate(solution.names) if before[other] == detector]
        out[name] = solution.coefficients[alike or slice(None)].mean(axis=0)
    return out


def _undistorted(matches, mean):
    """What was measured (n, 2) with mean distortions taken off."""
    seen, out = matches.observations, np.empty_like(matches.observations.xy)
    for i, name in enumerate(seen.names):
        rows = seen.exposure == i
        out[rows] = Distortion(mean[name], matches.shapes[name]).invert(seen.xy[rows])
    return out


def _refined(seen, q, positions, known):
    """Poses of exposures by positions (n_stars, 2) on the plane of those of their stars that are known there.

    For undistorted positions q (n, 2), so that mean distortions do not decide where the plane is.
    """
    poses = {}
    for i, name in enumerate(seen.names):
        rows = np.flatnonzero((seen.exposure == i) & known[seen.star])
        if len(rows) >= _FEWEST:
            poses[name] = robust_similarity(positions[seen.star[rows]], q[rows])
    return poses


def _more(solution, seen, q, poses, found, located):
    """Rows of the solution (n_stars,) that stars are, with those that rough positions did not tell; -1 for none.

    Of stars that are `located` (n_stars,) on its plane, by others of the same field.
    """
    known, first = solution.estimate.positions, found >= 0
    if not first.any():
        return found
    places = np.empty_like(q)
    for i, name in enumerate(seen.names):
        rows = seen.exposure == i
        places[rows] = apply(invert(poses[name]), q[rows])
    places = star_means(places, seen.star, len(seen.stars))
    limit = _FAR * np.median(np.hypot(*(places - known[found])[first].T))
    solved, own = np.flatnonzero(np.isfinite(known).all(axis=1)), cKDTree(places)
    _, nearest = own.query(known[solved], distance_upper_bound=limit)
    back = cKDTree(known[solved]).query(places)[1]
    out = found.copy()
    for row, star in zip(solved, nearest, strict=True):
        is_free = star < len(out) and located[star] and not first[star] and row not in found
        if is_free and solved[back[star]] == row:
            out[star] = row
    return out


def _detectors(seen):
    """Detector of every exposure, ``{name: id}``; None without, and of a camera with a focal plane."""
    if "detector" not in seen.table.colnames or "x_detector" in seen.table.colnames:
        return dict.fromkeys(seen.names)
    return dict(zip(seen.names, np.asarray(seen.table["detector"])[seen.first].tolist(), strict=True))


def _places(solution, matches):
    """Rough positions (n_stars, 2) of stars, on the plane of the solution if both know the sky."""
    if solution.sky is None or matches.sky is None:
        return matches.positions
    return solution.sky.from_sky(matches.sky.to_sky(matches.positions))


def _same(one, rows, two, others):
    """Rows of some stars of one list that are the same as some of another, and the rows of these."""
    parts = [[each if each is None else each[these] for each in part] for part, these in ((one, rows), (two, others))]
    try:
        mine, theirs = same_stars(*parts, "the solution")
    except InputError:
        mine = theirs = np.zeros(0, dtype=int)
    return rows[mine], others[theirs]


def _fresh(known, own):
    """Names for stars that are none of those known: numbers after the highest, or their own if these are free."""
    if known.dtype.kind in "iu":
        return (known.max() + 1 + np.arange(len(own))).tolist()
    taken, out = set(known.tolist()), []
    for name in map(str, own):
        ends = itertools.chain([""], map("_{}".format, itertools.count(2)))
        out.append(next(name + end for end in ends if name + end not in taken))
        taken.add(out[-1])
    return out
