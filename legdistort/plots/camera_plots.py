"""Picture of a camera: its detectors in the focal plane, the gaps between them, and their static distortion."""

import numpy as np

from ..geometry import basis
from . import elements

_ARROWS = 9  # along a side of a detector


def outline_detectors(camera, ax):
    """Draw the detectors with their ids, by their place in the focal plane."""
    for key, each in camera.detectors.items():
        ax.fill(*each.outline.T, facecolor="#eef3f8", edgecolor=elements.BLUE, linewidth=1.2, zorder=0)
        x, y = each.outline.min(axis=0)
        ax.annotate(key, (x, y), xytext=(5, 5), textcoords="offset points", color=elements.BLUE, parse_math=False)


def plot_camera(camera, *, ax=None, scale=None):
    """Outlines of the detectors, and arrows from undistorted to true places on them, magnified.

    Parameters
    ----------
    camera : `legdistort.Camera`
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw.
    scale : float, optional
        Magnification; by default a round number that makes the longest arrow 6 % of the field.
    """
    ax = elements.new_axes(ax, (6.8, 6.8))
    ny, nx = camera.field
    t = (np.arange(_ARROWS) + 0.5) / _ARROWS * 2 - 1
    places, shifts = [], []
    for each in camera.detectors.values():
        q = basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), each.shape)
        back = np.linalg.inv(each.layout[:, :2]).T
        places.append((q - each.layout[:, 2]) @ back)
        shifts.append((each.distortion(q) - q) @ back)
    places, shifts = np.concatenate(places), np.concatenate(shifts)
    longest = np.hypot(*shifts.T).max()
    scale = scale or elements.round_down(0.06 * max(nx, ny) / (longest or 1))
    outline_detectors(camera, ax)
    if longest > 0:
        ax.quiver(*places.T, *(scale * shifts.T), angles="xy", scale_units="xy", scale=1, width=2e-3)
    ax.set(xlim=(-0.03 * nx, 1.03 * nx), ylim=(-0.03 * ny, 1.03 * ny), aspect="equal")
    ax.set_xlabel("x in the focal plane [pix]")
    ax.set_ylabel("y in the focal plane [pix]")
    words = f"static distortion, up to {longest:.3g} px, x {scale:g}" if longest > 0 else "no static distortion"
    elements.set_title(ax, f"{camera.name}: {words}")
    return ax
