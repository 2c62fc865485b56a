"""Pictures as SVG that stands in a page: its text is text, its colours follow the page, its marks have names."""

import base64
import io
import itertools
import re
from functools import partial

import numpy as np
from markupsafe import Markup

#: Style of pictures in a page, whatever that of the user is.
STYLE = {
    "svg.fonttype": "none",
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.facecolor": "white",
    "legend.framealpha": 0.8,
    "image.interpolation": "none",  # its own pixels, which the browser scales
}
_MARGINS = {"left": 0.75, "right": 0.15, "bottom": 0.55, "top": 0.35}  # inches
_DPI = 130  # of what is made of pixels
_COLOURS = 64
_MARKS = re.compile(r'<g id="marks:([se=0-9,:]*)">')
_PLAIN_ID = re.compile(
    r' id="(?:figure|axes|patch|line2d|text|xtick|ytick|matplotlib\.axis|legend|LineCollection|PathCollection|'
    r'PolyCollection|QuadMesh|EllipseCollection|FillBetweenPolyCollection|Quiver|QuiverKey|PathPatch)_\d+"'
)
_IMAGE = re.compile(r'xlink:href="data:image/png;base64,([^"]*)"')
_NUMBERS, _DIGITS = re.compile(r' (?:d|x|y)="[^"]*"'), re.compile(r"(?<=\.\d\d)\d+| (?=\n)")
_DRAWN = re.compile(r"<(?:use|path)\b")
_PATH, _LINE = re.compile(r'<path d="([^"]*)"([^>]*)/>'), re.compile(r"M[^M]*")


def detached_figure(*size, layout="constrained"):
    """An empty figure that pyplot knows nothing of, of a size in inches or of whatever size a plot will give it.

    Without a `layout` it is drawn in a third of the time, with margins of `svg_of`.
    """
    from matplotlib.figure import Figure

    return Figure(figsize=size or None, layout=layout)


def svg_of(figure, salt, **spaces):
    """The SVG of a figure for a page: no header, no id that another picture has, no colour of paper or ink.

    Parameters
    ----------
    figure : `~matplotlib.figure.Figure`
    salt : str
        Tells its ids from those of other pictures of the page.
    **spaces
        Of a figure without layout: ``top``, ``bottom``, ``left``, ``right`` in inches, ``wspace``, ``hspace``.

    Returns
    -------
    `~markupsafe.Markup`
    """
    from matplotlib import rc_context

    if figure.get_layout_engine() is None:
        width, height = figure.get_size_inches()
        at = _MARGINS | spaces
        at |= {"left": at["left"] / width, "right": 1 - at["right"] / width}
        figure.subplots_adjust(**at | {"bottom": at["bottom"] / height, "top": 1 - at["top"] / height})
    _join_lines(figure)
    file = io.StringIO()
    with rc_context({"svg.hashsalt": salt}):
        figure.savefig(file, format="svg", dpi=_DPI, metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r' (?:xmlns(?::xlink)?|version)="[^"]*"', "", text)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"| height="[^"]*pt"', r"\1", text, count=2)
    text = _PLAIN_ID.sub("", text)
    text = text.replace("#000000", "currentColor").replace("#ffffff", "var(--paper)").replace("#0072b2", "var(--blue)")
    text = _IMAGE.sub(lambda found: f'xlink:href="data:image/png;base64,{_fewer_colours(found[1])}"', text)
    text = _NUMBERS.sub(lambda found: _DIGITS.sub("", found[0]), text)
    return Markup(re.sub(r"\n\s*", "\n", _named_marks(text)))


def _join_lines(figure):
    """Make the lines of every collection one path if they look alike: drawn in a tenth of the time."""
    from matplotlib.collections import LineCollection

    gap = np.full((1, 2), np.nan)
    for lines in (each for ax in figure.axes for each in ax.collections if isinstance(each, LineCollection)):
        looks = (lines.get_colors(), lines.get_linewidths(), lines.get_linestyles())
        paths = [path.vertices for path in lines.get_paths()]
        if len(paths) > 1 and all(len(each) == 1 for each in looks):
            lines.set_segments([np.concatenate([part for each in paths for part in (each, gap)])])
            lines.get_paths()[0].should_simplify = False  # a line of no length stays


def _fewer_colours(data):
    """A PNG with a palette, in base64: a third of the size."""
    from PIL import Image

    picture = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA")
    return png(picture.quantize(_COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))


def png(picture):
    """A PIL image as PNG in base64."""
    file = io.BytesIO()
    picture.save(file, format="png", compress_level=6)
    return base64.b64encode(file.getvalue()).decode("ascii")


def _named_marks(text):
    """The groups that `legdistort.plots.elements.mark` named: what they belong to stands at each of their members."""
    pieces, at = [], 0
    for found in _MARKS.finditer(text):
        keys = dict(each.split("=") for each in found[1].split(":"))
        lists = {key: values.split(",") for key, values in keys.items() if values}
        end = _end_of_group(text, found.end())
        group = text[found.end() : end]
        pieces.append(text[at : found.start()])
        at = end
        members = list(itertools.zip_longest(*lists.values()))
        if group.count("<use") + group.count("<path") > len(members) and len(members) == 1:  # axes: all of the group
            pieces.append(f'<g class="panel"{_attributes(lists, members[0])}>{group}')
            continue
        group = _PATH.sub(partial(_single_lines, number=len(members)), group)
        body = group[group.index("</defs>") + 7 :] if "</defs>" in group else group
        turn = iter(members)

        def named(match, lists=lists, turn=turn):
            return match[0] + _attributes(lists, next(turn, ()))

        head = group[: len(group) - len(body)]
        pieces.append(f'<g class="marks">{head}{_DRAWN.sub(named, body)}')
    return "".join([*pieces, text[at:]])


def _single_lines(path, number):
    """The lines that `_join_lines` made one path, each as a path again; their looks stand at the group."""
    lines = _LINE.findall(path[1])
    if len(lines) != number:
        return path[0]
    single = "\n".join(f'<path d="{line.strip()}"/>' for line in lines)
    return f"<g{path[2]}>\n{single}\n</g>"


def _attributes(lists, member):
    return "".join(f' data-{key}="{value}"' for key, value in zip(lists, member, strict=False))


def _end_of_group(text, start):
    """Where the group ends whose content begins at `start`."""
    depth = 1
    for found in re.compile(r"<g\b[^>]*?(/?)>|</g>").finditer(text, start):
        depth += -1 if found[0] == "</g>" else not found[1]
        if depth == 0:
            return found.start()
    return len(text)


def grey(image, low, high):
    """Pixels (ny, nx) between two levels in asinh stretch, dark on light, as a PNG in base64; without data white."""
    from PIL import Image

    scaled = np.arcsinh(10 * (np.nan_to_num(image, nan=low) - low) / ((high - low) or 1)) / np.arcsinh(10)
    return png(Image.fromarray((255 * (1 - np.clip(scaled, 0, 1))).astype(np.uint8)[::-1], mode="L"))
