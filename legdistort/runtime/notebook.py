"""What `print` shows of our objects as text, and a notebook as tables: headings, sentences, facts, tables of texts.

An object says its parts once; text and HTML are made of the same.
"""

import textwrap
from dataclasses import dataclass
from html import escape
from itertools import groupby

#: Rows of a table that a notebook shows: it keeps every output in its file.
MOST_ROWS = 100
_WIDTH, _KEY = 110, 8  # characters of a line of words, and of a key before it
_COLOURS = {"pass": "#2f7d4f", "unknown": "#51606d", "warn": "#7a6200", "fail": "#b3261e"}
# Ink and paper are those of the notebook, light or dark; badges are dark enough for white words.
_STYLE = """<style>
.legdistort { overflow-x: auto; }
.legdistort table { border-collapse: collapse; margin: .5em 0; font-variant-numeric: tabular-nums; }
.legdistort th, .legdistort td { text-align: right; vertical-align: top; white-space: nowrap; padding: .2em .6em;
  background: none; border: 0; border-bottom: 1px solid #8886; }
.legdistort thead th { vertical-align: bottom; }
.legdistort .words { text-align: left; white-space: normal; }
.legdistort tr > :first-child { white-space: nowrap; }
.legdistort small { opacity: .75; font-weight: normal; }
.legdistort p { margin: .5em 0; max-width: 60em; }
.legdistort .state { color: #fff; border-radius: .6em; padding: 0 .6em; }
</style>"""


class ShownAsPrinted:
    """An object whose cell in a notebook holds what `print` shows of it, as tables if it says its parts."""

    def _parts(self):
        return None

    def _repr_html_(self):
        parts = self._parts()
        if parts is None:
            return f'<pre style="line-height: 1.3">{escape(str(self))}</pre>'
        shown = "\n".join(kind.html_of(list(some)) for kind, some in groupby(parts, type))
        return f'<div class="legdistort">{_STYLE}\n{shown}\n</div>'


def text_of(parts):
    """Parts as `print` shows them."""
    return "\n".join(line for part in parts for line in part.lines())


@dataclass(frozen=True)
class Heading:
    """What it is, in a line."""

    text: str

    def lines(self):
        """The line."""
        return [self.text]

    @staticmethod
    def html_of(headings):
        """Each in bold type."""
        return "\n".join(f"<p><b>{escape(each.text)}</b></p>" for each in headings)


@dataclass(frozen=True)
class Sentence:
    """Words of a line of their own, or of as many as they need where they are `wrapped`; none is a line between."""

    text: str = ""
    wrapped: bool = False

    def lines(self):
        """The words in lines."""
        return textwrap.wrap(self.text, _WIDTH) if self.wrapped else [self.text]

    @staticmethod
    def html_of(sentences):
        """A paragraph each."""
        return "\n".join(f"<p>{escape(each.text)}</p>" for each in sentences if each.text)


@dataclass(frozen=True)
class Fact:
    """Words behind a key, which may be the state of a check; without words nothing."""

    key: str
    text: str

    def lines(self):
        """The words in lines, those after the first indented."""
        indent = {"initial_indent": f"{self.key:{_KEY}s}", "subsequent_indent": " " * _KEY}
        return textwrap.wrap(self.text, _WIDTH, **indent) if self.text else []

    @staticmethod
    def html_of(facts):
        """A table of those that stand together."""
        rows = (
            f'<tr><th class="words" scope="row">{_badge(each.key)}</th><td class="words">{escape(each.text)}</td></tr>'
            for each in facts
            if each.text
        )
        return "\n".join(["<table>", *rows, "</table>"]) if any(each.text for each in facts) else ""


@dataclass(frozen=True)
class Column:
    """A column of a table: heading, texts, least width in characters, unit; words are at the left of it.

    A unit, if one column has any, is in a line below the headings.
    """

    head: str
    texts: list
    size: int = 0
    unit: str = ""
    words: bool = False

    def padded(self, text):
        """A text in the width of the column."""
        return f"{text:{'<' if self.words else '>'}{self.size}s}"

    def cell(self, text, tag="td", shown=escape):
        """A text as a cell of a table."""
        kind = ' class="words"' * self.words
        return f"<{tag}{kind}>{shown(text)}</{tag}>"


@dataclass(frozen=True)
class Grid:
    """A table: its columns, and what is between them in lines of text."""

    columns: list
    gap: str = " "

    def lines(self):
        """A line a row below those of headings and units."""
        units = [each.unit for each in self.columns]
        rows = [[each.head for each in self.columns], *([units] if any(units) else []), *self._rows()]
        padded = (map(Column.padded, self.columns, row) for row in rows)
        return [self.gap.join(row).rstrip() for row in padded]

    def _rows(self):
        return zip(*(each.texts for each in self.columns), strict=True)

    @staticmethod
    def html_of(grids):
        """A table each; of a long one the beginning, and how many rows are missing."""
        return "\n".join(line for each in grids for line in each._html())

    def _html(self):
        rows = list(self._rows())
        yield "<table><thead><tr>"
        for each in self.columns:
            unit = f"<br><small>{escape(each.unit)}</small>" if each.unit else ""
            yield each.cell(each.head, "th", lambda text, unit=unit: escape(text.strip()) + unit)
        yield "</tr></thead><tbody>"
        for row in rows[:MOST_ROWS]:
            cells = (each.cell(text, shown=_badge) for each, text in zip(self.columns, row, strict=True))
            yield f"<tr>{''.join(cells)}</tr>"
        yield "</tbody></table>"
        if len(rows) > MOST_ROWS:
            yield f"<p>and {len(rows) - MOST_ROWS} more</p>"


def _badge(text):
    """A text, in its colour if it is the state of a check."""
    colour = _COLOURS.get(text)
    return f'<span class="state" style="background: {colour}">{text}</span>' if colour else escape(text.strip())
