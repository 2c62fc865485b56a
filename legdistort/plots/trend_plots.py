"""What changes from exposure to exposure: rotation, scale, dynamic distortion, seeing."""

import numpy as np

from ..geometry import similarity
from . import elements


def plot_trends(solution, time, label, *, dynamic=None, fwhm=None, fig=None):
    """A panel each, one mark an exposure, against time.

    Parameters
    ----------
    solution : `~legdistort.results.solution.Solution`
        Whose poses are drawn: rotation and scale against their medians.
    time : array_like, shape (n_exposures,)
        Of the exposures.
    label : str
        What the times are.
    dynamic : array_like, shape (n_exposures,), optional
        Rms size of the dynamic distortion, pixels.
    fwhm : dict, optional
        ``{exposure: FWHM [px]}`` of single exposures.
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw; its size is set.
    """
    poses = [similarity.describe(solution.poses[name]) for name in solution.names]
    rotation, scale = (np.array([pose[key] for pose in poses]) for key in ("rotation", "scale"))
    turn = np.rad2deg(np.angle(np.exp(1j * np.deg2rad(rotation - rotation[0]))))
    series = {
        "rotation [deg]": turn - np.median(turn),
        "scale [10⁻⁶]": 1e6 * (scale / np.median(scale) - 1),
    }
    if dynamic is not None:
        series["dynamic part [px]"] = np.asarray(dynamic)
    if fwhm:
        series["FWHM [px]"] = np.array([fwhm.get(name, np.nan) for name in solution.names])
    fig = elements.new_figure(fig, (7.0, 1.5 * len(series) + 0.5))
    panels = list(fig.subplots(len(series), 1, sharex=True, squeeze=False)[:, 0])
    for ax, (name, values) in zip(panels, series.items(), strict=True):
        seen = np.flatnonzero(np.isfinite(values) & np.isfinite(time))
        elements.mark(ax.scatter(np.asarray(time)[seen], values[seen], s=14, color=elements.BLUE, linewidths=0),
                      exposures=seen)  # fmt: skip
        ax.set_ylabel(name, fontsize="small")
        ax.grid(linewidth=0.3)
    panels[-1].set_xlabel(label)
    return panels
