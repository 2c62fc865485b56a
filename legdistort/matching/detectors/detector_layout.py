"""How the detectors of a camera lie, from the dithers alone: where neither a camera nor headers state it, or wrongly.

Every detector of every exposure is first matched as an exposure of its own. Stars that cross from one detector to
another put all of them on one plane, and two detectors of one exposure then lie there as they do in the camera.

From exposure to exposure the stars of a detector that is mirrored or turned against what a header states move another
way than those of the others, and farther or less far where its pixels are of another size: whether any cross or not.
"""

from dataclasses import replace
from itertools import combinations, product

import numpy as np

from ...cameras import header_layout
from ...cameras.camera import Camera, overlapping
from ...cameras.detector import Detector
from ...cameras.from_wcs import fullest, stated_detectors
from ...cameras.header_layout import ANGLE_SAME, SCALE_SAME, orientation_in_words
from ...exceptions import AssumptionWarning, InputError, MatchError, warn
from ...geometry import basis, similarity
from ...inputs.exposure_names import detector_name
from ..exposure_groups import link
from ..matches import Matches

#: What to do about headers that dithers contradict.
CURE = "mend the headers, or give a camera file (--camera), such as that of a solution of another night"
#: Exposures that are compared, most of them.
_COMPARED = 6
#: Dithers of two detectors agree to this part of them, and so many pixels: distortions make up for it.
_PART, _NEAR = 0.05, 2.0
#: Layouts that are tried, most of them.
_MOST_TRIED = 4


def is_needed(table, exposures):
    """Whether exposures have several detectors, and headers do not state how these lie."""
    if exposures is not None:
        return any(e.detector is not None and e.wcs is None for e in exposures)
    if "detector" not in table.colnames:
        return False
    parts = np.unique(np.char.add(np.char.add(np.asarray(table["exposure"]).astype(str), "\n"), _ids(table)))
    return len(parts) > len(np.unique(table["exposure"]))


def shapes_of(table, exposures, shape):
    """``{detector: (ny, nx)}``; `InputError` where it is not known."""
    if exposures is not None:
        return {e.detector: e.shape for e in exposures}
    keys = np.unique(_ids(table)).tolist()
    shapes = shape if isinstance(shape, dict) else dict.fromkeys(keys, shape)
    shapes = {str(key): value for key, value in shapes.items()}
    if missing := [key for key in keys if shapes.get(key) is None]:
        raise InputError(
            f"exposures have several detectors ({', '.join(keys)}) and no camera is given: give the shape (ny, nx) of "
            f"all, or a dict of it by detector (missing: {', '.join(missing)}), or the camera"
        )
    return shapes


def match_parts(table, shapes, match):
    """`Matches` over all detectors, with a camera whose layout the dithers determine.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Detections, with the column ``detector``.
    shapes : dict
        ``{detector: (ny, nx)}``.
    match : callable
        ``match(table, shape)``: the `Matches` of exposures of one detector.

    Raises
    ------
    MatchError
        If no star crosses from some detectors to others, naming them.
    """
    table, ids = table.copy(), _ids(table)
    frames, table["detector"] = np.asarray(table["exposure"]).astype(str), ids
    table["exposure"] = [detector_name(*part) for part in zip(frames, ids, strict=True)]
    part_of = dict(zip(table["exposure"], zip(frames, ids, strict=True), strict=True))
    try:
        matches = match(table, {name: shapes[key] for name, (_, key) in part_of.items()})
    except MatchError as error:
        _tell_apart([[part_of[name] for name in group] for group in error.groups])
        raise
    camera = Camera("camera", _layouts(matches.poses, part_of, shapes))
    made = matches.table.copy()
    made["exposure"] = [part_of[name][0] for name in made["exposure"]]
    whole = {part_of[name][0] for name in matches.names}
    lost = {n: why for n, why in matches.left_out.items() if n in part_of and part_of[n][0] not in whole}
    lost = {part_of[name][0]: why for name, why in lost.items()}
    found = Matches.from_table(made, camera=camera, allow_copies=True)
    placed = {"table": found.table, "shapes": found.shapes, "poses": found.poses, "sky": None}  # on another plane
    return replace(matches, **placed, left_out=lost, camera=camera)


def _ids(table):
    return np.asarray(table["detector"]).astype(str)


def _tell_apart(groups):
    """Raise `MatchError` if groups of ``(exposure, detector)`` are those of different detectors of exposures."""
    exposures = [{exposure for exposure, _ in group} for group in groups]
    groups = sorted(sorted({key for _, key in group}) for group in groups)
    listed = " | ".join(", ".join(each) for each in groups)
    for k, group in enumerate(groups):
        for other in groups[k + 1 :]:
            if not set(group) & set(other):
                raise MatchError(
                    f"how detectors {group[0]} and {other[0]} lie to each other is not known: no star was found on "
                    f"both (detectors that share stars: {listed}), and neither a camera nor headers state it; dither "
                    "over the gap, or give the camera"
                ) from None
    if any(one & two for one, two in combinations(exposures, 2)):
        raise MatchError(
            f"how detectors lie to each other is not known: those of an exposure fall into {len(groups)} groups "
            f"without a common star (of detectors {listed}), and neither a camera nor headers state it; give the "
            "frames (--wcs) or a camera (--camera), such as that of a solution of another night, and leave out what "
            "is no star, above all at the edges of detectors"
        ) from None


def _layouts(poses, part_of, shapes):
    """``{detector: Detector}`` in the pixels of the detector that is in most exposures."""
    found = {}
    for name, pose in poses.items():
        frame, key = part_of[name]
        found.setdefault(frame, {})[key] = pose
    keys = sorted({key for each in found.values() for key in each})
    first = max(keys, key=lambda key: sum(key in each for each in found.values()))
    out = {}
    for key in keys:
        corners = basis.denormalize(*np.array([[-1, 1, -1, 1], [-1, -1, 1, 1]]), shapes[key])
        there = [
            similarity.apply(similarity.compose(each[first], similarity.invert(each[key])), corners)
            for each in found.values()
            if first in each and key in each
        ]
        if not there:
            raise MatchError(
                f"how detectors {first} and {key} lie to each other is not known: no exposure has both; give the camera"
            )
        layout = similarity.fit_similarity(np.median(there, axis=0), corners)
        out[key] = Detector(tuple(shapes[key]), layout=layout, layout_sigma=np.inf if len(keys) > 1 else None)
    return out


def overlap_in_words(exposures):
    """Which detectors the headers of an exposure put on each other, in words; empty for none.

    Parameters
    ----------
    exposures : list of Exposure
        With `exposure` and `detector`; that which has most detectors states the layout.
    """
    pairs, first = overlapping(stated_detectors(exposures)), fullest(exposures)
    if not pairs:
        return ""
    told = ", ".join(f"{a} and {b} (by {100 * share:.0f} % of their area)" for (a, b), share in pairs.items())
    return f"the headers of {first[0].exposure} put detectors on each other: {told}"


def stated_layout(exposures):
    """Name of the camera and ``{id: Detector}`` as headers have these, which may lie on each other."""
    name = str(fullest(exposures)[0].header.get("INSTRUME", "")).strip()
    detectors = stated_detectors(exposures)
    return name or "camera", {key: replace(each, layout_sigma=np.inf) for key, each in detectors.items()}


def with_headers_exchanged(exposures, pair):
    """Exposures of which two detectors have the WCS of each other; None where one has a single one of them, or none."""
    partner, by_part = dict(zip(pair, pair[::-1], strict=True)), {(e.exposure, e.detector): e for e in exposures}
    others = {e.name: by_part.get((e.exposure, partner[e.detector])) for e in exposures if e.detector in partner}
    if not others or None in others.values():
        return None
    return [replace(e, wcs=others[e.name].wcs) if e.name in others else e for e in exposures]


def reference_pixels(exposures):
    """``{id: (x, y)}``, from 0, of the detectors whose headers are FITS WCSs, of the exposure that has most."""
    found = {each.detector: getattr(each.wcs, "wcs", None) for each in fullest(exposures)}
    return {key: np.asarray(wcs.crpix) - 1 for key, wcs in found.items() if wcs is not None}


def turned_by_dithers(detectors, lists, pivots):
    """Layouts in which detectors are turned as their stars move, where these contradict the given ones.

    Parameters
    ----------
    detectors : dict
        ``{id: Detector}``, which may lie on each other.
    lists : dict
        ``{id: {exposure: StarList}}`` in pixels of the detector.
    pivots : dict
        ``{id: (x, y)}``: the pixel whose place a header has right, perhaps; else it is the middle of the detector.

    Returns
    -------
    list of (dict, dict)
        Detectors as they may lie, and in words what was wrong, ``{id: str}``; empty if the dithers contradict nothing,
        or tell nothing.
    """
    moves = {key: _moves(each) for key, each in lists.items()}
    alike = {r: [c for c in moves if _is_alike(detectors, moves, r, c)] for r in moves}
    first = max(alike, key=lambda r: (len(alike[r]), len(moves[r])), default=None)
    odd = [key for key in moves if moves[key] and key not in alike[first]]
    found = {key: _linear_parts(detectors, moves, first, key) for key in odd}
    if not odd or not all(found.values()):
        return []
    out = []
    for linear in product(*found.values()):
        for known in (False, True)[: 1 + any(key in pivots for key in odd)]:
            made, words = dict(detectors), {}
            for key, each in zip(odd, linear, strict=True):
                pivot = pivots[key] if known and key in pivots else _middle(detectors[key])
                made[key], words[key] = _turned(detectors[key], each, pivot)
            out.append((made, words))
    return out[:_MOST_TRIED]


def _middle(detector):
    return basis.denormalize(*np.zeros((2, 1)), detector.shape)[0]


def with_usual_scales(camera):
    """The camera by headers, detectors whose pixels these have of another size than most with that of the others.

    Warns
    -----
    AssumptionWarning
        Naming these, and by how much.
    """
    detectors, odd = header_layout.with_usual_scales(camera.detectors)
    if not odd:
        return camera
    told = ", ".join(f"{key} {ratio:.3f} times" for key, ratio in odd.items())
    warn(
        f"the headers have the pixels of detector {told} as large as those of the other {len(detectors) - len(odd)}, "
        "which agree: it is taken to have pixels as large as theirs, and the sky is that of the others; exposures "
        "alone hardly tell which is right, a reference does (--reference); how well headers are known otherwise is "
        "--layout-sigma of solve, and a camera with such a detector is a camera file (--camera)",
        AssumptionWarning,
    )
    return replace(camera, detectors=detectors)


def _moves(lists):
    """Poses ``{exposure: (2, 3)}`` on a plane of their own of the exposures of one detector; empty if none is tied."""
    names = sorted(lists, key=lambda name: -len(lists[name]))[:_COMPARED]
    groups = link([lists[name] for name in names], lambda i, j: None) if len(names) > 1 else []
    poses = groups[0].poses if groups else {}
    return {names[i]: pose for i, pose in poses.items()} if len(poses) > 1 else {}


def _dithers(detectors, moves, first, key):
    """How the middle of a detector moves, in the focal plane by the stars of another and in its pixels by its own."""
    common = [name for name in moves[key] if name in moves[first]]
    middle, layout = _middle(detectors[key]), detectors[first].layout
    f = similarity.apply(similarity.invert(detectors[key].layout), middle)
    seen, own = [], []
    for name in common[1:]:
        here, there = (similarity.compose(moves[k][name], similarity.invert(moves[k][common[0]])) for k in (key, first))
        there = similarity.compose(similarity.invert(layout), similarity.compose(there, layout))
        own.append(similarity.apply(here, middle) - middle)
        seen.append(similarity.apply(there, f) - f)
    return np.reshape(seen, (-1, 2)), np.reshape(own, (-1, 2))


def _left(own, expected):
    """Whether dithers (n, 2) agree with expected ones, and by how much they do not, rms."""
    left = np.sqrt(np.mean(np.sum((own - expected) ** 2, axis=1)))
    return left < _PART * np.sqrt(np.mean(np.sum(own**2, axis=1))) + _NEAR, left


def _is_alike(detectors, moves, first, key):
    seen, own = _dithers(detectors, moves, first, key)
    return bool(len(own)) and bool(_left(own, seen @ detectors[key].layout[:, :2].T)[0])


def _linear_parts(detectors, moves, first, key):
    """Linear parts (2, 2) of a layout by which the dithers of both detectors agree, without a flip and with one."""
    seen, own = _dithers(detectors, moves, first, key)
    if not len(own) or np.sqrt(np.mean(np.sum(own**2, axis=1))) < 4 * _NEAR:
        return []
    z, w, out = seen @ [1, 1j], own @ [1, 1j], []
    for parity in (1, -1):
        turn = np.vdot(z if parity > 0 else z.conj(), w) / np.vdot(z, z).real
        linear = np.array([[turn.real, -turn.imag * parity], [turn.imag, turn.real * parity]])
        agree, left = _left(own, seen @ linear.T)
        out += [(left, linear)] if agree else []
    return [linear for _, linear in sorted(out, key=lambda each: each[0])]


def _turned(detector, linear, pivot):
    """The detector with the linear part of its layout about a pixel, and in words what it was before."""
    found = linear @ np.linalg.inv(detector.layout[:, :2])
    found = similarity.describe(np.column_stack([found, np.zeros(2)]))
    angle, scale, parity = found["rotation"], found["scale"], found["parity"]
    angle = np.radians(90 * round(angle / 90) if abs(angle - 90 * round(angle / 90)) < ANGLE_SAME else angle)
    scale = 1.0 if abs(scale - 1) < SCALE_SAME else scale
    cos, sin = np.cos(angle), np.sin(angle)
    step = scale * np.array([[cos, -sin * parity], [sin, cos * parity]])
    layout = similarity.compose(np.column_stack([step, pivot - step @ pivot]), detector.layout)
    own = similarity.describe(similarity.compose(similarity.invert(layout), detector.layout))
    words = orientation_in_words(own["rotation"], round(1 / own["scale"], 6), mirrored=own["parity"] < 0)
    return replace(detector, layout=layout), words
