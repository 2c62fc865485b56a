"""When star lists were taken, by a table that names them: lists themselves seldom state it."""

from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import Column
from astropy.time import Time

from ...exceptions import InputError, some_of
from ...geometry.epochs import exposure_years, read_date, years
from ...runtime.checks import check_is_file
from ..column_contract import values
from ..exposure_names import list_name
from ..plain_columns import is_text, text
from . import formats

#: Names that the two columns may have, in small letters; a table of two columns needs none of them.
_NAMES = "exposure", "name", "list", "file", "filename", "frame"
_DATES = "epoch", "date", "year", "mjd", "jyear", "time", "t", "date-obs", "date_obs", "mjd-obs", "mjd_obs"
_JD = 2400000.5  # of MJD 0
_MOST_NAMED = 6


def read_dates(path):
    """Years of exposures by a table of any kind that is read: ``{name: year}``.

    Parameters
    ----------
    path : str or path
        Of a table with names of lists or of their files, and decimal years, MJD or dates such as 2014-05-12T10:11:12.

    Raises
    ------
    InputError
        Naming the file and the row, or the columns that it has.
    """
    check_is_file(path)
    try:
        table = formats.read(Path(path))[0]
        name, date = _columns(table)
        names, found = [str(each).strip() for each in table[name]], _years(table, date)
        if (first := read_date(date)) is not None:  # texts without names of columns, whose first line is read as these
            names, found = [name, *names], np.append(first.jyear, found)
        twice = [each for each in dict.fromkeys(names) if names.count(each) > 1]
        if twice:
            raise InputError(f"{some_of(twice, _MOST_NAMED)} stand in it more than once: leave one row of each")
        number = np.arange(len(names))
        return dict(zip(names, exposure_years(tuple(names), number, found).tolist(), strict=True))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def with_dates(tables, dates, path):
    """Tables of files with a column ``epoch`` of the years that a table of dates has for them.

    Parameters
    ----------
    tables : dict of Path to Table
        As `legdistort.inputs.table_files.read_table` gives them.
    dates : dict
        ``{name: year}``; a name is that of an exposure, of a file, or of a file with its folder.
    path : str or path
        Of the table of dates, for messages.

    Raises
    ------
    InputError
        Naming exposures that have no date there.
    """
    bare = list(map(list_name, dates))
    by_name = {short: year for short, year in zip(bare, dates.values(), strict=True) if bare.count(short) == 1} | dates
    out, missing = {}, []
    for file, table in tables.items():
        names = table["exposure"].tolist()
        of_file = (str(file), file.name) if len(set(names)) == 1 else ()
        found = {name: _first(by_name, (*of_file[:1], name, *of_file[1:])) for name in dict.fromkeys(names)}
        missing += [name for name, year in found.items() if year is None]
        out[file] = table.copy(copy_data=False)
        out[file]["epoch"] = np.array([found[name] for name in names], dtype=float) * u.yr
    if missing:
        raise InputError(
            f"{path} has no date for {len(missing)} exposures ({some_of(missing, _MOST_NAMED)}); it has "
            f"{some_of(list(dates), _MOST_NAMED)}: names must be those of the lists"
        )
    return out


def _first(known, keys):
    """What is known of the first of some keys that it has; None without."""
    return next((known[key] for key in keys if key in known), None)


def _columns(table):
    """The column of names of a table, and that of dates."""
    small = {name.lower(): name for name in reversed(table.colnames)}
    name, date = (next((small[each] for each in known if each in small), None) for known in (_NAMES, _DATES))
    if name is not None and date is not None:
        return name, date
    if len(table.colnames) == 2:
        return tuple(table.colnames)
    raise InputError(
        f"a table of dates has two columns, names of lists and years, MJD or dates, or columns called name and epoch "
        f"among others; it has {', '.join(table.colnames)}"
    )


def _years(table, name):
    """Julian years (n,) of a column of dates."""
    column = table[name]
    if isinstance(column, Time):
        return years(column).to_value(u.yr)
    if not is_text(column):
        numbers = values(table, name)
        numbers = np.where(numbers > _JD, numbers - _JD, numbers)
        return years(Column(numbers, unit=getattr(column, "unit", None))).to_value(u.yr)
    words = [str(each).strip() for each in text(column)]
    found = [read_date(word) for word in words]
    bad = [f"row {k} has {word!r}" for k, (word, each) in enumerate(zip(words, found, strict=True)) if each is None]
    if bad:
        raise InputError(
            f"column {name!r} has no date that can be read: {some_of(bad, 3)}; give years, MJD or 2014-05-12"
        )
    return np.array([each.jyear for each in found])
