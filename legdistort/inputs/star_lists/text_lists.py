"""Tables in text: which format a text has shows in its first lines, seldom in the name of its file.

A text gives the names of its columns in a line above the numbers, commented or not. Comments may hold much more
than that (those of hst1pass fill 150 lines), so of the commented lines the last one is taken that has a name for every
column. Astropy's readers do the reading; what they refuse is looked through here, so that the row at fault is named.
"""

import codecs
import contextlib
import csv
import re
import textwrap
from collections import Counter
from itertools import takewhile

import numpy as np
from astropy import units as u
from astropy.io import ascii as astropy_ascii
from astropy.table import Table

from ...exceptions import InputError
from ...runtime import checks
from ...runtime.guards.yaml_text import check_yaml
from ..plain_columns import is_number, is_text, numbers, text
from . import votables

#: What missing values look like: empty fields, and the "null" of the Gaia archive.
_MISSING = [("", "0"), ("null", "0")]
_MOST_COLUMNS = 10_000
#: Beginnings of the tags in the headers of ECSV tables, and nodes that these may have.
_ECSV_TAGS = ("!astropy.", "!numpy.", "tag:yaml.org,2002:omap", "tag:yaml.org,2002:binary", "tag:yaml.org,2002:set",
              "tag:yaml.org,2002:python/tuple", "tag:yaml.org,2002:python/unicode", "tag:yaml.org,2002:python/complex",
              "tag:yaml.org,2002:python/str")  # fmt: skip
_MOST_NODES = 1_000_000
#: Lines that are looked at to tell how many columns there are.
_LOOKED_AT = 1000
#: Byte order marks, the longer before those that they begin with.
_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip
#: First words of the lists of DAOPHOT and ALLSTAR (Stetson); the columns of ALLSTAR, and those of FIND.
_STETSON = ["NL", "NX", "NY"]
_ALLSTAR = ("ID", "X", "Y", "MAG", "MERR", "SKY", "NITER", "CHI", "SHARP")
_FIND = ("ID", "X", "Y", "MAG", "SHARP", "ROUND", "ROUND2")
#: Columns of a list of Stetson's programs after the first, which has six or seven.
_WIDTH = 9
#: Words that readers of numbers do not know: Fortran's D for E, its asterisks for a number wider than its field, the
#: INDEF of IRAF.
_FORTRAN = re.compile(r"(?<![^\s,;|<>])(?:([-+]?\d*\.\d*)[dD]([-+]?\d+)|\*{2,}|INDEF)(?![^\s,;|<>])")
_NAME = re.compile(r"[A-Za-z_]\S*")
#: A name of one letter between dots, as wide as its column: ``#....u.... ....v....`` (hst1pass).
_DOTTED = re.compile(r"\.*[A-Za-z0-9]\.*")
_HINT = re.compile(r"[dD][-+\d]|\*\*|INDEF")
AGAIN = "; write it again, or save it as CSV or ECSV"
_CURE = "correct it or leave it out"


def read(content, suffix):
    """The table in a text.

    Parameters
    ----------
    content : bytes
    suffix : str
        Of its file, in small letters.

    Raises
    ------
    InputError
        Naming the row and line at fault, where there is one.
    """
    words = _decoded(content)
    if "<VOTABLE" in words[:2000] or suffix in (".vot", ".xml"):
        return votables.read(content, AGAIN)
    words = words.replace("\r\n", "\n").replace("\r", "\n")
    lines = words.split("\n")
    if _HINT.search(words):
        lines = [_FORTRAN.sub(_known_word, line) if _is_row(line) else line for line in lines]
    if "\0" in words:
        _refuse_zeros(lines)
    if lines[0].startswith("# %ECSV") or suffix == ".ecsv":
        return _read_ecsv(lines)
    if re.match(r"#\s+1\s+[A-Z]\w+", lines[0]):
        last = max(int(n) for n in re.findall(r"^#\s+(\d{1,30})\s", "\n".join(lines), re.MULTILINE))
        if last > _MOST_COLUMNS:  # astropy would count them all
            raise InputError(f"cannot be read as a table: it has a column {last}{AGAIN}")
        return _parsed(lines, "ascii.sextractor")
    if lines[0].startswith("#N ") or "\n#N " in words:
        return _read_iraf(lines)
    if lines[0].split()[:3] == _STETSON:
        return _read_stetson(lines)
    if any(line.startswith("|") for line in lines[:_LOOKED_AT]) and lines[0][:1] in "|\\":
        return _read_ipac(lines)
    return _read_named(lines)


def _decoded(content):
    """Text of bytes: by their mark, else UTF-8, else Latin-1, which takes all."""
    encoding = next((name for mark, name in _MARKS.items() if content.startswith(mark)), None)
    try:
        return content.decode(encoding or "utf-8")
    except UnicodeDecodeError as error:
        if encoding is not None:
            raise InputError(
                f"cannot be read as a table: by its byte order mark it is {encoding}, but it is not ({error.reason} at "
                f"byte {error.start}); save it as UTF-8"
            ) from None
        return content.decode("latin-1")


def _known_word(found):
    return "nan".rjust(len(found[0])) if found[1] is None else f"{found[1]}E{found[2]}"


def _refuse_zeros(lines):
    k = next(k for k, line in enumerate(lines) if "\0" in line)
    raise InputError(
        f"cannot be read as a table: {_place(lines, k)} has bytes of zero: the file is damaged, or UTF-16 without a "
        "byte order mark; copy it again, or save it as UTF-8"
    )


def _is_row(line):
    return line != "" and line[0] != "#" and not line.isspace()


def _place(lines, k, first=None):
    """Name of the row in line `k`; rows count from 0 in the line `first`, lines from 1, as editors do."""
    rows = [i for i, line in enumerate(lines[: k + 1]) if _is_row(line)]
    if first is None:  # behind names, if there are some
        rows = rows[2:] if lines[0].split()[:3] == _STETSON else rows
        first = next((i for i in rows if any(map(is_number, re.split(r"[\s,;]+", lines[i].strip())))), 0)
    row = sum(first <= i < k for i in rows)
    return f"row {row} (line {k + 1})"


def _by_astropy(lines, kind, **options):
    """Lines as a table. They are never given as one text, nor to be guessed: that might be taken for a path or URL."""
    return Table.read(list(lines), format=kind, guess=False, **options)


def _parsed(lines, kind, **options):
    """Lines as a table, by a reader of astropy; with all columns as text, if that is what it takes to read them."""
    full = [line for line in lines if line.strip()]
    try:
        return _by_astropy(full, kind, **options)
    except Exception as error:  # readers raise what they like
        as_text = {"*": [astropy_ascii.convert_numpy(str)]}
        try:
            return _by_astropy(full, kind, converters=as_text, **options)
        except Exception:
            rows = [(k, line.split()) for k, line in enumerate(lines) if _is_row(line) and line[0] not in "|\\"]
            _refuse_uneven(rows, lines)
            raise error from None


def _refuse_uneven(rows, lines, n=None, of="the others have"):
    """Raise `InputError` for the first of the rows ``(number of the line, cells)`` whose number of cells is not `n`."""
    n = _usual([len(cells) for _, cells in rows]) if n is None else n
    for k, cells in rows:
        if len(cells) != n:
            raise InputError(
                f"cannot be read as a table: {_place(lines, k, rows[0][0])} has {len(cells)} cells where {of} {n}, "
                f"{_shown(lines[k])}; {_CURE}"
            )


def _usual(counts):
    """The most common of some numbers."""
    return Counter(counts[:_LOOKED_AT]).most_common(1)[0][0] if counts else 0


def _shown(line, most=60):
    return repr(line if len(line) <= most else f"{line[:most]}...")


def _read_ipac(lines):
    """A table of IPAC, whose columns end at the bars above them."""
    bars = next([k for k, letter in enumerate(line) if letter == "|"] for line in lines if line.startswith("|"))
    rows = [(k, line) for k, line in enumerate(lines) if line.strip() and line[0] not in "|\\"]
    for k, line in rows:
        if any(line[bar : bar + 1].strip() for bar in bars) or len(line.rstrip()) > bars[-1] + 1:
            raise InputError(
                f"cannot be read as a table: {_place(lines, k, rows[0][0])} does not keep to the columns of the "
                f"header, {_shown(line)}; {_CURE}"
            )
    try:
        return _parsed(lines, "ascii.ipac")
    except InputError:
        raise
    except Exception:
        names = next(line for line in lines if line.startswith("|"))[1:].split("|")
        for name, start, stop in zip(names, bars, bars[1:], strict=False):
            cells = [(k, [line[start + 1 : stop]]) for k, line in rows]
            if sum(is_number(cell.strip()) for _, (cell,) in cells) > len(cells) / 2:  # numbers, but for a few
                _refuse_words(cells, 0, name.strip(), lines)
        raise


def _read_iraf(lines):
    """A list of IRAF, one row a star in one line or in several that end with a backslash.

    Its numbers are as wide as its header says, or wider: what stands between blanks counts. With several apertures,
    whose lines end with an asterisk and a backslash, they are left to the reader of astropy.
    """
    if any(line.rstrip().endswith("*\\") for line in lines):
        return _parsed(lines, "ascii.daophot")
    names, units = (
        " ".join(line[2:].rstrip().removesuffix("\\") for line in lines if line.startswith(mark)).split()
        for mark in ("#N", "#U")
    )
    rows, joined = [], True
    for k, line in enumerate(lines):
        if _is_row(line):
            words = line.rstrip().removesuffix("\\").split()
            if joined:
                rows.append((k, words))
            else:
                rows[-1][1].extend(words)
            joined = not line.rstrip().endswith("\\")
    firsts = {k for k, _ in rows}
    _refuse_uneven(rows, [line if k in firsts else "#" for k, line in enumerate(lines)], len(names), "the header names")
    table = _of_cells(rows, names)
    for name, unit in zip(names, units, strict=False):
        table[name].unit = {"pixels": u.pix, "magnitudes": u.mag, "counts": u.ct}.get(unit)
    return table


def _read_ecsv(lines):
    try:
        stripped = (line.strip() for line in lines)
        header = (line[1:] for line in takewhile(lambda line: line[0] == "#", filter(None, stripped)))
        known = (line for line in header if line and "%ECSV" not in line)
        check_yaml(textwrap.dedent("\n".join(known)), _ECSV_TAGS, _MOST_NODES)
        return _by_astropy(lines, "ascii.ecsv", fill_values=_MISSING)
    except Exception as error:  # astropy raises what it likes
        head = "\n".join(line for line in lines if line.startswith("#"))
        comma = re.search(r"delimiter: '?,", head)
        rows = _cells([(k, line) for k, line in enumerate(lines) if _is_row(line)], "," if comma else " ")
        if len(rows) > 1:
            _refuse_uneven(rows[1:], lines, len(rows[0][1]), "the header names")
            kinds = dict(re.findall(r"\{name: ([^,]+), .*?datatype: ([a-z]+)", head))
            for j, name in enumerate(rows[0][1]):
                if kinds.get(name) in ("float", "int", "uint"):
                    _refuse_words(rows[1:], j, name, lines)
        raise InputError(f"cannot be read as a table: {checks.first_line(error)}{AGAIN}") from None


def _refuse_words(rows, j, name, lines):
    """Raise `InputError` for the first cell of a column of numbers that is none."""
    for k, cells in rows:
        if not is_number(cells[j].strip()):
            raise InputError(
                f"cannot be read as a table: column {name!r} has {cells[j]!r} in {_place(lines, k, rows[0][0])}, which "
                f"is no number; {_CURE}"
            )


# -- lists of Stetson's programs


def _read_stetson(lines):
    """A list of DAOPHOT: names of values and values in the first two lines, the size of the image among them."""
    values = lines[1].split() if len(lines) > 1 else []
    if len(values) < 3 or not all(re.fullmatch(r"\d{1,9}", value) for value in values[:3]):
        raise InputError(
            "cannot be read as a table: a list of DAOPHOT without the values of NL, NX, NY in its second line; restore "
            "that line"
        )
    rows = [(k, line) for k, line in enumerate(lines[3:], start=3) if line.strip()]
    counts = (len(_ALLSTAR), len(_FIND), len(_FIND) - 1)
    n = _columns_of(rows, counts)
    cells = _of_fixed_width(rows, n, stetson=True)
    for k, row in cells:
        if len(row) != n or n not in counts:
            raise InputError(
                f"a list of DAOPHOT whose rows are not the nine numbers of ALLSTAR ({' '.join(_ALLSTAR)}), nor those "
                f"of FIND ({' '.join(_FIND)}), but {len(row)} words in {_place(lines, k, cells[0][0])}, "
                f"{_shown(lines[k])}: {_CURE}, or give the list of ALLSTAR (.als), or a text with the names of its "
                "columns in the first line"
            )
    names = _FIND[:n] if n in counts[1:] else _ALLSTAR
    table = _of_cells(cells, names)
    table.meta = {"program": "DAOPHOT", "shape": [int(values[2]), int(values[1])]}
    return table


def _of_cells(rows, names):
    """The table of rows ``(number of the line, cells)``, with numbers in columns that have nothing else."""
    if rows and not any("_" in cell for _, cells in rows for cell in cells):  # numpy takes 1_0 for a number
        with contextlib.suppress(ValueError):
            return Table(np.array([cells for _, cells in rows], dtype=float), names=names)
    columns = [np.array(column) for column in zip(*(cells for _, cells in rows), strict=True)]
    found = ((column, *numbers(column)) for column in columns or [np.array([], dtype=str)] * len(names))
    return Table([column if bad.any() else values for column, values, bad in found], names=names)


def _columns_of(rows, counts):
    """How many columns rows ``(number of the line, line)`` of Stetson's programs have: full ones show in the length."""
    length = _usual([len(line.rstrip()) for _, line in rows])
    by_length = next((n for n in counts if 5 <= length - _WIDTH * (n - 1) <= 7), 0)
    return max(by_length, _usual([len(line.split()) for _, line in rows]))


def _of_fixed_width(rows, n, *, stetson=False):
    """Cells of rows ``(number of the line, line)``, cut where full columns leave no blank between their numbers.

    Where columns end is known of the programs of Stetson, and of others by rows whose numbers stand apart.
    """
    split = [(k, line.split()) for k, line in rows]
    if all(len(cells) == n for _, cells in split):
        return split  # nothing to cut
    ends, decimals = _ends([line for (_, line), (_, cells) in zip(rows, split, strict=True) if len(cells) == n], n)
    out = []
    for (k, line), (_, cells) in zip(rows, split, strict=True):
        first = len(line.rstrip()) - _WIDTH * (n - 1)
        stated = [first + _WIDTH * j for j in range(n)] if stetson and 5 <= first <= 7 else ends
        cut = _cut(line, stated, decimals) if len(cells) < n and stated else None
        out.append((k, cut if cut and len(cut) == n else cells))
    return out


def _ends(lines, n):
    """Where the columns of numbers end (None where that varies) and their decimals, by lines of `n` words each."""
    if not lines:
        return None, [None] * n
    words = [list(re.finditer(r"\S+", line)) for line in lines]
    ends = [{row[j].end() for row in words} for j in range(n)]
    decimals = [{_decimals(row[j][0]) for row in words if re.search(r"\d", row[j][0])} for j in range(n)]
    alone = [[next(iter(found)) if len(found) == 1 else None for found in each] for each in (ends, decimals)]
    return alone[0], alone[1]


def _decimals(word):
    return len(word.partition(".")[2])


def _cut(line, ends, decimals):
    """The words of a line, cut at the ends of columns; None where a part of one is no number of that column."""
    cells, j = [], 0
    for word in re.finditer(r"\S+", line):
        start = word.start()
        for end in [end for end in ends if end is not None and word.start() < end < word.end()] + [word.end()]:
            part = line[start:end]
            cut = word.start() < start or end < word.end()
            usual = decimals[j] if j < len(decimals) else None
            if cut and not (is_number(part) and ("*" in part or usual in (None, _decimals(part)))):
                return None
            cells.append(part)
            start, j = end, j + 1
    return cells


# -- texts with the names of their columns, or without


def _read_named(lines):
    """A text whose comments, or whose first line, name the columns; without names they are ``col1``, ``col2`` ..."""
    comments = [line for line in lines if line.startswith("#")]
    rows = [(k, line) for k, line in enumerate(lines) if _is_row(line)]
    if not rows:
        raise InputError("cannot be read as a table: it has no rows; give a line for every star")
    separator = _separator([line for _, line in rows[:_LOOKED_AT]])
    if separator != " " and comments[:1] != lines[:1]:  # without a comment above, none below: a name may be "#1"
        rows = [(k, line) for k, line in enumerate(lines) if line.strip()]
    rows = _without_last(rows, separator)
    first = [cell.strip() for cell in _cells(rows[:1], separator)[0][1]]
    names = None
    if not any(map(_is_value, first)):
        names, rows, of = first, rows[1:], "the first line names"
        if len(set(names)) < len(names) or not all(names):
            raise InputError(
                f"cannot be read as a table: the first line must give each column a name of its own, got "
                f"{', '.join(map(repr, names))}; correct it"
            )
        if not rows:
            return Table(names=names, dtype=[str] * len(names))
    counts = [len(cells) for _, cells in _cells(rows[:_LOOKED_AT], separator)]
    if names is None:
        n = _usual(counts)
        names, of = _commented_names(comments, n), "the comment above names"
        if names is None:
            names, of = [f"col{j + 1}" for j in range(n)], "the others have"
    table = _table(rows, names, separator, lines, of)
    if any(map(_is_dotted, comments)) and names == _commented_names(comments, len(names)):
        table.meta["program"] = "hst1pass"
        epoch = re.search(r"^#\s*rDAT:\s*(\d{4}\.\d+)\s*$", "\n".join(comments), re.MULTILINE)
        if epoch:
            table["epoch"] = np.full(len(table), float(epoch[1]))
    return table


def _is_value(word):
    """Whether a word is the value of a column, not its name."""
    return is_number(word) and word not in ("", "null", "none", "nan")


def _separator(lines):
    """What stands between cells: blanks, if all lines then have as many; else what the first and most lines have."""
    if len({len(line.split()) for line in lines}) == 1 and not any("," in line or ";" in line for line in lines):
        return " "
    for separator in "\t;,|":
        if separator in lines[0] and sum(separator in line for line in lines) > len(lines) / 2:
            return separator
    return " "


def _without_last(rows, separator):
    """Rows ``(number of the line, line)`` without a separator at their ends, where all have one too many."""
    if separator == " " or not all(line.rstrip(" ").endswith(separator) for _, line in rows[1:]):
        return rows
    counts = [len(cells) for _, cells in _cells(rows[:_LOOKED_AT], separator)]
    ends = rows[0][1].rstrip(" ").endswith(separator)
    if not ends and counts[0] + 1 != _usual(counts[1:]):
        return rows  # the last column is empty
    return [(k, line.rstrip(" ").removesuffix(separator)) for k, line in rows]


def _cells(rows, separator):
    """``(number of the line, cells)`` of rows ``(number of the line, line)``."""
    if separator == " ":
        if not any('"' in line for _, line in rows):
            return [(k, line.split()) for k, line in rows]
        joined = [(k, re.sub(r"\s+(?=(?:[^\"]*\"[^\"]*\")*[^\"]*$)", " ", line.strip())) for k, line in rows]
        return [(k, next(csv.reader([line], delimiter=" "))) for k, line in joined]
    return [(k, next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])) for k, line in rows]


def _table(rows, names, separator, lines, of):
    """The table of rows ``(number of the line, line)`` below the names of their columns."""
    options = {"names": names, "delimiter": separator, "fill_values": _MISSING, "comment": None}
    try:
        table = _by_astropy([line for _, line in rows], "ascii.no_header", **options)
    except Exception as error:  # astropy raises what it likes
        cells = _cells(rows, separator)
        if separator == " ":
            cells = _of_fixed_width(rows, len(names))
        _refuse_uneven(cells, lines, len(names), of)
        if any('"' in line for _, line in rows):
            raise InputError(f"cannot be read as a table: {checks.first_line(error)}{AGAIN}") from None
        table = _of_cells(cells, names)
    table.meta = {}
    if separator == ";":
        _decimal_commas(table)
    return table


def _decimal_commas(table):
    """Numbers with a comma for the point, which a semicolon between the cells tells from a separator."""
    for name in table.colnames:
        if is_text(table[name]):
            words = text(table[name])
            points = np.char.replace(words, ",", ".")
            if any("," in word for word in words) and not numbers(points)[1].any():
                table[name] = numbers(points)[0]


def _commented_names(comments, n_columns):
    """The names in the last comment line that has one for every column, or None."""
    for line in reversed(comments):
        words = [word.strip(".") for word in re.split(r"[\s,;]+", line.lstrip("#").strip())]
        named = _is_dotted(line) or all(map(_NAME.fullmatch, words))
        if named and len(words) == len(set(words)) == n_columns:
            return words
    return None


def _is_dotted(line):
    return ".." in line and all(map(_DOTTED.fullmatch, line.lstrip("#").split()))
