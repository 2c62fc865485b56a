"""Tables of a report, as plain texts that the template puts into a page."""

from dataclasses import dataclass

import numpy as np

from ..assessment.pulls import exposure_rms
from ..exceptions import some_of
from ..geometry import similarity
from ..measurement.flags import TRAILED
from ..results.accuracy import sizes
from ..results.errors import pose_errors

#: An exposure whose residuals exceed the median by this factor is marked.
_MARK = 2.0
#: Different values of what frames state that are listed.
_MOST_VALUES = 4
#: Columns on the stars of an exposure: width, longer over shorter axis, direction of the longer one from x to y.
_SHAPE = {"FWHM of stars": "px", "length / width": "", "at": "deg"}
#: Stars that are listed, the brightest; all of them are in the file.
MOST_STARS = 500


@dataclass(frozen=True)
class Row:
    """A row: its texts, the columns that are marked, and the index of its star or exposure.

    Attributes
    ----------
    cells : list of str
    high : tuple of int
    star, exposure : int or None
    """

    cells: list
    high: tuple = ()
    star: int | None = None
    exposure: int | None = None


@dataclass(frozen=True)
class Table:
    """A table of figures.

    Attributes
    ----------
    head : dict
        ``{column: unit}``, "" for none.
    rows : list of Row
    note : str
    """

    head: dict
    rows: list
    note: str = ""


def count(n, what):
    """A number with its noun."""
    return f"{n} {what}{'' if n == 1 else 's'}"


def exposures_table(solution, shapes=None):
    """One row an exposure: pose, number of stars, residuals, size of the distortion, shape of its stars.

    `shapes` are ``{name: (FWHM [pix], ellipticity, angle [deg])}``, as far as stars of exposures were measured.
    """
    dx, dy, n = exposure_rms(solution)
    distortion, dynamic = sizes(solution)
    head = {
        "exposure": "",
        "shift x": "px",
        "shift y": "px",
        "rotation": "deg",
        "scale": "",
        "stars": "",
        "rms x": "px",
        "rms y": "px",
        "distortion": "rms, px",
        "dynamic part": "rms, px",
    } | (_SHAPE if shapes else {})
    rows, numbers = [], pose_errors.pose_numbers(solution)
    for i, name in enumerate(solution.names):
        pose = {key: _known(numbers[i], key) for key in pose_errors.POSE}
        pose["rotation"] += ", mirrored" * (similarity.describe(solution.poses[name])["parity"] < 0)
        cells = [
            name,
            *pose.values(),
            f"{n[i]}",
            *(_number(rms[i]) for rms in (dx, dy)),
            f"{distortion[i]:.3f}",
            f"{dynamic[i]:.3f}",
        ]
        high = tuple(k for k, rms in ((6, dx), (7, dy)) if np.isfinite(rms[i]) and rms[i] > _MARK * np.nanmedian(rms))
        if shapes:
            fwhm, ellipticity, angle = shapes.get(name, (np.nan,) * 3)
            ratio = 1 / max(1 - ellipticity, 1e-3)
            cells += [_number(fwhm, 2), _number(ratio, 2), _number(angle, 0)]
            high += (len(cells) - 2,) if ratio > TRAILED else ()
        rows.append(Row(cells, high, exposure=i))
    reference = "static distortion" if np.any(solution.estimate.prior_mean) else "median of the exposures"
    return Table(
        head,
        rows,
        f"Shift, rotation and scale lead from the reference plane to the detector{_how_known(numbers)}. Distortion: "
        "length of the displacement over the detector, less its mean; dynamic part: the same of the departure from the "
        f"{reference}. Residuals above {_MARK:g} times the median are marked"
        + (f", and stars longer than {TRAILED:g} times their width: they are trailed." if shapes else "."),
    )


def nights_table(solution):
    """One row a night, the worst first, as `Solution.nights` has it; None of a single one."""
    nights = solution.nights
    if len(nights) < 2:
        return None
    head = {"night": "", "exposures": "", "stars": "", "rms": "px", "rms over errors": ""}
    head |= {"departure": "rms length, px", "over scatter": "", "chi2": "", "dof": "", "p": "", "which": ""}
    rows = []
    for row in nights:
        departing = [f"{row['departure'].value:.4f}", f"{row['ratio']:.2f}", f"{row['chi2']:.1f}", f"{row['dof']:.0f}"]
        departing = [*departing, f"{row['p']:.2g}"] if row["dof"] else ["–"] * 5
        cells = [row["name"], f"{row['n_exposures']}", f"{row['n_stars']}", _number(row["rms"].value)]
        rows.append(
            Row(
                [*cells, _number(row["rms_ratio"], 3), *departing, some_of(row["exposures"].split(", "), 6)],
                (0, 5, 6) if row["odd"] else (),
            )
        )
    return Table(
        head,
        rows,
        "The worst first. Departure: length, both axes together, of what the exposures of a night have in common, from "
        "the static distortion of all other nights; over the scatter of these and all errors; p is the probability of "
        "so much by chance. Nights that depart farther than the others do are marked, and the rest is compared without "
        "them.",
    )


def stated_table(stated):
    """What frames state (`legdistort.inputs.frames.statement.stated_rows`): one row a quantity, value and source."""
    rows = []
    for (quantity, source), group in _grouped(stated).items():
        values = list(dict.fromkeys(row["value"] for row in group))
        listed = ", ".join(values) if len(values) <= _MOST_VALUES else f"{min(values)} to {max(values)}"
        names = [name for row in group for name in row["exposures"]]
        rows.append(Row([quantity, listed, source, some_of(names, 3)]))
    return Table({"quantity": "", "value": "", "source": "", "frames": ""}, rows)


def _grouped(stated):
    groups = {}
    for row in stated:
        groups.setdefault((row["quantity"], row["source"]), []).append(row)
    return groups


def stars_table(solution, pulls):
    """One row a star, the brightest first: place, errors, number of observations, residuals."""
    table, sums = solution.stars, pulls.by_star()
    first = np.argsort(-np.nan_to_num(table["flux"]), kind="stable") if "flux" in table.colnames else range(len(table))
    head = {"star": "", "x": "px", "y": "px", "x_err": "px", "y_err": "px", "x_err_abs": "px", "y_err_abs": "px"}
    head |= {name: unit for name, unit in {"ra": "deg", "dec": "deg"}.items() if name in table.colnames}
    columns = {name: (table[name].value, 7 if name in ("ra", "dec") else 4) for name in list(head)[1:]}
    columns |= {"flux": (np.asarray(table["flux"]), 0)} if "flux" in table.colnames else {}
    columns |= {"positions": (table["n"], 0), "residuals": (sums.rms, 2)}
    head |= {name: "" for name in columns if name not in head} | {"residuals": "over expected"}
    rows = [
        Row([str(table["star"][i]), *(_number(v[i], digits) for v, digits in columns.values())], star=int(i))
        for i in list(first)[:MOST_STARS]
    ]
    note = f"The {MOST_STARS} brightest of {len(table)}. " if len(table) > MOST_STARS else ""
    return Table(
        head,
        rows,
        f"{note}Relative errors hold once a map common to all exposures is taken off; absolute ones (abs) include "
        "its error. Residuals: their rms over what their errors and the fit lead to expect.",
    )


def _known(pose, name):
    """A number of a pose with its error, or with what there is of it where that is not determined."""
    error = pose.errors[name]
    if pose.is_lost(name) or not np.isfinite(error):
        return pose.text(name)
    return _with_error(pose.values[name], pose_errors.POSE[name][1], error)


def _how_known(numbers):
    words = pose_errors.in_words(numbers)
    return f" ({words})" if words else ""


def detectors_table(camera, after=""):
    """One row a detector: where it lies, with the errors of that, and the size of its static distortion."""
    head = {"detector": "", "centre x": "px", "centre y": "px", "rotation": "deg", "scale": "", "static": "rms, px"}
    rows, places = [], camera.places
    for key, each in camera.detectors.items():
        place = places[key]
        errors = place.errors or (None, None, None)
        values = (place.x, 3), (place.y, 3), (place.rotation, 5)
        cells = [_with_error(*value, error) for value, error in zip(values, errors, strict=True)]
        rows.append(Row([key, *cells, f"{place.scale:.6f}", f"{each.rms:.3f}"]))
    return Table(
        head,
        rows,
        f"Centres in the focal plane{': ' if after else '.'}{after}{'.' if after else ''}",
    )


def _with_error(value, digits, error):
    """A value and its error with the same decimals, two significant digits of the error; without one so many digits."""
    if error is None:
        return f"{value:.{digits}f}"
    if not np.isfinite(error):
        return f"{value:.{digits}f} ± unknown"
    if error > 0:
        digits = min(max(0, 1 - int(f"{error:.1e}".partition("e")[2])), 9)  # of the error as it is rounded
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _number(value, digits=4):
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"
