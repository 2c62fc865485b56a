"""Fields: groups of exposures without a common star, which lie side by side on the reference plane."""

from collections import Counter
from dataclasses import replace

import numpy as np
from astropy import units as u
from astropy.table import vstack

from ..exceptions import AssumptionWarning, InputError, MatchError, some_of, warn
from ..geometry import similarity
from ..inputs import column_contract, exposure_names, start_poses
from ..inputs.plain_columns import is_text

_BY_NAME = {"shape": "shapes", "poses": "poses", "left_out": "left_out"}


def in_words(groups):
    """Groups of exposures, as lists of their names, in a sentence."""
    return "; ".join(some_of(group, 6) for group in groups[:6]) + f"; and {len(groups) - 6} more" * (len(groups) > 6)


def apart(groups, cure):
    """The `MatchError` for groups of exposures without a common star, lists of their names; with what to do."""
    words = f"the exposures form {len(groups)} groups with no star in common: {in_words(groups)}; {cure}"
    return MatchError(words, groups=groups)


def estimated(seen):
    """Poses by the positions of `Observations` alone, those of every field by itself, ``{exposure: (2, 3)}``."""
    poses = {}
    for number in range(seen.fields.max() + 1):
        mine = seen.fields == number
        rows, names = mine[seen.exposure], np.array(seen.names)[mine].tolist()
        exposure, star = (np.unique(each[rows], return_inverse=True)[1] for each in (seen.exposure, seen.star))
        found = start_poses.estimate_poses(exposure, star, seen.xy[rows], names=names)
        poses |= dict(zip(names, found, strict=True))
    return {name: poses[name] for name in seen.names}


def side_by_side(seen, poses, shapes, sky):
    """Poses with fields that overlap on the reference plane moved apart.

    Raises
    ------
    MatchError
        Where the plane is one of the sky.
    """
    names = list(seen.names)
    moves = start_poses.moves_apart([poses[name] for name in names], [shapes[name] for name in names], seen.fields)
    if not moves.any():
        return poses
    if sky is not None:
        raise MatchError(
            f"exposures overlap on the sky and have no star in common: {in_words(seen.groups)}; match them anew, or "
            "solve each group by itself"
        )
    shifts = [np.column_stack([np.eye(2), -move]) for move in moves[seen.fields]]
    return {name: similarity.compose(poses[name], shift) for name, shift in zip(names, shifts, strict=True)}


def joined(parts):
    """The table of several `Matches`, ``{name of the field: Matches}``, and the other words of `Matches.from_table`.

    The name of the field stands in front of names of exposures, or of stars, if several fields have some of them.

    Raises
    ------
    InputError
        For different cameras or errors of poses.
    """
    for label in parts:
        exposure_names.check_exposure_name(label)
    # headers of every field may have the detectors a little elsewhere
    parts = {label: replace(part, camera=part.camera.with_headers([])) for label, part in parts.items()}
    metas = [part.to_meta() for part in parts.values()]
    same = {key: all(meta[key] == metas[0][key] for meta in metas) for key in ("camera", "pose_sigma", "sky")}
    for key, cure in (("camera", "match them with the same one"), ("pose_sigma", "state the same, or none")):
        if not same[key]:
            raise InputError(f"fields {', '.join(parts)} differ in {key}: {cure}")
    names = Counter(name for part in parts.values() for name in (*part.names, *part.left_out))
    stars = Counter(str(star) for part in parts.values() for star in part.stars)
    again = max(names.values()) > 1, max(stars.values()) > 1 or len({p.stars.dtype.kind for p in parts.values()}) > 1
    tables, known = [], {key: {} for key in _BY_NAME}
    for label, part in parts.items():
        new = {name: f"{label}_{name}" if again[0] else name for name in (*part.names, *part.left_out)}
        table = part.table.copy(copy_data=False)
        table["exposure"] = [new[name] for name in table["exposure"]]
        if again[1]:
            table["star"] = [f"{label}_{star}" for star in table["star"]]
        tables.append(table)
        for key, attribute in _BY_NAME.items():
            known[key] |= {new[name]: value for name, value in getattr(part, attribute).items()}
    first = next(iter(parts.values()))
    known |= {"pose_sigma": first.pose_sigma, "sky": first.sky if same["sky"] else None}
    known |= {"camera": first.camera if first.camera.is_known else None}
    known["pointing"] = first.pointing if same["sky"] else None
    known["header_distortion"] = next((p.header_distortion for p in parts.values() if p.header_distortion), None)
    return stacked(dict(zip(parts, tables, strict=True))), known


def stacked(tables):
    """One table of several, ``{what it is of: table}``, with the columns that all have; warns of others.

    A column without a unit, as files have it of a number without one, is in that of the others.

    Raises
    ------
    InputError
        For a column that has numbers in one table and text in another, or units that cannot be converted.
    """
    lost = {}
    for name in dict.fromkeys(name for table in tables.values() for name in table.colnames):
        lacking = [label for label, table in tables.items() if name not in table.colnames]
        if lacking:
            lost.setdefault(tuple(lacking), []).append(name)
    if lost:
        named = "; ".join(f"{', '.join(names)} (not in {some_of(lacking, 3)})" for lacking, names in lost.items())
        warn(f"columns that not all tables have are left out: {named}; add them there to keep them", AssumptionWarning)
    return vstack(_alike(tables), join_type="inner", metadata_conflicts="silent")


def _alike(tables):
    """The tables, ``{what it is of: table}``, with columns that all have of one kind: numbers in a unit, or none."""
    parts = {label: table.copy(copy_data=False) for label, table in tables.items()}
    for name in set.intersection(*(set(part.colnames) for part in parts.values())):
        texts = {label: is_text(part[name]) for label, part in parts.items()}
        units = {label: part[name].unit for label, part in parts.items() if isinstance(part[name], u.Quantity)}
        if len(set(texts.values())) > 1:
            text, numbers = (next(label for label, each in texts.items() if each is kind) for kind in (True, False))
            raise InputError(
                f"column {name!r} has text in {text} and numbers in {numbers}: make them alike, or leave it out of one"
            )
        for label, unit in units.items():
            first, known = next(iter(units.items()))
            if not unit.is_equivalent(known):
                raise InputError(
                    f"column {name!r} is in {known or 'no unit'} in {first} and in {unit or 'no unit'} in {label}: "
                    "state the same unit, or leave it out of one"
                )
        for label in set(parts) - set(units) if units else ():
            part = parts[label]
            part[name] = u.Quantity(column_contract.values(part, name), next(iter(units.values())))
    return list(parts.values())
