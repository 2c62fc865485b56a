"""Where planned exposures and stars lie, and which star will be measured where and how well."""

from dataclasses import dataclass
from numbers import Real

import numpy as np
from astropy import units as u
from astropy.table import Table

from ..exceptions import InputError
from ..geometry import similarity
from ..inputs import column_contract
from ..runtime.checks import check_counts
from . import truth
from .observations import matches_from, position_errors


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
    """

    positions: np.ndarray
    poses: dict
    shape: tuple
    observed: np.ndarray
    errors: np.ndarray

    @property
    def sigma(self):
        """Rms error of a measured position per axis, pixels."""
        return float(np.sqrt(np.mean(self.errors[self.observed] ** 2)))

    def matches(self, static):
        """The positions that will be matched, without noise, for a static distortion (2, n_modes)."""
        names = tuple(self.poses)
        plan = truth.Truth(
            names, self.shape, self.positions, None, static, np.zeros((len(names), 1, 1)), self.poses, self.poses
        )
        return matches_from(plan, self.observed, self.errors, np.random.default_rng(0), noise=0)

    def axes(self, n):
        """Coordinates x, y of a grid of the field, n points along its longer side, as centres of cells."""
        low, high = truth.footprint(self.poses.values(), self.shape)
        n_xy = np.maximum(1, np.rint(n * (high - low) / (high - low).max())).astype(int)
        return tuple(a + (b - a) * (np.arange(m) + 0.5) / m for a, b, m in zip(low, high, n_xy, strict=True))


def lay_out(*, n_exposures, stars, n_stars, density, sigma, shape, dithers, poses, min_exposures, seed):
    """A `Layout` from the arguments of `legdistort.predict`, which explains them.

    Raises
    ------
    InputError
        For arguments out of range or in contradiction.
    """
    check_counts(n_exposures=n_exposures)
    if np.shape(shape) != (2,):
        raise InputError(f"shape must be (ny, nx) of the detector, got {shape!r}")
    shape = tuple(shape)
    check_counts(**dict(zip(("ny in shape", "nx in shape"), shape, strict=True)))
    if min_exposures is None:
        min_exposures = min(4, n_exposures)
    if min_exposures not in range(1, n_exposures + 1):
        raise InputError(f"min_exposures must be from 1 to the {n_exposures} exposures, got {min_exposures!r}")
    star_rng, _, pose_rng, _ = np.random.default_rng(seed).spawn(4)  # as in simulate_matches
    pose_list = _poses(n_exposures, shape, dithers, poses, pose_rng)

    def inside(xy):
        return np.array([truth.within(similarity.apply(pose, xy), shape) for pose in pose_list.values()])

    if sum(value is not None for value in (stars, n_stars, density)) != 1:
        raise InputError("one of stars (positions), n_stars (how many) and density (how many a detector) is needed")
    region = truth.footprint(pose_list.values(), shape)
    if stars is not None:
        positions = _positions(stars)
    elif n_stars is not None:
        check_counts(n_stars=n_stars)
        positions = truth.draw_stars(star_rng, n_stars, region, inside, min_exposures)
    else:
        if not (isinstance(density, Real) and 0 < density < np.inf):
            raise InputError(f"density must be a positive number of stars a detector, got {density!r}")
        count = round(density * np.prod(region[1] - region[0]) / np.prod(shape))
        positions = star_rng.uniform(*region, size=(count, 2))
    observed = inside(positions)
    observed &= np.count_nonzero(observed, axis=0) >= min_exposures
    if not observed.any():
        raise InputError(
            f"none of {len(positions)} stars lies on {min_exposures} or more of the detectors; positions are pixels of "
            f"the reference plane, here from {region[0].round()} to {region[1].round()} (x, y)"
        )
    return Layout(positions, pose_list, shape, observed, _errors(sigma, stars, n_exposures, len(positions)))


def _poses(n_exposures, shape, dithers, given, rng):
    """``{exposure: (2, 3)}``, given or made of dithers."""
    if given is not None:
        if np.any(dithers):
            raise InputError("poses and dithers both say where the exposures lie: leave one out")
        if len(given) != n_exposures:
            raise InputError(f"poses has {len(given)} exposures, n_exposures is {n_exposures}")
        return {str(name): similarity.check(pose, f"pose of exposure {name!r}") for name, pose in given.items()}
    shifts = np.asarray(dithers, dtype=float)
    if shifts.shape not in ((), (n_exposures, 2)) or not np.isfinite(shifts).all() or (shifts.ndim == 0 and shifts < 0):
        raise InputError(
            f"dithers must be an rms length in pixels, or one shift for each exposure, shape ({n_exposures}, 2), got "
            f"{dithers if shifts.ndim == 0 else f'shape {shifts.shape}'}"
        )
    names = truth.exposure_names(n_exposures)
    if shifts.ndim == 0:
        return truth.draw_poses(rng, names, shape, float(shifts))
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


def _errors(sigma, stars, n_exposures, n):
    """Errors (n_exposures, n, 2) from `sigma` or from the columns of the table of stars."""
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
    return position_errors(sigma, n_exposures, n)
