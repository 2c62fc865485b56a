"""Nights of a camera with several detectors, each by itself and with nothing known of the camera beforehand."""

import logging
import warnings
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from ...exceptions import AssumptionWarning, InputError, LegdistortError, some_of, warn
from ...geometry import basis
from ...matching.matches import Matches
from ...results.nights import blocks
from ...solving.estimation import solve

#: Settings with which a night is solved again as it was asked for, and those that one night of several does not show.
_KEPT = "loss", "clip", "errors", "error_floor", "max_iterations", "terms", "night_sigma", "pixel_scale"
_MOTIONS = "motion", "motion_sigma", "motion_epoch"
_FEWEST = 2  # exposures that tell detectors from stars


def nights_alone(solution, label):
    """Nights of a solution: (name, exposures, solution) of every one, a list.

    One that found layouts and static distortions by its exposures alone is its own. Else every night is solved again as
    it was asked for, but from the camera that was found on, with all of that to find: what was held, or known
    beforehand, counts in no night, and nights have only the camera in common.

    Raises
    ------
    InputError
        For one detector in a focal plane, nights that cannot be solved, or exposures one a night.

    Warns
    -----
    AssumptionWarning
        Naming nights of one exposure, which are left out.
    """
    camera = solution.camera
    if len(camera.detectors) < 2:
        raise InputError(
            f"{label} is of camera {camera.name}, one detector in a focal plane, whose distortions exposures can take "
            "over: solve its exposures as images without a camera"
        )
    number, names, _ = blocks(solution)
    exposures = [[e for e, mine in zip(solution.names, number == n, strict=True) if mine] for n in range(len(names))]
    if len(names) == 1:
        own = solution if _is_own(solution) else _again(solution, label, exposures[0], _MOTIONS)
        return [(label, exposures[0], _settled(own, label, "leave it out"))]
    named = [(f"{name} of {label}", those) for name, those in zip(names, exposures, strict=True)]
    alone = [name for name, those in named if len(those) < _FEWEST]
    if len(alone) == len(named):
        raise InputError(
            f"{label} has {len(named)} nights of one exposure each, which alone do not tell detectors from stars: if "
            "they are one night, give all of them one name of it, a column block of the table of matches, and solve "
            "them again"
        )
    if alone:
        warn(
            f"{some_of(alone, 4)} left out: one exposure alone does not tell detectors from stars; exposures of "
            "another night that are one with it get one name, a column block of the table of matches",
            AssumptionWarning,
        )
    cure = "solve again without its exposures (--without)"
    return [
        (name, those, _settled(_again(solution, name, those, cure=cure), name, cure))
        for name, those in named
        if name not in alone
    ]


@contextmanager
def _of_the_camera_alone():
    """Leave unsaid what is assumed, or not known, of stars: these are not kept."""
    log = logging.getLogger("legdistort.solving.estimation")
    log.addFilter(_is_no_warning)
    try:
        with warnings.catch_warnings(action="ignore", category=AssumptionWarning):
            yield
    finally:
        log.removeFilter(_is_no_warning)


def _is_no_warning(record):
    return record.levelno < logging.WARNING


def _settled(solution, name, cure):
    """The solution of a night, if its errors hold."""
    if solution.estimate.uncertainty.camera.unsettled:
        raise InputError(f"{name} did not settle (check camera), and its errors do not hold: {cure}")
    return solution


def _is_own(solution):
    """Whether all modes of all detectors with positions were found by the exposures alone."""
    errors, camera = solution.estimate.uncertainty.camera, solution.camera
    if errors is None or errors.departure is not None:
        return False
    n, seen = basis.n_modes(solution.degree), np.isin(list(camera.detectors), camera.ids(solution.residuals))
    return bool(errors.free[seen, :, :n].all())


def _again(solution, name, exposures, more=(), *, cure="leave it out"):
    """Some exposures solved by themselves, with all of the camera that nothing is known of; with `more` settings."""
    exact = dict.fromkeys(("layout_sigma", "layout_covariance", "static_sigma", "static_covariance"))
    of_plane = dict.fromkeys(("common_sigma", "common_map", "header_map", "place_errors", "covariance"))
    detectors = {key: replace(each, **exact) for key, each in solution.camera.detectors.items()}
    camera = replace(solution.camera, detectors=detectors, **of_plane)
    table = solution.residuals[np.isin(np.asarray(solution.residuals["exposure"]), exposures)]
    table.remove_columns(["dx", "dy", "used"])
    poses = {each: solution.poses[each] for each in exposures}
    kept = {each: getattr(solution.settings, each) for each in (*_KEPT, *more)}
    try:
        with _of_the_camera_alone():
            matches = Matches.from_table(solution.camera.on_detectors(table), camera=camera, poses=poses)
            return solve(matches, degree=solution.degree, layout="fit", static="fit", **kept)
    except LegdistortError as error:
        raise InputError(f"{name} cannot be solved by itself, as a night that counts must ({error}): {cure}") from None
