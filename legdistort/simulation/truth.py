"""What a simulation puts in: stars, poses and distortions, drawn from a seed, and the direct model.

The direct model of Bernard et al. (2017, section 2), ``q = T_i(X)``, ``x = q + A_i b(u(q))``, is written here a second
time, with `numpy.polynomial.legendre.legval2d` and the published polynomials of a real instrument and without
`legdistort.geometry.basis`, so that a swapped index or direction in the package cannot hide in its own tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u
from astropy.table import QTable
from numpy.polynomial import legendre
from scipy.spatial import cKDTree

from ..exceptions import InputError
from ..geometry import parallax, similarity
from ..geometry.gsaoi import GsaoiMap
from ..geometry.tangent_plane import TangentPlane

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..cameras.camera import Camera


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulation put in.

    Attributes
    ----------
    names : tuple of str
        Exposures.
    shape : tuple of int
        ``(ny, nx)`` of every exposure.
    positions : ndarray, shape (n_stars, 2)
        Distortion-free positions in the reference plane, pixels; the row is the star's number.
    flux : ndarray, shape (n_stars,), or None
        ADU.
    static : ndarray, shape (2, n_modes)
        Static distortion, normalised Legendre coefficients in pixels. With an `instrument`, which is not a
        polynomial in this direction, the best fit to it of the degree of the dynamic part, mostly 3.
    dynamic : ndarray, shape (n_exposures, 2, n_modes)
        What every exposure adds to it.
    poses, nominal_poses : dict
        ``{name: (2, 3) array}``, reference plane -> undistorted pixels: the true ones, and those that the
        headers or the user know.
    instrument : `~legdistort.geometry.gsaoi.GsaoiMap` or None
        The real static distortion.
    sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
    years : ndarray, shape (n_exposures,), or None
        When the exposures were taken.
    epoch : float or None
        Year of the positions.
    motions : ndarray, shape (n_stars, 2), or None
        Proper motions, pixels a year.
    parallaxes : ndarray, shape (n_stars,), or None
        Pixels.
    camera : `~legdistort.cameras.camera.Camera` or None
        Where several detectors were simulated: pixels of exposures are then those of its focal plane.
    """

    names: tuple[str, ...]
    shape: tuple[int, int]
    positions: np.ndarray
    flux: np.ndarray | None
    static: np.ndarray
    dynamic: np.ndarray
    poses: dict[str, np.ndarray]
    nominal_poses: dict[str, np.ndarray]
    instrument: GsaoiMap | None = None
    sky: TangentPlane | None = None
    years: np.ndarray | None = None
    epoch: float | None = None
    motions: np.ndarray | None = None
    parallaxes: np.ndarray | None = None
    camera: Camera | None = None

    def place(self, name: str) -> np.ndarray:
        """True reference-plane positions (n_stars, 2) of the stars at the time of an exposure."""
        if self.motions is None:
            return self.positions
        i = self.names.index(self._known(name))
        out = self.positions + (self.years[i] - self.epoch) * self.motions
        if self.parallaxes is not None:
            out = out + self.parallaxes[:, None] * parallax.on_plane(self.sky, self.years[i : i + 1])
        return out

    @property
    def coefficients(self) -> np.ndarray:
        """Legendre coefficients of every exposure (n_exposures, 2, n_modes), static part included."""
        return self.static + self.dynamic

    def distort(self, name: str, xy: ArrayLike) -> np.ndarray:
        """True pixels of reference-plane positions (..., 2) in one exposure, noise-free."""
        q = similarity.apply(self.poses[self._known(name)], xy)
        i = self.names.index(name)
        if self.instrument is None:
            return q + displacement(self.coefficients[i], q, self.shape)
        return self.instrument.distort(q) + displacement(self.dynamic[i], q, self.shape)

    def on_detector(self, name: str, detector: str, xy: ArrayLike) -> np.ndarray:
        """True pixels (n, 2) of reference-plane positions (n, 2) on one detector of the camera; NaN far off it."""
        chip, f = self.camera[detector], self.distort(name, xy)
        q = similarity.apply(chip.layout, f)
        near = within(q, chip.shape, -0.1 * max(chip.shape))  # beyond that its series means nothing
        out = np.full(f.shape, np.nan)
        out[near] = chip.to_pixels(f[near])
        return out

    def grid(self, name: str, n: int = 20) -> np.ndarray:
        """Reference-plane positions (n*n, 2) that cover one exposure's detector evenly.

        They are not among the stars: use them, with `distort`, to judge a correction where it was not fitted.
        """
        u_, v = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 2)
        q = np.stack([u_.ravel() * self.shape[1] - 0.5, v.ravel() * self.shape[0] - 0.5], axis=-1)
        return similarity.apply(similarity.invert(self.poses[self._known(name)]), q)

    def table(self) -> QTable:
        """Stars as a QTable; the rest in its meta.

        Columns ``star``, ``x``, ``y``, ``flux``; ``ra``, ``dec`` if known; of stars that move ``vx``, ``vy``,
        ``pmra``, ``pmdec`` and ``parallax``, at the year ``epoch`` of the meta.
        """
        x, y = self.positions.T * u.pix
        out = QTable({"star": np.arange(len(x)), "x": x, "y": y})
        if self.flux is not None:
            out["flux"] = self.flux
        if self.sky is not None:
            sky = self.sky.to_sky(self.positions)
            out["ra"], out["dec"] = sky.ra, sky.dec
        if self.motions is not None:
            self._add_motions(out)
        out.meta |= {"shape": list(self.shape), "static": self.static.tolist()} | {
            name: {"pose": self.poses[name].tolist(), "coefficients": coefficients.tolist()}
            for name, coefficients in zip(self.names, self.coefficients, strict=True)
        }
        if self.years is not None:
            for name, value in zip(self.names, self.years, strict=True):
                out.meta[name]["epoch"] = float(value)
        return out

    def _add_motions(self, table):
        table["vx"], table["vy"] = self.motions.T * u.pix / u.yr
        if self.sky is not None:
            slope = self.sky.jacobian(self.positions) * u.deg.to(u.mas)
            table["pmra"], table["pmdec"] = np.einsum("jab,jb->aj", slope, self.motions) * u.mas / u.yr
        if self.parallaxes is not None:
            table["parallax"] = self.parallaxes * self.sky.pixel_scale * 1000 * u.mas
        table.meta["epoch"] = self.epoch

    def _known(self, name):
        if name not in self.poses:
            raise InputError(f"no exposure {name!r} was simulated; there are {', '.join(self.names)}")
        return name

    def __repr__(self) -> str:
        return f"<Truth: {len(self.positions)} stars, {len(self.names)} exposures, {self.static.shape[1]} modes>"


def mode_orders(degree):
    """Orders (l-k, k) in x and y of the modes, in their order (section 2.1 of the paper), as a list of pairs."""
    return [(total - k, k) for total in range(degree + 1) for k in range(total + 1)]


def displacement(coefficients, q, shape):
    """Displacement (..., 2) [pix] at undistorted pixels q (..., 2), from coefficients (2, n_modes)."""
    degree = int(np.sqrt(2 * coefficients.shape[1])) - 1
    tensor = np.zeros((degree + 1, degree + 1, 2))
    for m, (i, j) in enumerate(mode_orders(degree)):
        tensor[i, j] = coefficients[:, m] * np.sqrt((2 * i + 1) / 2 * (2 * j + 1) / 2)
    q = np.asarray(q, dtype=float)
    x, y = (2 * q[..., 0] + 1) / shape[1] - 1, (2 * q[..., 1] + 1) / shape[0] - 1
    return np.moveaxis(legendre.legval2d(x, y, tensor), 0, -1)


def fit_static(instrument, shape, degree=3):
    """Best Legendre coefficients (2, n_modes) [pix] of an instrument's map, undistorted -> detector pixels."""
    nodes, weights = legendre.leggauss(16)
    x, y = (a.ravel() for a in np.meshgrid(nodes, nodes))
    q = np.stack([((x + 1) * shape[1] - 1) / 2, ((y + 1) * shape[0] - 1) / 2], axis=-1)
    orders = np.array(mode_orders(degree))
    vander = legendre.legvander2d(x, y, (degree, degree)).reshape(-1, degree + 1, degree + 1)
    columns = vander[:, orders[:, 0], orders[:, 1]] * np.sqrt((2 * orders + 1).prod(axis=1) / 4)
    root = np.sqrt(np.outer(weights, weights).ravel())[:, None]
    return np.linalg.lstsq(root * columns, root * (instrument.distort(q) - q), rcond=None)[0].T


def draw_coefficients(rng, spread, degree, n, name, *, zero_mean=False):
    """Normal coefficients (n, 2, n_modes) of standard deviation `spread`: scalar, (n_modes,) or (2, n_modes)."""
    if not (isinstance(degree, (int, np.integer)) and degree >= 0):
        raise InputError(f"degree must be an integer of at least 0, got {degree!r}")
    n_modes = (degree + 1) * (degree + 2) // 2
    try:
        spread = np.broadcast_to(np.asarray(spread, dtype=float), (2, n_modes))
    except ValueError:
        raise InputError(
            f"{name} must be a number, ({n_modes},) or (2, {n_modes}) standard deviations for degree {degree}, "
            f"got shape {np.shape(spread)}"
        ) from None
    if not np.all(spread >= 0):
        raise InputError(f"{name} holds standard deviations, none may be negative or NaN")
    out = spread * rng.normal(size=(n, 2, n_modes))
    return out - out.mean(axis=0) if zero_mean else out


def draw_poses(rng, names, shape, dither, *, rotations=None, flips=None):
    """True poses ``{name: (2, 3)}``: turned and mirrored about the middle of the detector, then shifted."""
    n = len(names)
    shifts = dither * np.sqrt(1.5) * rng.uniform(-1, 1, size=(n, 2))
    rotations = np.zeros(n) if rotations is None else np.radians(rotations)
    flips = np.zeros(n, dtype=bool) if flips is None else np.asarray(flips, dtype=bool)
    for label, values in (("rotations", rotations), ("flips", flips)):
        if np.shape(values) != (n,):
            raise InputError(f"{label} must have one value for each of the {n} exposures, got shape {np.shape(values)}")
    middle = (np.array(shape[::-1]) - 1) / 2
    out = {}
    for name, shift, angle, flip in zip(names, shifts, rotations, flips, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, -s], [s, c]]) @ np.diag([-1.0 if flip else 1.0, 1.0])
        out[name] = np.column_stack([matrix, middle - matrix @ middle + shift])
    return out


def draw_motions(rng, n_stars, n_exposures, motion, parallax, epochs, sky):
    """Motions, parallaxes and times as `Truth` has them."""
    still = not np.any(motion) and not np.any(parallax)
    if epochs is None:
        if still:
            return {}
        raise InputError("stars that move need epochs, the years of the exposures")
    years = checked_epochs(epochs, n_exposures)
    made = {"years": years, "epoch": float(years.mean()), "motions": _drawn(rng, motion, (n_stars, 2), "motion")}
    if np.any(parallax):
        if sky is None:
            raise InputError("parallaxes need sky, the place of the field")
        made["parallaxes"] = _drawn(rng, parallax, (n_stars,), "parallax")
    return made


def checked_epochs(epochs, n_exposures):
    """Years (n_exposures,) of exposures; `InputError` if they are not."""
    years = np.asarray(epochs, dtype=float)
    if years.shape != (n_exposures,) or not np.all((years > 1800) & (years < 2200)):
        raise InputError(f"epochs must be the years of the {n_exposures} exposures, 1800 to 2200, got {epochs!r}")
    return years


def _drawn(rng, given, shape, name):
    """Values of a shape: those given, or drawn with the scatter given."""
    given = np.asarray(given, dtype=float)
    if given.shape not in ((), shape) or not np.isfinite(given).all():
        raise InputError(f"{name} must be a number or an array of shape {shape}, got shape {given.shape}")
    return given * rng.normal(size=shape) if given.ndim == 0 else given


def draw_stars(rng, n, region, inside, least, *, separation=0.0):
    """Positions (n, 2), uniform in `region`, on at least `least` exposures by ``inside(xy)`` -> (n_exposures, n)."""
    kept = np.empty((0, 2))
    for _ in range(200):
        batch = rng.uniform(*region, size=(n, 2))
        batch = batch[np.count_nonzero(inside(batch), axis=0) >= least]
        if separation == 0:
            kept = np.vstack([kept, batch])
        else:
            free = cKDTree(kept).query(batch)[0] >= separation if len(kept) else slice(None)
            for xy in batch[free]:
                if np.all(np.hypot(*(kept - xy).T) >= separation):
                    kept = np.vstack([kept, xy])
        if len(kept) >= n:
            return kept[:n]
    found = f"only {len(kept)} of {n} stars found a place on {least} exposures or more"
    if separation:
        raise InputError(f"{found}, {separation:.0f} px apart: ask for fewer stars, or for smaller dithers")
    raise InputError(
        f"{found}: the dithers, and a margin if there is one, leave too little of the detector that {least} exposures "
        "share; make them smaller, or (in Python) give a smaller min_exposures"
    )


def footprint(pose_list, shape):
    """Lower and upper corner, (2,) each, of the box in the reference plane that holds all the detectors."""
    ny, nx = shape
    corners = np.array([(-0.5, -0.5), (nx - 0.5, -0.5), (-0.5, ny - 0.5), (nx - 0.5, ny - 0.5)])
    back = np.concatenate([similarity.apply(similarity.invert(pose), corners) for pose in pose_list])
    return back.min(axis=0), back.max(axis=0)


def within(xy, shape, margin=0.0):
    """Whether pixels (..., 2) lie on the detector, at least `margin` from its edge."""
    return np.all((xy >= margin - 0.5) & (xy <= np.array(shape[::-1]) - 0.5 - margin), axis=-1)


def exposure_names(n):
    """``exp00``, ``exp01`` and so on."""
    width = max(2, len(str(n - 1)))
    return tuple(f"exp{i:0{width}d}" for i in range(n))


def shifted(pose, shift):
    """The pose with `shift` (2,) [pix] added on the detector."""
    return np.column_stack([pose[:, :2], pose[:, 2] + shift])
