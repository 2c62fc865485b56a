"""Artificial stars: put into all exposures and found again, they tell what a catalogue misses, and how it errs."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy.spatial import cKDTree

from ..inputs.table_files import write_table
from ..measurement.injection import APART, distant, statistics, with_photons
from ..measurement.scene.confusion import flux_law
from ..runtime.notebook import ShownAsPrinted
from ..runtime.progress import Bar
from .measuring import covariances, measure_again
from .tables import SAME, magnitudes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..runtime.annotations import StrPath

_SHARE = 0.03  # of the rows of the catalogue, put in at a time: the field is as crowded as before
_FAINTEST = 0.4  # of the threshold, the ratio of signal to noise of the faintest
_STEP, _BINS = 10**0.2, 9  # of fluxes: half a magnitude
_POWER = 0.7  # of the number of stars over their flux, where too few tell
_TRIES = 10  # places drawn for each one wanted
_LOOK = 200  # places whose median tells how faint a star may be
_WIDE = 4  # times the stamps on which stars are fitted: as far as the light of any star is subtracted
_BLENDED = 2.0  # FWHM of an artificial star: stars that no single exposure showed are found anew
_BESIDE = 4.0  # FWHM: rows of other stars might be taken for its own
_CELLS = 3  # of the field, along x and along y
_SHOWN = 10  # stars of a place, at least, for its completeness to be named
_FEWEST = 40  # stars that show a bias near the threshold to 0.3 of an error
_VALUES = {"x": u.pix, "y": u.pix, "flux": 1}
_COLUMNS = "x", "y", "flux", "snr", "x_off", "y_off", "flux_off", "x_err", "y_err", "flux_err", "snr_found"


@dataclass(frozen=True, eq=False, repr=False)
class Completeness(ShownAsPrinted):
    """What a catalogue misses, how its rows err, and how many of them are false, by artificial stars.

    Attributes
    ----------
    by_flux : `~astropy.table.QTable`
        One row for half a magnitude: ``flux_low``, ``flux_high`` (with a zero point ``mag_high``, ``mag_low``);
        ``snr``, the median ratio of signal to noise; ``n`` stars put in; ``completeness``, the part found, and its
        binomial ``completeness_err``; ``n_false``, rows of such fluxes of negative light, found by the same rules in
        what the fit leaves. Of measured less true values of ``x``, ``y`` [pix, reference plane] and ``flux``:
        ``x_bias`` (median), ``x_rms``, ``x_sigma`` (robust), ``x_err``, the median error stated, ``x_ratio``, stated
        over true errors (robust). ``meta["n_false"]`` and ``meta["n_rows"]``: all rows of negative light, and all rows
        of the catalogue.
    by_place : `~astropy.table.QTable`
        One row for a ninth of the field, ``x_low``, ``x_high``, ``y_low``, ``y_high``, with the columns of the other;
        stars of all fluxes, which are drawn alike everywhere.
    stars : `~astropy.table.QTable`
        One row an artificial star: ``x``, ``y``, ``flux``, ``snr`` put in, ``found``; ``x_off``, ``y_off``,
        ``flux_off``, measured less true, the errors stated, and ``snr_found``; NaN where it was not found.

    See Also
    --------
    legdistort.catalogue : Makes it, with `artificial`.
    """

    by_flux: QTable
    by_place: QTable
    stars: QTable

    def __repr__(self) -> str:
        return f"<Completeness: {len(self.stars)} artificial stars, {int(self.stars['found'].sum())} of them found>"

    def __str__(self) -> str:
        table, meta = self.by_flux, self.by_flux.meta
        name = "mag" if "mag_low" in table.colnames else "flux"
        head = f"{name:>21} {'snr':>6} {'stars':>6} {'found':>12} {'flux off / err':>14} {'false':>6}"
        lines = [repr(self)[1:-1], head]
        for row in table:
            span = f"{row[f'{name}_low']:.4g} - {row[f'{name}_high']:.4g}"
            found = f"{100 * row['completeness']:.0f} +- {100 * row['completeness_err']:.0f} %"
            bias = row["flux_bias"] / row["flux_err"]
            lines.append(f"{span:>21} {row['snr']:6.1f} {row['n']:6d} {found:>12} {bias:14.2f} {row['n_false']:6d}")
        part = 100 * np.asarray(self.by_place["completeness"])[self.by_place["n"] >= _SHOWN]
        if len(part):
            lines.append(f"found by place: {part.min():.0f} to {part.max():.0f} % of stars of the same fluxes")
        lines.append(f"about {meta['n_false']} of {meta['n_rows']} rows are false, by negative light")
        return "\n".join(lines)

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """The part found against flux, or magnitude with a zero point; returns the axes."""
        from ..plots.completeness_plots import plot_completeness

        return plot_completeness(self, ax=ax)

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write `by_flux` as ECSV, the others beside it as ``..._places.ecsv``, ``..._stars.ecsv``; returns the path.

        Raises
        ------
        InputError
            If one of them exists.
        """
        first, *beside = table_paths(path)
        for table, each in zip((self.by_place, self.stars, self.by_flux), (*beside, first), strict=True):
            write_table(table, each, overwrite=overwrite)
        return first


def table_paths(path):
    """Where the tables of a `Completeness` go: by flux, by place, and the stars."""
    path = Path(path)
    return path, *(path.with_name(f"{path.stem}_{what}{path.suffix}") for what in ("places", "stars"))


def measure_completeness(field, known, threshold, n, *, seed, zero_point):
    """Artificial stars put into a measured field, some at a time, and found again.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
        It is left as it was.
    known : ndarray, shape (k, 2)
        Where its first search began; what lies elsewhere is found anew where an artificial star is near.
    threshold : float
    n : int
        So many stars, their fluxes distributed as those of the field.
    seed : int
        Of the random numbers.
    zero_point : float or None

    Returns
    -------
    Completeness
    """
    rng = np.random.default_rng(seed)
    law = flux_law(field.flux, field.snr(), threshold)
    faintest = _FAINTEST * threshold / np.median(_places(field, _LOOK, rng, apart=0)[1])
    edges, power = faintest * _STEP ** np.arange(_BINS + 1), law[1] if law else _POWER
    most, rows = max(1, int(_SHARE * len(field.flux))), []
    with Bar(total=n, desc="artificial stars", unit="star", disable=not field.progress) as bar:
        while (left := n - sum(map(len, rows))) > 0:
            xy, unit = _places(field, min(most, left), rng)
            low, high = edges[[0, -1]] ** -power
            flux = (low - rng.uniform(size=len(xy)) * (low - high)) ** (-1 / power)
            rows.append(np.column_stack([xy, flux, unit * flux, _found_again(field, known, xy, flux, threshold, rng)]))
            bar.update(len(xy))
    stars = _star_table(np.concatenate(rows))
    false = _negative(field, threshold)
    by_flux, by_place = _by_flux(stars, edges, false, zero_point), _by_place(stars, field.grid)
    by_flux.meta = {"threshold": threshold, "seed": seed, "n_rows": len(field.flux), "n_false": len(false)}
    return Completeness(by_flux, by_place, stars)


def flux_bias(stars, snr, error):
    """How much too large fluxes are on average, since of faint stars those are found whose noise is favourable; (n,).

    In errors it is ``a / snr``: a number of stars that grows as flux to the power -p has the most probable true flux
    ``(p + 1) / snr`` errors below the measured one (Hogg & Turner 1998, PASP 110, 727), and a place that is fitted has
    the noise that adds ``1 / snr`` more. The number a is that with the least absolute deviations of artificial stars.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        Those of a `Completeness`.
    snr, error : ndarray, shape (n,)
        Ratios of signal to noise of rows, and errors of their fluxes.

    Returns
    -------
    ndarray, shape (n,)
        NaN where fewer than 40 artificial stars were found.
    """
    found = stars[stars["found"]]
    if len(found) < _FEWEST:
        return np.full(len(snr), np.nan)
    ratio, off = np.asarray(found["snr_found"]), np.asarray(found["flux_off"] / found["flux_err"])
    order = np.argsort(off * ratio)
    weight = np.cumsum(1 / ratio[order])
    return (off * ratio)[order[np.searchsorted(weight, weight[-1] / 2)]] / snr * error


def _places(field, n, rng, apart=APART):
    """Random places (at most n, 2) that any exposure sees, so many FWHM apart, and the ratio for unit flux."""
    xy = field.grid.to_reference(rng.uniform(-0.5, np.array(field.grid.shape[::-1]) - 0.5, (_TRIES * n, 2)))
    unit = field.unit_snr(xy)
    xy, unit = xy[unit > 0], unit[unit > 0]
    keep = distant(xy, apart * field.fwhm, n)
    return xy[keep], unit[keep]


def _found_again(field, known, xy, flux, threshold, rng):
    """Off and error of x, y and flux, and ratio of signal to noise, of artificial stars; (n, 7), NaN if not found."""
    tree, out = cKDTree(xy), np.full((len(xy), 7), np.nan)
    beside = tree.query(field.xy)[0] < _BESIDE * field.fwhm
    places, light = np.vstack([xy, field.xy[beside]]), np.append(flux, field.flux[beside])
    with field.restored(), _put_in(field, xy, flux, rng):
        near = tree.query(field.xy)[0] < _BLENDED * field.fwhm
        field.remove(near & ~field.wide & (cKDTree(known).query(field.xy)[0] > SAME * field.fwhm))
        measure_again(field, threshold, xy)
        row = matched(places, light, field.xy, field.fwhm)[: len(xy)]
        there, row = row >= 0, row[row >= 0]
        errors = np.sqrt(np.einsum("naa->na", covariances(field, threshold, row)[0]))
        off = np.column_stack([field.xy[row] - xy[there], field.flux[row] - flux[there]])
        out[there] = np.column_stack([off, errors, field.snr(row)])
    return out


@contextmanager
def _put_in(field, xy, flux, rng):
    """The light of stars with its photon noise in all exposures, through their maps and by their own PSFs."""
    before = []
    for layer in field.layers:
        scene, (pixel, there) = layer.scene, layer.local(xy)
        signal, half = scene.frame.signal, _WIDE * scene.half
        pixel = pixel[there]
        centres = np.round(pixel).astype(int)
        params = np.column_stack([pixel - centres, layer.transmission * flux[there]])
        light = with_photons(scene.psf.light(params, centres, half).astype(float), scene.photon, rng)
        for (x, y), stamp in zip(centres, light.reshape(-1, 2 * half + 1, 2 * half + 1), strict=True):
            low, left = max(y - half, 0), max(x - half, 0)
            window = signal[low : y + half + 1, left : x + half + 1]
            before.append((window, window.copy()))
            start = np.array([low - y, left - x]) + half
            window += stamp[start[0] :, start[1] :][: window.shape[0], : window.shape[1]]
    try:
        yield
    finally:
        for window, pixels in reversed(before):
            window[:] = pixels


def matched(xy, flux, rows, radius):
    """For each of some stars the row that is its own, -1 without one: the nearest, the brightest star choosing first.

    Parameters
    ----------
    xy, flux : ndarray, shape (n, 2), (n,)
    rows : ndarray, shape (m, 2)
    radius : float

    Returns
    -------
    ndarray of int, shape (n,)
    """
    out, free, near = np.full(len(xy), -1), np.ones(len(rows), dtype=bool), cKDTree(rows).query_ball_point(xy, radius)
    for k in np.argsort(-flux, kind="stable"):
        own = [i for i in near[k] if free[i]]
        if own:
            out[k] = own[int(np.argmin(np.hypot(*(rows[own] - xy[k]).T)))]
            free[out[k]] = False
    return out


def _negative(field, threshold):
    """Fluxes of the rows that there would be in addition if what is left had the other sign."""
    before = field.xy.copy(), field.flux.copy()
    _mirror(field)
    try:
        with field.restored():
            measure_again(field, threshold)
            row, new = matched(*before, field.xy, field.fwhm), np.ones(len(field.flux), dtype=bool)
            new[row[row >= 0]] = False
            return field.flux[new]
    finally:
        _mirror(field)


def _mirror(field):
    """What stars and sky leave gets the other sign."""
    for layer in field.layers:
        signal = layer.scene.frame.signal
        signal[:] = 2 * (layer.scene.sky + layer.scene.light) - signal


def _star_table(values):
    """`Completeness.stars` of values (n, 11)."""
    table = QTable()
    for name, column in zip(_COLUMNS, values.T, strict=True):
        table[name] = column * _VALUES.get(name.split("_")[0], 1)
    table.add_column(np.isfinite(table["flux_off"]), name="found", index=4)
    return table


def _by_flux(stars, edges, false, zero_point):
    """`Completeness.by_flux`."""
    low, high = edges[:-1], edges[1:]
    groups = [(stars["flux"] >= a) & (stars["flux"] < b) for a, b in zip(low, high, strict=True)]
    table = QTable({"flux_low": low, "flux_high": high})
    if zero_point is not None:
        table["mag_high"], table["mag_low"] = (magnitudes(each, 0, zero_point)[0] for each in (low, high))
    table["snr"] = [np.median(stars["snr"][own]) if own.any() else np.nan for own in groups]
    return _with_statistics(table, stars, groups, n_false=np.histogram(false, edges)[0])


def _by_place(stars, grid):
    """`Completeness.by_place`: cells of the grid of the sum, as it lies in the reference plane."""
    corners = grid.to_reference(np.array([[0.0, 0.0], np.array(grid.shape[::-1]) - 1.0]))
    x, y = (np.linspace(*np.sort(c), _CELLS + 1) for c in corners.T)
    j, i = np.meshgrid(range(_CELLS), range(_CELLS))
    spans = {"x_low": x[j.ravel()], "x_high": x[j.ravel() + 1], "y_low": y[i.ravel()], "y_high": y[i.ravel() + 1]}
    own = [np.clip(np.searchsorted(e, stars[c].value) - 1, 0, _CELLS - 1) for c, e in (("x", x), ("y", y))]
    groups = [(own[0] == a) & (own[1] == b) for a, b in zip(j.ravel(), i.ravel(), strict=True)]
    return _with_statistics(QTable({name: values * u.pix for name, values in spans.items()}), stars, groups)


def _with_statistics(table, stars, groups, **more):
    """A table of groups of stars with how these were found."""
    off, error = (np.column_stack([np.asarray(stars[f"{name}_{kind}"]) for name in _VALUES]) for kind in ("off", "err"))
    rows = [statistics(off[own], error[own], _VALUES) for own in groups]
    n, part = (np.array([row.pop(name) for row in rows]) for name in ("n", "found"))
    table["n"], table["completeness"] = n, np.where(n > 0, part, np.nan)
    table["completeness_err"] = np.sqrt((n * part + 0.5) * (n * (1 - part) + 0.5) / (n + 1) ** 3)
    for name, column in more.items():
        table[name] = column
    for name in rows[0]:
        table[name] = u.Quantity([row[name] for row in rows]) if name[0] in "xy" else [row[name] for row in rows]
    return table
