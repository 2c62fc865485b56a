"""What is known of the distortion beforehand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cameras.source import check_shape
from ..cameras.stated_errors import as_errors, as_widths, resized
from ..exceptions import AssumptionWarning, InputError, warn
from ..geometry import basis
from ..geometry.distortion import TABLE_TOLERANCE
from ..geometry.tabulated.displacement_table import DisplacementTable
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted
from ..runtime.trees.facts import SIZE, array, number
from ..runtime.words import UNSTATED
from .mode_tables import mode_table

if TYPE_CHECKING:
    from astropy.table import QTable, Table
    from numpy.typing import ArrayLike

    from ..inputs.exposures import Exposure
    from ..results.solution import Solution
    from ..runtime.annotations import Extension, Shape, StrPath

#: As `sigma` of a `Prior`: to be found from the exposures.
EVIDENCE = "evidence"
#: As `prior` of `legdistort.run`: that of the headers of the frames.
HEADER = "header"
#: Degree to which a size of the static distortion is taken where exposures scatter by a given number of pixels.
_HIGHEST = 9
_WIDTHS = array(2, "n_modes", unit="pix", minimum=0, infinite=True, choices=(EVIDENCE,))


def _declared(static_sigma):
    """The size of a static distortion of which nothing else is known, a positive number."""
    given = isinstance(static_sigma, Real) and not isinstance(static_sigma, bool)
    if not (given and 0 < static_sigma < np.inf):
        raise InputError(
            "without a mean, static_sigma must be a positive number: the size of every coefficient of the static "
            f"distortion in pixels, got {static_sigma!r}"
        )
    return float(static_sigma)


@plain_numbers
@dataclass(frozen=True, eq=False)
class Prior(ShownAsPrinted):
    """Static distortion known beforehand, with its uncertainty.

    Parameters
    ----------
    mean : array_like, shape (2, n_modes), or None
        Static distortion A_0 in the normalised Legendre basis, pixels, x then y (reference -> detector). None: only its
        size is known, see `static_sigma`; or, with ``sigma="evidence"`` alone, nothing.
    sigma : array_like, optional
        Scatter of single exposures around the mean, pixels: a number, (n_modes,) or (2, n_modes). It shrinks modes
        that the data do not determine. None leaves the exposures free. Zero keeps a mode at the mean, infinity leaves
        it free. "evidence" lets `legdistort.solve` find it from the exposures, one width a degree
        (`legdistort.solving.choices.prior_widths`).
    static_sigma : array_like, optional
        Uncertainty of the mean itself, same forms. It is common to all exposures and does not average down. None takes
        the mean as exact, infinity means that nothing is known of a mode. Without a mean, a number s: every coefficient
        of the degree d that is fitted is about that large, in pixels, either sign. This makes
        ``s sqrt(((d + 1) (d + 2) - 4) / 8)`` px of distortion, rms per axis over the detector, shift, rotation and
        scale aside: s at degree 2, 1.4 s at 3, 1.8 s at 4, 2.2 s at 5; the scatter of exposures is then found, or it
        is `sigma`, about a static distortion of that size.
    static_covariance : array_like, shape (2 n_modes, 2 n_modes), optional
        The covariance of the mean, those of x first, px^2, in the place of `static_sigma`, which its diagonal becomes:
        what several coefficients have in common, such as maps that dithers without a roll do not tell, then leaves
        the others as well known as they are. An infinite variance, or a combination with an error of 100 px and more,
        is one of which nothing is known.
    shape : tuple, optional
        ``(ny, nx)`` of the detector it belongs to; solving exposures of another shape with it is then an error.
    source : str or dict, optional
        Where it comes from, in words, or item by item (kind, name, direction, files with their checksums); kept with
        the solution.
    table : DisplacementTable, optional
        What the static distortion has beside the series of the mean, taken as exact: from maps that no series follows.
        `legdistort.solve` has it as a part of the distortion of every exposure; `legdistort.predict` and cameras leave
        it out.

    Attributes
    ----------
    truncation : float
        Largest distance [pix] on the detector between mean and table together and the model they were made from (0 if
        given directly).
    plane : ndarray or None
        Pose (2, 3) from the plane of that model to undistorted pixels: the similarity taken out of the mean.

    Raises
    ------
    InputError
        For arrays of the wrong length or values that are not finite, what is no covariance, both of `static_sigma` and
        `static_covariance` where they differ, and a table that is none, or without a mean.

    See Also
    --------
    legdistort.solve : Takes it as ``prior=``.
    legdistort.Camera : Several detectors with static distortions of their own.

    Examples
    --------
    >>> import legdistort as ld
    >>> def undistorted(x, y):  # detector pixels to undistorted ones, a pincushion
    ...     r2 = ((x - 1023.5) ** 2 + (y - 1023.5) ** 2) / 1024**2
    ...     return x - 2 * r2 * (x - 1023.5) / 1024, y - 2 * r2 * (y - 1023.5) / 1024
    >>> ld.Prior.from_model(
    ...     undistorted, shape=(2048, 2048), direction="detector_to_reference", degree=3, static_sigma=0.02
    ... )
    <Prior: degree 3, 10 modes an axis, static_sigma given>
    """

    mean: np.ndarray | None = field(metadata=array(2, "n_modes", unit="pix", entry="coefficients"))
    _: KW_ONLY
    sigma: np.ndarray | str | None = field(default=None, metadata=_WIDTHS)
    static_sigma: np.ndarray | float | None = field(default=None, metadata=_WIDTHS)
    static_covariance: np.ndarray | None = field(
        default=None,
        metadata=array("2 n_modes", "2 n_modes", unit="pix2", covariance=True, infinite=True),
    )
    shape: tuple[int, int] | None = field(default=None, metadata=SIZE)
    truncation: float = field(default=0.0, metadata=number(entry="truncation_px", minimum=0, unit="pix"))
    plane: np.ndarray | None = field(default=None, metadata=array(2, 3, unit="pix", invertible=True))
    source: str | dict[str, Any] | None = None
    table: DisplacementTable | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.table, DisplacementTable | None) or (self.table is not None and self.mean is None):
            raise InputError("table must be a DisplacementTable beside a mean, or None: see Prior.from_file")
        is_sought = isinstance(self.sigma, str) and self.sigma == EVIDENCE
        if self.mean is None and is_sought and self.static_sigma is None:
            object.__setattr__(self, "mean", np.zeros((2, 1)))
            object.__setattr__(self, "source", UNSTATED)
        if self.mean is None:
            if self.static_covariance is not None:
                raise InputError("static_covariance is that of a mean: give the mean as well")
            size = _declared(self.static_sigma)
            object.__setattr__(self, "static_sigma", size)
            if self.sigma is None or is_sought:
                object.__setattr__(self, "sigma", None)  # which is found
                return
            n_modes = np.shape(self.sigma)[-1] if np.ndim(self.sigma) else basis.n_modes(_HIGHEST)
            object.__setattr__(self, "mean", np.zeros((2, n_modes)))  # about which exposures scatter by sigma
            object.__setattr__(self, "source", UNSTATED)
        try:
            mean = np.array(self.mean, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"mean must be numbers, pixels, in shape (2, n_modes), got {self.mean!r}") from None
        if mean.ndim != 2 or mean.shape[0] != 2:
            raise InputError(f"mean must have shape (2, n_modes), x then y, got {mean.shape}")
        if not np.all(np.isfinite(mean)):
            raise InputError("mean has values that are not finite")
        basis.degree_of(mean.shape[1])
        object.__setattr__(self, "mean", mean)
        if isinstance(self.sigma, str) and not is_sought:
            words = f"widths in pixels, or {EVIDENCE!r}: found from the exposures"
            raise InputError(f"sigma must be {words}, got {self.sigma!r}")
        names = "static_sigma", "static_covariance"
        errors = as_errors(self.static_sigma, self.static_covariance, mean.shape[1], names)
        given = dict(zip(names, errors, strict=True))
        given |= {} if is_sought else {"sigma": as_widths(self.sigma, mean.shape[1], "sigma")}
        for name, value in given.items():
            object.__setattr__(self, name, value)

    @property
    def degree(self) -> int:
        """Total degree of the mean; 0 without one."""
        return 0 if self.mean is None else basis.degree_of(self.mean.shape[1])

    @property
    def states_mean(self) -> bool:
        """Whether a static distortion is stated, and not its size or the scatter of exposures alone."""
        return self.mean is not None and self.source != UNSTATED

    @plain_numbers
    def static_widths(self, degree: int) -> np.ndarray:
        """Uncertainty (2, n_modes) of the static distortion to a total degree, pixels; zero where it is exact.

        Infinite where nothing is stated.
        """
        if self.mean is None:
            return np.full((2, basis.n_modes(degree)), self.static_sigma)
        if self.source == UNSTATED and self.static_sigma is None:
            return np.full((2, basis.n_modes(degree)), np.inf)
        return basis.change_degree(np.zeros((2, 1)) if self.static_sigma is None else self.static_sigma, degree)

    @plain_numbers
    def static_covariance_to(self, degree: int) -> np.ndarray | None:
        """`static_covariance` to a total degree, (2 n_modes, 2 n_modes), px^2; None where there is none.

        Zero beyond the degree of the mean, as the modes there are.
        """
        return resized(self.static_covariance, basis.n_modes(degree))

    def describe(self) -> dict[str, Any]:
        """Everything but the mean as plain numbers and strings, as files of solutions keep it."""
        widths = {"sigma": self.sigma, "static_sigma": self.static_sigma}
        return {
            "source": self.source,
            "degree": None if self.mean is None else self.degree,
            "shape": None if self.shape is None else [int(n) for n in self.shape],
            "truncation_px": float(self.truncation),
            **{name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in widths.items()},
        }

    @property
    def in_numbers(self) -> np.ndarray | None:
        """`sigma` as an array, or None.

        Raises
        ------
        InputError
            While it is to be found from the exposures.
        """
        if isinstance(self.sigma, str):
            raise InputError(
                f"the prior has sigma={self.sigma!r}: solve finds it from exposures; give widths in pixels here"
            )
        return self.sigma

    @plain_numbers
    def with_sigma(self, sigma: ArrayLike | None, *, degree: int = 0) -> Prior:
        """The same prior with another scatter `sigma`, its mean taken as zero from its own degree up to `degree`."""
        degree = max(self.degree, degree)
        if np.ndim(sigma):  # of modes beyond those given nothing is known
            given = np.asarray(sigma, dtype=float)
            sigma = np.full((*given.shape[:-1], basis.n_modes(degree)), np.inf)
            sigma[..., : given.shape[-1]] = given[..., : sigma.shape[-1]]
        if self.mean is None:
            return replace(self, sigma=sigma)
        static = None if self.static_sigma is None else basis.change_degree(self.static_sigma, degree)
        known = {"static_sigma": static, "static_covariance": self.static_covariance_to(degree)}
        return replace(self, mean=basis.change_degree(self.mean, degree), sigma=sigma, **known)

    @plain_numbers
    def with_static_sigma(self, static_sigma: ArrayLike | None) -> Prior:
        """The same prior with another uncertainty `static_sigma` of its mean, in the place of a covariance too."""
        source = self.source
        if isinstance(source, dict):
            source = {key: value for key, value in source.items() if key != "errors_of"}
        return replace(self, static_sigma=static_sigma, static_covariance=None, source=source)

    @plain_numbers
    def correct_table(self, table: Table) -> QTable:
        """Positions in any list of its detector without the static distortion: `Camera.correct_table`, with `sigma`.

        Raises
        ------
        InputError
            As there; if the prior states no static distortion, or no `shape`.
        """
        from ..cameras.camera import Camera
        from ..cameras.detector import Detector
        from ..cameras.static_correction import correct_table

        if not self.states_mean or self.shape is None:
            lacks = "shape of its detector" if self.states_mean else "static distortion"
            raise InputError(f"the prior states no {lacks}, by which positions could be corrected: give one that does")
        name = self.source.get("name") if isinstance(self.source, dict) else self.source
        camera = Camera(str(name or "of the prior"), {"1": Detector(self.shape, static=self)})
        return correct_table(camera, table, None if isinstance(self.sigma, str) else self.sigma, self.table)

    def __repr__(self) -> str:
        if self.mean is None:
            return f"<Prior: not known, {self.static_sigma:g} px a mode>"
        words = [f"degree {self.degree}", f"{self.mean.shape[1]} modes an axis"] if self.states_mean else ["not known"]
        widths = {name: getattr(self, name) for name in ("sigma", "static_sigma")}
        words += [
            f"{name} {'by evidence' if isinstance(v, str) else 'given'}" for name, v in widths.items() if v is not None
        ]
        words += ["with correlations"] if self.static_covariance is not None else []
        words += ["table beside"] if self.table is not None else []
        return f"<Prior: {', '.join(words)}>"

    @property
    def modes(self) -> QTable:
        """One row a mode and axis: ``axis``, ``x_degree``, ``y_degree``, ``coefficient``, widths if given; pixels."""
        mean = np.zeros((2, 1)) if self.mean is None else self.mean
        widths = {name: getattr(self, name) for name in ("sigma", "static_sigma")}
        given = {name: value for name, value in widths.items() if isinstance(value, np.ndarray)}
        return mode_table(coefficient=mean, **given)

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers and texts for JSON, None for infinite widths."""
        modes = self.modes
        rows = (dict(zip(modes.colnames, row, strict=True)) for row in modes.as_array().tolist())
        known = [{key: None if value == np.inf else value for key, value in row.items()} for row in rows]
        stated = {key: value for key, value in self.describe().items() if not isinstance(value, list) or key == "shape"}
        return stated | {"modes": known}

    def __str__(self) -> str:
        lines = [repr(self)[1:-1], *(self.modes.pformat(max_lines=-1, max_width=-1) if self.states_mean else [])]
        return "\n".join(lines)

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the mean, its series, over the detector [pix], x and y; zero without one."""
        if self.mean is None:
            return np.zeros(2)
        return np.sqrt((self.mean**2).sum(axis=1)) / 2  # the basis has unit norm on [-1, 1]^2, of area 4

    @classmethod
    @plain_numbers
    def from_model(
        cls,
        model: Any,
        *,
        shape: Shape | None = None,
        direction: str | None = None,
        origin: int | None = None,
        frame: str | None = None,
        degree: int = 5,
        parity: int | None = None,
        offset: tuple[float, float] | None = None,
        sigma: ArrayLike | str | None = None,
        static_sigma: ArrayLike | None = None,
    ) -> Prior:
        """Prior from a model, WCS, aperture or function of a detector's static distortion.

        The map may end in any plane (arcsec, degrees, pixels): the similarity between that plane and the detector
        is taken out, since it belongs to the pose of an exposure; shear stays. What ends on the sky, or in V2 and V3,
        is first projected on the plane that touches the sphere at the centre of the detector.

        Parameters
        ----------
        model : callable, astropy model, gwcs, `~astropy.wcs.WCS` or SIAF aperture
            ``model(x, y) -> (x, y)`` on arrays, between detector pixels and an undistorted plane; units are welcome.
        shape : tuple, optional
            ``(ny, nx)`` of the detector; needed if the model does not state it.
        direction : {"detector_to_reference", "reference_to_detector"}, optional
            What the model does; needed if it does not state that.
        origin : {0, 1}, optional
            Coordinate of the centre of the model's first pixel (default 0; WCSs and apertures state it).
        frame : str, optional
            Where to end: of a gwcs, the name of a frame (default "undistorted", or else "v2v3", or else the last; "sky"
            is the last one, where that is on the sky, whatever it is called); of a SIAF aperture "idl" (default) or
            "tel".
        degree : int
            Total degree of the Legendre series; `truncation` is what it leaves out.
        parity : {1, -1, None}
            Orientation of the plane relative to the detector; None takes what fits.
        offset : tuple of float, optional
            Pixel (x, y) of the detector, 0-based, on which the first pixel of a source lies that has another size than
            the detector, whose size is then `shape`. Where the source does not reach, its polynomial is continued.
        sigma, static_sigma
            As for `Prior`. Without `static_sigma` the errors of maps that have some make it
            (`legdistort.cameras.expansion.coefficient_widths`).

        Raises
        ------
        InputError
            For a wrong direction or origin, or a model that cannot be followed over the detector.

        Warns
        -----
        AssumptionWarning
            If the source covers only a part of the detector, which the warning states.
        """
        from ..cameras.expansion import coefficient_widths, expand, rough_part
        from .from_objects import as_source

        source, degree = as_source(model, frame=frame), basis.check_degree(degree)
        if offset is not None:
            if source.shape is None:
                raise InputError(f"{source.name} ({source.kind}) has no size of its own: leave offset (--offset) out")
            if shape is None:
                raise InputError(
                    f"offset (--offset) places {source.name} in a detector of another size: give that one's as well, "
                    "as shape (--shape), or leave the offset out"
                )
            source = source.stated(direction=direction, origin=origin)
            known = _placed(source, degree, parity, check_shape(shape), offset)
        else:
            source = source.stated(shape=shape, direction=direction, origin=origin)
            mean, plane, truncation = expand(source, degree, parity)
            known = {"mean": mean, "plane": plane, "truncation": truncation}
            if source.is_ragged and truncation > TABLE_TOLERANCE:
                known["table"], known["truncation"] = rough_part(source, mean, plane)
            known |= {"shape": source.shape, "source": source.record()}
        if static_sigma is None and source.errors is not None:
            static_sigma = coefficient_widths(source, known["mean"], known["shape"], offset or (0.0, 0.0))
        return cls(**known, sigma=sigma, static_sigma=static_sigma)

    @classmethod
    def from_file(
        cls,
        where: StrPath | Sequence[StrPath],
        *,
        ext: Extension | None = None,
        frame: str | None = None,
        **options: Any,
    ) -> Prior:
        """Prior from a file, or a name, of any kind that is recognised.

        Parameters
        ----------
        where : str, path, or sequence of two or four of them
            ``prior.asdf``, ``solution.asdf`` or the folder with it (`from_solution`), or any source of
            `legdistort.priors.from_files.read_source`: ASDF with a gwcs or a model, FITS headers, two FITS maps and
            perhaps those of their errors, Drizzle coefficients, ``gsaoi-1`` ... ``gsaoi-4``,
            ``siaf:INSTRUMENT/APERTURE``. Of maps, what the series leaves out is kept as `table`.
        ext : int, str or (str, int), optional
            Extension of FITS files, header of a text, place in the tree of an ASDF file, or id of a detector of a
            camera or a solution of several.
        frame : str, optional
        **options
            As for `from_model`: shape, direction, origin, degree, parity, offset, sigma, static_sigma.

        Raises
        ------
        InputError
            Naming the file, and what to do.
        """
        from .storage import open_prior

        return open_prior(where, cls, ext=ext, frame=frame, **options)

    @classmethod
    @plain_numbers
    def from_headers(
        cls,
        exposures: Sequence[Exposure],
        *,
        degree: int = 3,
        sigma: ArrayLike | str | None = None,
        static_sigma: ArrayLike | None = None,
    ) -> Prior | dict[str, Prior]:
        """Prior from the distortions that the headers of exposures have, as `legdistort.solve` takes it.

        Read are SIP, TPV, look-up tables and what else astropy reads; a gwcs in an extension ``ASDF`` goes before them.

        Parameters
        ----------
        exposures : list of Exposure
            From `legdistort.read_exposures` or `legdistort.open_exposures`.
        degree : int
            Total degree of the series at least; it is raised, up to 9, until less than 0.001 pixels are left out.
        sigma, static_sigma
            As for `Prior`.

        Returns
        -------
        Prior or dict
            One, if all headers state the same (to 0.001 pixels); else ``{exposure: Prior}``.

        Raises
        ------
        InputError
            If no header has a distortion, or some have none and the others differ.

        Warns
        -----
        AssumptionWarning
            For headers without a distortion where all others state the same, which is then taken for these too.
        """
        from .from_headers import from_headers

        return from_headers(exposures, cls, degree=degree, sigma=sigma, static_sigma=static_sigma)

    @classmethod
    def from_solution(cls, solution: Solution) -> Prior:
        """Static distortion of the exposures of an earlier solution, for nights that come.

        Of several nights it is that about which they scatter, odd ones left out, and `static_sigma` is the scatter of
        single nights and its own error together; infinite where nothing determines it (shear, and maps of degree 2,
        without rolls or a prior). Of one night it is the mean of its exposures, without a width: it does not tell how
        far nights scatter.

        Parameters
        ----------
        solution : Solution
            Of one detector.

        Raises
        ------
        InputError
            If it has several detectors: `from_file` takes one of these.
        """
        from .storage import of_solution

        return of_solution(solution, cls, {})

    def write(self, path: StrPath, *, overwrite: bool = False) -> Path:
        """Write everything to an ASDF file (`legdistort.priors.storage`).

        Or, as ``NAME.fits``, the mean and the table as maps of shifts, ``NAME_x.fits`` and ``NAME_y.fits``, and with
        `static_sigma` maps of their errors, ``NAME_x_err.fits`` and ``NAME_y_err.fits`` (`legdistort.priors.maps`);
        the keyword ``ERRORSOF`` of their headers says of what: ``further night``, with the scatter between nights,
        ``exposure`` of one night, or ``stated``.

        Raises
        ------
        InputError
            If a file exists; for maps, without a mean or the shape of the detector, or with infinite errors.
        """
        from .maps import write_maps
        from .storage import write_prior

        if Path(path).suffix.lower() == ".fits":
            write_maps(self, path, overwrite=overwrite)
            return Path(path)
        return write_prior(self, path, overwrite=overwrite)

    @classmethod
    def read(cls, path: StrPath) -> Prior:
        """Read what `write` wrote."""
        from .storage import read_prior

        return read_prior(path, cls)


def _placed(source, degree, parity, shape, offset):
    """Arguments of `Prior` for a source of another size than the detector."""
    from ..cameras.expansion import expand_placed

    try:
        x, y = (float(value) for value in offset)
    except (TypeError, ValueError):
        x = y = np.nan
    if not np.isfinite([x, y]).all():
        raise InputError(f"offset must be x, y in pixels of the detector, got {offset!r}")
    mean, plane, truncation, covered = expand_placed(source, degree, parity, shape=shape, offset=(x, y))
    if covered < 1:
        warn(
            f"{source.name} covers {100 * covered:.0f} % of the detector; elsewhere its polynomial of degree {degree} "
            "is continued: keep the degree low, or state how uncertain it is (static_sigma, --static-sigma)",
            AssumptionWarning,
        )
    record = source.record() | {"offset": [x, y], "source_shape": list(source.shape), "covered": covered}
    return {"mean": mean, "shape": shape, "truncation": truncation, "plane": plane, "source": record}


@dataclass(frozen=True, eq=False)
class HeaderPrior:
    """As `prior` of `legdistort.run`: that of the headers, with widths as of a `Prior`; ``"header"`` is one without."""

    sigma: np.ndarray | str | None = None
    static_sigma: np.ndarray | None = None

    @property
    def stand_in(self) -> Prior:
        """A prior with the same widths, for checks before a header is read."""
        return Prior([[0.0], [0.0]], **vars(self))

    def read(self, exposures: Sequence[Exposure], degree: int | str) -> Prior | dict[str, Prior]:
        """The prior, or dict of priors; `degree` may be a word."""
        return Prior.from_headers(exposures, degree=3 if isinstance(degree, str) else degree, **vars(self))


def has_distortion(prior):
    """Whether a prior, or any of a dict of them, holds a distortion: its mean is not zero."""
    each = prior.values() if isinstance(prior, dict) else [prior]
    return any(p is not None and np.any(p.mean) for p in each)


def means(prior):
    """A prior, or dict of priors, without the widths; None for one without a mean."""
    if isinstance(prior, dict):
        return {key: means(each) for key, each in prior.items()}
    if isinstance(prior, Prior):
        return None if prior.mean is None else prior.with_sigma(None)
    return prior
