"""Detections of all exposures -> matches: the same star gets the same number, every exposure its nominal pose."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u
from astropy.table import vstack

from ..cameras import ties
from ..cameras.camera import Camera, check_camera
from ..cameras.exchanged import check_places
from ..cameras.focal_planes import focal_planes
from ..exceptions import AssumptionWarning, InputError, MatchError, reasons_of, some_of, warn
from ..geometry.epochs import header_epoch, mean_epoch
from ..geometry.zenith import stated_zenith
from ..inputs import column_contract, repetitions
from ..inputs.column_contract import colour_column
from ..inputs.exposure_files import ExposureFile, listed
from ..inputs.exposure_names import whole_name
from ..inputs.exposures import Exposure, stated_numbers
from ..inputs.star_lists.bad_places import without_bad_places
from ..inputs.start_poses import estimate_poses
from ..measurement.crowding import LIMIT, is_isolated
from ..measurement.flags import UNUSABLE, Flag, flags_of
from ..priors.from_headers import describe, header_distortions
from ..runtime import parallel
from ..runtime.guards.units import plain_numbers
from . import detector_layout, detector_places
from .exposure_groups import interlink, link, standing, unite, without
from .fields import apart
from .header_poses import HeaderPoses
from .lattices.identification import identify_holes
from .lattices.periods import warn_of_lattice
from .matches import Matches, in_focal_plane, shapes_by_exposure
from .options import MatchOptions, check_enough
from .star_labels import label_stars
from .star_lists import StarList

if TYPE_CHECKING:
    from astropy.table import Table

    from ..inputs.exposures import Exposure
    from ..runtime.annotations import Shape, StrPath

log = logging.getLogger(__name__)

#: Fewest detections with which an exposure can take part.
FEWEST = 5
#: With a smaller part of hot pixels among the detections of every exposure these are not linked anew without them.
FEW_HOT = 0.05
#: How often detectors are placed by the stars that were found with the placing before.
_MOST_PLACINGS = 4
#: Detections that a layout must gain in which detectors lie elsewhere than in an exact one.
_FEWEST_GAINED = 10


@plain_numbers
def match(
    detections: Table,
    *,
    exposures: Sequence[Exposure] | None = None,
    shape: Shape | Mapping[str, Shape] | None = None,
    camera: Camera | None = None,
    min_exposures: int = 4,
    columns: Mapping[str, str] | None = None,
    tolerance: float | None = None,
    reject_flags: int = UNUSABLE,
    isolation: float | None = LIMIT,
    start: Mapping[str, Sequence[float]] | Table | StrPath | None = None,
    keywords: Sequence[str] | None = None,
    progress: bool = False,
) -> Matches:
    """Find out which detections are the same star.

    Exposures may differ by any shift that leaves an overlap, any rotation, a flip, several per cent of scale
    and a distortion of about one per cent of the field. Header WCSs, where there are any, are tried first
    and always verified: what does not stand out from chance is not a match.

    Parameters
    ----------
    detections : `~astropy.table.Table`
        Columns ``exposure``, ``x``, ``y``, ``x_err``, ``y_err`` (pixels, 0-based, standard deviations), optional
        ``flux``, ``flags``, ``xy_corr``; further columns are kept.
    exposures : list of `~legdistort.inputs.exposures.Exposure`, optional
        Give the shapes and the nominal WCSs, by name.
    shape : tuple or dict, optional
        ``(ny, nx)``, or that by exposure, when there are no `exposures`; by detector, where these are distinguished and
        there is no camera.
    camera : `legdistort.Camera`, optional
        Where exposures have several detectors, distinguished by the column ``detector``: they are matched as one, the
        focal plane. Without it their layout is that of the headers of `exposures`; without these the dithers determine
        it, where stars cross from one detector to another. Where the layout is not exact (`Detector.layout_sigma`;
        that of headers is not), such stars are found though it is wrong by some ten pixels and tenths of a degree.
    min_exposures : int
        A star is kept when it was found in that many exposures; in two if no others tie some detectors of a camera.
        Of a single exposure, which a reference catalogue may solve, every detection is a star.
    columns : dict, optional
        ``{name expected: name in the table}``.
    tolerance : float, optional
        Largest distance of two detections of a star after distortions have been fitted for the pair, pixels;
        by default 5 times the scatter found, with the errors of both detections and of the fit on top.
    reject_flags : int
        Detections with any of these bits in ``flags`` are not used.
    isolation : float or None
        Largest ``crowding`` of a detection, see `legdistort.measurement.crowding`; deformed ones are left out too.
        They still help to identify stars before that. None = all are kept. Of tables without the column those with the
        flag ``BLENDED`` are left out, if they are less than half.
    start : dict, `~astropy.table.Table` or path of a table, optional
        Where stars lie in the exposures: ``{exposure: (xshift, yshift)}``, pixels, or ``(xshift, yshift, rotation)``,
        degrees about the centre of the detector from x to y; columns ``exposure``, ``xshift``, ``yshift``,
        ``rotation``. It is tried first, as header WCSs are, in place of these. Of the holes of a mask, which match as
        well when they are shifted by a period, it selects the period, if it is right to half of one.
    keywords : sequence of str, optional
        Keywords of numbers in the headers of `exposures`, such as the angle of a rotator: each becomes a column of that
        name, if there is none yet, NaN where a header does not state it (see `legdistort.combine_nights`).
    progress : bool
        Show progress bars.

    Returns
    -------
    Matches
        Stars are numbered from 0, the brightest first (without fluxes, in order of position). Poses refer to the
        plane of the richest exposure, or, with WCSs, to the tangent plane at their median pointing, in pixels of the
        first exposure and with its orientation. Exposures that fit nowhere stand in ``left_out`` with the reason.

    Raises
    ------
    InputError
        For missing columns, bad values, a missing shape, fewer exposures than `min_exposures`, keywords that no header
        states, or detectors that seem to lie in each other's places.
    MatchError
        For exposures in groups without a star in common, no star in `min_exposures` exposures, or holes of a mask of
        which nothing tells by how many periods they are shifted.

    See Also
    --------
    legdistort.measure : Makes the table of detections.
    legdistort.Matches.from_table : Takes positions that are matched already.

    Examples
    --------
    >>> import legdistort as ld
    >>> table = ld.simulate_matches(n_stars=40, n_exposures=5, dither=50, seed=1).matches.table
    >>> table.remove_column("star")
    >>> ld.match(table, shape=(2048, 2048)).names
    ('exp00', 'exp01', 'exp02', 'exp03', 'exp04')
    """
    options = MatchOptions(
        min_exposures=min_exposures, columns=columns, tolerance=tolerance, reject_flags=reject_flags,
        isolation=isolation, start=start, keywords=keywords, progress=progress,
    )  # fmt: skip
    _check_measured(detections)
    check_camera(camera)
    detections = column_contract.rename(detections, columns) if columns else detections
    table = column_contract.check(detections, column_contract.DETECTED, "the table of detections")
    exposures = None if exposures is None else listed(exposures, "match")
    table = without_bad_places(table, exposures or ())
    if camera is None:
        if detector_layout.is_needed(table, exposures):
            if start is not None:
                raise InputError(
                    "start positions are those of whole exposures, and how the detectors of these lie to each other is "
                    "not known: give the camera too, camera= (--camera)"
                )
            shapes = detector_layout.shapes_of(table, exposures, shape)
            log.info("neither a camera nor headers: how the detectors lie is sought in the dithers")
            _add_stated(table, {whole_name(exposure): exposure for exposure in exposures or ()}, options.keywords)
            again = vars(replace(options, columns=None))
            return detector_layout.match_parts(table, shapes, lambda parts, shape: match(parts, shape=shape, **again))
        if any(exposure.detector is not None for exposure in exposures or ()):
            camera = Camera.of_frames(exposures)
            log.info("layout of the detectors by the headers, from which solve begins to find it: %s", camera)
    elif any(exposure.detector is not None for exposure in exposures or ()):
        camera = camera.with_headers(exposures)
    if camera is not None:
        table = in_focal_plane(table, camera)
        shape = camera.field
        exposures = None if exposures is None else focal_planes(camera, exposures)
    named = None if exposures is None else {e.name: e for e in exposures}
    _add_numbers(table, named or {}, options.keywords)
    names = list(dict.fromkeys(table["exposure"].tolist()) if named is None else named)
    _check_names(table, names, min_exposures)
    shapes = _shapes(table, names, named, shape)
    edges = _at_edges(table, int(reject_flags))
    table = _without_repetitions(_without_flagged(table, int(reject_flags)))
    copies = _copies(table)
    table, names = table[~np.isin(table["exposure"], list(copies))], [name for name in names if name not in copies]
    headers = HeaderPoses.of((named or {}).values(), shapes, _known_starts(options.start, shapes))

    with parallel.one_blas_thread():  # matrices are small
        if camera is not None and len(camera.detectors) > 1 and len(names) > 1:
            star, left_out = _label_over_gaps(table, names, shapes, headers, options, camera, edges)
        else:
            star, left_out = _label(table, names, shapes, headers, options, camera)
    star[~_isolated(table, isolation)] = -1
    if camera is not None and len(names) > 1:
        _check_detectors(camera, table, star, shapes)
    tying = None if camera is None or len(names) == 1 else _ties_of_few(camera, table, star, min_exposures)
    table, star = _keep_common(table, star, 1 if len(names) == 1 else min_exposures, left_out, tying, tell=True)
    epoch = mean_epoch(e.header for e in named.values()) if named else None
    _add_stated(table, named or {})
    distortions = header_distortions(named[name] for name in np.unique(table["exposure"])) if named else {}
    matches = _finish(table, star, shapes, headers, left_out, epoch, distortions)
    return replace(matches, left_out=copies | left_out, camera=camera)


def _label(table, names, shapes, headers, options, camera=None):
    """Number of the star of every detection, -1 for none, and exposures that are left out, with the reason."""
    rows = {name: np.flatnonzero(table["exposure"] == name) for name in names}
    left_out = {n: f"only {len(r)} usable detections of at least {FEWEST}" for n, r in rows.items() if len(r) < FEWEST}
    kept = [name for name in names if name not in left_out]
    lists = [_star_list(table[rows[name]], shapes[name]) for name in kept]
    star = np.full(len(table), -1)
    if len(names) == 1 and kept:
        log.info(
            "one exposure (%s): every detection is a star; a solution that it comes into (--base), or a reference "
            "catalogue, solves it",
            names[0],
        )
        star[:] = np.arange(len(table))
        return star, left_out
    found = identify_holes(lists, kept, headers, left_out, gaps=len(camera.detectors) > 1 if camera else False)
    if found is None:
        found = _associate(lists, kept, headers, left_out, options)
    for name, labels in found.items():
        star[rows[name]] = labels
    return star, left_out


def _label_over_gaps(table, names, shapes, headers, options, camera, edges):
    """The same in the layout which the stars call for: labels, with a warning where that of the camera is exact.

    It is sought anew with the stars that were found, as long as more detections become the same star; of an exact one
    by more than chance. Stars that cross are at the `edges`: a table of detections for this search alone.
    """
    keys, free = list(camera.detectors), detector_places.is_free(camera)
    rows, moved = len(table), vstack([table, edges[np.isin(edges["exposure"], names)]], metadata_conflicts="silent")
    detector = np.array([keys.index(key) for key in camera.ids(moved)])
    exposure, given = np.unique(moved["exposure"], return_inverse=True)[1], _positions(moved)
    flux = column_contract.values(moved, "flux") if "flux" in moved.colnames else None
    found, alone = _label(table, names, shapes, headers, options), np.full(len(moved) - rows, -1)
    for _ in range(_MOST_PLACINGS):
        star = np.concatenate([found[0], alone])
        xy = detector_places.nearer(camera, _positions(moved), exposure, detector, star, flux)
        if xy is None:
            break
        c, far = detector_places.farthest(xy - given, detector)
        if not free and far < detector_places.WIDTH:
            break
        moved["x"], moved["y"] = xy.T * u.pix
        try:
            again = _label(moved[:rows], names, shapes, headers, options)
        except MatchError:
            break
        gained = detector_places.n_tied(again[0]) - detector_places.n_tied(found[0])
        if gained <= (0 if free else _FEWEST_GAINED):
            break
        found = again
        if not free:
            warn(
                f"stars that move over the gaps do not fit the layout of camera {camera.name}: detector {keys[c]} "
                f"seems to lie {far:.0f} px from where it has it; they are matched nevertheless, and layout='fit' "
                "(--layout fit) of solve and run finds the layout",
                AssumptionWarning,
            )
            break
    star = np.concatenate([found[0], alone])
    return detector_places.with_crossing(camera, _positions(moved), exposure, detector, star, flux)[:rows], found[1]


def _positions(table):
    """Positions (n, 2) of a table, pixels."""
    return np.column_stack([table["x"].to_value(u.pix), table["y"].to_value(u.pix)])


def _check_detectors(camera, table, star, shapes):
    """`check_places` with all stars that were found twice: few of those that cross are in many exposures."""
    table, star = _keep_common(table, star, 2, {})
    table["star"] = star
    check_places(replace(Matches.from_table(table, shape=shapes, allow_copies=True), camera=camera))


def _check_measured(detections):
    """Raise `InputError` for exposures in the place of what was measured in them."""
    each = detections if isinstance(detections, (list, tuple)) else [detections]
    if each and isinstance(each[0], (Exposure, ExposureFile)):
        raise InputError("match takes the table that measure makes of exposures: call match(measure(exposures))")


def _add_numbers(table, named, keywords):
    """Add a column for every keyword with a number in the headers of exposures, if the table has none of that name."""
    lacking = [keyword for keyword in keywords or () if keyword not in table.colnames]
    if lacking and not named:
        raise InputError(
            f"keywords: {lacking[0]} is to be read from headers, and there are no frames: give them, exposures= "
            "(--wcs FRAME ...), or a column of that name"
        )
    headers = {name: exposure.header for name, exposure in named.items()}
    for keyword, numbers in stated_numbers(headers, lacking).items():
        table[keyword] = [numbers.get(name, np.nan) for name in table["exposure"]]


def _add_stated(table, named, keywords=None):
    """Add the column ``epoch`` [yr] if headers state it and the table does not; NaN where one does not.

    Also ``tan_z`` and ``parallactic_angle`` [deg], as refraction needs them; from place, time and site for stars with
    colours alone.
    """
    _add_numbers(table, named, keywords)
    epochs = {name: header_epoch(exposure.header) for name, exposure in named.items()}
    if any(epoch is not None for epoch in epochs.values()) and "epoch" not in table.colnames:
        years = {name: np.nan if epoch is None else epoch for name, epoch in epochs.items()}
        table["epoch"] = [years.get(name, np.nan) for name in table["exposure"]] * u.yr
    how = {"reckoned": colour_column(table) is not None}
    zenith = {name: stated_zenith(exposure.header, **how) for name, exposure in named.items()}
    for k, column in enumerate(("tan_z", "parallactic_angle")):
        values = [zenith.get(name, (np.nan, np.nan))[k] for name in table["exposure"]]
        if column not in table.colnames and np.isfinite(values).any():
            table[column] = values * (u.deg if k else u.one)


def _isolated(table, limit):
    """Which detections (n,) no neighbour disturbs, as `is_isolated`; how many others there are is logged."""
    isolated = is_isolated(table, limit)
    if not isolated.all():
        why = "" if "crowding" in table.colnames else " (flagged as blended in their lists; --isolation inf keeps them)"
        log.info("%d of %d detections are not isolated and left out%s", np.count_nonzero(~isolated), len(table), why)
    return isolated


def _without_flagged(table, reject_flags):
    """The table without rows of which a flag is to be rejected; a missing flag is none."""
    if "flags" not in table.colnames:
        return table
    flags = flags_of(table)
    good = (flags & reject_flags) == 0
    counts = {flag.name: np.count_nonzero(flags & flag) for flag in Flag if flag & reject_flags}
    named = ", ".join(f"{name} {count}" for name, count in counts.items() if count)
    if not good.all() and "crowding" not in table.colnames:  # what measure flags is in its own table
        n = np.count_nonzero(~good)
        log.info("%d of %d detections are left out for their flags (%s)", n, len(table), named)
    if not good.any():
        raise MatchError(
            f"none of the {len(table)} detections can be used, all have flags for which they are rejected ({named}): "
            "correct the column flags or leave it out, or give the bits to reject, match(reject_flags=...), 0 for none"
        )
    return table[good]


def _at_edges(table, reject_flags):
    """Detections at the edge of an image that are rejected for no other reason."""
    if "flags" not in table.colnames:
        return table[:0]
    return table[(flags_of(table) & reject_flags) == Flag.EDGE]


def _without_repetitions(table):
    """The table without rows that repeat a position of the same exposure: they would pass for two blended stars."""
    place = np.rec.fromarrays([table["exposure"], table["x"].value, table["y"].value])
    first = np.sort(np.unique(place, return_index=True)[1])
    if len(first) < len(table):
        log.warning("%d detections stand twice at the very same place; one of each is kept", len(table) - len(first))
    return table[first]


def _known_starts(start, shapes):
    """Start positions of exposures that there are."""
    unknown = sorted(set(start or ()) - set(shapes))
    if unknown:
        raise InputError(
            f"start has exposure {unknown[0]}, which is none of those of the table: {some_of(sorted(shapes), 6)}"
        )
    return start


def _copies(table):
    """Exposures that repeat another one, ``{name: reason}``."""
    names, exposure = np.unique(table["exposure"], return_inverse=True)
    xy = np.column_stack([table["x"].to_value(u.pix), table["y"].to_value(u.pix)])
    return repetitions.reasons([str(name) for name in names], exposure, xy)


def _check_names(table, names, min_exposures):
    unknown = sorted(set(table["exposure"].tolist()) - set(names))
    if unknown:
        raise InputError(
            f"the table of detections names exposure {unknown[0]!r}, which is not among exposures= ({', '.join(names)})"
        )
    if len(names) > 1:
        check_enough(len(names), min_exposures)


def _shapes(table, names, named, shape):
    if named is not None:
        return {name: named[name].shape for name in names}
    if shape is None:
        shape = tuple(int(np.ceil(table[c].to_value(u.pix).max() + 0.5)) for c in ("y", "x"))
        warn(
            f"no shape given: every exposure is taken as {shape[1]} x {shape[0]} pixels, the extent of the positions; "
            "give shape=(ny, nx) or exposures= (--shape NY NX)",
            AssumptionWarning,
        )
    return shapes_by_exposure(shape, names)


def _star_list(table, shape):
    x, y, x_err, y_err = (table[c].to_value(u.pix) for c in ("x", "y", "x_err", "y_err"))
    has_flux = "flux" in table.colnames
    flux = np.nan_to_num(column_contract.values(table, "flux"), nan=-np.inf) if has_flux else None
    return StarList(np.column_stack([x, y]), np.hypot(x_err, y_err), shape, flux)


def _associate(lists, names, headers, left_out, options):
    """Star labels by exposure name; exposures without a place are added to `left_out`."""
    if len(lists) < 2:
        raise MatchError(f"fewer than two exposures have stars enough: {reasons_of(left_out)}")

    tolerance, progress = options.tolerance, options.progress

    def guess(i, j):
        return headers.step(names[i], names[j])

    def grouped(lists):
        return unite(lists, link(lists, guess, tolerance=tolerance, progress=progress), guess, tolerance=tolerance)

    groups = grouped(lists)
    hot = standing(lists, groups[0])
    if any(h.any() for h in hot):
        log.info(
            "%d detections stand still while the sky moves: hot pixels or bad columns, not used",
            sum(h.sum() for h in hot),
        )
        lists = [stars.subset(~h) for stars, h in zip(lists, hot, strict=True)]
        few = max(h.mean() for h in hot) < FEW_HOT  # they have not led the registrations astray
        groups = [without(group, hot) for group in groups] if few else grouped(lists)
    _check_groups(groups, lists, names, left_out, tolerance)
    warn_of_lattice(lists, names, groups[0].poses, headers)
    registrations, misfits = interlink(lists, groups[0], tolerance=tolerance, progress=progress)
    left_out.update({names[i]: reason for i, reason in misfits.items()})
    good = {pair: r for pair, r in registrations.items() if not misfits.keys() & set(pair)}
    log.info("%d pairs of exposures registered", len(good))
    labels = [np.full(len(h), -1) for h in hot]
    for label, h, found in zip(labels, hot, label_stars([len(stars) for stars in lists], good), strict=True):
        label[~h] = found
    return dict(zip(names, labels, strict=True))


def _check_groups(groups, lists, names, left_out, tolerance):
    for group in groups:
        if len(group.poses) == 1:
            (only,) = group.poses
            left_out[names[only]] = f"none of its {len(lists[only])} detections fit other exposures better than chance"
    large = [sorted(names[i] for i in group.poses) for group in groups if len(group.poses) > 1]
    if len(large) > 1:
        raise apart(large, "match each group by itself; fields of one camera can be solved together then")
    if not large:
        message = (
            f"no two exposures show the same stars (tried {some_of(names, 6)}); check that they overlap and that the "
        )
        message += "detections are stars"
        if tolerance is not None:
            message += (
                f"; tolerance={tolerance:g} (--tolerance) is no reach of the search, but how far one star may lie "
            )
            message += "apart: leave it out, it is found"
        raise MatchError(message)


def _ties_of_few(camera, table, star, min_exposures):
    """Rows (n,) of stars on detectors that stars in enough exposures do not tie, bool: fewer are enough for them."""
    labelled = table["exposure", "detector"].copy()
    labelled["star"] = star
    number, inverse, count = np.unique(star, return_inverse=True, return_counts=True)
    seen = ties.seen_by(camera, labelled) & (number >= 0) & (count > 1)
    group = ties.believed(seen & (count >= min_exposures))
    tying = sum(seen[group == g].any(axis=0).astype(int) for g in range(group.max(initial=-1) + 1)) > 1
    few = int(np.count_nonzero(tying & (count < min_exposures)))
    if few:
        log.info(
            "%d star%s in fewer than %d exposures kept: how detectors lie to each other rests on %s",
            few, "s" * (few > 1), min_exposures, "them" if few > 1 else "it",
        )  # fmt: skip
    return tying[inverse]


def _keep_common(table, star, min_exposures, left_out, tying=None, *, tell=False):
    """Rows of stars in enough exposures, or of those `tying` detectors; exposures with fewer than 3 of these go too.

    How many do not stay is told, if that is wanted.
    """
    exposure = np.asarray(table["exposure"])
    while True:
        _, inverse, count = np.unique(star, return_inverse=True, return_counts=True)
        keep = (star >= 0) & (count[inverse] >= (min_exposures if tying is None else np.where(tying, 2, min_exposures)))
        seen = np.unique(exposure[keep], return_counts=True)
        poor = {str(n): c for n, c in zip(*seen, strict=True) if c < 3}
        absent = [n for n in np.unique(exposure) if n not in seen[0] and n not in left_out]
        if not keep.any():
            most = np.max(count[inverse][star >= 0], initial=0)
            raise MatchError(
                f"no star was found in {min_exposures} exposures or more, the best in {most}; "
                f"give min_exposures={most} (--min-exposures) or less"
                + (f"; left out: {reasons_of(left_out)}" if left_out else "")
            )
        left_out.update(
            {str(n): f"only {poor.get(n, 0)} of its stars are in {min_exposures} exposures" for n in [*poor, *absent]}
        )
        if not poor:
            if tell and not keep.all():
                log.info("%d of %d detections are of stars in fewer than %d exposures (min_exposures), and left out",
                         np.count_nonzero(~keep), len(keep), min_exposures)  # fmt: skip
            return table[keep], star[keep]
        star = np.where(np.isin(exposure, list(poor)), -1, star)


def _finish(table, star, shapes, headers, left_out, epoch, distortions):
    table["star"] = _numbers(table, star)
    if left_out:
        log.warning("left out: %s", reasons_of(left_out))
    matches = Matches.from_table(table, shape=shapes, left_out=left_out, epoch=epoch)
    undistorted = _undistorted_poses(matches, distortions)
    poses, sky = headers.place(undistorted)
    known = {"header_distortion": describe(distortions), "pointing": headers.pointing(undistorted)}
    return replace(matches, poses=poses, sky=sky, **known)


def _undistorted_poses(matches, distortions):
    """Poses by positions without what the headers know of distortion: so the sky is that which they mean."""
    if not distortions:
        return matches.poses
    obs = matches.observations
    xy = obs.xy.copy()
    for i, name in enumerate(matches.names):
        if name in distortions:
            rows = obs.exposure == i
            xy[rows] = distortions[name].undistort(xy[rows])
    return dict(zip(matches.names, estimate_poses(obs.exposure, obs.star, xy, names=matches.names), strict=True))


def _numbers(table, star):
    """Serial numbers for labels: by falling median flux, or else by position from left to right."""
    _, index, count = np.unique(star, return_inverse=True, return_counts=True)
    if "flux" in table.colnames:
        flux = column_contract.values(table, "flux")
        order = np.lexsort([flux, index])
        middle = np.searchsorted(index[order], np.arange(len(count))) + count // 2
        value = -np.nan_to_num(flux[order][middle], nan=-np.inf)
    else:
        value = np.bincount(index, table["x"].to_value(u.pix)) / count
    serial = np.empty(len(count), int)
    serial[np.argsort(value, kind="stable")] = np.arange(len(count))
    return serial[index]
