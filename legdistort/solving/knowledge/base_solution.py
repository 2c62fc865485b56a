"""A finished solution that further exposures come into."""

from dataclasses import fields, replace
from functools import wraps
from pathlib import Path

import numpy as np

from ...exceptions import InputError
from ...geometry import basis
from ...inputs.repetitions import fingerprints
from ...matching.further_exposures import with_further
from ...matching.matches import Matches
from ...priors.prior import Prior
from ...results.settings import Settings
from ...results.solution import Solution
from ...runtime.provenance import now
from ...runtime.words import UNSTATED

#: Settings that are no arguments of `legdistort.solve`, or none that are kept in full.
_NOT_KEPT = {"prior", "model", "method", "gauge"}


def with_base(solve):
    """`legdistort.solve` with its argument `base`: what it solves then is all, with the options of the base."""

    @wraps(solve)
    def extended(matches, *, base=None, **given):
        if base is None or not isinstance(matches, Matches):  # which is refused there
            return solve(matches, **given)
        before = _opened(base)
        _check(before, given)
        whole = with_further(before, matches)
        asked = {name: value for name, value in given.items() if name not in _NOT_KEPT or value is not None}
        solution = solve(whole, **_options(before) | asked)
        return replace(solution, provenance=solution.provenance | _log(before, matches))

    return extended


def _opened(base):
    if isinstance(base, Solution):
        return base
    if isinstance(base, (str, Path)):
        return Solution.read(base)
    raise InputError(f"base must be a Solution, its file or its folder, got {type(base).__name__}")


def _check(base, given):
    """Raise `InputError` for a base that is not kept as it was asked for, with what to give again, or instead."""
    settings = base.settings
    if base.gauge.plane is not None:
        raise InputError(f"the base is a simpler correction ({base.gauge.kind}): give a solution of legdistort.solve")
    for name, why in (
        ("dynamic", "dynamic='detector' makes exposures of its detectors"),
        ("validate", "the stars that it kept out of the fit (validate) are not in it"),
        ("pose_sigma", "the poses that were given with their errors (pose_sigma) are not in it"),
    ):
        if getattr(settings, name) not in (None, "focal_plane"):
            raise InputError(f"nothing can be added to the base, {why}: solve all exposures together")
    internal = (settings.prior or {}).get("source") == f"camera {base.camera.name}"
    needed = {
        "prior": settings.prior is not None and not internal and settings.model is None and _widths(settings) is None,
        "model": settings.model is not None,
        "reference": base.diagnostics.reference is not None,
    }
    if missing := [name for name in needed if needed[name] and given.get(name) is None]:
        words = ", ".join(f"{name}=" + f" (--{name})" * (name != "model") for name in missing)
        raise InputError(
            f"the base was solved with a {' and a '.join(missing)}, of which it keeps a description alone: give "
            f"{'it' if len(missing) == 1 else 'both'} again, {words}"
        )


def _options(base):
    """The arguments of `solve` that the base was made with."""
    left = _NOT_KEPT | {"degree"} if base.settings.model is not None else _NOT_KEPT  # which a model has
    kept = {each.name: getattr(base.settings, each.name) for each in fields(Settings) if each.name not in left}
    return kept | {"prior": _widths(base.settings)}


def _widths(settings):
    """The prior of settings that states widths alone, of which the description is all; None for another one, or none.

    That is the size of a static distortion, or how far exposures scatter about one of which nothing is stated.
    """
    known = settings.prior or {}
    if known.get("degree", 0) is not None and known.get("source") != UNSTATED:  # by exposure or by detector is none
        return None
    mean = None if known["degree"] is None else np.zeros((2, basis.n_modes(known["degree"])))
    return Prior(mean, sigma=known["sigma"], static_sigma=known["static_sigma"], source=known["source"])


def _log(base, matches):
    """What files went into the base, and a line for every time that exposures came in."""
    came = {"created": f"{now()}+00:00", "base": base.checksum, "exposures": fingerprints(matches.table)}
    known = base.provenance
    return {"inputs": known.get("inputs", {}), "added": [*known.get("added", []), came]}
