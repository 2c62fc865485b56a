"""What a set of observations will give, before it is made: the two criteria of the paper from the Fisher matrix alone.

Positions without noise, the normal equations there, the gauge and the covariances as `legdistort.solve` reports them;
no simulation (Bernard et al. 2017, section 4, measures the same by Monte Carlo).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import Table

from ..exceptions import LegdistortError
from ..geometry import basis
from ..matching.matches import alone
from ..results import accuracy
from ..results.errors.absolute_errors import absolute_blocks, relative_blocks
from ..results.solution import Solution
from ..runtime.checks import check_positive
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted, text_of
from ..solving import star_motions
from ..solving.equations.problem import build_problem
from ..solving.options import SolveOptions
from . import magnitudes
from .aliasing import alias, assumed_spectra
from .noiseless_solution import noiseless_solution
from .plan import Plan, lay_out
from .prediction_text import decimals, finite_rms, parts, unit_of

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from ..cameras.camera import Camera
    from ..priors.prior import Prior
    from ..runtime.annotations import Shape
    from ..solving.terms.term import RandomField, Term
    from .instruments.instrument import Instrument


@dataclass(frozen=True, eq=False)
class Prediction(ShownAsPrinted):
    """Expected errors of a planned set of exposures, made by `predict`.

    All are rms per axis in pixels; the paper's equations, which sum both axes, give sqrt(2) times as much.

    Attributes
    ----------
    solution : Solution
        As the solution would be without noise: star positions with their expected errors (``solution.stars``),
        covariances, gauge, ``solution[name].sigma_map()``.
    sigma_meas : float
        Error of one measured position: rms over all, and that of new positions.
    b : float
        Expected error of the reference positions, the plane held by the convention of the gauge (paper, section 3.4).
        ``solution.stars`` has the errors ``x_err`` that are left once a common map is taken off.
    b_abs : float
        With the common map: mean dynamic distortion of the set, uncertainty of the static one; pointing, rotation and
        scale of the field aside, and what is unknown (``solution.gauge.unknown``: without a prior, shears at least).
        NaN where nothing was assumed of the dynamic distortion.
    sigma : float
        Expected scatter of new corrected positions inside the contour of the stars, a square that holds most of them.
    sigma_field : float
        The same over the whole field (wherever two exposures see it).
    b_alias, sigma_alias : float
        Errors beside these from distortions of higher degree than is fitted, if a spectrum was given (else 0).
    x, y : ndarray, shape (n_x,), (n_y,)
        Reference-plane pixels of the maps.
    error_map, alias_map : ndarray, shape (n_y, n_x)
        Scatter sigma_j' over the field (the paper's Figure "ergrid"), NaN where fewer than two exposures see it; and
        that from aliasing.
    correction_map : ndarray, shape (n_y, n_x)
        The part of the scatter that the correction has, whatever the error of a new position, aliasing aside.
    contour : ndarray, shape (2, 2)
        Lower and upper corner of the square.
    folded : ndarray, shape (2, n_modes)
        Rms error of the fitted coefficients from aliasing: where the energy of the modes left out goes.
    spectrum : ndarray, shape (2, n_modes)
        Scatter of the distortion from exposure to exposure that was assumed, NaN where it is unknown.
    settings : Plan
        What was asked for, the stars that were drawn in it.
    """

    solution: Solution
    sigma_meas: float
    b: float
    b_abs: float
    sigma: float
    sigma_field: float
    b_alias: float
    sigma_alias: float
    x: np.ndarray
    y: np.ndarray
    error_map: np.ndarray
    alias_map: np.ndarray
    correction_map: np.ndarray
    contour: np.ndarray
    folded: np.ndarray
    spectrum: np.ndarray
    settings: Plan

    @property
    def degree(self) -> int:
        """Total degree that is fitted."""
        return self.solution.degree

    @property
    def n_exposures(self) -> int:
        """Number of exposures."""
        return len(self.solution.names)

    @property
    def n_stars(self) -> int:
        """Number of stars that serve."""
        return len(self.solution.estimate.star_names)

    @property
    def stars_per_exposure(self) -> np.ndarray:
        """Stars on every exposure, shape (n_exposures,)."""
        table = self.solution.residuals
        return np.array([np.count_nonzero(table["exposure"] == name) for name in self.solution.names])

    @property
    def s_b(self) -> float:
        """Slope of the noise propagation on reference positions, b / sigma_meas (paper, section 4.2)."""
        return self.b / self.sigma_meas

    @property
    def s_sigma(self) -> float:
        """Slope of the noise propagation on corrected positions, sigma / sigma_meas (paper, section 4.2)."""
        return self.sigma / self.sigma_meas

    @property
    def sigma_correction(self) -> float:
        """The part of `sigma` that the correction has, whatever the error of a new position."""
        grid = np.stack(np.meshgrid(self.x, self.y), axis=-1).reshape(-1, 2)
        return finite_rms(self.correction_map.ravel()[accuracy.in_contour(grid, self.contour)])

    @property
    def b_total(self) -> float:
        """Noise and aliasing together, relative."""
        return float(np.hypot(self.b, self.b_alias))

    @property
    def sigma_total(self) -> float:
        """Noise and aliasing together, inside the contour."""
        return float(np.hypot(self.sigma, self.sigma_alias))

    @property
    def thumb(self) -> tuple[float, float]:
        """Rules of thumb for s_b and s_sigma: 1/sqrt(n_im) and sqrt((1 - 1/n_im)(1 + n_modes/n_star)).

        With the mean number of exposures of a star for n_im, and that of stars on an exposure for n_star.
        """
        n = len(self.solution.residuals)
        n_im, n_star = n / self.n_stars, n / self.n_exposures
        return n_im**-0.5, float(np.sqrt((1 - 1 / n_im) * (1 + basis.n_modes(self.degree) / n_star)))

    @property
    def motion_errors(self) -> dict[str, float]:
        """Expected errors of proper motions [pix/yr per axis] and parallaxes [pix], rms over the stars.

        ``{"motion" | "parallax": error}``, relative, and with ``_abs`` at the end of the name absolute: with the common
        map that changes with time, by departures of the exposures. What all stars move by, and rates of rotation and
        scale, are aside; NaN where `b_abs` is not known. Empty without epochs. ``solution.stars`` has them star by
        star.
        """
        estimate, out = self.solution.estimate, {}
        if estimate.motions is None:
            return out
        known = self.solution.gauge, estimate.uncertainty, estimate.positions
        variances = {"": relative_blocks(*known)}
        variances["_abs"] = absolute_blocks(*known) if np.isfinite(self.b_abs) else np.full_like(variances[""], np.nan)
        names = {"motion": slice(2, 4)} | ({"parallax": slice(4, 5)} if variances[""].shape[1] > 4 else {})
        for name, which in names.items():
            for suffix, blocks in variances.items():
                out[name + suffix] = finite_rms(np.sqrt(np.einsum("jkk->kj", blocks)[which]))
        return out

    def summary(self) -> dict[str, float]:
        """All figures as a dict of numbers."""
        counts = {"n_exposures": self.n_exposures, "n_stars": self.n_stars, "degree": self.degree}
        names = [f.name for f in fields(self) if f.type == "float"] + ["b_total", "sigma_total", "s_b", "s_sigma"]
        thumb = dict(zip(("thumb_b", "thumb_sigma"), self.thumb, strict=True))
        moving = {f"{name}_error": error for name, error in self.motion_errors.items()}
        return counts | {name: getattr(self, name) for name in names} | moving | thumb

    def plot(self, *, ax: Axes | None = None) -> Axes:
        """Map of the expected scatter of new positions, aliasing included, with stars and contour; returns the axes.

        The paper's Figure "ergrid". With an instrument new positions have no error that is common to all, and the
        part is shown that the correction has. Of more than 300 stars none are drawn.
        """
        from ..plots import elements, solution_plots

        stars, (unit, scale) = self.solution.estimate.positions, unit_of(self)
        shown, what = (
            (self.correction_map, "Error of the correction")
            if self.settings.instrument
            else (self.error_map, "Expected scatter")
        )
        total = scale * np.hypot(shown, self.alias_map)
        ax = solution_plots.plot_sigma_map(
            self.x, self.y, total, stars=stars if len(stars) <= 300 else None, unit=unit, ax=ax
        )
        (x0, y0), (x1, y1) = self.contour
        ax.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=elements.RED, linewidth=1.8)
        elements.set_title(ax, f"{what}: {self.n_exposures} exposures, {self.n_stars} stars, degree {self.degree}")
        return ax

    def by_magnitude(self, step: float = 1.0) -> QTable:
        """Median errors in bins of magnitudes, where the stars have magnitudes.

        Parameters
        ----------
        step : float
            Width of a bin.

        Returns
        -------
        `~astropy.table.QTable`
            ``mag`` (middle), ``n`` stars, ``error`` of a position in one exposure and ``joint_error`` of a star in the
            solution, relative, per axis: mas, or pixels where the scale is not known.

        Raises
        ------
        InputError
            If the stars have no magnitudes.
        """
        check_positive(step, "step", "number of magnitudes")
        return magnitudes.by_magnitude(self, step)

    def plot_errors(self, *, ax: Axes | None = None) -> Axes:
        """Error of a position against magnitude, in one exposure and joint (`by_magnitude`); returns the axes."""
        from ..plots import planning_plots

        instrument = self.settings.instrument
        return planning_plots.plot_errors(
            magnitudes.star_errors(self), self.by_magnitude(0.5),
            limits=None if instrument is None else instrument.limits,
            title=f"{'' if instrument is None else instrument.name + ': '}{self.n_exposures} exposures, "
            f"{self.n_stars} stars, degree {self.degree}",
            ax=ax,
        )  # fmt: skip

    def alternatives(self) -> Table:
        """The same stars with half and twice the exposures, and fitted one degree lower and higher, as a table.

        The distortion assumed stays the same: what a lower degree leaves out is counted as aliasing. Exposures
        are only varied where their offsets and errors do not name single ones.

        Returns
        -------
        `~astropy.table.Table`
            One row a plan, this one first; ``meta["failed"]`` names those that cannot be solved, with the reason.
        """
        n, settings = self.n_exposures, self.settings
        changes = [{"degree": d} for d in (self.degree - 1, self.degree + 1) if 0 <= d <= basis.MAX_DEGREE]
        if (
            settings.poses is None
            and settings.epochs is None
            and settings.tan_z is None
            and np.ndim(settings.dithers) == 0
            and np.ndim(settings.sigma) < 2
        ):
            least = settings.least / n  # the same part of them, for the same stars
            some = [m for m in (n // 2, 2 * n) if m > 1]
            changes += [{"n_exposures": m, "min_exposures": max(min(2, m), round(least * m))} for m in some]
        rows, failed = [self.summary()], {}
        for change in changes:
            try:
                rows.append(_predict(replace(settings, **change)).summary())
            except LegdistortError as error:
                failed["{} {}".format(*next(iter(change.items())))] = str(error)
        table = Table(rows)
        table.meta |= {"failed": failed, "pixel_scale": settings.pixel_scale}
        for name in table.colnames:
            if table[name].dtype.kind == "f":
                slope = name.startswith(("s_", "thumb_"))
                table[name].info.format = ".3f" if slope else f".{decimals(self)}f"
        return table

    def __repr__(self) -> str:
        return (
            f"<Prediction: {self.n_exposures} exposures, {self.n_stars} stars, degree {self.degree}, "
            f"b {self.b:.4f} px, sigma {self.sigma:.4f} px>"
        )

    def __str__(self) -> str:
        return text_of(self._parts())

    def _parts(self):
        return parts(self)


@plain_numbers
def predict(
    *,
    n_exposures: int,
    stars: ArrayLike | Table | None = None,
    n_stars: int | None = None,
    density: float | None = None,
    sigma: ArrayLike | Callable[..., Any] | None = None,
    degree: int = 3,
    shape: Shape | None = None,
    camera: Camera | None = None,
    dithers: ArrayLike = 0.0,
    poses: Mapping[str, ArrayLike] | None = None,
    prior: Prior | None = None,
    dynamic: ArrayLike | None = None,
    spectrum: Mapping[int, float] | ArrayLike | None = None,
    static_spectrum: Mapping[int, float] | ArrayLike | None = None,
    min_exposures: int | None = None,
    epochs: ArrayLike | None = None,
    field: SkyCoord | None = None,
    pixel_scale: float | None = None,
    terms: Term | RandomField | Iterable[Term | RandomField] = (),
    tan_z: ArrayLike | None = None,
    parallactic_angle: ArrayLike | None = None,
    instrument: Instrument | None = None,
    n_grid: int = 50,
    seed: int = 0,
) -> Prediction:
    """Expected errors of a planned set of exposures, from its Fisher matrix.

    Parameters
    ----------
    n_exposures : int
        Two or more.
    stars : array_like, shape (n, 2), or Table, optional
        Positions in the reference plane, pixels; of a table the columns ``x``, ``y``. One of `stars`, `n_stars` and
        `density` is needed.
    n_stars : int, optional
        So many are drawn, evenly over the field. With the same seed they are those of `simulate_matches`.
    density : float, optional
        The same as stars per detector, of a camera the mean of its detectors.
    sigma : float, array_like or callable
        Error of one measured position per axis, pixels: a number, or broadcast to (n_exposures, n_stars), so that
        (n_stars,) is per star and (n_exposures, 1) per exposure; or a function of the column ``flux`` of `stars`.
        By default the columns ``x_err``, ``y_err`` of `stars`.
    degree : int
        Total degree that will be fitted.
    shape : tuple of int, optional
        ``(ny, nx)`` of the detector, by default (2048, 2048).
    camera : `legdistort.Camera`, optional
        Its detectors take the place of one: stars, dithers and what is expected are in pixels of its focal plane, whose
        distortion is fitted; `sigma` in those of the detectors. Layout and static distortions count as known.
    dithers : float or array_like, shape (n_exposures, 2)
        Shifts of the exposures in pixels, or their rms length, to be drawn evenly in a square.
    poses : dict, optional
        Instead of dithers, ``{exposure: (2, 3)}``, reference plane -> undistorted pixels, as for rolls.
    prior : Prior, optional
        Static distortion; with widths the exposures may have fewer stars than modes.
    dynamic : float or array_like, optional
        Scatter of the fitted coefficients from exposure to exposure, pixels: one, per mode (n_modes,) or
        (2, n_modes). It gives the absolute error. Not with a prior that has widths, which mean the same.
    spectrum : dict or array_like, optional
        The same with degrees beyond the fitted one, whose aliasing it predicts: ``{degree: pixels}``, the standard
        deviation of each coefficient of a degree, or per mode. Without a fitted degree in it, `dynamic` may be added.
    static_spectrum : dict or array_like, optional
        The same for a distortion common to all exposures that the prior does not contain; only modes beyond the fitted
        degree count (for the others see ``static_sigma`` of `Prior`).
    min_exposures : int, optional
        Stars on fewer exposures are left out; default 4, or all if there are fewer.
    epochs : array_like, shape (n_exposures,), optional
        Years of the exposures: proper motions are fitted too.
    field : `~astropy.coordinates.SkyCoord`, optional
        Where it lies: parallaxes are fitted too.
    pixel_scale : float, optional
        Arcsec: lengths may be given as angles then (``0.4 * u.mas``), and errors are angles where they are printed or
        drawn. Attributes stay in pixels.
    terms : Term, or a list of them, optional
        What displaces stars beside the distortion and will be found with it, as `legdistort.solve` takes them, but with
        their sizes: ``Term.named("pixel_phase", sigma=0.03)``, ``Term.named("turbulence", size=0.1, length=200)``.
        Turbulence stands in the place of `dynamic` where that is not given: the mean distortion of the exposures then
        is as large as such fields make it. Columns that a term needs (`Term.needs`) are those of `stars`.
    tan_z, parallactic_angle : array_like, shape (n_exposures,), optional
        Tangent of the zenith distance, and degrees, of the exposures, which "refraction" needs.
    instrument : Instrument, optional
        In the place of `sigma`, `camera`, `shape` and `pixel_scale`: errors come from magnitudes, and stars that are
        too bright or too faint are not measured. `stars` then is a table with ``x``, ``y``, ``mag``, or a luminosity
        function to draw them from, evenly over the field: ``mag`` and ``density``, stars a magnitude and square arcmin
        (or arcsec, by its unit), linear in between.
    n_grid : int
        Points of the maps along the longer side.
    seed : int
        Of what is drawn.

    Returns
    -------
    Prediction

    Raises
    ------
    InputError
        For arguments out of range or in contradiction.
    SolveError
        Naming the exposure with fewer stars than modes, as `solve` would; for terms of more numbers than can be found.

    See Also
    --------
    legdistort.Instrument : Errors from magnitudes.
    legdistort.simulate_matches : Draw such observations.
    legdistort.solve : Solve them.

    Notes
    -----
    Up to 8000 coefficients (400 exposures at degree 3), and with few stars, their full covariance is used; else one
    block an exposure.
    With more than 4000 stars as well, it is approximated, and an `AssumptionWarning` gives the factor.

    Examples
    --------
    >>> import legdistort as ld
    >>> plan = ld.predict(n_exposures=11, n_stars=80, sigma=0.02, dynamic=0.3)
    >>> plan.n_stars, plan.degree
    (80, 3)
    """
    plan = Plan(
        n_exposures=n_exposures, stars=stars, n_stars=n_stars, density=density, sigma=sigma, degree=degree,
        shape=shape, dithers=dithers, poses=poses, prior=prior, dynamic=dynamic, spectrum=spectrum,
        static_spectrum=static_spectrum, min_exposures=min_exposures, n_grid=n_grid, seed=seed,
        epochs=epochs, field=field, camera=camera, pixel_scale=pixel_scale, terms=terms, tan_z=tan_z,
        parallactic_angle=parallactic_angle, instrument=instrument,
    )  # fmt: skip
    return _predict(plan)


def _predict(plan):
    """The `Prediction` of a `Plan`."""
    independent, common = assumed_spectra(plan)
    layout = lay_out(plan)
    matches = layout.matches(np.zeros((2, 1)) if plan.prior is None or plan.prior.mean is None else plan.prior.mean)
    if len(matches.names) == 1:
        raise alone(*matches.names)
    if plan.motion is not None:
        star_motions.check_epochs(matches, plan.motion)
    motion = star_motions.terms_of(SolveOptions(motion=plan.motion))
    problem = build_problem(matches, plan.degree, prior=plan.prior, motion=motion)
    fitted = independent[:, : problem.n_modes]
    known = bool(np.isfinite(fitted).all())
    solution, state, held, errors = noiseless_solution(matches, problem, layout, fitted if known else None)
    known |= plan.has_fields
    x, y = layout.axes(plan.n_grid)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    noise = accuracy.expected_scatter(solution, grid, layout.sigma, covariance=errors)
    aliased, folded, b_alias = np.where(np.isfinite(noise), 0.0, np.nan), np.zeros_like(fitted), 0.0
    if max(independent.shape[1], common.shape[1]) > problem.n_modes:
        aliasing = alias(
            problem,
            state,
            solution.gauge,
            held.coefficients,
            independent=independent,
            common=common,
        )
        aliased = accuracy.expected_scatter(solution, grid, 0.0, covariance=aliasing.covariance)
        folded, b_alias = aliasing.folded, float(np.sqrt(np.mean(aliasing.stars)))
    square = accuracy.contour(solution.estimate.positions)
    inside = accuracy.in_contour(grid, square)
    drawn = {"stars": layout.stars, "n_stars": None, "density": None} if plan.stars is None or plan.has_counts else {}
    return Prediction(
        solution=solution,
        sigma_meas=layout.sigma,
        b=finite_rms(np.sqrt(held.stars[:2])),
        b_abs=accuracy.expected_bias(solution, absolute=True) if known or solution.gauge.prior else np.nan,
        sigma=finite_rms(noise[inside]),
        sigma_field=finite_rms(noise),
        b_alias=b_alias,
        sigma_alias=finite_rms(aliased[inside]),
        x=x,
        y=y,
        error_map=noise.reshape(len(y), len(x)),
        alias_map=aliased.reshape(len(y), len(x)),
        correction_map=accuracy.expected_scatter(solution, grid, 0.0, covariance=errors).reshape(len(y), len(x)),
        contour=square,
        folded=folded,
        spectrum=independent,
        settings=replace(plan, **drawn, spectrum=independent, dynamic=None),
    )
