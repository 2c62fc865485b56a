"""Pieces of an HTML page that is complete in itself: style, tables of figures, pictures.

They are written without a template engine: one page of two tables and some pictures is not worth a dependency and a
second language. Texts are escaped here, where they become markup.
"""

import base64
import io
from html import escape

STYLE = """
body { margin: 2rem auto; max-width: 62rem; padding: 0 1.2rem; background: #fff; color: #1d2730;
       font: 16px/1.5 system-ui, "Segoe UI", Helvetica, Arial, sans-serif; }
h1 { font-size: 1.7rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p.lead { margin: .2rem 0 1.4rem; color: #51606d; }
section.verdict { border-left: 6px solid #2f7d4f; background: #f4f7f5; padding: .7rem 1rem; margin: 0 0 1.6rem; }
section.verdict.warn, section.verdict.unknown { border-color: #c98a00; background: #fdf8ec; }
section.verdict.fail { border-color: #b3261e; background: #fcf1f0; }
section.verdict h2 { margin: 0 0 .4rem; }
.state { border-radius: .6rem; padding: .05rem .6rem; color: #fff; background: #7a6200; font-size: .8rem; }
.state.fail { background: #b3261e; } .state.unknown { background: #51606d; }
details summary { cursor: pointer; font-size: .88rem; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .7rem; border-bottom: 1px solid #dde3e8; text-align: left; vertical-align: top; }
table.facts th { white-space: nowrap; font-weight: 600; }
table.exposures { width: 100%; }
table.exposures thead th { border-bottom: 2px solid #51606d; vertical-align: bottom; line-height: 1.25; }
table.exposures td + td, table.exposures th + th { text-align: right; white-space: nowrap; }
table.exposures td:first-child { overflow-wrap: anywhere; }
td.high { color: #a84300; font-weight: 700; }
small { font-weight: 400; color: #51606d; }
.wide { overflow-x: auto; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(24rem, 1fr)); gap: 0 1.6rem; align-items: start; }
figure { margin: .8rem 0 1.6rem; break-inside: avoid; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: .88rem; color: #3c4a56; margin: .4rem auto 0; max-width: 46rem; }
footer { margin-top: 2.5rem; font-size: .8rem; color: #51606d; }
@media print { body { margin: 0; max-width: none; font-size: 11px; } tr { break-inside: avoid; }
               .wide { overflow: visible; } .pair { grid-template-columns: 1fr 1fr; } }
"""


def wide_table(head, rows):
    """Table of figures: columns with their units, rows of a name and cells (ready-made ``<td>``, or plain text)."""
    header = "".join(
        f'<th scope="col">{h}{f"<br><small>{unit}</small>" if unit else ""}</th>' for h, unit in head.items()
    )
    body = ""
    for name, *cells in rows:
        cells = "".join(c if c.startswith("<td") else f"<td>{escape(c)}</td>" for c in cells)
        body += f"<tr><td>{escape(name)}</td>{cells}</tr>\n"
    return (
        f'<div class="wide"><table class="exposures">\n<thead><tr>{header}</tr></thead>\n'
        f"<tbody>\n{body}</tbody></table></div>"
    )


def detached_figure(*size):
    """An empty figure that pyplot knows nothing of, of a size in inches or of whatever size a plot will give it."""
    from matplotlib.figure import Figure

    return Figure(figsize=size or None, layout="constrained")


def figure(ax, caption):
    """A picture with its sentence, the PNG inside the page."""
    from PIL import Image

    caption = escape(caption)
    file, small = io.BytesIO(), io.BytesIO()
    ax.figure.savefig(file, format="png", dpi=120)
    # A palette takes a third of the room; "maximum coverage" keeps rare colours, such as the black of stars.
    picture = Image.open(file).convert("RGB").quantize(64, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    picture.save(small, format="png", optimize=True)
    width = round(96 * ax.figure.get_figwidth())
    data = base64.b64encode(small.getvalue()).decode("ascii")
    return (
        f'<figure><img src="data:image/png;base64,{data}" width="{width}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def count(n, what):
    """A number with its noun."""
    return f"{n} {what}{'' if n == 1 else 's'}"
