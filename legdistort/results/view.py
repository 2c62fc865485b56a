"""One exposure of a solution, or one detector of it: its pixels, the reference plane and the sky."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.wcs import WCS

from ..exceptions import FoldError, InputError, some_of
from ..geometry import similarity, star_hull
from ..geometry.distortion import Distortion
from ..geometry.models import exposure_model, like, outside, to_pixels
from ..inputs.detector_files import label_of
from ..inputs.exposure_names import detector_name, folder_mark, marked, whole_name
from ..plots import solution_plots
from ..runtime.checks import check_counts
from ..runtime.notebook import ShownAsPrinted
from . import detector_view, new_positions
from .errors import absolute_errors

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.modeling import Model
    from astropy.table import QTable
    from astropy.time import Time
    from gwcs import WCS as GWCS
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from ..cameras.detector import Detector
    from .detector_view import OnDetector
    from .solution import Solution

#: Names that a message lists.
_MOST_NAMED = 6


@dataclass(frozen=True, repr=False)
class View(ShownAsPrinted):
    """One exposure of a solution, or one detector of it.

    ``solution["exp00"]`` and, of a camera with several detectors, ``solution["exp00", "2"]``. Without such a camera an
    exposure has one detector, whose pixels are meant everywhere. With one the view of an exposure has what its
    detectors have in common, the pose and the distortion of the focal plane, and whatever needs pixels asks for a
    detector; the view of a detector has the pixels of that, and its `pose` and `coefficients` are those of focal plane,
    layout and static distortion together.

    Attributes
    ----------
    solution : Solution
    name : str
        Exposure.
    detector : str or None
        Id of the detector; None for all that the exposure has in common.

    See Also
    --------
    legdistort.Solution : Where views come from.
    legdistort.refine : The distortion of a view in the WCS of a pipeline.

    Examples
    --------
    >>> import legdistort as ld
    >>> solution = ld.solve(ld.simulate_matches(seed=1).matches)
    >>> view = solution["exp00"]
    >>> view
    <View of exp00: 30 stars, degree 3, 2048 x 2048 px>
    >>> view.correct([[100.0, 200.0]]).shape
    (1, 2)
    >>> x, y = view.distort(*view.correct(100.0, 200.0))
    >>> bool(abs(x - 100) < 1e-6 and abs(y - 200) < 1e-6)
    True
    >>> [each.name for each in solution][:2]
    ['exp00', 'exp01']
    """

    solution: Solution
    name: str
    detector: str | None = None

    # -- what it is of

    @property
    def index(self) -> int:
        """Position of the exposure among the names of the solution."""
        return self.solution.names.index(self.name)

    @property
    def detectors(self) -> tuple[str, ...]:
        """Ids of the detectors: all of the exposure, or the one that this view is of."""
        if self.detector is not None:
            return (self.detector,)
        table, camera = self.solution.residuals, self.solution.camera
        if camera.has_focal_plane or "detector" not in table.colnames:
            return tuple(camera.detectors)
        return tuple(dict.fromkeys(np.asarray(self.residuals["detector"]).astype(str).tolist()))

    @property
    def label(self) -> str:
        """Name as files have it: that of the exposure, ``NAME-DETECTOR`` for a detector of a focal plane."""
        return self.name if self.chip is None else detector_name(self.name, self.detector)

    @property
    def parts(self) -> tuple[View, ...]:
        """Views whose pixels are those of images: this one, or those of all detectors of a focal plane."""
        if self.chip is not None or not self.solution.camera.has_focal_plane:
            return (self,)
        return tuple(View(self.solution, self.name, key) for key in self.detectors)

    @property
    def chip(self) -> Detector | None:
        """The `Detector`, if this view is of one in a focal plane; else None."""
        camera = self.solution.camera
        return camera[self.detector] if camera.has_focal_plane and self.detector is not None else None

    @cached_property
    def fold(self) -> str:
        """Why its map cannot be inverted, which a WCS needs; empty if it can.

        Examples
        --------
        >>> import legdistort as ld
        >>> ld.solve(ld.simulate_matches(seed=1).matches)["exp00"].fold
        ''
        """
        try:
            for each in (self.common, *(() if self.chip is None else (self.chip,))):
                float(each.distortion.inverse.error)
        except FoldError as error:
            return str(error) if self.chip is None else f"{self.label}: {error}"
        return ""

    def check_pixels(self) -> None:
        """Raise `InputError` if its pixels are those of a focal plane, and of no image."""
        if self.chip is None and self.solution.camera.has_focal_plane:
            raise InputError(
                f"exposure {self.name} has detectors, {some_of(self.detectors, _MOST_NAMED)}, with their own pixels: "
                f"say which, solution[{self.name!r}, {self.detectors[0]!r}]"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """``(ny, nx)`` of the detector, or of the focal plane of several."""
        return self.solution.estimate.shapes[self.name] if self.chip is None else self.chip.shape

    @property
    def residuals(self) -> QTable:
        """The rows of ``solution.residuals`` that are of it; of a detector in its own pixels, residuals too.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.residuals["star", "x", "dx", "used"].colnames
        ['star', 'x', 'dx', 'used']
        """
        table = self.solution.residuals
        rows = table[np.asarray(table["exposure"] == self.name)]
        return rows if self.chip is None else detector_view.own_rows(self, rows)

    @cached_property
    def common(self) -> View:
        """What the detectors of the exposure have in common: this view itself, but for a detector in a focal plane."""
        return self if self.chip is None else View(self.solution, self.name)

    # -- the map

    @cached_property
    def _whole(self) -> OnDetector:
        """Pose and series of a detector in a focal plane."""
        return detector_view.on_detector(self)

    @property
    def pose(self) -> np.ndarray:
        """Similarity (2, 3) from the reference plane to undistorted pixels.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.pose.shape
        (2, 3)
        """
        return self.solution.poses[self.name] if self.chip is None else self._whole.pose

    @property
    def coefficients(self) -> np.ndarray:
        """Total distortion (2, n_modes), undistorted -> detector pixels: normalised Legendre modes in pixels, x first.

        Where a term of the model found more than the series of the fitted degree has, `distortion` has a table beside.
        Of a detector in a focal plane the degree is as high as it takes to hold a millionth of a pixel.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.coefficients.shape
        (2, 10)
        """
        return self.solution.coefficients[self.index] if self.chip is None else self._whole.coefficients

    @cached_property
    def prior_mean(self) -> np.ndarray:
        """Static distortion around which it lies, modes as those fitted; zero without a prior."""
        mean = self.solution.estimate.prior_mean[self.index]
        return mean if self.chip is None else detector_view.without_departure(self, mean)

    @cached_property
    def distortion(self) -> Distortion:
        """The total `Distortion`: undistorted -> detector pixels, without the pose.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.distortion
        <Distortion of exp00: degree 3, 2048 x 2048 px>
        """
        if self.chip is not None:
            return Distortion(self.coefficients, self.shape, self.label, table=self._whole.table)
        estimate = self.solution.estimate
        of_one = bool(estimate.static_tables) and not self.solution.camera.has_focal_plane
        table = estimate.table_of(self.name, self.detectors[0] if of_one else None)
        return estimate.certified_as(Distortion(self.coefficients, self.shape, self.name, table=table))

    @cached_property
    def model(self) -> Model:
        """Reference plane -> pixels as an astropy compound model with inverse.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> x, y = view.model(1000.0, 500.0)
        >>> back = view.model.inverse(x, y)
        >>> bool(abs(back[0] - 1000) < 1e-6 and abs(back[1] - 500) < 1e-6)
        True
        """
        form = None if self.chip is not None else self.solution.estimate.form
        return exposure_model(self.pose, self.distortion, form)

    def distort(self, x: ArrayLike, y: ArrayLike | None = None) -> Any:
        """Reference positions -> pixels; NaN where the detector does not reach.

        Parameters
        ----------
        x : array_like, shape (n, 2)
            Positions. Or, with `y`, their x alone.
        y : array_like, optional

        Returns
        -------
        ndarray, shape (n, 2), or tuple of two arrays
            As it was asked for. Quantities in pixels give quantities.

        Raises
        ------
        InputError
            Where several detectors have pixels of their own.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.distort([[1000.0, 1000.0], [-500.0, 0.0]]).round(1)
        array([[1000.4, 1000.4],
               [   nan,    nan]])
        """
        self.check_pixels()
        if y is not None:
            return _one_by_one(self.distort, x, y)
        places = _points(x)
        q = similarity.apply(self.pose, places)
        if self.chip is None:
            p = self.distortion(q)
        else:
            p = self.chip.to_pixels(self.common.distortion(similarity.apply(self.common.pose, places)))
        p[outside(self.distortion.inverse.valid, q[:, 0], q[:, 1])] = np.nan
        return like(x, p)

    def correct(
        self,
        x: ArrayLike,
        y: ArrayLike | None = None,
        *,
        errors: ArrayLike | None = None,
        epoch: float | Time | None = None,
        stars: Sequence[str] | None = None,
        flux: ArrayLike | None = None,
    ) -> Any:
        """Pixels -> reference positions, exact (section 3.3, criterion J_3).

        Positions are those at the time of the exposure; the motions that were fitted carry those of known stars to
        another.

        Parameters
        ----------
        x : array_like, shape (n, 2)
            Any pixels of the exposure. Or, with `y`, their x alone.
        y : array_like, optional
        errors : array_like, shape (n, 2) or (n, 2, 2), optional
            Of the measurement, as they are stated for the observations: standard deviations per axis [pix], or
            covariances [pix^2]. The floor, scale or law of the errors that the solution found is applied to them
            (`Diagnostics.found_errors`). Zeros stay zeros: they leave the errors of the correction alone.
        epoch : float or `~astropy.time.Time`, optional
            Another time, a Julian year, to which positions are carried. Stars without a motion stay where they are,
            with errors that are not known.
        stars : sequence of str, optional
            With `epoch`: to which stars of the solution the positions belong.
        flux : array_like, shape (n,), optional
            With `errors`, in the unit of the flux of the observations. It counts where a law of brightness was found,
            which takes the place of `errors`; positions without a positive flux keep those given.

        Returns
        -------
        ndarray, shape (n, 2), tuple of two arrays, or `legdistort.results.new_positions.Corrected`
            Points or x and y, as it was asked for; quantities in pixels give quantities. With `errors`
            ``(xy, relative, absolute)``: two covariances (n, 2, 2) [pix^2] beside the positions. They hold for
            positions that took no part in the solution; those of its stars are in `Solution.stars`. Outside the stars
            of the exposure (`supported`) the correction is extrapolated.

        Raises
        ------
        InputError
            If there is no such star, motions were not fitted, several detectors have pixels of their own, `errors` go
            with x and y apart, or for errors of another shape, negative ones or such that are not finite,
            and for fluxes without errors.
        FoldError
            If the distortion folds.

        Warns
        -----
        AssumptionWarning
            Of positions with errors and without a flux, where a law of brightness was found.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> x, y = view.correct(1000.0, 500.0)
        >>> xy, relative, absolute = view.correct([[1000.0, 500.0]], errors=[[0.05, 0.05]])
        >>> bool(abs(xy[0, 0] - x) < 1e-9), relative.shape
        (True, (1, 2, 2))
        """
        self.check_pixels()
        if flux is not None and errors is None:
            raise InputError("flux tells the errors of measured positions by a law of brightness: give errors too")
        if y is not None:
            if errors is not None:
                raise InputError("errors go with points: give positions (n, 2) in the place of x and y")
            return _one_by_one(self.correct, x, y, epoch=epoch, stars=stars)
        pixels = _points(x)
        moved = new_positions.movement(self.solution, self.name, stars, epoch, len(pixels))
        if errors is not None:
            return new_positions.correct_with_errors(self, x, errors, moved, flux)
        pixels = pixels if self.chip is None else self.chip.to_focal_plane(pixels)
        return like(x, new_positions.correct(self.common, pixels, moved)[0])

    def to_reference(self, xy: ArrayLike) -> np.ndarray:
        """Pixels (n, 2) as `residuals` has them, of several detectors those of the focal plane -> reference positions.

        Raises
        ------
        FoldError
            If the distortion folds.

        Examples
        --------
        >>> import legdistort as ld
        >>> import numpy as np
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> rows = view.residuals[:3]
        >>> view.to_reference(np.column_stack([rows["x"].value, rows["y"].value])).shape
        (3, 2)
        """
        return new_positions.correct(self, _points(xy))[0]

    def supported(self, xy: ArrayLike) -> np.ndarray:
        """Whether pixels (n, 2) lie inside the convex hull of the stars used.

        Those of the detector, or of the focal plane of several. Outside the correction is extrapolated.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.supported([[1000.0, 1000.0], [-30.0, 1000.0]])
        array([ True, False])
        """
        return star_hull.supported(star_hull.support(self.residuals), _points(xy).T)

    # -- WCS

    @cached_property
    def wcs(self) -> GWCS:
        """The gwcs: detector -> undistorted -> reference -> icrs (the last if the sky is known).

        That of a detector in a focal plane: detector -> undistorted -> focal_plane -> reference -> icrs.

        Examples
        --------
        >>> import legdistort as ld
        >>> import numpy as np
        >>> from legdistort.geometry.tangent_plane import TangentPlane
        >>> sky = TangentPlane(85.0, -70.0, np.array([[-2e-5, 0, 0.02], [0, 2e-5, -0.02]]))
        >>> view = ld.solve(ld.simulate_matches(sky=sky, seed=1).matches)["exp00"]
        >>> view.wcs.available_frames
        ['detector', 'undistorted', 'reference', 'icrs']
        """
        from ..wcs.exposure_wcs import exposure_wcs

        self.check_pixels()
        return exposure_wcs(self.name, self.common.pose, self.common.distortion, self.solution.sky, self.chip)

    def header(self, *, kind: str = "sip", max_error: float = 1e-3) -> Header:
        """FITS header, TAN-SIP or TPV, with its error in it.

        Parameters
        ----------
        kind : {"sip", "tpv"}
        max_error : float
            Largest error allowed over the whole detector, pixels.

        Raises
        ------
        ExportError
            If no polynomial is that close, naming the best.
        InputError
            If the sky is not known, or several detectors have pixels of their own.

        Examples
        --------
        >>> import legdistort as ld
        >>> import numpy as np
        >>> from legdistort.geometry.tangent_plane import TangentPlane
        >>> sky = TangentPlane(85.0, -70.0, np.array([[-2e-5, 0, 0.02], [0, 2e-5, -0.02]]))
        >>> view = ld.solve(ld.simulate_matches(sky=sky, seed=1).matches)["exp00"]
        >>> view.header(kind="tpv", max_error=0.01)["CTYPE1"]
        'RA---TPV'
        """
        from ..wcs.fits_headers import make_header

        self.check_pixels()
        return make_header(self.pose, self.distortion, self.solution.sky, kind=kind, max_error=max_error)

    def fits_wcs(self, *, max_error: float = 1e-3) -> WCS:
        """The nearest `astropy.wcs.WCS`, TAN-SIP, for what takes no other (`CCDData`, `Cutout2D`).

        Parameters and errors are those of `header`.

        Examples
        --------
        >>> import legdistort as ld
        >>> import numpy as np
        >>> from legdistort.geometry.tangent_plane import TangentPlane
        >>> sky = TangentPlane(85.0, -70.0, np.array([[-2e-5, 0, 0.02], [0, 2e-5, -0.02]]))
        >>> view = ld.solve(ld.simulate_matches(sky=sky, seed=1).matches)["exp00"]
        >>> view.fits_wcs().array_shape
        (2048, 2048)
        """
        wcs = WCS(self.header(max_error=max_error))
        wcs.array_shape = self.shape
        return wcs

    @property
    def orientation(self) -> tuple[float, float]:
        """Position angle of the y axis [deg, north through east] and pixel scale [arcsec], those of the pose.

        Without the distortion: means over the detector. At one place, its centre too, they are those of `wcs` there.

        Raises
        ------
        InputError
            If the sky is not known.

        Examples
        --------
        >>> import legdistort as ld
        >>> import numpy as np
        >>> from legdistort.geometry.tangent_plane import TangentPlane
        >>> sky = TangentPlane(85.0, -70.0, np.array([[-2e-5, 0, 0.02], [0, 2e-5, -0.02]]))
        >>> view = ld.solve(ld.simulate_matches(sky=sky, seed=1).matches)["exp00"]
        >>> angle, scale = view.orientation
        >>> round(scale, 3)
        0.072
        """
        if self.solution.sky is None:
            raise InputError("no position angle: where the exposures lie on the sky is not known")
        return self.solution.sky.orientation(self.pose, self.shape)

    # -- errors

    @property
    def errors(self) -> np.ndarray:
        """Standard deviations (2, n_modes) of the fitted coefficients, pixels.

        With the error of the common map, and NaN for what changes with an unknown direction (`Gauge.unknown`).

        Examples
        --------
        >>> import legdistort as ld
        >>> sim = ld.simulate_matches(seed=1)
        >>> view = ld.solve(sim.matches, prior=ld.Prior(sim.truth.static))["exp00"]
        >>> view.errors.shape, bool((view.errors > view.relative_errors).all())
        ((2, 10), True)
        """
        if self.chip is not None:
            return np.sqrt(detector_view.coefficient_variance(self))
        if self.solution.gauge.plane is not None:
            return _deviations(self.covariance)
        return np.sqrt(absolute_errors.coefficient_variance(self.solution.gauge, self.covariance, self.index))

    @property
    def relative_errors(self) -> np.ndarray:
        """Standard deviations (2, n_modes) of the coefficients without the error of the common map, pixels.

        After a common map is taken off the stars.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.relative_errors.shape
        (2, 10)
        """
        return _deviations(self.relative_covariance)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (2 n_modes, 2 n_modes) of the fitted coefficients, px^2, x first, in the gauge.

        Under all its constraints, with the errors of a camera that was fitted.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.covariance.shape
        (20, 20)
        """
        return self._covariance(absolute_errors.own_coefficients)

    @property
    def relative_covariance(self) -> np.ndarray:
        """Covariance (2 n_modes, 2 n_modes) of the coefficients after a common map is taken off the stars, px^2.

        So that it is free of what is hardly known of that map.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.relative_covariance.shape
        (20, 20)
        """
        return self._covariance(absolute_errors.relative_coefficients)

    def _covariance(self, of_exposure):
        block = of_exposure(self.solution.gauge, self.solution.estimate.uncertainty, self.index)
        if self.chip is not None:
            return detector_view.covariance(self, block)
        camera = self.solution.estimate.uncertainty.camera
        return block + camera.of_coefficients(self.index) if camera else block

    def sigma_map(
        self, *, n: int = 64, support: bool = True, absolute: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Error of the distortion correction over a detector (paper's Figure "ergrid", noise of the position excluded).

        Parameters
        ----------
        n : int
            Points along the longer side.
        support : bool
            NaN outside the convex hull of the stars used, where the correction is extrapolated.
        absolute : bool
            With the error of the common map, NaN where that is not known (`Gauge.unknown`); else relative.

        Returns
        -------
        x, y : ndarray, shape (n_x,), (n_y,)
            Pixels.
        sigma : ndarray, shape (n_y, n_x, 2)
            Standard deviation of the corrected position per axis, reference-plane pixels.

        Raises
        ------
        InputError
            Where several detectors have pixels of their own, or if n is no positive integer.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> x, y, sigma = view.sigma_map(n=16, support=False)
        >>> x.shape, y.shape, sigma.shape
        ((16,), (16,), (16, 16, 2))
        """
        self.check_pixels()
        check_counts(n=n)
        return error_map(self, n=n, support=support, absolute=absolute)

    # -- pictures

    def plot_residuals(self, *, scale: float | None = None, ax: Axes | None = None) -> Axes:
        """Arrows of the residuals, see `legdistort.plots.solution_plots.plot_residuals`.

        Of several detectors over the focal plane, in which they are outlined.

        Parameters
        ----------
        scale : float, optional
            Magnification.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; WCSAxes too (``projection=view.wcs``, or that of another image).

        Returns
        -------
        `~matplotlib.axes.Axes`

        Raises
        ------
        InputError
            If none of the positions was used, the scale is not positive, or WCSAxes and exposure have no sky in common.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.plot_residuals(scale=500).get_title(loc="left")
        'exp00: residuals × 500'
        """
        return solution_plots.plot_residuals(self, scale=scale, ax=ax)

    def plot_error_map(self, *, absolute: bool = False, ax: Axes | None = None) -> Axes:
        """Map of the error of the correction, see `sigma_map`.

        Parameters
        ----------
        absolute : bool
            With the error of the common map.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; WCSAxes too (``projection=view.wcs``, or that of another image).

        Returns
        -------
        `~matplotlib.axes.Axes`

        Raises
        ------
        InputError
            Where several detectors have pixels of their own, or WCSAxes and exposure have no sky in common.
        FoldError
            If the distortion folds.

        Examples
        --------
        >>> import legdistort as ld
        >>> view = ld.solve(ld.simulate_matches(seed=1).matches)["exp00"]
        >>> view.plot_error_map().get_xlabel()
        'x [px]'
        """
        return solution_plots.plot_sigma_map(*self.sigma_map(absolute=absolute), wcs=lambda: self.wcs, ax=ax)

    # -- words

    @property
    def n_stars(self) -> int:
        """Number of positions used."""
        return int(np.count_nonzero(self.residuals["used"]))

    def __repr__(self) -> str:
        ny, nx = self.shape
        words = [f"{self.n_stars} stars", f"degree {self.distortion.degree}", f"{nx} x {ny} px"]
        if self.chip is None and self.solution.camera.has_focal_plane:
            words[-1] = f"focal plane of {nx} x {ny} px, detectors {some_of(self.detectors, _MOST_NAMED)}"
        return f"<View of {self.label}: {', '.join(words)}>"

    def __str__(self) -> str:
        used = self.residuals[np.asarray(self.residuals["used"], dtype=bool)]
        rms = [float(np.sqrt(np.mean(used[k].to_value(u.pix) ** 2))) if len(used) else np.nan for k in ("dx", "dy")]
        d = similarity.describe(self.pose)
        lines = [
            repr(self)[1:-1],
            f"pose        shift {d['dx']:.2f}, {d['dy']:.2f} px, rotation {d['rotation']:.4f} deg, scale "
            f"{d['scale']:.6f}",
            f"distortion  {np.sqrt((self.coefficients**2).sum()) / 2:.3f} px rms over the detector",
            f"residuals   {rms[0]:.4f}, {rms[1]:.4f} px rms in x, y",
        ]
        if self.solution.sky is not None:
            angle, scale = self.orientation
            lines.append(f"sky         position angle {angle:.4f} deg, {scale:.6f} arcsec/px")
        return "\n".join(lines)


def _pair(solution, key):
    """Name of an exposure and id of a detector, or None, of a key; single detectors are exposures of their own."""
    name, detector = key if isinstance(key, tuple) and len(key) == 2 else (key, None)
    detector = None if detector is None else str(detector)
    if isinstance(name, str) and detector is not None and name not in solution.names:
        alone = detector_name(name, detector)
        name = alone if alone in solution.names else name
    return name, detector


def has_key(solution, key):
    """Whether a solution has the exposure, or the detector of an exposure, that a key means."""
    name, detector = _pair(solution, key)
    if not isinstance(name, str) or name not in solution.names:
        return False
    return detector is None or detector in View(solution, name).detectors


def check_key(solution, key):
    """Exposure and detector (None for all of it) that a key of a solution means.

    Raises
    ------
    InputError
        For an exposure or a detector that is not there, naming what is.
    """
    name, detector = _pair(solution, key)
    if not isinstance(name, str) or name not in solution.names:
        left_out = isinstance(name, str) and name in solution.left_out
        why = f": it was left out ({solution.left_out[name]})" if left_out else ""
        near = [] if why else get_close_matches(str(name), solution.names, n=3)
        meant = f" (do you mean {' or '.join(near)}?)" if near else ""
        known = some_of(list(solution.names), _MOST_NAMED)
        raise InputError(f"no exposure {name!r} in the solution{why}{meant}; it has {known}")
    detectors = View(solution, name).detectors
    if detector is not None and detector not in detectors:
        raise InputError(
            f"exposure {name} has no detector {detector!r}; it has {some_of(list(detectors), _MOST_NAMED)}"
        )
    return name, detector


def image_view(solution, image):
    """The view of an image, an Exposure or ExposureFile, by its exposure and detector or by its name; None without."""
    of_camera = solution.camera.has_focal_plane
    key = (image.exposure, image.detector) if of_camera else image.name
    if key in solution:
        return solution[key]
    parts = {part.label: part for view in solution for part in view.parts}
    label = label_of(image.name, image.header, parts, exact=not of_camera)
    if label is None and image.path is not None and (mark := folder_mark(whole_name(image), image.path, parts)):
        return image_view(solution, marked(image, mark))
    return parts.get(label)


def error_map(view, *, n=64, support=True, absolute=False):
    """`View.sigma_map`, of the focal plane of several detectors too."""
    check_counts(n=n)
    ny, nx = view.shape
    step = max(nx, ny) / n
    x = np.linspace(-0.5, nx - 0.5, max(2, round(nx / step)))
    y = np.linspace(-0.5, ny - 0.5, max(2, round(ny / step)))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    q = view.common.distortion.invert(grid if view.chip is None else view.chip.to_focal_plane(grid))
    if absolute:
        covariance = new_positions.covariances(view, q, np.zeros((len(q), 2, 2)))[1]
    else:
        covariance = new_positions.relative_errors(view, q)
    variance = np.einsum("naa->na", covariance)
    sigma = np.sqrt(np.maximum(variance, 0)).reshape(len(y), len(x), 2)
    if support:
        sigma[~view.supported(grid).reshape(len(y), len(x))] = np.nan
    return x, y, sigma


def _deviations(covariance):
    return np.sqrt(np.diag(covariance)).reshape(2, -1)


def _points(xy):
    """Positions (n, 2) as floats, pixels taken off quantities."""
    return np.atleast_2d(similarity.as_positions(to_pixels(xy)))


def _one_by_one(function, x, y, **keywords):
    """A function of points for x and y apart: two arrays, or numbers, of their common shape."""
    quantity = isinstance(x, u.Quantity) or isinstance(y, u.Quantity)
    x, y = to_pixels(x), to_pixels(y)
    try:
        x, y = np.broadcast_arrays(x, y)
    except ValueError:
        raise InputError(f"x and y must have one shape, got {x.shape} and {y.shape}: give as many of each") from None
    out = function(np.stack([x.ravel(), y.ravel()], axis=1), **keywords).T.reshape(2, *x.shape)
    return tuple(each * u.pix if quantity else each[()] for each in out)
