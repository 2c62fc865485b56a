"""The column contract of every table that enters or leaves, checked in one place."""

from itertools import combinations

import numpy as np
from astropy import units as u
from astropy.table import Column, QTable, Table

from ..exceptions import InputError
from ..geometry.epochs import night_labels, nights, years
from ..runtime import checks
from .plain_columns import is_text, numbers, text

#: Columns of a table of matched positions: name -> (unit, required)
MATCHED = {
    "exposure": (None, True),
    "star": (None, True),
    "x": (u.pix, True),
    "y": (u.pix, True),
    "x_err": (u.pix, True),
    "y_err": (u.pix, True),
    "xy_corr": (None, False),
    "detector": (None, False),
    "flux": (None, False),
    "mag": (None, False),
    "epoch": (u.yr, False),
    "block": (None, False),
}

#: Columns of a table of detections.
DETECTED = {
    "exposure": (None, True),
    "x": (u.pix, True),
    "y": (u.pix, True),
    "x_err": (u.pix, True),
    "y_err": (u.pix, True),
    "xy_corr": (None, False),
    "flux": (None, False),
    "flux_err": (None, False),
    "mag": (None, False),
    "fwhm": (u.pix, False),
    "flags": (None, False),
    "crowding": (None, False),
}

#: The same of any exposure, and of positions alone.
MEASURED = DETECTED | {"exposure": (None, False)}
LISTED = {name: (unit, name in ("x", "y")) for name, (unit, _) in DETECTED.items()}

#: Beyond these, either way, a magnitude stands for none.
_NO_MAGNITUDE = 90

#: Columns of a table of stars: name -> (UCD of the Virtual Observatory, meaning). Names of sky columns are Gaia's.
STARS = {
    "star": ("meta.id;meta.main", "name or number of the star"),
    "x": ("pos.cartesian.x", "distortion-free position in the reference plane, pixels from 0"),
    "y": ("pos.cartesian.y", "distortion-free position in the reference plane, pixels from 0"),
    "x_err": ("stat.error;pos.cartesian.x", "standard deviation after a common map is taken off"),
    "y_err": ("stat.error;pos.cartesian.y", "standard deviation after a common map is taken off"),
    "x_err_abs": ("stat.error;pos.cartesian.x", "standard deviation with the common map, apart from the pointing"),
    "y_err_abs": ("stat.error;pos.cartesian.y", "standard deviation with the common map, apart from the pointing"),
    "x_err_known": ("stat.error;pos.cartesian.x", "x_err_abs after the unknown directions are taken off"),
    "y_err_known": ("stat.error;pos.cartesian.y", "y_err_abs after the unknown directions are taken off"),
    "xy_corr": ("stat.correlation;pos.cartesian", "correlation of x_err and y_err"),
    "n": ("meta.number;obs", "observations used"),
    "field": ("meta.code", "number of the field, from 1, of exposures that have common stars"),
    "group": ("meta.code", "which detectors saw it, of those that nothing ties to others; errors hold within"),
    "reference_used": ("meta.code", "whether the position in the reference catalogue counts among what is known of it"),
    "flux": ("phot.flux;stat.mean", "mean over the exposures as they are, whatever their depths"),
    "ra": ("pos.eq.ra;meta.main", "right ascension, ICRS"),
    "dec": ("pos.eq.dec;meta.main", "declination, ICRS"),
    "ra_error": ("stat.error;pos.eq.ra", "standard deviation of ra times cos(dec), after a common map is taken off"),
    "dec_error": ("stat.error;pos.eq.dec", "standard deviation of dec, after a common map is taken off"),
    "ra_dec_corr": ("stat.correlation;pos.eq", "correlation of ra_error and dec_error"),
    "ra_error_abs": ("stat.error;pos.eq.ra", "the same with the common map, apart from the pointing"),
    "dec_error_abs": ("stat.error;pos.eq.dec", "the same with the common map, apart from the pointing"),
}

_FLUX_AT_MEAN_DEPTH = "mean over the exposures, each scaled to their mean depth by the fluxes of common stars"

#: Names that a column of colours of stars may have.
COLOURS = "colour", "color", "bp_rp", "colour_index"

#: The same where the motions of stars were fitted.
MOTIONS = {
    "vx": ("pos.cartesian.x;pos.pm", "proper motion along x of the reference plane"),
    "vy": ("pos.cartesian.y;pos.pm", "proper motion along y of the reference plane"),
    "vx_err": ("stat.error;pos.pm", "standard deviation after a common map is taken off"),
    "vy_err": ("stat.error;pos.pm", "standard deviation after a common map is taken off"),
    "vx_err_abs": ("stat.error;pos.pm", "the same with the common map, common rates aside"),
    "vy_err_abs": ("stat.error;pos.pm", "the same with the common map, common rates aside"),
    "vx_vy_corr": ("stat.correlation;pos.pm", "correlation of vx_err and vy_err"),
    "pmra": ("pos.pm;pos.eq.ra", "proper motion in ra times cos(dec)"),
    "pmdec": ("pos.pm;pos.eq.dec", "proper motion in dec"),
    "pmra_error": ("stat.error;pos.pm;pos.eq.ra", "standard deviation after a common map is taken off"),
    "pmdec_error": ("stat.error;pos.pm;pos.eq.dec", "standard deviation after a common map is taken off"),
    "pmra_error_abs": ("stat.error;pos.pm;pos.eq.ra", "the same with the common map, common rates aside"),
    "pmdec_error_abs": ("stat.error;pos.pm;pos.eq.dec", "the same with the common map, common rates aside"),
    "pmra_pmdec_corr": ("stat.correlation;pos.pm", "correlation of pmra_error and pmdec_error"),
    "parallax": ("pos.parallax", "parallax, up to a common value"),
    "parallax_error": ("stat.error;pos.parallax", "standard deviation after a common map is taken off"),
    "parallax_error_abs": ("stat.error;pos.parallax", "the same with the common map, the mean parallax aside"),
    "chi2": ("stat.fit.chi2", "of the observations used"),
    "n_epochs": ("meta.number;time.epoch", "epochs of the observations used, exposures within a day as one"),
    "span": ("time.interval", "between the first and the last of them"),
}


#: In this order the names of two columns make that of their correlation, as in the Gaia catalogue.
_ORDER = ("x", "y", "ra", "dec", "parallax", "vx", "vy", "pmra", "pmdec")


def correlation(first, second):
    """Name of the column with the correlation of two others: ``ra_pmra_corr``, ``x_vx_corr`` and so on."""
    first, second = sorted((first, second), key=_ORDER.index)
    return "xy_corr" if (first, second) == ("x", "y") else f"{first}_{second}_corr"


#: The correlations of positions with motions and parallaxes, and of these.
CORRELATIONS = {
    correlation(*pair): ("stat.correlation", f"correlation of the relative errors of {pair[0]} and {pair[1]}")
    for names in (("x", "y", "vx", "vy", "parallax"), ("ra", "dec", "pmra", "pmdec", "parallax"))
    for pair in combinations(names, 2)
}


def describe_stars(table, one_scale=False):
    """Give the columns of a table of stars their UCDs and meanings (`STARS`, `MOTIONS`); returns the table.

    With `one_scale` fluxes of the exposures were brought to one scale.
    """
    known = CORRELATIONS | STARS | MOTIONS
    for name in table.colnames:
        if name in known:
            ucd, table[name].info.description = known[name]
            table[name].info.meta = {"ucd": ucd}
    if one_scale:
        table["flux"].info.description = _FLUX_AT_MEAN_DEPTH
    return table


def colour_column(table):
    """Name of the column of a table that holds colours of stars; None without one."""
    for name in COLOURS:
        if name in table.colnames and np.issubdtype(table[name].dtype, np.number):
            return name
    return None


def values(table, column, unit=None):
    """A column as a plain float array in `unit`; columns without a unit are taken as they are.

    Raises
    ------
    InputError
        If the column's unit cannot be converted.
    """
    data = table[column]
    if data.ndim != 1:
        raise InputError(f"column {column!r} must hold one number a row, it has shape {data.shape}")
    if is_text(data):
        data = _stated(data, column, unit)
    try:
        if np.ma.isMaskedArray(data) and np.ma.is_masked(data):
            data = data.astype(float).filled(np.nan)
        if getattr(data, "unit", None) is not None and unit is not None:
            data = u.Quantity(data).to_value(unit)
        return np.array(data, dtype=float)
    except (u.UnitConversionError, TypeError, ValueError) as error:
        raise InputError(f"column {column!r} cannot be read as numbers in {unit or 'no unit'}: {error}") from None


def _stated(data, column, unit):
    """The numbers that a column of text states, with its unit."""
    found, bad = numbers(data)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"column {column!r} cannot be read as numbers in {unit or 'no unit'}: row {row} has "
            f"{str(text(data)[row])!r}, the first of {np.count_nonzero(bad)} of {len(bad)} that are none; correct "
            "them or leave these rows out"
        )
    return found if getattr(data, "unit", None) is None else u.Quantity(found, data.unit)


def covariance(table):
    """Covariance (n, 2, 2) [px^2] of the positions of a table that keeps a contract; without ``xy_corr`` diagonal."""
    x_err, y_err = (table[name].to_value(u.pix) for name in ("x_err", "y_err"))
    both = (np.asarray(table["xy_corr"]) if "xy_corr" in table.colnames else 0.0) * x_err * y_err
    return np.moveaxis(np.array([[x_err**2, both], [both, y_err**2]]), 2, 0)


def set_covariance(table, blocks):
    """Give a table ``x_err``, ``y_err`` and ``xy_corr`` of positions with these covariances (n, 2, 2) [px^2]."""
    table["x_err"], table["y_err"] = np.sqrt(np.einsum("nkk->kn", blocks)) * u.pix
    table["xy_corr"] = blocks[:, 0, 1] / np.sqrt(blocks[:, 0, 0] * blocks[:, 1, 1])


def labels(table, column):
    """A column of names (str) or serials (int) as a plain array."""
    data = table[column]
    if data.ndim != 1:
        raise InputError(f"column {column!r} must hold one name a row, it has shape {data.shape}")
    missing = np.ma.getmaskarray(data) if np.ma.isMaskedArray(data) else np.zeros(len(table), bool)
    if data.dtype.kind in "SUO":
        data = text(data)
        missing = missing | (data == "")
    if missing.any():
        raise InputError(
            f"column {column!r} has no value in {np.count_nonzero(missing)} of {len(missing)} rows, the first is row "
            f"{int(np.argmax(missing))}; fill them or leave these rows out"
        )
    data = np.asarray(data)
    if data.dtype.kind not in "iuU":
        raise InputError(f"column {column!r} must hold names or integers, got {data.dtype}; write them as text")
    return data


def blocks(table, first):
    """Night, or other block, of exposures whose first rows are given: integers (n_exposures,).

    By the column ``block``, else by gaps of more than half a day in ``epoch``, else one.
    """
    if "block" in table.colnames:
        return np.unique(np.asarray(table["block"])[first], return_inverse=True)[1]
    return nights(values(table, "epoch", u.yr)[first]) if "epoch" in table.colnames else np.zeros(len(first), dtype=int)


def nights_of(table, first):
    """Number of the night (n_exposures,), label of every night (n_nights,), and year (n_exposures,), NaN if unknown.

    Labels are those of the column ``block``, else dates, else names of first exposures.
    """
    number, of = blocks(table, first), np.full(len(first), np.nan)
    if "epoch" in table.colnames:
        of = values(table, "epoch", u.yr)[first]
    if "block" in table.colnames:
        return number, [str(label) for label in np.unique(np.asarray(table["block"])[first])], of
    return number, night_labels(of, number, labels(table, "exposure")[first]), of


def rename(table, columns):
    """Copy of a table with columns renamed to the contract's names.

    Parameters
    ----------
    table : `~astropy.table.Table` or anything that it takes
    columns : dict
        ``{contract name: name in the table}``, for example ``{"star": "name", "x_err": "xe"}``.

    Raises
    ------
    InputError
        Naming the column that is not there.
    """
    table = as_table(table, "the table")
    if not isinstance(columns, dict):
        raise InputError(f"columns must be a dict {{name expected: name in the table}}, got {columns!r}")
    for wanted, present in columns.items():
        if present not in table.colnames:
            raise InputError(f"no column {present!r} to use as {wanted!r}; the table has {', '.join(table.colnames)}")
    out = Table(meta=table.meta)
    for name in table.colnames:
        targets = [wanted for wanted, present in columns.items() if present == name]  # one column may serve twice
        for target in targets or ([] if name in columns else [name]):
            out[target] = table[name]
    return out


#: What values must be, and the words if they are not, by column.
_RULES = (
    (("x", "y"), np.isfinite, "not finite", "; correct these rows or leave them out"),
    (
        ("x_err", "y_err"),
        lambda values: np.isfinite(values) & (values > 0),
        "not a positive finite number",
        "; errors are standard deviations in pixels: leave out rows without one, or give them one (--error PIXELS)",
    ),
    (("x", "y"), lambda values: np.abs(values) < checks.LARGEST, "beyond 1e30", "; these are no pixels"),
    (
        ("x_err", "y_err"),
        lambda values: (values > 1 / checks.LARGEST) & (values < checks.LARGEST),
        "not between 1e-30 and 1e30",
        "; errors are standard deviations in pixels",
    ),
    (("xy_corr",), lambda values: np.abs(values) < 1, "not inside (-1, 1)", "; correct it or leave the column out"),
)


#: Description of a column `exposure` that the file of a table does not have.
OF_FILE = "name of the file"
_UNMATCHED = "find out first which positions are of the same star: match(table) (legdistort match); "
#: What to do without errors of positions, and what `legdistort.solve` does then.
GIVE_ERRORS = "; where a list has no errors, give one for all, read_table(error=...) or --error PIXELS"
_FOUND = ", and let solve find them with errors='by-brightness'"


def _check_values(table, what):
    for names, allowed, fault, advice in _RULES:
        for name in filter(table.colnames.__contains__, names):
            bad = ~allowed(np.asarray(table[name]))
            if bad.any():
                row = int(np.argmax(bad))
                where = ", ".join(f"{k} {table[k][row]}" for k in ("exposure", "star") if k in table.colnames)
                raise InputError(
                    f"{what}: {name} is {fault} in {np.count_nonzero(bad)} of {len(bad)} rows; the first is row {row} "
                    f"({where}){advice}"
                )


def as_table(table, what):
    """A `~astropy.table.Table` that shares the columns of whatever one can be made of.

    Raises
    ------
    InputError
        If none can be made of it; `what` is how the message calls it.
    """
    try:
        made = Table(table, copy=False)
        len(made)
    except Exception as error:  # astropy and numpy raise what they like
        raise InputError(f"{what} must be a table, got {type(table).__name__} ({checks.first_line(error)})") from None
    return made


def check(table, contract, what, without_errors=GIVE_ERRORS + _FOUND):
    """Check a table against a column contract and return it as a `~astropy.table.QTable`.

    Columns beyond the contract are kept; of magnitudes fluxes are made where there are none. Positions must be finite,
    errors positive and finite, correlations inside (-1, 1).

    Parameters
    ----------
    table : `~astropy.table.Table`
    contract : dict
        `MATCHED` or `DETECTED`.
    what : str
        How messages call the table.
    without_errors : str
        What they advise where there are no errors of positions.

    Raises
    ------
    InputError
        Naming the column and the first row at fault.
    """
    table = as_table(table, what)
    missing = [name for name, (_, required) in contract.items() if required and name not in table.colnames]
    if missing and table.colnames:
        present = [name for name in table.colnames if table[name].info.description != OF_FILE]
        raise InputError(
            f"{what} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            + _UNMATCHED * ("star" in missing)
            + f"it has {', '.join(present)} (map names: columns={{'{missing[0]}': ...}} or --columns {missing[0]}=..."
            + without_errors * bool({"x_err", "y_err"} & set(missing))
            + ")"
        )
    if len(table) == 0:
        needed = f" the columns {', '.join(missing)} and" if missing else ""
        raise InputError(f"{what} is empty: give one with{needed} a row for each position")
    table, out = _in_fluxes(table, contract), QTable()
    for name in table.colnames:
        try:
            out.add_column(_kept(table, name, contract), name=name, copy=False)
        except InputError as error:
            raise InputError(f"{what}: {error}") from None
    if "mag" in contract and "mag" in out.colnames and "flux" not in out.colnames:
        out["flux"] = flux_of(out["mag"])
    _check_values(out, what)
    return out


def fluxes(table):
    """Fluxes of the rows of a table (n,), NaN where there is none, by its column ``flux`` or ``mag``; None without."""
    if "flux" in table.colnames:
        return values(_in_fluxes(table, DETECTED), "flux")
    return flux_of(values(table, "mag")) if "mag" in table.colnames else None


def _in_fluxes(table, contract):
    """The table with fluxes where its column ``flux`` holds magnitudes, by its unit, and their errors likewise."""
    if "flux" not in contract or "flux" not in table.colnames:
        return table
    unit = getattr(table["flux"], "unit", None)
    if not (unit == u.mag or isinstance(unit, u.MagUnit)):
        return table
    table = table.copy(copy_data=False)
    magnitudes = np.ma.filled(np.ma.asarray(getattr(table["flux"], "value", table["flux"]), dtype=float), np.nan)
    flux = flux_of(magnitudes)
    if "flux_err" in table.colnames:
        error = np.asarray(getattr(table["flux_err"], "value", table["flux_err"]), dtype=float)
        table["flux_err"] = flux * 0.4 * np.log(10) * error
    table["flux"] = flux
    return table


def _kept(table, name, contract):
    """A column as a table that keeps the contract has it."""
    if name in ("exposure", "star", "detector", "block"):
        return labels(table, name).copy()
    if name not in contract:
        column = table[name]
        return Column(text(column)) if is_text(column) and getattr(column, "unit", None) is not None else column.copy()
    if name == "epoch":
        column = table[name]
        return years(column if not is_text(column) else Column(values(table, name), unit=column.unit))
    column, unit = values(table, name, contract[name][0]), contract[name][0]  # `values` makes a copy
    return column if unit is None else u.Quantity(column, unit, copy=False)


def flux_of(magnitudes):
    """Fluxes on an arbitrary scale; NaN for what is no magnitude (NaN, or the 99.999 and -99.999 of many programs)."""
    magnitudes = np.asarray(magnitudes, dtype=float)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.where(np.abs(magnitudes) < _NO_MAGNITUDE, 10 ** (-0.4 * magnitudes), np.nan)
