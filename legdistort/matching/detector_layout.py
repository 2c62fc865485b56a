"""How the detectors of a camera lie, from the dithers alone: where neither a camera nor headers state it.

Every detector of every exposure is first matched as an exposure of its own. Stars that cross from one detector to
another put all of them on one plane, and two detectors of one exposure then lie there as they do in the camera.
"""

from dataclasses import replace

import numpy as np

from ..cameras.camera import Camera
from ..cameras.detector import Detector
from ..exceptions import InputError, MatchError
from ..geometry import basis, similarity
from ..inputs.exposure_names import detector_name
from .matches import Matches


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
        _tell_apart([{part_of[name][1] for name in group} for group in error.groups])
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
    """Raise `MatchError` if groups of exposures are those of different detectors."""
    groups = sorted(sorted(set(group)) for group in groups)
    for k, group in enumerate(groups):
        for other in groups[k + 1 :]:
            if not set(group) & set(other):
                listed = " | ".join(", ".join(each) for each in groups)
                raise MatchError(
                    f"how detectors {group[0]} and {other[0]} lie to each other is not known: no star was found on "
                    f"both (detectors that share stars: {listed}), and neither a camera nor headers state it; dither "
                    "over the gap, or give the camera"
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
