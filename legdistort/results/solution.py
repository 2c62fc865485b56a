"""The result of `solve`: positions, distortions, their errors, and everything made from them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import InitVar, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.table import QTable

from ..cameras.camera import Camera
from ..geometry.tangent_plane import TangentPlane
from ..plots import residual_plots
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted, text_of
from . import in_tables, new_positions, nights
from .check import Checks
from .diagnostics import Diagnostics
from .errors import absolute_errors
from .estimate import Estimate, plain_covariances
from .gauge import Gauge
from .settings import Settings
from .view import View, check_key, has_key

if TYPE_CHECKING:
    from astropy.table import Table
    from astropy.time import Time
    from matplotlib.axes import Axes

    from ..runtime.annotations import StrPath
    from .check import Check


@dataclass(frozen=True, eq=False)
class Solution(ShownAsPrinted):
    """Distortion-free star positions and the distortion of every exposure.

    Made by `legdistort.solve`, read back by `Solution.read`. ``solution["exp00"]`` is a `View` of an exposure: its
    pixels, WCS, errors and pictures; ``solution["exp00", "2"]`` of one detector of a camera. ``for view in solution``
    goes over the exposures, ``"exp00" in solution`` asks for one, ``len(solution)`` is their number.

    Attributes
    ----------
    names : tuple of str
        Exposures.
    degree : int
        Total degree that was fitted.
    poses : dict
        ``{exposure: (2, 3)}``, reference plane -> undistorted pixels, refined.
    coefficients : ndarray, shape (n_exposures, 2, n_modes)
        Distortion A_i, pixels, normalised Legendre modes, x then y: static and dynamic part together. With a prior of
        higher degree than the fit, its remaining modes follow unchanged.
    residuals : `~astropy.table.QTable`
        The matched table that was solved, one row an observation, with ``dx``, ``dy`` [pix], measured minus predicted
        detector position, and ``used`` added. With terms ``x_terms``, ``y_terms`` [pix] are what they displace it by.
    chi2 : float
        Weighted sum of squares of the used residuals.
    dof : float
        Its degrees of freedom: coordinates less what the data determine of the unknowns; the directions fixed by the
        gauge (the null space) are counted.
    status : str
        How the minimisation ended.
    gauge : Gauge
    settings : Settings
        How `solve` was called.
    diagnostics : Diagnostics
        What `solve` estimated beside the unknowns.
    estimate : Estimate
        Arrays of stars and exposures, and their covariances.
    sky : TangentPlane or None
    left_out : dict
        ``{exposure: reason}``.
    provenance : dict
        ``created``, ``versions`` of packages and, if files went in, ``inputs`` ``{base name: SHA-256}``.
    camera : `legdistort.Camera`
        Of a camera with a focal plane (`Camera.has_focal_plane`) positions, shapes and distortions are those of that.
        That of plain images has one detector, "1"; it need not be given.
    checksum : str or None
        SHA-256 of the file that it was read from, in hexadecimal digits; what `dataclasses.replace` makes has none.

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
    >>> solution["exp00"].correct([[100.0, 200.0]]).shape
    (1, 2)
    >>> len(solution), "exp00" in solution
    (10, True)
    >>> solution.write("solution.asdf").name
    'solution.asdf'
    >>> ld.Solution.read("solution.asdf").names == solution.names
    True
    """

    names: tuple[str, ...]
    degree: int
    poses: dict[str, np.ndarray]
    coefficients: np.ndarray
    residuals: QTable
    chi2: float
    dof: float
    status: str
    gauge: Gauge
    settings: Settings
    diagnostics: Diagnostics
    estimate: Estimate
    sky: TangentPlane | None = None
    left_out: dict[str, str] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    camera: Camera = None
    checksum: str | None = field(default=None, init=False)  # what `replace` makes is another solution
    _checksum: InitVar[str | None] = None

    def __post_init__(self, _checksum: str | None) -> None:
        object.__setattr__(self, "checksum", _checksum)
        if self.camera is None:
            object.__setattr__(self, "camera", Camera.of_images(self.estimate.shapes.values()))

    # -- exposures

    def __getitem__(self, key: str | tuple[str, str]) -> View:
        """View of an exposure, by its name, or of a detector, by both; a new one, which keeps what it has made."""
        return View(self, *check_key(self, key))

    def __iter__(self) -> Iterator[View]:
        return (self[name] for name in self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __getstate__(self) -> dict[str, Any]:
        """What goes into a pickle: numbers as a file has them, nothing of the equations that they came from."""
        state = {each.name: getattr(self, each.name) for each in fields(self)}
        known = {"checked": self.checks, "nights": nights.found(self)}
        estimate = replace(self.estimate, **known, uncertainty=plain_covariances(self.estimate))
        return state | {"estimate": estimate, "gauge": replace(self.gauge, responses=estimate.uncertainty)}

    def __copy__(self) -> Solution:
        return replace(self, _checksum=self.checksum)

    def __contains__(self, key: object) -> bool:
        return has_key(self, key)

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """Tests of the solution with their results: a tuple of `legdistort.results.check.Check`; made at first use."""
        return Checks(self.estimate.checked(self) if callable(self.estimate.checked) else self.estimate.checked)

    @cached_property
    def factors(self) -> QTable:
        """One row for all that was known beforehand of something: is it what everything else shows?

        ``name``, ``source``, ``rows`` (numbers that were known), ``chi2``, ``dof``, ``p``: the difference of both under
        the sum of their covariances, as the checks have it that ask the same (`checks`). Nothing else tests what has no
        degrees of freedom.
        """
        tests = [test for check in self.checks for test in check.tests]
        types = {"name": str, "source": str, "rows": int, "chi2": float, "dof": float, "p": float}
        columns = [[getattr(test, name) for test in tests] for name in types]
        return QTable(columns, names=list(types), dtype=list(types.values()))

    @cached_property
    def nights(self) -> QTable:
        """One row a night, or other block of exposures (`Matches.blocks`): which one differs? The worst first.

        ``name`` (the label of the column ``block``, else the date), ``block`` (its number), ``epoch`` [yr],
        ``n_exposures``, ``n_stars``; ``rms`` [pix] of its residuals, per axis, and ``rms_ratio`` of these over their
        errors; ``departure`` [pix], rms length over the detector, both axes together, of what its exposures have in
        common from the static distortion of all other nights, ``ratio`` over the scatter of these and all errors, with
        its ``chi2``, ``dof`` and ``p``, the probability of so much by chance. A night that is ``odd`` departs farther
        than the others do (p < 0.001 over the number of nights, and three times as far), and the rest is compared
        without it; none is where there are no two others. Of two nights p is that of no departure at all. Without
        others, and where exposures have no distortion of their own, there is no departure (NaN, ``dof`` 0).
        ``exposures``: their names.
        `print` shows the columns that tell how a night differs; ``pprint_all()`` shows all.
        """
        return nights.table(self)

    @cached_property
    def higher_static(self) -> QTable | None:
        """The static distortion of detectors beyond the degree, as their exposures share it; None if they show none.

        One row for each mode of a detector: ``detector``, its orders ``m`` (along x) and ``n`` (along y), ``x``, ``y``
        [pix], coefficients with what a prior has of them, and their errors ``x_err``, ``y_err``. It is part of the
        distortion of every exposure (`coefficients`), so of its WCS.
        """
        return in_tables.higher_static(self)

    @cached_property
    def terms(self) -> QTable:
        """One row for every number of the terms that were fitted (``terms=`` of `legdistort.solve`).

        ``term``, ``owner`` (the exposure or detector, if each has its own), ``number``, ``value``, ``error`` and
        ``unit`` (they differ); ``size``, the scatter of the numbers of the term about zero, 0 where the positions do
        not show it, and ``gain``, twice that in the logarithm of the likelihood. What they displace positions by is in
        ``x_terms``, ``y_terms`` of `residuals`.
        """
        return in_tables.terms(self)

    # -- stars

    @cached_property
    def stars(self) -> QTable:
        """One row a star: ``star``, ``x``, ``y``, errors [pix], ``n``, mean ``flux`` and the sky if known.

        ``x_err``, ``y_err`` are relative: the errors once a common map of the fitted degree is taken off.
        ``x_err_abs``, ``y_err_abs`` add that map: the mean dynamic distortion of the set and the uncertainty of the
        static one; NaN where they are not known (`Gauge.unknown`). ``x_err_known``, ``y_err_known`` are those after the
        unknown directions are taken off; infinite where nothing determines how the detectors of a camera lie. Where no
        star ties some detectors to others, ``group`` is the number of those that saw it, and ``x_err``, ``y_err`` hold
        among the stars of a group, once a map that these have in common is taken off.
        Pointing, rotation and scale common to all exposures are those of the nominal
        poses. These errors include them only where a reference ties them. On the sky:
        ``ra``, ``dec`` [deg, ICRS], ``ra_error`` (of ra cos(dec)), ``dec_error`` [mas], ``ra_dec_corr``,
        ``ra_error_abs``, ``dec_error_abs`` [mas], named as in the Gaia catalogue, and ``sky``, the same places as a
        `~astropy.coordinates.SkyCoord` (not in files). ``flux`` is the mean over the exposures, each brought to their
        mean depth by the fluxes of common stars; where these do not join the exposures, as they are, which the
        description of the column says. ``meta`` has ``frame``, ``epoch`` (a Julian year, if it is
        known), ``gauge``, ``motions`` (what of these is a convention), ``degree``, ``pixel_scale`` (arcsec, of the sky
        or as stated), ``prior`` and ``version``.

        Where motions were fitted, positions are those of the epoch, and there are ``vx``, ``vy`` [pix/yr], with a sky
        ``pmra`` (with cos(dec)), ``pmdec`` [mas/yr] and, if it was fitted, ``parallax`` [mas], all with relative and
        absolute errors and with correlations named alike; ``chi2``, ``n_epochs`` and ``span`` [yr]. ``sky`` then has
        the motions too. Absolute errors of motions leave out common rates of shift, rotation and scale, those of
        parallaxes the mean parallax: nothing but a reference determines these. NaN where a star is seen at one epoch
        only.
        """
        return in_tables.stars(self)

    @plain_numbers
    def stars_at(self, epoch: float | Time) -> QTable:
        """The stars where they are at another time, with their errors then, as a table.

        Parameters
        ----------
        epoch : float or `~astropy.time.Time`
            A Julian year.

        Returns
        -------
        `~astropy.table.QTable`
            All columns of `stars`, with positions, errors and correlations of that time; the ``epoch`` of its ``meta``
            is that time. Parallaxes are in the positions. Stars without a motion stay where they are, with errors that
            are not known.

        Raises
        ------
        InputError
            If motions were not fitted.
        """
        return in_tables.stars(self, epoch)

    def absolute_covariance(self, *, without_unknown: bool = False) -> np.ndarray:
        """Covariance (n_stars, 2, 2) [pix^2] of every star position with the error of the common map.

        NaN where that is not known, unless the error asked for is that after the unknown directions
        (`Gauge.unknown`) are taken off.
        """
        xx, yy, xy = absolute_errors.absolute_variance(
            self.gauge, self.estimate.uncertainty, self.estimate.positions, without_unknown=without_unknown
        )
        return np.stack([np.stack([xx, xy]), np.stack([xy, yy])]).transpose(2, 0, 1)

    @plain_numbers
    def correct_table(self, table: Table, *, epoch: float | Time | None = None) -> QTable:
        """Positions measured in any exposures -> the reference plane and the sky, with their errors, as a table.

        Parameters
        ----------
        table : `~astropy.table.Table`
            Columns ``exposure``, ``x``, ``y``, ``x_err``, ``y_err`` [pix] and perhaps ``xy_corr``, of positions that
            took no part in the solution; with `epoch` ``star`` too, a star of the solution. Errors are those stated,
            to which what the solution found of them is applied as in `correct`; where that is a law of brightness,
            ``flux`` or ``mag`` too.
        epoch : float or `~astropy.time.Time`, optional
            A Julian year, to which the motions that were fitted carry all positions; it is then in the ``meta`` too.

        Returns
        -------
        `~astropy.table.QTable`
            Row by row, with columns that are named as in `stars`: ``x``, ``y``, their errors relative and absolute, and
            if the sky is known ``ra``, ``dec``, ``ra_error``, ``dec_error`` [mas], ``ra_dec_corr``, ``ra_error_abs``,
            ``dec_error_abs``; and the other columns of the table. Without a column ``star`` it gets one, with the star
            of `stars` whose observation a row is: of the same exposure at the same place, to 0.001 px; -1 or an empty
            text for none.

        Raises
        ------
        InputError
            For a table that lacks columns or has bad values, or names an exposure or, with `epoch`, a star that the
            solution does not have; with `epoch` if motions were not fitted.

        Warns
        -----
        AssumptionWarning
            Of positions off their detector, where the correction is extrapolated, and of such without a flux where a
            law of brightness was found.
        """
        return new_positions.correct_table(self, table, epoch)

    # -- pictures and words

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

    def __repr__(self) -> str:
        lost = np.count_nonzero(np.isnan(self.estimate.positions[:, 0]))
        stars = f"{len(self.estimate.star_names)} stars{f' ({lost} without a position)' if lost else ''}"
        exposures = f"{len(self.names)} exposure{'s' * (len(self.names) != 1)}"
        return f"<Solution: {exposures}, {stars}, degree {self.degree}, {in_tables.goodness(self)}>"

    def __str__(self) -> str:
        return text_of(self._parts())

    def _parts(self):
        return in_tables.parts(self)

    # -- files

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write everything to an ASDF file (`legdistort.results.storage`)."""
        from .storage import write_solution

        return write_solution(self, path, overwrite=overwrite)

    @classmethod
    def read(cls, path: StrPath, *, max_bytes: int | None = None) -> Solution:
        """Read what `write` wrote; residuals, and inverses that the file holds, are checked again.

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
