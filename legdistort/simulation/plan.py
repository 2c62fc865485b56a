"""Observations that are planned, as asked for, and where their stars will be measured, and how well."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import Table

from ..cameras.camera import Camera, check_camera
from ..exceptions import InputError
from ..geometry import basis, similarity
from ..geometry.tangent_plane import TangentPlane
from ..inputs import column_contract
from ..priors.prior import Prior
from ..runtime.checks import check_counts, check_positive
from ..solving.equations.problem import as_given
from ..solving.terms.term import RandomField, Term, listed
from . import observations, truth
from .instruments import star_counts
from .instruments.instrument import Instrument

#: What is stated of the exposures for terms.
OF_EXPOSURES = "tan_z", "parallactic_angle"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Plan:
    """What is planned: the arguments of `legdistort.predict`, which explains them.

    Raises
    ------
    InputError
        For a value out of range.
    """

    n_exposures: int
    stars: np.ndarray | None
    n_stars: int | None
    density: float | None
    sigma: Any
    degree: int
    shape: tuple[int, int]
    dithers: Any
    poses: dict[str, np.ndarray] | None
    prior: Prior | None
    dynamic: Any
    spectrum: Any
    static_spectrum: Any
    min_exposures: int | None
    n_grid: int
    seed: int
    epochs: Any = None
    field: SkyCoord | None = None
    camera: Camera | None = None
    pixel_scale: float | None = None
    terms: tuple[Term | RandomField, ...] = ()
    tan_z: Any = None
    parallactic_angle: Any = None
    instrument: Instrument | None = None

    def __post_init__(self) -> None:
        for name, value in self._of_instrument().items():
            object.__setattr__(self, name, value)
        for name, value in zip(("shape", "prior"), self._field(), strict=True):
            object.__setattr__(self, name, value)
        self._check_epochs()
        object.__setattr__(self, "terms", tuple(_sized(term) for term in listed(self.terms)))
        self._check_terms()
        check_counts(n_grid=self.n_grid, n_exposures=self.n_exposures)
        object.__setattr__(self, "degree", basis.check_degree(self.degree))
        if self.pixel_scale is not None:
            check_positive(self.pixel_scale, "pixel_scale", "number of arcsec")
        if not isinstance(self.prior, Prior | None):
            raise InputError(f"prior must be a Prior, got {as_given(self.prior)}")
        if np.shape(self.shape) != (2,):
            raise InputError(f"shape must be (ny, nx) of the detector, got {self.shape!r}")
        check_counts(**dict(zip(("ny in shape", "nx in shape"), self.shape, strict=True)))
        if self.least not in range(1, self.n_exposures + 1):
            raise InputError(
                f"min_exposures must be from 1 to the {self.n_exposures} exposures, got {self.min_exposures!r}"
            )
        if sum(value is not None for value in (self.stars, self.n_stars, self.density)) != 1:
            raise InputError("one of stars (positions), n_stars (how many) and density (how many a detector) is needed")
        if self.n_stars is not None:
            check_counts(n_stars=self.n_stars)
        if self.density is not None and not (isinstance(self.density, Real) and 0 < self.density < np.inf):
            raise InputError(f"density must be a positive number of stars a detector, got {self.density!r}")

    def _of_instrument(self):
        """What an instrument states, the camera and its scale; stars have magnitudes then, and no errors."""
        if self.instrument is None:
            if self.has_counts:
                raise InputError("stars is a luminosity function, which needs an instrument: give instrument")
            return {}
        if not isinstance(self.instrument, Instrument):
            raise InputError(f"instrument must be a legdistort.Instrument, got {as_given(self.instrument)}")
        stated = {name: getattr(self.instrument, name) for name in ("camera", "pixel_scale")}
        for name, value in stated.items():
            if getattr(self, name) not in (None, value):
                raise InputError(f"{name} is stated by the instrument: leave it out")
        if self.sigma is not None:
            raise InputError("sigma and instrument both state the errors: leave one out")
        if not self.has_counts and not (isinstance(self.stars, Table) and "mag" in self.stars.colnames):
            raise InputError(
                "an instrument measures stars of magnitudes: give stars as a table with x, y and mag, or as a "
                "luminosity function, with mag and density"
            )
        return stated

    def _field(self):
        """Shape and prior: the focal plane of a camera takes the place of the detector, and it is the prior."""
        camera, shape = self.camera, self.shape
        if camera is None:
            return (2048, 2048) if shape is None else shape, self.prior
        check_camera(camera)
        if shape is not None and tuple(shape) != camera.field:
            raise InputError("shape and camera both state the size of the field: leave shape out")
        if self.prior is not None or not camera.has_focal_plane:
            return camera.field, self.prior
        widths = camera.common_sigma
        mean = np.zeros((2, 1) if widths is None else widths.shape)
        return camera.field, Prior(mean, static_sigma=widths, source=f"camera {camera.name}")

    def _check_epochs(self):
        """When the exposures will be taken, and where the field lies."""
        if self.epochs is None:
            if self.field is not None:
                raise InputError("field, the place on the sky, is for parallaxes: give epochs too")
            return
        years = np.asarray(self.epochs, dtype=float)
        if years.shape != (self.n_exposures,) or not np.isfinite(years).all():
            raise InputError(f"epochs must be the years of the {self.n_exposures} exposures, got {self.epochs!r}")
        if self.field is not None and not (isinstance(self.field, SkyCoord) and self.field.isscalar):
            raise InputError(f"field must be the place on the sky as one SkyCoord, got {self.field!r}")

    @property
    def has_counts(self) -> bool:
        """Whether the stars are to be drawn from a luminosity function."""
        return isinstance(self.stars, Table) and star_counts.is_counts(self.stars)

    @property
    def has_focal_plane(self) -> bool:
        """Whether detectors lie in a focal plane, see `Camera.has_focal_plane`."""
        return bool(self.camera) and self.camera.has_focal_plane

    @property
    def motion(self) -> str | None:
        """What of the motions of stars will be fitted, or None."""
        return None if self.epochs is None else "proper" if self.field is None else "parallax"

    @property
    def sky(self) -> TangentPlane | None:
        """The field on the sky, north up; the scale is of no matter."""
        if self.field is None:
            return None
        place, pixel = self.field.icrs, 1e-5
        matrix = pixel * np.array([[-1.0, 0, self.shape[1] / 2], [0, 1.0, -self.shape[0] / 2]])
        return TangentPlane(place.ra.deg, place.dec.deg, matrix)

    @property
    def has_fields(self) -> bool:
        """Whether every exposure has a random field."""
        return any(isinstance(term, RandomField) for term in self.terms)

    def columns(self, n: int) -> dict[str, np.ndarray]:
        """Columns that terms need, of n stars in every exposure: ``{name: (n_exposures, n)}``."""
        listed_stars = isinstance(self.stars, Table) and not self.has_counts
        stars, made = self.stars if listed_stars else Table(), {}
        for name in dict.fromkeys(name for term in self.terms for name in getattr(term, "needs", ())):
            found = column_contract.colour_column(stars) if name == "colour" else name
            if name in OF_EXPOSURES and getattr(self, name) is not None:
                made[name] = np.asarray(getattr(self, name), dtype=float)[:, None]
            elif found in stars.colnames:
                made[found] = stars[found]
        return {name: np.broadcast_to(values, (self.n_exposures, n)) for name, values in made.items()}

    def _check_terms(self):
        """Terms that are of detectors, and what is stated of the exposures for others."""
        if self.has_focal_plane and (own := [term.name for term in self.terms if term.owner == "detector"]):
            raise InputError(f"term {own[0]} is of every detector: leave the camera out, and give the shape of one")
        for name in OF_EXPOSURES:
            if (given := getattr(self, name)) is None:
                continue
            if not any(name in getattr(term, "needs", ()) for term in self.terms):
                raise InputError(f"{name} is for terms that need it, such as refraction: give terms, or leave it out")
            values = np.asarray(given, dtype=float)
            if values.shape != (self.n_exposures,) or not np.isfinite(values).all():
                raise InputError(f"{name} must be a number for each of the {self.n_exposures} exposures, got {given!r}")

    @property
    def least(self) -> int:
        """Exposures that a star must be on: four, or all if there are fewer, unless `min_exposures` is given."""
        return min(4, self.n_exposures) if self.min_exposures is None else self.min_exposures

    def __repr__(self) -> str:
        return f"<Plan: {self.n_exposures} exposures, degree {self.degree}>"


@dataclass(frozen=True, eq=False)
class Layout:
    """A planned set of exposures.

    Attributes
    ----------
    positions : ndarray, shape (n_all, 2)
        All stars, reference-plane pixels.
    poses : dict
        ``{exposure: (2, 3)}``, reference plane -> undistorted pixels.
    shape : tuple
        ``(ny, nx)`` of the detector.
    observed : ndarray of bool, shape (n_exposures, n_all)
        What will be measured: stars on the detector, if on enough exposures.
    errors : ndarray, shape (n_exposures, n_all, 2)
        Standard deviations, pixels.
    years : ndarray, shape (n_exposures,), or None
    sky : TangentPlane or None
    columns : dict
        ``{name: (n_exposures, n_all)}`` that terms need.
    terms : tuple of Term or RandomField
    mag : ndarray, shape (n_all,), or None
        Magnitudes, of stars that an instrument measures.
    """

    positions: np.ndarray
    poses: dict
    shape: tuple
    observed: np.ndarray
    errors: np.ndarray
    years: np.ndarray | None = None
    sky: TangentPlane | None = None
    columns: dict = field(default_factory=dict)
    terms: tuple = ()
    mag: np.ndarray | None = None

    @property
    def stars(self):
        """The stars as `predict` takes them again."""
        return self.positions if self.mag is None else Table([*self.positions.T, self.mag], names=("x", "y", "mag"))

    @property
    def sigma(self):
        """Rms error of a measured position per axis, pixels."""
        return float(np.sqrt(np.mean(self.errors[self.observed] ** 2)))

    def matches(self, static):
        """The positions that will be matched, without noise, for a static distortion (2, n_modes)."""
        names = tuple(self.poses)
        zero = np.zeros((len(names), 1, 1))
        plan = truth.Truth(
            names, self.shape, self.positions, None, static, zero, self.poses, self.poses, years=self.years
        )
        rng = np.random.default_rng(0)
        matches = observations.matches_from(plan, self.observed, self.errors, rng, noise=0, sky=self.sky)
        table, at = matches.table.copy(copy_data=False), {name: i for i, name in enumerate(names)}
        exposure, star = [at[str(name)] for name in table["exposure"]], np.asarray(table["star"])
        for name, values in self.columns.items():
            table[name] = values[exposure, star]
        for term in self.terms:
            if isinstance(term, Term) and (lacking := term.lacking(table)):
                raise InputError(
                    f"term {term.name} needs {', '.join(lacking)}: give stars as a table with such columns, and "
                    f"{' and '.join(OF_EXPOSURES)} of the exposures (--tan-z, --parallactic-angle)"
                )
        return replace(matches, table=table)

    def axes(self, n):
        """Coordinates x, y of a grid of the field, n points along its longer side, as centres of cells."""
        low, high = truth.footprint(self.poses.values(), self.shape)
        n_xy = np.maximum(1, np.rint(n * (high - low) / (high - low).max())).astype(int)
        return tuple(a + (b - a) * (np.arange(m) + 0.5) / m for a, b, m in zip(low, high, n_xy, strict=True))


def lay_out(plan):
    """The `Layout` of a `Plan`.

    Raises
    ------
    InputError
        If its stars, dithers, poses or errors have a wrong shape or value, or no star is on enough exposures.
    """
    star_rng, _, pose_rng, _ = np.random.default_rng(plan.seed).spawn(4)  # as in simulate_matches
    shape = tuple(plan.shape)
    pose_list = _poses(plan, pose_rng)

    def inside(xy):
        placed = [similarity.apply(pose, xy) for pose in pose_list.values()]
        if plan.has_focal_plane:
            return np.array([np.any(plan.camera.sees(q), axis=0) for q in placed])
        return np.array([truth.within(q, shape) for q in placed])

    region = truth.footprint(pose_list.values(), shape)
    mag = None
    if plan.has_counts:
        mag, positions = _draw_counts(plan, region, star_rng)
    elif plan.stars is not None:
        positions = _positions(plan.stars)
        mag = None if plan.instrument is None else column_contract.values(plan.stars, "mag", u.mag)
    elif plan.n_stars is not None:
        positions = truth.draw_stars(star_rng, plan.n_stars, region, inside, plan.least)
    else:
        sizes = [each.shape for each in plan.camera.detectors.values()] if plan.has_focal_plane else [shape]
        count = round(plan.density * np.prod(region[1] - region[0]) / np.mean(np.prod(sizes, axis=1)))
        positions = star_rng.uniform(*region, size=(count, 2))
    planes = np.array([similarity.apply(pose, positions) for pose in pose_list.values()])
    observed, (errors, measured) = inside(positions), _errors(plan, planes, mag)
    if not (observed & measured).any() and observed.any():
        bright, faint = plan.instrument.widest_limits
        raise InputError(f"none of {len(positions)} stars is measured, from {bright:.2f} to {faint:.2f} mag")
    observed &= measured
    observed &= np.count_nonzero(observed, axis=0) >= plan.least
    if not observed.any():
        raise InputError(
            f"none of {len(positions)} stars lies on {plan.least} or more of the detectors; positions are pixels of "
            f"the reference plane, here from {region[0].round()} to {region[1].round()} (x, y)"
        )
    years = None if plan.epochs is None else np.asarray(plan.epochs, dtype=float)
    if plan.has_focal_plane:
        errors = np.array([plan.camera.errors_in_focal_plane(f, e) for f, e in zip(planes, errors, strict=True)])
    columns = plan.columns(len(positions))
    return Layout(positions, pose_list, shape, observed, errors, years, plan.sky, columns, plan.terms, mag)


def _draw_counts(plan, region, rng):
    """Magnitudes (n,) and positions (n, 2) of the stars of a luminosity function that are measured somewhere."""
    area = float(np.prod(region[1] - region[0])) * plan.pixel_scale**2
    mag = star_counts.draw_magnitudes(plan.stars, area, plan.instrument.widest_limits, rng)
    return mag, rng.uniform(*region, size=(len(mag), 2))


def _sized(term):
    """A term whose sizes are stated, and which a forecast can have."""
    if isinstance(term, RandomField):
        if term.size is None:
            raise InputError(
                f"a forecast finds no sizes: give {term.name} its own, "
                f"Term.named({term.name!r}, size=0.1, length=200) [pix] (--term {term.name}=0.1:200)"
            )
        return term
    if hasattr(term.columns, "basis"):
        raise InputError(f"a forecast has no distortion that is rougher than the series: leave {term.name} out")
    if term.each:
        raise InputError(
            f"which stars have the term {term.name} is not known before they are seen: leave it out, or let all have "
            f"it, of a stated size (Term.named({term.name!r}, each=False, sigma=...))"
        )
    if term.sigma is None:
        raise InputError(
            f"a forecast finds no sizes: give {term.name} its own, Term.named({term.name!r}, sigma=0.03) "
            f"[{term.unit}] (--term {term.name}=0.03)"
        )
    return term


def _poses(plan, rng):
    """``{exposure: (2, 3)}``, given or made of dithers."""
    n_exposures = plan.n_exposures
    if plan.poses is not None:
        if np.any(plan.dithers):
            raise InputError("poses and dithers both state where the exposures lie: leave one out")
        if len(plan.poses) != n_exposures:
            raise InputError(f"poses has {len(plan.poses)} exposures, n_exposures is {n_exposures}")
        return {str(name): similarity.check(pose, f"pose of exposure {name!r}") for name, pose in plan.poses.items()}
    shifts = np.asarray(plan.dithers, dtype=float)
    if shifts.shape not in ((), (n_exposures, 2)) or not np.isfinite(shifts).all() or (shifts.ndim == 0 and shifts < 0):
        raise InputError(
            f"dithers must be an rms length in pixels, or one shift for each exposure, shape ({n_exposures}, 2), got "
            f"{plan.dithers if shifts.ndim == 0 else f'shape {shifts.shape}'}"
        )
    names = truth.exposure_names(n_exposures)
    if shifts.ndim == 0:
        return truth.draw_poses(rng, names, tuple(plan.shape), float(shifts))
    return {name: np.column_stack([np.eye(2), shift]) for name, shift in zip(names, shifts, strict=True)}


def _positions(stars):
    """Positions (n, 2) from an array or a table."""
    if isinstance(stars, Table):
        missing = [name for name in ("x", "y") if name not in stars.colnames]
        if missing:
            raise InputError(f"the table of stars has no column {missing[0]}; it has {', '.join(stars.colnames)}")
        xy = np.column_stack([column_contract.values(stars, name, u.pix) for name in ("x", "y")])
    else:
        xy = np.asarray(stars, dtype=float)
    if xy.ndim != 2 or xy.shape[1] != 2 or not len(xy):
        raise InputError(f"stars must be positions of shape (n, 2) or a table with x, y, got shape {xy.shape}")
    if not np.isfinite(xy).all():
        row = int(np.flatnonzero(~np.isfinite(xy).all(axis=1))[0])
        raise InputError(f"stars has a position that is not finite in row {row}: leave it out")
    return xy


def _errors(plan, planes, mag):
    """Errors (n_exposures, n, 2) of stars at the places (n_exposures, n, 2), and which are measured, (n_exposures, n).

    Stated, from the columns of the table of stars, or from magnitudes by an instrument.
    """
    if plan.instrument is not None:
        places = (planes - (np.array(plan.shape[::-1]) - 1) / 2) * plan.pixel_scale
        errors = np.array([plan.instrument.position_error(mag, at=each) for each in places])
        measured = np.array([plan.instrument.measures(mag, at=each) for each in places])
        return np.stack([errors, errors], axis=-1), measured
    return _stated_errors(plan, planes.shape[1]), True


def _stated_errors(plan, n):
    """Errors (n_exposures, n, 2) of n stars, stated or from the columns of the table of stars."""
    sigma, stars = plan.sigma, plan.stars
    columns = stars.colnames if isinstance(stars, Table) else ()
    if sigma is None:
        if "x_err" not in columns or "y_err" not in columns:
            raise InputError(
                "sigma is needed: the error of one measured position in pixels (or stars with x_err, y_err)"
            )
        if "x_err_abs" in columns:
            raise InputError(
                "x_err and y_err of the stars of a solution are errors of reference positions, not of single "
                "measurements: give sigma"
            )
        sigma = np.stack([column_contract.values(stars, name, u.pix) for name in ("x_err", "y_err")], axis=-1)[None]
    elif callable(sigma):
        if "flux" not in columns:
            raise InputError("sigma is a function of the flux, but stars is not a table with a column flux")
        sigma = sigma(column_contract.values(stars, "flux"))
    sigma = np.asarray(sigma, dtype=float)
    if not np.all((sigma > 0) & np.isfinite(sigma)):
        raise InputError(
            f"sigma must be positive and finite everywhere, got {sigma if sigma.ndim == 0 else sigma.min()}"
        )
    return observations.position_errors(sigma, plan.n_exposures, n)
