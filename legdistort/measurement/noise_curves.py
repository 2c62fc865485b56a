"""Error of a position as a function of flux, from stars of known position put into the real background.

Bernard et al. 2017, section 5.2.2 and Figure "noiseflux". Where sky and detector rule, errors fall as 1/flux, where the
star's own photons do, as 1/sqrt(flux): ``sigma^2 = (a / flux)^2 + b^2 / flux + floor^2``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy.optimize import nnls

from ..exceptions import InputError
from ..inputs.star_lists import text_lists
from ..inputs.table_files import write_table
from ..runtime.checks import check_choice, first_line
from ..runtime.notebook import ShownAsPrinted
from ..runtime.words import POSITION_ERRORS

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from ..runtime.annotations import StrPath

#: Where the errors of `legdistort.measure` come from: the fit, the curve, or the fit scaled to the curve.
#: A level of flux counts if this part of its stars was found, and so many.
ENOUGH, FEWEST = 0.5, 10

_AXES = ("x", "y")
_PIXELS = ("fwhm", *(f"{axis}_{what}" for axis in _AXES for what in ("rms", "sigma", "bias", "err")))
_COLUMNS = ("exposure", "flux", "n", "found", "x_ratio", "y_ratio", *_PIXELS)


@dataclass(frozen=True, eq=False)
class NoiseCurves(ShownAsPrinted):
    """Errors of positions against flux, for one or more exposures and widths.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        One row an exposure, width and flux: ``exposure``, ``fwhm`` [pix], ``flux``, ``n`` stars injected, fraction
        ``found``; for either axis ``x_rms`` (plain), ``x_sigma`` (robust: biweight), ``x_bias`` (median), ``x_err``
        (median of the errors stated by the fits) [pix], ``x_ratio`` (errors stated over actual ones, 1 = calibrated).
        ``meta`` has ``fwhm`` (of each exposure's own stars, pixels; None if there were none) and ``photon`` (variance
        per unit of flux that was used), by exposure, and ``seed``.

    Raises
    ------
    InputError
        If columns are missing.
    """

    table: QTable

    def __post_init__(self) -> None:
        missing = [name for name in _COLUMNS if name not in self.table.colnames]
        if missing or not len(self.table):
            what = f"no column {missing[0]!r}" if missing else "no rows"
            raise InputError(f"this is no table of noise curves: {what}; make one with calibrate_noise")

    @property
    def exposures(self) -> tuple[str, ...]:
        """Names of the exposures."""
        return list(dict.fromkeys(self.table["exposure"].tolist()))

    def __repr__(self) -> str:
        widths, fluxes = np.unique(self.laws["fwhm"].value), np.unique(self.table["flux"])
        words = f"{len(self.exposures)} exposures, {len(widths)} widths, fluxes {fluxes[0]:.3g} to {fluxes[-1]:.3g}"
        return f"<NoiseCurves: {words}>"

    def __str__(self) -> str:
        laws = self.laws["exposure", "fwhm", "x_a", "x_b", "x_floor", "y_a", "y_b", "y_floor", "knee"]
        for name in laws.colnames[1:]:
            laws[name].info.format = ".4g"
        return "\n".join([repr(self)[1:-1], *laws.pformat(max_lines=-1, max_width=-1)])

    @cached_property
    def laws(self) -> QTable:
        """Laws fitted to the robust errors, one row an exposure and width.

        Columns ``exposure``, ``fwhm`` [pix]; for either axis ``x_a`` [pix x flux], ``x_b`` [pix x sqrt(flux)],
        ``x_floor`` [pix; 0 unless the errors determine it]; ``knee``, the flux at which sky and photons weigh the same.
        NaN where too few stars were found.
        """
        rows = []
        for name in self.exposures:
            of_exposure = self.table[self.table["exposure"] == name]
            for fwhm in np.unique(of_exposure["fwhm"].value):
                levels = of_exposure[of_exposure["fwhm"].value == fwhm]
                row = {"exposure": name, "fwhm": fwhm * u.pix}
                for axis in _AXES:
                    fitted = _fit_law(levels, levels[f"{axis}_sigma"].value)
                    row |= dict(zip((f"{axis}_a", f"{axis}_b", f"{axis}_floor"), fitted, strict=True))
                a, b = (np.hypot(row[f"x_{key}"], row[f"y_{key}"]) for key in "ab")
                row["knee"] = (a / b) ** 2 if b > 0 else np.nan if np.isnan(b) else np.inf
                rows.append(row)
        return QTable(rows)

    def sigma(
        self, flux: ArrayLike, *, fwhm: float | None = None, exposure: str | None = None, axis: str | None = None
    ) -> np.ndarray:
        """Error of a position by the fitted law.

        Parameters
        ----------
        flux : array_like
            In units of the data.
        fwhm : float, optional
            Width [pix] between those calibrated, between which the law is interpolated; by default the one nearest to
            that of the exposure's own stars.
        exposure : str, optional
            By default the rms over all exposures.
        axis : {"x", "y"}, optional
            By default the rms of both.

        Returns
        -------
        ndarray
            Pixels, in the shape of `flux`; NaN for fluxes that are not positive.

        Raises
        ------
        InputError
            For an exposure, axis or width that was not calibrated, and where too few stars were found for a law.
        """
        flux = np.asarray(flux, dtype=float)
        check_choice(axis, (None, *_AXES), "axis")
        names = self.exposures if exposure is None else [exposure]
        axes = _AXES if axis is None else (axis,)
        variances = [_variance(self._law(name, fwhm, each), flux) for name in names for each in axes]
        return np.sqrt(np.mean(variances, axis=0))

    def _law(self, exposure, fwhm, axis):
        """a, b and floor at a width."""
        laws = self.laws[self.laws["exposure"] == exposure]
        if not len(laws):
            raise InputError(f"no noise curve for exposure {exposure!r}; there are {', '.join(self.exposures)}")
        laws = laws[np.isfinite(laws[f"{axis}_a"])]
        if not len(laws):
            raise InputError(f"{exposure}: too few injected stars were found for a noise curve; raise fluxes")
        widths = laws["fwhm"].value
        if fwhm is None:
            fwhm = self._own_width(exposure, widths)
        if not widths[0] <= fwhm <= widths[-1]:
            raise InputError(
                f"fwhm {fwhm!r} lies outside the widths calibrated for {exposure}, {widths[0]:.4g} to {widths[-1]:.4g} "
                "pixels; give calibrate_noise the widths wanted"
            )
        return [np.interp(fwhm, widths, laws[f"{axis}_{key}"]) for key in ("a", "b", "floor")]

    def _own_width(self, exposure, widths):
        """The one of some widths that is nearest to that of the exposure's own stars."""
        own = self.table.meta.get("fwhm", {}).get(exposure) or np.median(widths)
        return widths[np.argmin(np.abs(widths - own))]

    def in_unit(self, unit: float) -> NoiseCurves:
        """The same for fluxes in a unit of light that is so many times larger."""
        table = self.table.copy()
        table["flux"] = table["flux"] / unit
        photons = {name: photon / unit for name, photon in table.meta.get("photon", {}).items()}
        table.meta |= {"photon": photons} if photons else {}
        return NoiseCurves(table)

    def apply(self, table: Table, source: str) -> QTable:
        """A table of detections with its errors replaced.

        Parameters
        ----------
        table : `~astropy.table.QTable`
            As from `legdistort.measure`, of exposures that are calibrated.
        source : {"fit", "injected", "scaled"}
            Errors of the fit as they are; from the law at every star's flux; or those of the fit times the ratio of the
            law to what fits of this flux state.

        Returns
        -------
        `~astropy.table.QTable`
            A copy. Rows without a positive flux keep their errors.
        """
        check_choice(source, POSITION_ERRORS, "errors")
        table = table.copy()
        if source == "fit":
            return table
        flux, names = np.asarray(table["flux"], dtype=float), np.asarray(table["exposure"])
        for name in dict.fromkeys(names.tolist()):
            rows = np.flatnonzero((names == name) & (flux > 0))
            for axis in _AXES:
                error = self.sigma(flux[rows], exposure=name, axis=axis)
                if source == "scaled":
                    error = table[f"{axis}_err"][rows].value * error / self._stated(name, flux[rows], axis)
                table[f"{axis}_err"][rows] = error * u.pix
        return table

    def _stated(self, exposure, flux, axis):
        """What fits of that flux state; beyond the fluxes calibrated in proportion to the law."""
        levels = self.table[self.table["exposure"] == exposure]
        widths = levels["fwhm"].value
        levels = levels[(widths == self._own_width(exposure, widths)) & _enough(levels)]
        ratio = levels[f"{axis}_err"].value / self.sigma(levels["flux"], exposure=exposure, axis=axis)
        order = np.argsort(levels["flux"])
        return self.sigma(flux, exposure=exposure, axis=axis) * np.interp(
            np.log(flux), np.log(levels["flux"][order]), ratio[order]
        )

    def plot(self, *, exposure: str | None = None, ax: Axes | None = None) -> Axes:
        """Errors against flux with the fitted laws and both regimes (Figure "noiseflux"); returns the axes."""
        from ..plots.noise_plots import plot_noise

        return plot_noise(self, exposure=exposure, ax=ax)

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write the table as ECSV; returns the path."""
        write_table(self.table, path, overwrite=overwrite)
        return Path(path)

    @classmethod
    def read(cls, path: StrPath) -> NoiseCurves:
        """Read what `write` wrote; `InputError` if it is something else."""
        if not Path(path).is_file():
            raise InputError(f"{path} does not exist")
        try:
            table = QTable(text_lists.read(Path(path).read_bytes(), ".ecsv"))
        except InputError as error:
            raise InputError(f"{path} is no ECSV table: {error}") from None
        curves = cls(table)
        try:
            repr(curves)  # which takes all of it
        except Exception as error:
            raise InputError(f"{path} is damaged: {first_line(error)}") from error
        return curves


def _enough(levels):
    return (levels["found"] >= ENOUGH) & (levels["found"] * levels["n"] >= FEWEST)


def _variance(law, flux):
    a, b, floor = law
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(flux > 0, (a / flux) ** 2 + b**2 / flux + floor**2, np.nan)


def _fit_law(levels, sigma):
    """a, b and floor of the levels at which enough was found; the floor only where the errors determine it."""
    use = _enough(levels) & (sigma > 0)
    if np.count_nonzero(use) < 2:
        return np.full(3, np.nan)
    flux, square = np.asarray(levels["flux"], dtype=float)[use], sigma[use] ** 2
    n = (levels["found"] * levels["n"])[use]
    terms = np.column_stack([flux**-2.0, 1 / flux, np.ones(len(flux))])

    def fit(columns):
        model = square
        for _ in range(5):  # the spread of a measured variance goes with the true one: weights of the law itself
            weight = np.sqrt(n / 2) / model
            norm = (terms[:, columns] * weight[:, None]).max(axis=0)
            found = nnls(terms[:, columns] * weight[:, None] / norm, square * weight)[0] / norm
            model = terms[:, columns] @ found
        return found, float((n / 2 * (square / model - 1) ** 2).sum())

    two, chi2 = fit([0, 1])
    three, chi2_floor = fit([0, 1, 2]) if len(flux) > 3 else (two, chi2)
    return np.sqrt(three if chi2_floor < chi2 - 4 else np.append(two, 0.0))
