"""Picture of the difference of two distortion maps."""

import numpy as np

from ..geometry import basis
from . import elements

_ARROWS = 13  # along the longer side of a detector
#: Magnification at most: arrows of what is far below a thousandth of a pixel are short, and do not look like something.
_MOST = 1e4


def plot_difference(difference, *, ax=None, scale=None):
    """Arrows by which the second map displaces beyond the first, magnified, detectors side by side.

    One below them has its length in detector pixels.

    Parameters
    ----------
    difference : `legdistort.assessment.map_difference.MapDifference`
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    scale : float, optional
        Magnification; by default a round number that makes the longest arrow 6 % of a detector, 10 000 at most.
    """
    shapes, count = difference.shapes, len(difference.shapes)
    columns = int(np.ceil(np.sqrt(count)))
    ax = elements.new_axes(ax, (6.8, 7.2))
    size = max(max(shape) for shape in shapes.values())
    t = (np.arange(_ARROWS) + 0.5) / _ARROWS * 2 - 1
    u, v = (each.ravel() for each in np.meshgrid(t, t))
    fields = {key: np.tensordot(each, basis.values(basis.degree_of(each.shape[1]), u, v), 1)
              for key, each in difference.coefficients.items()}  # fmt: skip
    longest = max(np.hypot(*each).max() for each in fields.values())
    scale = scale or min(elements.round_down(0.06 * size / (longest or 1)), _MOST)
    for number, (key, (ny, nx)) in enumerate(shapes.items()):
        corner = 1.08 * size * np.array([number % columns, -(number // columns)])
        edge = np.array([[0, 0], [nx, 0], [nx, ny], [0, ny]]) - 0.5 + corner
        ax.fill(*edge.T, facecolor="#eef3f8", edgecolor=elements.BLUE, linewidth=1.2, zorder=0)
        if count > 1:
            ax.annotate(key, edge[0], xytext=(5, 5), textcoords="offset points", color=elements.BLUE, parse_math=False)
        if longest > 0:
            places = basis.denormalize(u, v, (ny, nx)) + corner
            arrows = ax.quiver(*places.T, *(scale * fields[key]), angles="xy", scale_units="xy", scale=1, width=2.4e-3)
    if longest > 0:
        low, high = ax.get_ylim()
        ax.set_ylim(low - 0.05 * size, high)
        length = elements.round_down(longest)
        ax.quiverkey(arrows, 0.9, 0.03, scale * length, f"{length:g} px", labelpos="W", coordinates="axes")
    ax.set_aspect("equal")
    ax.set_xlabel("x [pix]")
    ax.set_ylabel("y [pix]")
    verdict = {
        True: "as far as is known none",
        False: f"{min(difference.sigmas, 37):.1f} sigma",
        None: difference.why_not,
    }
    words = (
        f"second minus first, {difference.rms:.2g} px rms per axis ({verdict[difference.agrees]}), arrows x {scale:g}"
    )
    if difference.n_undetermined and difference.agrees is not None:
        words += f"\n{difference.n_undetermined} directions are not determined, and not drawn"
    first, second = (elements.shorten(each) for each in difference.labels)
    elements.set_title(ax, f"{second}\nagainst {first}:\n{words}", size="small")
    return ax
