"""The stars of a solution as a reference of other exposures: where they lie, and what their errors have in common."""

from dataclasses import replace

import numpy as np
from astropy.table import Table

from ...exceptions import InputError
from ...inputs.references.catalogue import read_reference
from ...results.errors.absolute_errors import map_directions

_MAS = 3.6e6  # of a degree
#: Columns of errors that have what is common to all stars in them, which is a matter of `Reference.maps` here.
_COMMON = ("_abs", "_known")


def known_stars(solution, name):
    """What a `Solution` knows of its stars, as a `legdistort.inputs.references.catalogue.Reference` of this name.

    Relative errors are those of single stars; the error of the common map is common to all, and maps that the solution
    does not determine are unknown.

    Raises
    ------
    InputError
        For a simpler correction, whose plane is not known, or if no star has a position with errors.
    """
    if solution.gauge.plane is not None:
        raise InputError(f"{name} is a simpler correction ({solution.gauge.kind}), whose plane is not known")
    stars = solution.stars
    known = np.isfinite(stars["x_err"]) & np.isfinite(stars["y_err"])
    if not known.any():
        raise InputError(f"{name} knows the position of no star relative to the others")
    kept = [column for column in stars.colnames if not column.endswith(_COMMON) and column not in ("star", "sky")]
    table, xy = Table(stars[kept][known]), solution.estimate.positions
    sizes, vectors = np.linalg.eigh(solution.gauge.absolute_covariance)
    maps = map_directions(solution.gauge, xy)[:, :2] @ (vectors * np.sqrt(np.maximum(sizes, 0)))
    unknown = np.stack([np.zeros_like(xy), *(each.stars for each in solution.gauge.unknown)], axis=2)[:, :, 1:]
    maps, unknown = maps[known], unknown[known]
    if solution.sky is not None:
        turn = _MAS * solution.sky.jacobian(xy[known])
        maps, unknown = turn @ maps, turn @ unknown
    return replace(read_reference(table), label=name, maps=maps, unknown=unknown)
