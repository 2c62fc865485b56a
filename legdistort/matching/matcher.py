"""Detections of all exposures -> matches: the same star gets the same number, every exposure its nominal pose."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u

from ..cameras import ties
from ..cameras.camera import Camera, check_camera
from ..cameras.exchanged import check_places, exchanged
from ..exceptions import AssumptionWarning, InputError, MatchError, reasons_of, warn
from ..geometry.epochs import header_epoch, mean_epoch
from ..geometry.zenith import stated_zenith
from ..inputs import column_contract
from ..inputs.column_contract import colour_column
from ..inputs.exposure_files import ExposureFile, listed
from ..inputs.exposure_names import whole_name
from ..inputs.exposures import Exposure
from ..inputs.star_lists.bad_places import without_bad_places
from ..inputs.start_poses import estimate_poses
from ..measurement.crowding import LIMIT, is_isolated
from ..measurement.flags import UNUSABLE
from ..priors.from_headers import describe, header_distortions
from ..runtime.guards.units import plain_numbers
from .detectors import detector_layout
from .detectors.foreign_images import without_foreign_images
from .labelling import add_numbers, labelled
from .matches import Matches
from .options import MatchOptions

if TYPE_CHECKING:
    from astropy.table import Table

    from ..inputs.exposures import Exposure
    from ..runtime.annotations import Shape, StrPath

log = logging.getLogger(__name__)

#: Years between exposures in which stars may move by more than the tolerance that is found.
LONG = 1.0
#: Exposures up to which it is told what fewer of them for a star would keep: `min_exposures` are most of them then.
_FEW_EXPOSURES = 5


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
    if camera is None and detector_layout.is_needed(table, exposures):
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
    found, is_given = labelled(table, exposures, shape, camera, options), camera is not None
    camera, named, shapes, left_out = found.camera, found.named, found.shapes, found.left_out
    table, star, several = found.table, found.star, len(found.names) > 1
    star[~_isolated(table, isolation)] = -1
    if camera is not None and several:
        mended = _with_headers_exchanged(camera, table, star, shapes, None if is_given else exposures)
        if mended is not None:
            again = vars(replace(options, columns=None)) | {"camera": Camera.of_frames(mended)}
            return match(detections, exposures=mended, shape=shape, **again)
        star = without_foreign_images(camera, table, star, min_exposures)
    tying = _ties_of_few(camera, table, star, min_exposures) if camera is not None and several else None
    table, star = _keep_common(table, star, min_exposures if several else 1, left_out, tying, tell=True)
    epoch = mean_epoch(e.header for e in named.values()) if named else None
    _add_stated(table, named or {})
    distortions = header_distortions(named[name] for name in np.unique(table["exposure"])) if named else {}
    matches = _finish(table, star, shapes, found.headers, left_out, epoch, distortions)
    _tell_of_motions(matches, tolerance)
    return replace(matches, left_out=found.copies | left_out, camera=camera)


def _tell_of_motions(matches, tolerance):
    """Say that stars which move may have been lost, where dates are years apart and no tolerance is given."""
    span = 0.0
    if tolerance is None and "epoch" in matches.table.colnames:
        with contextlib.suppress(InputError):  # of some the time is not known, which matters where motions are fitted
            span = float(np.ptp(matches.epochs))
    if span > LONG:
        log.info(
            "the exposures span %.1f years: stars that move farther than others scatter lose observations, or count as "
            "several; --tolerance PIXELS, as far as they move in that time, keeps them where stars are sparse",
            span,
        )


def _with_headers_exchanged(camera, table, star, shapes, exposures):
    """Exposures with the headers of two detectors exchanged, with a warning, where the stars tell so; None if not.

    With all stars that were found twice: few of those that cross are in many exposures. `InputError` where the places
    are not those of headers (exposures None), or an exposure has one of the two alone.
    """
    table, star = _keep_common(table, star, 2, {})
    table["star"] = star
    matches = replace(Matches.from_table(table, shape=shapes, allow_copies=True), camera=camera)
    found = exchanged(matches)
    if found is None:
        return None
    mended = detector_layout.with_headers_exchanged(exposures or (), found.pair)
    if mended is None:
        check_places(matches)
    a, b = found.pair
    warn(
        f"the headers have detectors {a} and {b} in each other's places: {found.words}; each is taken to have the "
        "header of the other, and the night goes on; mend the headers",
        AssumptionWarning,
    )
    return mended


def _check_measured(detections):
    """Raise `InputError` for exposures in the place of what was measured in them."""
    each = detections if isinstance(detections, (list, tuple)) else [detections]
    if each and isinstance(each[0], (Exposure, ExposureFile)):
        raise InputError("match takes the table that measure makes of exposures: call match(measure(exposures))")


def _add_stated(table, named, keywords=None):
    """Add the column ``epoch`` [yr] if headers state it and the table does not; NaN where one does not.

    Also ``tan_z`` and ``parallactic_angle`` [deg], as refraction needs them; from place, time and site for stars with
    colours alone.
    """
    add_numbers(table, named, keywords)
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
                others = count[inverse][~keep & (star >= 0)] if len(seen[0]) <= _FEW_EXPOSURES else ()
                log.info(
                    "%d of %d detections are of stars in fewer than %d exposures (min_exposures), and left out%s",
                    np.count_nonzero(~keep), len(keep), min_exposures, _kept_in_words(others, min_exposures),
                )  # fmt: skip
            return table[keep], star[keep]
        star = np.where(np.isin(exposure, list(poor)), -1, star)


def _kept_in_words(count, min_exposures):
    """How many of detections of stars in so many exposures (n,) a smaller number asked for keeps; empty for none."""
    kept = {least: np.count_nonzero(np.asarray(count) >= least) for least in range(2, min_exposures)}
    told = [f"--min-exposures {least} keeps {n}" for least, n in kept.items() if n][:2]
    return f": {', '.join(told)} of them" * bool(told)


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
