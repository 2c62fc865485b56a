"""The result of `solve`: positions, distortions, their errors, and everything made from them."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import InitVar, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS

from ..exceptions import InputError
from ..geometry import similarity
from ..geometry.distortion import Distortion
from ..geometry.epochs import year
from ..geometry.models import exposure_model, like, outside, to_pixels
from ..geometry.star_hull import support, supported
from ..geometry.tangent_plane import TangentPlane
from ..inputs import column_contract
from ..plots import residual_plots, solution_plots
from ..runtime.notebook import ShownAsPrinted
from . import absolute_errors, new_positions
from . import motions as star_motions
from .check import in_lines
from .detector_view import by_detector
from .diagnostics import Diagnostics
from .gauge import Gauge
from .motions import StarMotions
from .settings import Settings

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.modeling import Model
    from astropy.table import Table
    from gwcs import WCS as GWCS
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from ..cameras.camera import Camera
    from ..runtime.annotations import StrPath
    from ..solving.equations.covariances import Uncertainty
    from .check import Check


def _wrapped(key, text):
    """Lines of at most 110 characters that begin with a key."""
    return textwrap.wrap(text, 110, initial_indent=f"{key:8s}", subsequent_indent=" " * 8)


@dataclass(frozen=True, eq=False)
class Solution(ShownAsPrinted):
    """Distortion-free star positions and the distortion of every exposure.

    Made by `legdistort.solve`, read back by `Solution.read`.

    Attributes
    ----------
    names : tuple of str
        Exposures.
    degree : int
        Total degree that was fitted.
    shapes : dict
        ``{exposure: (ny, nx)}``.
    poses : dict
        ``{exposure: (2, 3)}``, reference plane -> undistorted pixels, refined.
    coefficients : ndarray, shape (n_exposures, 2, n_modes)
        Distortion A_i, pixels, normalised Legendre modes, x then y. With a prior of higher degree than the
        fit, its remaining modes follow unchanged.
    prior_mean : ndarray, same shape
        Static distortion A_0 around which the solution lies (zero without a prior).
    star_names : ndarray, shape (n_stars,)
    positions : ndarray, shape (n_stars, 2)
        X_ref, reference-plane pixels; NaN for a star without a used observation.
    observations : `~astropy.table.QTable`
        The matched table that was solved, with ``dx``, ``dy`` [pix] and ``used`` added.
    chi2 : float
        Weighted sum of squares of the used residuals.
    dof : int
        Its degrees of freedom; the directions fixed by the gauge (the null space) are counted.
    status : str
        How the minimisation ended.
    gauge : Gauge
    uncertainty : Uncertainty
        Covariances in the gauge.
    settings : Settings
        How `solve` was called.
    diagnostics : Diagnostics
        What `solve` estimated beside the unknowns.
    sky : TangentPlane or None
    left_out : dict
        ``{exposure: reason}``.
    provenance : dict
        ``created``, ``versions`` of packages and, if files went in, ``inputs`` ``{base name: SHA-256}``.
    form : `legdistort.solving.model_forms.Form` or None
        The model that was given to `solve`. Files do not keep it: of a solution that was read, `model` has the usual
        form, which is the same function.
    camera : `legdistort.Camera` or None
        Where several detectors were solved as one focal plane: positions, shapes and distortions then are those of the
        focal plane.
    checked : callable or tuple of Check
        The `checks`, or a function that makes them from the solution.
    motions : StarMotions or None
        Motions of the stars, where they were fitted.

    Parameters
    ----------
    inverses : dict, optional
        ``{exposure: Inverse}`` that were certified for these coefficients earlier; checked again where they are used.
        What `dataclasses.replace` makes finds its own.
    file_checksum : str, optional
        SHA-256 of the file that it was read from. What `dataclasses.replace` makes is another solution and has none.

    See Also
    --------
    legdistort.solve : Makes one.
    legdistort.coadd : A mosaic of the exposures of a solution.

    Examples
    --------
    >>> import legdistort as ld
    >>> solution = ld.solve(ld.simulate_matches(seed=1).matches)
    >>> solution
    <Solution: 10 exposures, 30 stars, degree 3, chi2 ... for ... degrees of freedom>
    >>> solution.stars["star", "x", "y", "x_err"].colnames
    ['star', 'x', 'y', 'x_err']
    >>> solution.correct("exp00", [[100.0, 200.0]]).shape
    (1, 2)
    >>> solution.write("solution.asdf").name
    'solution.asdf'
    >>> ld.Solution.read("solution.asdf").names == solution.names
    True
    """

    names: tuple[str, ...]
    degree: int
    shapes: dict[str, tuple[int, int]]
    poses: dict[str, np.ndarray]
    coefficients: np.ndarray
    prior_mean: np.ndarray
    star_names: np.ndarray
    positions: np.ndarray
    observations: QTable
    chi2: float
    dof: int
    status: str
    gauge: Gauge
    uncertainty: Uncertainty
    settings: Settings
    diagnostics: Diagnostics
    sky: TangentPlane | None = None
    left_out: dict[str, str] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    form: object = None
    camera: Camera | None = None
    checked: Any = field(default=(), repr=False)
    motions: StarMotions | None = None
    inverses: InitVar[dict[str, Any] | None] = None
    file_checksum: InitVar[str | None] = None

    def __post_init__(self, inverses: dict[str, Any] | None, file_checksum: str | None) -> None:
        object.__setattr__(self, "_inverses", inverses or {})
        object.__setattr__(self, "_checksum", file_checksum)

    @property
    def checksum(self) -> str | None:
        """SHA-256 of the file that it was read from, in hexadecimal digits; None if it was not."""
        return self._checksum

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """Tests of the solution with their results: a tuple of `legdistort.results.check.Check`; made at first use."""
        return self.checked(self) if callable(self.checked) else self.checked

    # -- tables

    @cached_property
    def stars(self) -> QTable:
        """One row a star: ``star``, ``x``, ``y``, errors [pix], ``n``, mean ``flux`` and the sky if known.

        ``x_err``, ``y_err`` are relative: the errors once a common map of the fitted degree is taken off.
        ``x_err_abs``, ``y_err_abs`` add that map: the mean dynamic distortion of the set and the uncertainty of the
        static one; NaN where they are not known (`Gauge.unknown`). ``x_err_known``, ``y_err_known`` are those after the
        unknown directions are taken off; infinite where nothing determines how the detectors of a camera lie.
        Pointing, rotation and scale common to all exposures are those of the nominal
        poses. These errors include them only where a reference ties them. On the sky:
        ``ra``, ``dec`` [deg, ICRS], ``ra_error`` (of ra cos(dec)), ``dec_error`` [mas], ``ra_dec_corr``,
        ``ra_error_abs``, ``dec_error_abs`` [mas], named as in the Gaia catalogue, and ``sky``, the same places as a
        `~astropy.coordinates.SkyCoord` (not in files). ``meta`` has ``frame``, ``epoch`` (a Julian year, if it is
        known), ``gauge``, ``degree``, ``prior`` and ``version``.

        Where motions were fitted, positions are those of the epoch, and there are ``vx``, ``vy`` [pix/yr], with a sky
        ``pmra`` (with cos(dec)), ``pmdec`` [mas/yr] and, if it was fitted, ``parallax`` [mas], all with relative and
        absolute errors and with correlations named alike; ``chi2``, ``n_epochs`` and ``span`` [yr]. ``sky`` then has
        the motions too. Absolute errors of motions leave out common rates of shift, rotation and scale, those of
        parallaxes the mean parallax: nothing but a reference determines these. NaN where a star is seen at one epoch
        only.
        """
        variance = absolute_errors.relative_variance(self.gauge, self.uncertainty, self.positions)
        absolute = self._absolute(False)
        table = self._places(self.positions, err=variance, err_abs=absolute, err_known=self._absolute(True))
        used = self.observations[self.observations["used"]]
        index = np.searchsorted(self.star_names, used["star"])
        table["n"] = np.bincount(index, minlength=len(table))
        if "flux" in used.colnames:
            with np.errstate(invalid="ignore"):
                table["flux"] = np.bincount(index, used["flux"], len(table)) / table["n"]
        if self.sky is not None:
            new_positions.add_sky(table, self.sky, self.positions, variance, absolute)
            table["sky"] = SkyCoord(table["ra"], table["dec"], frame="icrs", obstime=self._obstime)
        if self.motions is not None:
            star_motions.add_motions(table, self.motions, *self._unknowns, self.positions, self.sky)
            if self.sky is not None:
                table["sky"] = SkyCoord(
                    table["ra"], table["dec"], pm_ra_cosdec=table["pmra"], pm_dec=table["pmdec"], frame="icrs",
                    obstime=self._obstime,
                )  # fmt: skip
        table.meta = self._stars_meta()
        return column_contract.describe_stars(table)

    def _places(self, xy, **variances):
        """Table of the stars at positions (n_stars, 2), with errors of variances xx, yy, xy (3, n_stars) by suffix."""
        table = QTable({"star": self.star_names, "x": xy[:, 0] * u.pix, "y": xy[:, 1] * u.pix})
        for suffix, each in variances.items():
            table[f"x_{suffix}"], table[f"y_{suffix}"] = np.sqrt(each[:2]) * u.pix
        xx, yy, both = variances["err"]
        table["xy_corr"] = both / np.sqrt(xx * yy)
        return table

    @property
    def epoch(self) -> float | None:
        """Julian year of the positions, or None."""
        return self.diagnostics.epoch if self.motions is None else self.motions.epoch

    @property
    def _obstime(self):
        return None if self.epoch is None else Time(self.epoch, format="jyear")

    def _stars_meta(self):
        """What must be known of a table of stars by itself, in words and numbers that any file can hold."""
        prior = self.settings.prior
        if isinstance(prior, dict):
            prior = prior.get("source", "one for each detector or exposure")
        if isinstance(prior, dict):
            prior = prior.get("name", "")
        meta = {
            "frame": "reference plane" if self.sky is None else "ICRS",
            "epoch": self.epoch,
            "gauge": self.gauge.kind,
            "degree": self.degree,
            "prior": None if self.settings.prior is None else str(prior or "given"),
            "version": f"legdistort {self.provenance.get('versions', {}).get('legdistort', '')}".strip(),
        }
        return {key: value for key, value in meta.items() if value is not None}

    def positions_at(self, epoch: float | Time) -> np.ndarray:
        """Positions (n_stars, 2) of the stars in the reference plane at another time, pixels.

        Stars without a motion stay where they are.

        Parameters
        ----------
        epoch : float or `~astropy.time.Time`
            A Julian year.

        Raises
        ------
        InputError
            If motions were not fitted.
        """
        return self.positions + star_motions.fitted(self.motions).displacement(year(epoch), self.sky)

    def stars_at(self, epoch: float | Time) -> QTable:
        """The stars where they are at another time, with their errors then, as a table.

        Parameters
        ----------
        epoch : float or `~astropy.time.Time`
            A Julian year.

        Returns
        -------
        `~astropy.table.QTable`
            ``star``, ``x``, ``y``, ``x_err``, ``y_err``, ``x_err_abs``, ``y_err_abs`` [pix], ``xy_corr`` and, with a
            sky, ``ra``, ``dec`` [deg], their errors [mas] and correlation and ``sky``, named as in `stars`. Parallaxes
            are in the positions. Stars without a motion stay where they are, with errors that are not known.

        Raises
        ------
        InputError
            If motions were not fitted.
        """
        xy, epoch = self.positions_at(epoch), year(epoch)
        moved = [self.motions.carried(each, epoch, self.sky) for each in self._unknowns]
        moved[1][:, np.isnan(self._absolute(False)[0])] = np.nan
        table = self._places(xy, err=moved[0], err_abs=moved[1])
        if self.sky is not None:
            new_positions.add_sky(table, self.sky, xy, *moved)
            obstime = Time(epoch, format="jyear")
            table["sky"] = SkyCoord(table["ra"], table["dec"], frame="icrs", obstime=obstime)
        table.meta = self._stars_meta() | {"epoch": epoch}
        return column_contract.describe_stars(table)

    @property
    def residuals(self) -> QTable:
        """One row an observation, as given: ``exposure``, ``star``, ``dx``, ``dy`` [pix], ``used`` and more.

        A residual is the measured minus the predicted detector position.
        """
        return self.observations

    def _absolute(self, without_unknown):
        return absolute_errors.absolute_variance(
            self.gauge, self.uncertainty, self.positions, without_unknown=without_unknown
        )

    @property
    def _unknowns(self):
        """Relative and absolute covariance (n_stars, 2 + k, 2 + k) of positions, motions and parallaxes."""
        known = self.gauge, self.uncertainty, self.positions
        return absolute_errors.relative_blocks(*known), absolute_errors.absolute_blocks(*known)

    def absolute_covariance(self, *, without_unknown: bool = False) -> np.ndarray:
        """Covariance (n_stars, 2, 2) [pix^2] of every star position with the error of the common map.

        NaN where that is not known, unless the error asked for is that after the unknown directions
        (`Gauge.unknown`) are taken off.
        """
        xx, yy, xy = self._absolute(without_unknown)
        return np.stack([np.stack([xx, xy]), np.stack([xy, yy])]).transpose(2, 0, 1)

    @property
    def effective_modes(self) -> dict[str, float] | None:
        """``{exposure: number}`` of its modes, both axes together, that the data determine rather than a prior.

        The trace of the influence of the data on the coefficients. Without prior widths it is their number, less what
        the gauge fixes. None if it is not known.
        """
        return self.diagnostics.effective_modes

    # -- geometry

    def index(self, name: str) -> int:
        """Position of an exposure in `names`.

        Raises
        ------
        InputError
            If the solution has no such exposure; with the reason if it was left out.
        """
        if name not in self.names:
            why = f": it was left out ({self.left_out[name]})" if name in self.left_out else ""
            raise InputError(f"no exposure {name!r} in the solution{why}; it has {', '.join(self.names)}")
        return self.names.index(name)

    @cached_property
    def _distortions(self):
        return [
            Distortion(a, self.shapes[name], name, self._inverses.get(name))
            for name, a in zip(self.names, self.coefficients, strict=True)
        ]

    def distortion(self, name: str) -> Distortion:
        """The `Distortion` of an exposure: undistorted -> detector pixels, without the pose."""
        return self._distortions[self.index(name)]

    @cached_property
    def by_detector(self) -> Solution:
        """Of a camera, the same with every detector of every exposure, ``NAME-DETECTOR``, as an exposure of its own.

        For positions alone, without errors; a solution without a camera is returned as it is. See
        `legdistort.results.detector_view`.
        """
        return self if self.camera is None else by_detector(self)

    def _detector(self, detector):
        """The `Detector` of an id; `InputError` where there are none."""
        if self.camera is None:
            raise InputError(f"detector={detector!r}: this solution has no camera with several detectors; leave it out")
        return self.camera[detector]

    def distort(self, name: str, xy: ArrayLike, *, detector: str | None = None) -> Any:
        """Reference positions (n, 2) -> detector pixels (n, 2); NaN where the exposure does not reach.

        A quantity in pixels gives a quantity. Of a camera the pixels are those of the focal plane, or of a `detector`,
        also where that ends.
        """
        distortion = self.distortion(name)
        q = similarity.apply(self.poses[name], np.atleast_2d(to_pixels(xy)))
        p = distortion(q)
        p[outside(distortion.inverse.valid, q[:, 0], q[:, 1])] = np.nan
        return like(xy, p if detector is None else self._detector(detector).to_pixels(p))

    def correct(
        self,
        name: str,
        xy: ArrayLike,
        *,
        errors: ArrayLike | None = None,
        detector: str | None = None,
        epoch: float | Time | None = None,
        stars: Sequence[str] | None = None,
    ) -> Any:
        """Detector pixels (n, 2) -> reference positions (n, 2), exact (section 3.3, criterion J_3).

        A quantity in pixels gives a quantity. Positions are those at the time of the exposure; the motions that were
        fitted carry those of known stars to another.

        Parameters
        ----------
        name : str
        xy : array_like, shape (n, 2)
            Any pixels of the exposure.
        errors : array_like, shape (n, 2) or (n, 2, 2), optional
            Of the measurement: standard deviations per axis [pix], or covariances [pix^2]; zeros leave the errors of
            the correction alone.
        detector : str, optional
            Of a camera, to which the pixels and their errors belong; without it they are those of the focal plane.
        epoch : float or `~astropy.time.Time`, optional
            Another time, a Julian year, to which positions are carried. Stars without a motion stay where they are,
            with errors that are not known.
        stars : sequence of str, optional
            With `epoch`: to which stars of the solution the positions belong.

        Returns
        -------
        ndarray, shape (n, 2), or `legdistort.results.new_positions.Corrected`
            With `errors` ``(xy, relative, absolute)``: two covariances (n, 2, 2) [pix^2] beside the positions. They
            hold for positions that took no part in the solution; those of its stars are in `stars`. Outside the stars
            of the exposure (`supported`) the correction is extrapolated.

        Raises
        ------
        InputError
            If there is no such exposure or star, motions were not fitted, or for errors of another shape, negative ones
            or such that are not finite.
        FoldError
            If the distortion folds.
        """
        chip = None if detector is None else self._detector(detector)
        pixels = np.atleast_2d(to_pixels(xy))
        moved = new_positions.movement(self, name, stars, epoch, len(pixels))
        if errors is not None:
            return new_positions.correct_with_errors(self, name, xy, errors, detector, moved)
        pixels = pixels if chip is None else chip.to_focal_plane(pixels)
        return like(xy, new_positions.correct(self, name, pixels, moved)[0])

    def correct_table(self, table: Table, *, epoch: float | Time | None = None) -> QTable:
        """Positions measured in any exposures -> the reference plane and the sky, with their errors, as a table.

        Parameters
        ----------
        table : `~astropy.table.Table`
            Columns ``exposure``, ``x``, ``y``, ``x_err``, ``y_err`` [pix] and perhaps ``xy_corr``, of positions that
            took no part in the solution; with `epoch` ``star`` too, a star of the solution.
        epoch : float or `~astropy.time.Time`, optional
            A Julian year, to which the motions that were fitted carry all positions; it is then in the ``meta`` too.

        Returns
        -------
        `~astropy.table.QTable`
            Row by row, with columns that are named as in `stars`: ``x``, ``y``, their errors relative and absolute, and
            if the sky is known ``ra``, ``dec``, ``ra_error``, ``dec_error`` [mas], ``ra_dec_corr``, ``ra_error_abs``,
            ``dec_error_abs``; and the other columns of the table.

        Raises
        ------
        InputError
            For a table that lacks columns or has bad values, or names an exposure or, with `epoch`, a star that the
            solution does not have; with `epoch` if motions were not fitted.

        Warns
        -----
        AssumptionWarning
            Of positions off their detector, where the correction is extrapolated.
        """
        return new_positions.correct_table(self, table, epoch)

    def model(self, name: str) -> Model:
        """Reference plane -> detector pixels as an astropy compound model with inverse."""
        distortion = self.distortion(name)
        return exposure_model(self.poses[name], distortion, self.form)

    def wcs(self, name: str, detector: str | None = None) -> GWCS:
        """The gwcs of an exposure: detector -> undistorted -> reference -> icrs (the last if the sky is known).

        That of a `detector` of a camera: detector -> undistorted -> focal_plane -> reference -> icrs.
        """
        from ..wcs.exposure_wcs import exposure_wcs

        distortion = self.distortion(name)
        chip = None if detector is None else self._detector(detector)
        return exposure_wcs(name, self.poses[name], distortion, self.sky, chip)

    def header(self, name: str, *, kind: str = "sip", max_error: float = 1e-3) -> Header:
        """FITS header of an exposure, TAN-SIP or TPV, with its error in it (`legdistort.wcs.fits_headers`)."""
        from ..wcs.fits_headers import make_header

        distortion = self.distortion(name)
        return make_header(self.poses[name], distortion, self.sky, kind=kind, max_error=max_error)

    def fits_wcs(self, name: str, *, max_error: float = 1e-3) -> WCS:
        """The nearest `astropy.wcs.WCS` of an exposure, TAN-SIP, for what takes no other (`CCDData`, `Cutout2D`).

        Parameters
        ----------
        name : str
        max_error : float
            Largest error allowed over the whole detector, pixels.

        Raises
        ------
        ExportError
            If no SIP polynomial is that close, naming the best.
        InputError
            If the sky is not known.
        """
        wcs = WCS(self.header(name, max_error=max_error))
        wcs.array_shape = self.shapes[name]
        return wcs

    def orientation(self, name: str) -> tuple[float, float]:
        """Position angle of an exposure's y axis [deg, north through east] and pixel scale [arcsec], at its centre.

        Those of its pose: without the distortion, whose linear part stays out.

        Raises
        ------
        InputError
            If the sky is not known.
        """
        self.index(name)
        if self.sky is None:
            raise InputError("no position angle: where the exposures lie on the sky is not known")
        return self.sky.orientation(self.poses[name], self.shapes[name])

    @property
    def max_inverse_error(self) -> float:
        """Largest certified round-trip error over all exposures, pixels."""
        return max(distortion.inverse.error for distortion in self._distortions)

    # -- errors

    def coefficient_errors(self, name: str, *, relative: bool = False) -> np.ndarray:
        """Standard deviations (2, n_modes) of the fitted coefficients of an exposure, pixels.

        With the error of the common map, and NaN for what changes with an unknown direction (`Gauge.unknown`); or
        `relative` ones, under the convention of the gauge.
        """
        block = self.coefficient_covariance(name, relative=relative)
        if relative or self.gauge.plane is not None:
            return np.sqrt(np.diag(block)).reshape(2, -1)
        return np.sqrt(absolute_errors.coefficient_variance(self.gauge, block, self.index(name)))

    def coefficient_covariance(self, name: str, *, relative: bool = False) -> np.ndarray:
        """Covariance (2 n_modes, 2 n_modes) of the fitted coefficients of an exposure, px^2; x first.

        With the errors of a camera that was fitted. Under the constraints of the gauge; or `relative`, under its
        convention alone (`Gauge.convention`).
        """
        known, camera = (self.gauge, self.uncertainty, self.index(name)), self.uncertainty.camera
        block = (absolute_errors.relative_coefficients if relative else absolute_errors.own_coefficients)(*known)
        return block if camera is None else block + camera.of_coefficients(self.index(name))

    def sigma_map(
        self, name: str, *, n: int = 64, support: bool = True, absolute: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Error of the distortion correction over a detector (paper's Figure "ergrid", noise of the position excluded).

        Parameters
        ----------
        name : str
        n : int
            Points along the longer side.
        support : bool
            NaN outside the convex hull of the stars used in this exposure, where the correction is extrapolated.
        absolute : bool
            With the error of the common map, NaN where that is not known (`Gauge.unknown`); else relative.

        Returns
        -------
        x, y : ndarray, shape (n_x,), (n_y,)
            Pixels.
        sigma : ndarray, shape (n_y, n_x, 2)
            Standard deviation of the corrected position per axis, reference-plane pixels.
        """
        distortion = self.distortion(name)
        ny, nx = self.shapes[name]
        step = max(nx, ny) / n
        x = np.linspace(-0.5, nx - 0.5, max(2, round(nx / step)))
        y = np.linspace(-0.5, ny - 0.5, max(2, round(ny / step)))
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        q = distortion.invert(grid)
        if absolute:
            covariance = new_positions.covariances(self, name, q, np.zeros((len(q), 2, 2)))[1]
        else:
            covariance = new_positions.relative_errors(self, name, q)
        variance = np.einsum("naa->na", covariance)
        sigma = np.sqrt(np.maximum(variance, 0)).reshape(len(y), len(x), 2)
        if support:
            sigma[~self.supported(name, grid).reshape(len(y), len(x))] = np.nan
        return x, y, sigma

    def supported(self, name: str, xy: ArrayLike) -> np.ndarray:
        """Whether detector positions (n, 2) lie inside the convex hull of the stars used in an exposure."""
        return supported(support(name, self), np.asarray(xy, dtype=float).T)

    # -- pictures

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Map of the mean residuals of all exposures, see `legdistort.plots.residual_plots.plot_mean_residuals`.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw.

        Returns
        -------
        `~matplotlib.axes.Axes`
        """
        return residual_plots.plot_mean_residuals(self, ax=ax)

    def plot_residuals(self, name: str | None = None, *, ax: Axes | None = None) -> Axes:
        """Arrows of the residuals of an exposure, or of all, see `legdistort.plots.solution_plots.plot_residuals`.

        Parameters
        ----------
        name : str, optional
            Exposure; by default all are drawn over each other.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw.

        Returns
        -------
        `~matplotlib.axes.Axes`

        Raises
        ------
        InputError
            If the exposure is unknown or none of its positions was used.
        """
        return solution_plots.plot_residuals(self, name, ax=ax)

    def plot_error_map(self, name: str, *, absolute: bool = False, ax: Axes | None = None) -> Axes:
        """Map of the error of the correction over an exposure, see `sigma_map`.

        Parameters
        ----------
        name : str
            Exposure.
        absolute : bool
            With the error of the common map.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw.

        Returns
        -------
        `~matplotlib.axes.Axes`

        Raises
        ------
        InputError
            If there is no such exposure.
        FoldError
            If its distortion folds.
        """
        self.index(name)
        return solution_plots.plot_sigma_map(*self.sigma_map(name, absolute=absolute), ax=ax)

    # -- words

    @property
    def rms(self) -> np.ndarray:
        """Unweighted rms residual (2,) per axis of the used observations, pixels."""
        used = self.observations["used"]
        return np.array([np.sqrt(np.mean(self.observations[d][used].to_value(u.pix) ** 2)) for d in ("dx", "dy")])

    @property
    def sky_sentence(self) -> str:
        """Where the reference plane lies on the sky, and how that is known."""
        if self.sky is None:
            return "not known: no WCS in the headers that proved right, no reference catalogue with ra, dec"
        source = {"exposures": "from the headers", "reference": "from the reference"}.get(self.diagnostics.sky, "")
        tied = ", tied to the reference" if source and self.gauge.tie is not None and "head" in source else ""
        words = f"tangent point {self.sky.lon:.6f} {self.sky.lat:+.6f} deg, {self.sky.pixel_scale:.5g} arcsec/px"
        return f"{words}{', ' * bool(source)}{source}{tied}"

    def __repr__(self) -> str:
        lost = np.count_nonzero(np.isnan(self.positions[:, 0]))
        stars = f"{len(self.star_names)} stars{f' ({lost} without a position)' if lost else ''}"
        return (
            f"<Solution: {len(self.names)} exposures, {stars}, degree {self.degree}, "
            f"chi2 {self.chi2:.1f} for {self.dof} degrees of freedom>"
        )

    def _camera_in_words(self):
        if self.camera is None:
            return []
        return _wrapped("camera", self.camera_sentence)

    @property
    def camera_sentence(self) -> str:
        """Which camera it is, and what of it the exposures do not determine; empty without one."""
        if self.camera is None:
            return ""
        ny, nx = self.camera.field
        ids = ", ".join(self.camera.detectors)
        words = f"{self.camera.name}, detectors {ids}; positions in its focal plane, {nx} x {ny} px"
        groups = self.camera.groups(self.observations[self.observations["used"]])
        if len(groups) > 1:
            words += f"; no star in common: {' | '.join(', '.join(group) for group in groups)}"
            held = any(
                np.isinf(each.place.errors).any() for each in self.camera.detectors.values() if each.place.errors
            )
            words += ", so that their places relative to each other are not determined" * held
        common = self.camera.common_sigma
        if common is not None and np.isinf(common[:, 1:3]).any() and "shear" in self.gauge.unknown_names:
            words += (
                "; a shear of all detectors together is not determined: the exposures are not turned enough against "
                "one another"
            )
        return words

    def _static_in_words(self):
        if self.settings.static != "fit" or self.camera is not None:
            return []
        own = self.settings.exposure_degree
        mine = f"modes up to degree {own}" if own else "its pose alone"
        return [f"static  fitted: one distortion for all exposures of a detector, {mine} for every exposure"]

    def _orientation_in_words(self, name=None):
        """Columns of an exposure in the printed table, or their heads; empty without a sky."""
        if self.sky is None:
            return ""
        if name is None:
            return f" {'PA [deg]':>9s} {'arcsec/px':>9s}"
        angle, scale = self.orientation(name)
        return f" {angle:9.4f} {scale:9.6f}"

    def __str__(self) -> str:
        used = self.observations["used"]
        lines = [
            repr(self)[1:-1],
            *in_lines(self.checks),
            f"status  {self.status}",
            *self._camera_in_words(),
            *self._static_in_words(),
            *_wrapped("gauge", self.gauge.sentence),
            f"sky     {self.sky_sentence}",
            *(_wrapped("stars", self.motions.sentence) if self.motions is not None else []),
            f"rms     {self.rms[0]:.4f}, {self.rms[1]:.4f} px in x, y; "
            f"{np.count_nonzero(used)} of {len(used)} observations used",
            *(line for key, text in self.diagnostics.in_words().items() for line in _wrapped(key, text)),
            "",
            f"{'exposure':24s} {'stars':>5s} {'shift x':>9s} {'shift y':>9s} {'rotation':>9s} {'scale':>9s} "
            f"{'rms x':>7s} {'rms y':>7s} {'distortion':>10s}{self._orientation_in_words()}",
        ]
        for name, a in zip(self.names, self.coefficients, strict=True):
            rows = self.observations[used & (self.observations["exposure"] == name)]
            d = similarity.describe(self.poses[name])
            rms = [np.sqrt(np.mean(rows[k].to_value(u.pix) ** 2)) if len(rows) else np.nan for k in ("dx", "dy")]
            lines.append(
                f"{name[:24]:24s} {len(rows):5d} {d['dx']:9.2f} {d['dy']:9.2f} {d['rotation']:9.4f} {d['scale']:9.6f} "
                f"{rms[0]:7.4f} {rms[1]:7.4f} {np.sqrt((a**2).sum()) / 2:10.3f}{self._orientation_in_words(name)}"
            )
        if self.camera is not None:
            lines += ["", *self.camera.table_lines()]
        lines += [f"left out {name}: {reason}" for name, reason in self.left_out.items()]
        return "\n".join(lines)

    # -- files

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write everything to an ASDF file (`legdistort.results.storage`)."""
        from .storage import write_solution

        return write_solution(self, path, overwrite=overwrite)

    @classmethod
    def read(cls, path: StrPath, *, max_bytes: int | None = None) -> Solution:
        """Read what `write` wrote; the certificate of every inverse is checked again.

        Parameters
        ----------
        path : str or path
            The file, or a folder of results with a ``solution.asdf``.
        max_bytes : int, optional
            Largest size of the arrays in the file, unpacked; 2 GiB if not given.

        Raises
        ------
        InputError
            For a file that is damaged, too large, no solution, or was changed after it was written.
        """
        from .storage import read_solution

        return read_solution(path, cls, max_bytes=max_bytes)
