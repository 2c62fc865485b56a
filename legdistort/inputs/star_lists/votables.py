"""VOTables: read after their elements were looked through for references to elsewhere, and for sizes.

The format allows data to lie at an address (``<STREAM href=...>``), of another server or of this disk, and astropy
would fetch them; and a few words in it claim any number of rows and cells.
"""

import io
import re
from xml.parsers import expat

from astropy.table import Table

from ...exceptions import InputError
from ...runtime import checks
from ...runtime.guards.memory import most_bytes

_FORTRAN = re.compile(rb"(?<=>)(\s*[-+]?\d*\.\d*)[dD]([-+]?\d+\s*)(?=<)")
#: Rows that astropy makes room for before there are any, and bytes that a cell takes, about.
_FIRST_ROWS = 512
_BYTES = {"char": 4, "unicodeChar": 4}
_MOST_BYTES_OF_A_CELL = 16


def read(content, again):
    """The first table of a VOTable.

    Parameters
    ----------
    content : bytes
    again : str
        What to do with what cannot be read, for messages.

    Raises
    ------
    InputError
        For what refers to other files or addresses, claims more than there may be, or cannot be read; with the row and
        line, where they are known.
    """
    try:
        _Elements(content).check()
        return Table.read(io.BytesIO(_FORTRAN.sub(rb"\1E\2", content)), format="votable")
    except (InputError, MemoryError):
        raise
    except Exception as error:  # astropy raises what it likes
        message = checks.first_line(error)
        line, row = 0, re.search(r"(\d+):(\d+)", message)
        if isinstance(error, expat.ExpatError):
            line = error.lineno
        elif row:
            line = int(row[1])
        if line:
            start = b"".join(content.splitlines(keepends=True)[:line])
            row = max(len(re.findall(rb"<(?:\w+:)?TR\b", start)) - 1, 0)
            message = f"row {row} (line {line}) is damaged ({message})"
        raise InputError(f"cannot be read as a table: {message}{again}") from None


class _Elements:
    """The elements of an XML text, as the parser gives them that astropy uses as well."""

    def __init__(self, content):
        self.content = content
        self.row_bytes, self.rows, self.counted = 0, 0, 0
        self.parser = parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.EntityDeclHandler = self._entity
        parser.StartDoctypeDeclHandler = self._doctype

    def check(self):
        """Go through all of them."""
        self.parser.Parse(self.content, True)

    def _start(self, name, attributes):
        name = name.rpartition(":")[2].upper()
        attributes = {key.rpartition(":")[2].lower(): value for key, value in attributes.items()}
        if name in ("STREAM", "INCLUDE") and "href" in attributes:
            self._refuse(f"its data lie elsewhere, {name} href={attributes['href'][:100]!r}")
        if name == "TABLE":
            self.row_bytes, self.counted = 0, 0
            self.rows = int(attributes.get("nrows") or 0)
        elif name == "FIELD":
            cells = 1
            for n in re.findall(r"\d+", attributes.get("arraysize") or ""):
                cells *= int(n[:20])
            self.row_bytes += cells * _BYTES.get(attributes.get("datatype"), _MOST_BYTES_OF_A_CELL)
        elif name == "TR":
            self.counted += 1
        if name in ("DATA", "TR"):
            need, most = max(self.rows, self.counted, _FIRST_ROWS) * self.row_bytes, most_bytes(len(self.content))
            if need > most:
                raise InputError(
                    f"is refused: a table in it claims {need} bytes, where its text lets expect {most} at most; "
                    "correct nrows and arraysize, or save it as CSV or ECSV"
                )

    def _doctype(self, name, system, public, has_own_definitions):
        if has_own_definitions:
            self._refuse("it defines words of its own, <!DOCTYPE [...]>")

    def _entity(self, *_):
        self._refuse("it defines words of its own, <!ENTITY>")

    def _refuse(self, what):
        raise InputError(
            f"is refused: {what} (line {self.parser.CurrentLineNumber}), and no other file or address is opened "
            "for it; save the table with its data in it (TABLEDATA), or as CSV or ECSV"
        )
