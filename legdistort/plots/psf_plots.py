"""Picture of an effective PSF: its core, what it leaves of its stars, and how it varies over the field."""

import numpy as np

from . import elements

_PLACES = 3  # along x and along y
_REACH = 2.5  # FWHM
_SOFT = 100.0  # part of the peak where the stretch turns from linear to logarithmic, inverse


def plot_psf(psf, *, fig=None):
    """Draw the PSF at the centre of the field, what it leaves of its stars, and how it differs elsewhere.

    Parameters
    ----------
    psf : `~legdistort.measurement.effective.model.EffectivePSF`
    fig : `~matplotlib.figure.Figure`, optional
        Where to draw.

    Returns
    -------
    fig : `~matplotlib.figure.Figure`
    axes : list of `~matplotlib.axes.Axes`
        Core, residual (not of a PSF from elsewhere), and the places of the field, rows from the top.
    """
    parts = 1 if psf.residual is None else 2
    fig = elements.new_figure(fig, (3.2 + 3.4 * parts, 4.3))
    left, right = fig.subfigures(1, 2, width_ratios=(parts, 1))
    axes = left.subplots(1, parts, squeeze=False)[0]
    middle, half = np.asarray(psf.middle, dtype=float), _REACH * psf.fwhm
    top = _draw_core(left, axes[0], psf, middle, half)
    if psf.residual is not None:
        _draw_residual(left, axes[1], psf, half, top)
    for ax in axes:
        ax.set(xlabel="x [px]", ylabel="y [px]", xlim=(-half, half), ylim=(-half, half))
    return fig, [*axes, *_draw_variation(right, psf, middle, half)]


def _draw_core(fig, ax, psf, middle, half):
    """The PSF in asinh stretch, with contours at 10 and 50 % of its peak, which is returned."""
    image = psf.images(middle, half=half, oversampling=max(4, int(np.ceil(12 / psf.fwhm))))[0]
    top, end = image.max(), half * (1 + 1 / len(image))
    extent = (-end, end, -end, end)
    shown = ax.imshow(np.arcsinh(image / top * _SOFT), cmap="gray_r", vmin=0, origin="lower", extent=extent)
    ax.contour(image / top, levels=[0.1, 0.5], colors=[elements.BLUE], linewidths=0.9, extent=extent)
    ax.plot(0, 0, "+", color=elements.ORANGE, markersize=9)
    ticks = np.array([0, 0.01, 0.03, 0.1, 0.3, 1])
    bar = fig.colorbar(shown, ax=ax, location="bottom", shrink=0.9, label="part of the peak")
    bar.set_ticks(np.arcsinh(_SOFT * ticks), labels=[f"{t:g}" for t in ticks])
    elements.set_title(ax, f"PSF, FWHM {psf.fwhm:.2f} px")
    return top


def _draw_residual(fig, ax, psf, half, top):
    """What the PSF leaves of its stars."""
    off, end = 100 * psf.residual / top, len(psf.residual) / 2
    shown = ax.imshow(off, **_about_zero(off), origin="lower", extent=(-end, end, -end, end))
    fig.colorbar(shown, ax=ax, location="bottom", shrink=0.9, label="% of the peak")
    elements.set_title(ax, f"left of its {psf.n_stars} stars, mean")


def _about_zero(values):
    """Colours of values about zero."""
    limit = max(float(np.abs(values).max()), 1e-3)
    return {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}


def _draw_variation(fig, psf, middle, half):
    """Differences from the PSF at the centre, at places of the field."""
    ny, nx = psf.shape if psf.shape is not None else 2 * np.flip(middle[0]) + 1
    x, y = (np.linspace(0.08, 0.92, _PLACES) * n for n in (nx, ny))
    places = np.stack(np.meshgrid(x, y[::-1]), axis=-1).reshape(-1, 2)
    images = psf.images(np.vstack([middle, places]), half=half)
    off = 100 * (images[1:] - images[0]) / images[0].max()
    axes = fig.subplots(_PLACES, _PLACES)
    for ax, one in zip(axes.flat, off, strict=True):
        shown = ax.imshow(one, **_about_zero(off), origin="lower")
        ax.set(xticks=[], yticks=[])
    fig.colorbar(shown, ax=axes, location="bottom", shrink=0.9, label="% of the peak")
    fig.suptitle("over the field, less the centre", fontsize="medium")
    return list(axes.flat)
