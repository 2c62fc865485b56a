"""Which images a solution has maps of, and why others are left out."""

from pathlib import Path

import numpy as np

from ..exceptions import AssumptionWarning, InputError, reasons_of, some_of, warn
from ..inputs.exposure_names import whole_name
from ..results.solution import Solution
from ..results.view import image_view


def check_order(exposures, solution, verb):
    """Raise `InputError` for a solution in the place of exposures, and for anything else in the place of a solution."""
    if isinstance(exposures, Solution):
        raise InputError(f"{verb} takes the exposures first and then the solution: call {verb}(exposures, solution)")
    if not isinstance(solution, Solution):
        kind = type(solution).__name__
        raise InputError(f"{verb} takes a Solution after the exposures, as solve gives it, got {kind}")


def select_images(exposures, solution, verb, product):
    """Exposures that can be used, their views by name, and the reasons why others cannot."""
    one = isinstance(exposures, str | Path) or not np.iterable(exposures)
    exposures = [exposures] if one else list(exposures)
    if not all(hasattr(e, "read") for e in exposures):
        raise InputError(
            "exposures must be images as open_exposures or read_exposures give them, got "
            f"{type(exposures[0]).__name__}; give open_exposures('frames/*.fits')"
        )
    names = [f.name for f in exposures]
    twice = {n for n in names if names.count(n) > 1}
    if twice:
        raise InputError(f"exposures come twice: {', '.join(sorted(twice))}; names must differ")
    frames, views, left_out = [], {}, {}
    for frame in exposures:
        view = image_view(solution, frame)
        if view is None:
            whole = solution.left_out.get(whole_name(frame), "it is not in the solution")
            left_out[frame.name] = solution.left_out.get(frame.name, whole)
        elif frame.shape != tuple(view.shape):
            raise InputError(
                f"exposure {frame.name}: its shape {frame.shape} is not that of the solution, {tuple(view.shape)}; a "
                "trimmed or binned image needs a solution of its own"
            )
        elif view.fold:
            left_out[frame.name] = view.fold
        else:
            frames.append(frame)
            views[frame.name] = view
    if not frames:
        known = f"; the solution has {some_of([v.label for view in solution for v in view.parts], 5)}" * bool(left_out)
        raise InputError(f"no exposure to {verb}: {reasons_of(left_out) or 'the list is empty'}{known}")
    warn_of_left_out(left_out, product)
    return frames, views, left_out


def warn_of_left_out(left_out, product):
    """Warn of images that are not used, ``{name: reason}``."""
    if left_out:
        warn(f"left out of {product}: {reasons_of(left_out)}", AssumptionWarning)
