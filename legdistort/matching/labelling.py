"""Numbers of stars for detections, in a layout of the detectors that the dithers do not contradict."""

from __future__ import annotations

import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u
from astropy.table import vstack

from ..cameras.camera import Camera
from ..cameras.focal_planes import focal_planes
from ..exceptions import AssumptionWarning, InputError, MatchError, reasons_of, some_of, warn
from ..inputs import column_contract, repetitions
from ..inputs.detector_files import with_ids_of
from ..inputs.exposures import stated_numbers
from ..measurement.flags import Flag, flags_of
from ..runtime import parallel
from .detectors import detector_layout, detector_places
from .exposure_groups import interlink, link, standing, unite, without
from .fields import apart
from .header_poses import HeaderPoses
from .lattices.identification import identify_holes
from .lattices.periods import warn_of_lattice
from .matches import in_focal_plane, shapes_by_exposure
from .options import check_enough
from .star_labels import label_stars
from .star_lists import StarList

if TYPE_CHECKING:
    from astropy.table import QTable


log = logging.getLogger(__name__)

#: Fewest detections with which an exposure can take part.
FEWEST = 5
#: With a smaller part of hot pixels among the detections of every exposure these are not linked anew without them.
FEW_HOT = 0.05
#: How often detectors are placed by the stars that were found with the placing before.
_MOST_PLACINGS = 4
#: Detections that a layout must gain in which detectors lie elsewhere than in an exact one.
_FEWEST_GAINED = 10
#: A detector is lost of which less than this part of what the others have is tied to other exposures, and by chance
#: alone less than that; from so many detections on.
_FEW, _CHANCE, _ENOUGH = 0.7, 0.1, 20
#: Names in a sentence.
_MOST_NAMED = 6


@dataclass(frozen=True, eq=False)
class Labelled:
    """Usable detections (n,) of `names` with the number of their star (n,), -1 for none, and what is known of them.

    In the focal plane of the camera, if there is one; `named` are its exposures, None without any.
    """

    table: QTable
    star: np.ndarray
    camera: Camera | None
    names: list
    named: dict | None
    shapes: dict
    headers: HeaderPoses
    copies: dict
    left_out: dict

    def is_tied(self, least):
        """Which detections (n,) are of a star that so many are of."""
        return detector_places.is_tied(self.star, least)

    def n_tied(self, least):
        """Number of detections that are of a star that so many are of."""
        return np.count_nonzero(self.is_tied(least))

    def lost(self, part, least):
        """Detectors of which less than this part of what the others have is of stars in so many exposures or more."""
        if self.camera is None or len(self.camera.detectors) < 2 or len(self.names) < 2:
            return []
        ids, tied = self.camera.ids(self.table), self.is_tied(least)
        parts = {key: tied[ids == key] for key in self.camera.detectors}
        shares = {key: each.mean() for key, each in parts.items() if len(each) >= _ENOUGH}
        usual = max(np.median([*shares.values()]), max(shares.values()) / 2) if shares else 0.0
        return [key for key, share in shares.items() if share < part * usual]

    def n_crossing(self, least):
        """Number of stars in so many exposures or more that are on several detectors."""
        tied = self.is_tied(least)
        pairs = set(zip(self.star[tied].tolist(), self.camera.ids(self.table)[tied].tolist(), strict=True))
        return len(pairs) - len(np.unique(self.star[tied]))


def labelled(table, exposures, shape, camera, options):
    """The `Labelled` detections, in a layout that the dithers do not contradict.

    Detectors that headers, or a layout that is not exact, have mirrored or turned are set right if these tell how.
    """
    parts = [exposure for exposure in exposures or () if exposure.detector is not None]
    over = detector_layout.overlap_in_words(parts) if camera is None and parts else ""
    if over:
        begun = detector_layout.stated_layout(parts)
    else:
        if camera is None and parts:
            camera = Camera.of_frames(parts)
            _check_instruments(parts, camera)
            camera = detector_layout.with_usual_scales(camera)
            log.info("layout of the detectors by the headers, from which solve begins to find it: %s", camera)
        elif parts:
            camera = camera.with_headers(parts)
        if camera is not None and camera.has_focal_plane:
            table = with_ids_of(table, camera.detectors)
        found = _labelled_in(table, exposures, shape, camera, options)
        if not found.lost(_FEW, options.min_exposures):
            return found
        begun, n_tied = (camera.name, camera.detectors), found.n_tied(options.min_exposures)
    set_right, words = _set_right(table, exposures, shape, begun, options)
    if over and set_right is None:
        raise InputError(f"{over}, and the dithers do not tell how they lie: {detector_layout.CURE}")
    if not over and (set_right is None or set_right.n_tied(options.min_exposures) <= n_tied):
        return _without_lost(found, options.min_exposures)
    told = "; ".join(f"detector {key} ({each})" for key, each in words.items())
    if not over and not detector_places.is_free(camera):
        raise InputError(
            f"the dithers contradict the layout of camera {camera.name}, which is taken as exact, of {told}, against "
            "the other detectors: correct it, or leave camera out (--camera), and headers or dithers tell the layout"
        )
    by = f"headers (those of {parts[0].exposure}, for example)" if parts else f"layout of camera {camera.name}"
    warn(
        f"the dithers contradict the {by}, of {told}, against the other detectors: the layout is set right by the "
        f"dithers, and the night goes on; {detector_layout.CURE}",
        AssumptionWarning,
    )
    return set_right


def _check_instruments(parts, camera):
    """Raise `InputError`, naming them, for exposures of another instrument that has detectors of its own."""
    named = {each.name: str(each.header.get("INSTRUME", "")).strip() for each in parts}
    ours = {named[each.name] for each in parts if each.detector in camera.detectors}
    others = [each.name for each in parts if each.detector not in camera.detectors and named[each.name] not in ours]
    if ours and others and all(map(named.get, others)):
        theirs = " and ".join(dict.fromkeys(map(named.get, others)))
        raise InputError(
            f"{some_of(others, _MOST_NAMED)} {'are' if len(others) > 1 else 'is'} of {theirs}, another instrument than "
            f"{' and '.join(sorted(ours))} ({', '.join(camera.detectors)}): leave out what is of {theirs}, and match "
            "and solve it alone"
        )


def _set_right(table, exposures, shape, begun, options):
    """The `Labelled` detections with detectors turned as these move, None if that is not, and in words what was wrong.

    Of several ways it is that in which most stars cross from one detector to another.
    """
    name, detectors = begun
    parts = [exposure for exposure in exposures or () if exposure.detector is not None]
    given, tried = _without_flagged(table, int(options.reject_flags)), []
    lists = {key: {} for key in detectors}
    ids = np.asarray(given["detector"]).astype(str)
    for key in detectors:
        mine = given[ids == key]
        for exposure in dict.fromkeys(mine["exposure"]):
            rows = mine[mine["exposure"] == exposure]
            if len(rows) >= FEWEST:
                lists[key][exposure] = _star_list(rows, detectors[key].shape)
    for made, words in detector_layout.turned_by_dithers(detectors, lists, detector_layout.reference_pixels(parts)):
        with contextlib.suppress(InputError, MatchError):
            camera = Camera(name, made)
            camera = camera.with_headers(parts) if parts else camera
            found = _labelled_in(table, exposures, shape, camera, options)
            if not found.lost(_CHANCE, options.min_exposures):
                tried.append((found, words))
    return max(tried, key=lambda each: each[0].n_crossing(options.min_exposures), default=(None, {}))


def _without_lost(found, least):
    """The detections without those of detectors of which so few are tied as chance ties, with a warning."""
    if lost := found.lost(_CHANCE, least):
        ids = found.camera.ids(found.table)
        found.star[np.isin(ids, lost)] = -1
        warn(
            f"hardly a detection of detector{'s' * (len(lost) > 1)} {', '.join(lost)} fits those of the others, and "
            f"the dithers do not tell why: nothing of it is used; {detector_layout.CURE}",
            AssumptionWarning,
        )
    return found


def _labelled_in(table, exposures, shape, camera, options):
    """The `Labelled` detections in the layout of a camera, or of plain images without one."""
    if camera is not None:
        table = in_focal_plane(table, camera)
        shape = camera.field
        exposures = None if exposures is None else focal_planes(camera, exposures)
    named = None if exposures is None else {e.name: e for e in exposures}
    add_numbers(table, named or {}, options.keywords)
    names = list(dict.fromkeys(table["exposure"].tolist()) if named is None else named)
    _check_names(table, names, options.min_exposures)
    shapes = _shapes(table, names, named, shape)
    edges = _at_edges(table, int(options.reject_flags))
    table = _without_repetitions(_without_flagged(table, int(options.reject_flags)))
    copies = _copies(table)
    table, names = table[~np.isin(table["exposure"], list(copies))], [name for name in names if name not in copies]
    headers = HeaderPoses.of((named or {}).values(), shapes, _known_starts(options.start, shapes))
    with parallel.one_blas_thread():  # matrices are small
        if camera is not None and len(camera.detectors) > 1 and len(names) > 1:
            star, left_out = _label_over_gaps(table, names, shapes, headers, options, camera, edges)
        else:
            star, left_out = _label(table, names, shapes, headers, options, camera)
    return Labelled(table, star, camera, names, named, shapes, headers, copies, left_out)


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


def add_numbers(table, named, keywords):
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
