"""Weights of exposures and of their pixels in a co-added image."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from astropy import units as u
from scipy.ndimage import map_coordinates

from ..exceptions import InputError
from .options import by_name

_OWN = 0.02  # error of the position of a star of signal-to-noise ratio 20, in units of the FWHM
_FWHM = 3.0  # taken where it is not known, px


def stellar_widths(views):
    """FWHM [px] of the stars of each exposure, medians of what was measured, as a dict; None if any is not known.

    Parameters
    ----------
    views : dict
        ``{name: View}``, with a column ``fwhm`` in their residuals, if `legdistort.measure` made them.
    """
    widths = {}
    for name, view in views.items():
        rows = view.residuals
        if "fwhm" not in rows.colnames:
            return None
        fwhm = u.Quantity(rows["fwhm"], u.pix).value[np.asarray(rows["used"], dtype=bool)]
        widths[name] = fwhm[np.isfinite(fwhm) & (fwhm > 0)]
    return {name: float(np.median(w)) for name, w in widths.items()} if all(len(w) for w in widths.values()) else None


@dataclass(frozen=True, eq=False, repr=False)
class Weight:
    """Weight of one exposure, or of its pixels.

    Attributes
    ----------
    value : float
        Of the exposure.
    by_pixel : bool
        Whether it goes with the inverse variance of the sky in every pixel
        (`legdistort.coaddition.background.Background.sky_variance`), relative to that of the background.
    map : tuple or None
        ``(x, y, factor)``: a further factor on a coarse grid of the detector.
    """

    value: float
    by_pixel: bool = False
    map: tuple | None = None

    def at(self, xy):
        """The weight (a number or an array) at detector pixels ``xy``, shape (2, ...), but for `by_pixel`."""
        if self.map is None:
            return self.value
        x, y, factor = self.map
        place = [(xy[1] - y[0]) / (y[1] - y[0]), (xy[0] - x[0]) / (x[1] - x[0])]
        return self.value * map_coordinates(factor, place, order=1, mode="nearest")


def make_weights(weights, noise, views, *, times=None):
    """The `Weight` of every exposure.

    Parameters
    ----------
    weights : {'noise', 'variance', 'exptime', 'seeing', 'sigma_map', None} or dict
        See `legdistort.coadd`.
    noise : dict
        Of the background of each exposure, at its flux scale.
    views : dict
        ``{name: View}``, asked for widths of stars and error maps only where they are needed.
    times : dict, optional
        Exposure times.

    Returns
    -------
    dict
        By name.

    Raises
    ------
    InputError
        If what the option needs is not known, naming the exposures.
    """
    if isinstance(weights, Mapping):
        return {name: Weight(value) for name, value in by_name("weights", weights, noise).items()}
    if weights is None:
        return dict.fromkeys(noise, Weight(1.0))
    if weights == "exptime":
        unknown = [name for name in noise if not (times or {}).get(name)]
        if unknown:
            raise InputError(f"weights='exptime': no exposure time known for {', '.join(unknown)}; give a dict")
        longest = max(times[name] for name in noise)
        return {name: Weight(times[name] / longest) for name in noise}
    best = min(noise.values())
    base = {name: (best / sigma) ** 2 if best > 0 else 1.0 for name, sigma in noise.items()}
    if weights in ("noise", "variance"):
        return {name: Weight(value, by_pixel=weights == "variance") for name, value in base.items()}
    fwhm = stellar_widths({name: views[name] for name in noise})
    if weights == "sigma_map":
        fwhm = fwhm or dict.fromkeys(noise, _FWHM)
        return {name: Weight(value, map=_share(views[name], fwhm[name])) for name, value in base.items()}
    if fwhm is None:
        raise InputError("weights='seeing': the solution has no FWHM of stars in every exposure; give a dict")
    return {name: Weight(value * (min(fwhm.values()) / fwhm[name]) ** 2) for name, value in base.items()}


def _share(view, fwhm):
    """Map of the share that a star of signal-to-noise ratio 20 has in the variance of its corrected position."""
    x, y, sigma = view.sigma_map(support=False)
    own = (_OWN * fwhm) ** 2
    return x, y, own / (own + (sigma**2).mean(axis=2))
