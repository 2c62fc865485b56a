"""Proper motions and parallaxes of the stars of a solution, with their errors."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from astropy import units as u
from numpy.polynomial import legendre

from ..exceptions import InputError
from ..geometry import parallax
from ..geometry.epochs import ONE_EPOCH
from ..inputs.column_contract import correlation
from ..runtime.notebook import ShownAsPrinted
from ..runtime.trees.facts import YEARS, array, text

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..geometry.tangent_plane import TangentPlane

#: Degrees of the polynomials of time that follow an orbit, once round it, to a thousandth of its size.
_ORBIT = range(2, 9)
#: Units of the terms of stars in the reference plane and on the sky, and their names there.
UNITS = {"vx": u.pix / u.yr, "vy": u.pix / u.yr, "parallax": u.pix}


@dataclass(frozen=True, eq=False)
class StarMotions(ShownAsPrinted):
    """What moves the stars from exposure to exposure.

    Attributes
    ----------
    names : tuple of str
        Of the terms: "vx", "vy" [pix/yr], "parallax" [pix].
    values : ndarray, shape (n_stars, k)
        NaN for what the observations of a star do not determine.
    epoch : float
        Julian year of the positions.
    years : ndarray, shape (n_exposures,)
        When the exposures were taken.
    chi2 : ndarray, shape (n_stars,)
        Of the used observations of every star.
    n_epochs : ndarray of int, shape (n_stars,)
        At which it was used; exposures within a day count as one.
    span : ndarray, shape (n_stars,)
        Between the first and the last of them, years.
    """

    names: tuple[str, ...] = field(metadata=text(*UNITS, length="n_terms"))
    values: np.ndarray = field(metadata=array("n_stars", "n_terms", unit="pix/yr, pix", nan=True))
    epoch: float = field(metadata=YEARS)
    years: np.ndarray = field(metadata=array("n_exposures", unit="yr", minimum=1800, maximum=2200))
    chi2: np.ndarray = field(metadata=array("n_stars", minimum=0))
    n_epochs: np.ndarray = field(metadata=array("n_stars", holds="integers", minimum=0))
    span: np.ndarray = field(metadata=array("n_stars", unit="yr", minimum=0))

    @property
    def longest(self) -> float:
        """Between the epoch and an exposure, years, at least a day."""
        return max(float(np.abs(self.years - self.epoch).max()), ONE_EPOCH)

    @property
    def kind(self) -> str:
        """Either "proper" or "parallax"."""
        return "parallax" if "parallax" in self.names else "proper"

    def displacement(self, years: float, sky: TangentPlane | None = None) -> np.ndarray:
        """Displacements (n_stars, 2) [pix] from the epoch to another year; zero for stars without a motion."""
        return np.nan_to_num(self.values) @ self.columns([years], sky)[0].T

    def columns(self, years: ArrayLike, sky: TangentPlane | None = None) -> np.ndarray:
        """Displacements (n, 2, k) [pix] at years (n,) for a unit of each term; zero for parallaxes without a sky."""
        years = np.asarray(years, dtype=float)
        out = (years - self.epoch)[:, None, None] * np.eye(2, len(self.names))
        if self.kind == "parallax" and sky is not None:
            out[:, :, 2] = parallax.on_plane(sky, years)
        return out

    def carried(self, covariance: np.ndarray, years: float, sky: TangentPlane | None = None) -> np.ndarray:
        """Covariance (n_stars, 2 + k, 2 + k) with positions of another year from that with those of the epoch."""
        change = self.change(years, sky)
        return change @ covariance @ change.T

    def change(self, years: float, sky: TangentPlane | None = None) -> np.ndarray:
        """How positions at another year, and what moves stars, follow these at the epoch, (2 + k, 2 + k)."""
        out = np.eye(2 + len(self.names))
        out[:2, 2:] = self.columns([years], sky)[0]
        return out

    def __repr__(self) -> str:
        n = int(np.isfinite(self.values[:, 0]).sum())
        return f"<StarMotions: {self.kind}, {n} of {len(self.values)} stars, positions of {self.epoch:.3f}>"

    @property
    def sentence(self) -> str:
        """What was fitted, in a sentence."""
        what = "proper motions and parallaxes" if self.kind == "parallax" else "proper motions"
        n, once, twice = (int(np.sum(at)) for at in (self.n_epochs > 1, self.n_epochs == 1, self.n_epochs == 2))
        words = f"{what} of {n} stars over {np.ptp(self.years):.2f} yr; positions are those of {self.epoch:.4f}"
        if once:
            where = "stays where it was" if once == 1 else "stay where they were"
            words += f"; {once} seen at a single epoch {where} then"
        if twice:
            words += f"; {twice} seen at two epochs only, so that no observation checks the motion{'s' * (twice > 1)}"
        return words


def accelerated(time, _span):
    """Paths (1, n) of unit acceleration at times (n,) since the epoch."""
    return 0.5 * np.asarray(time)[None] ** 2


def smooth_paths(time, span):
    """Paths (7, n) beyond a straight motion at times (n,) since the epoch, for exposures up to `span` from it.

    Legendre polynomials without what they are at the epoch, in place and rate: position and motion are those then.
    """
    u, out = np.asarray(time) / span, []
    for degree in _ORBIT:
        series = legendre.Legendre.basis(degree)
        out.append(series(u) - series(0.0) - series.deriv()(0.0) * u)
    return np.stack(out)


#: Names of the numbers of a path, along x and along y, and the paths, of terms of which stars are the owners.
PATHS = {
    "acceleration": (("ax", "ay"), accelerated),
    "orbits": (tuple(f"{axis} {degree}" for degree in _ORBIT for axis in "xy"), smooth_paths),
}


def curved(solution, time):
    """What terms that bend the paths of stars add at a time: displacements (n_stars, 2), their responses (.., 2, r)."""
    estimate, found = solution.estimate, solution.diagnostics.terms
    errors, motions = estimate.uncertainty.camera, fitted(estimate.motions)
    size = 0 if errors is None else errors.changes.shape[1]
    moved, responses = np.zeros((len(estimate.star_names), 2)), np.zeros((len(estimate.star_names), 2, size))
    number, index = 0, {str(name): j for j, name in enumerate(estimate.star_names)}
    for each in found:
        if each.name in PATHS:
            names, paths = PATHS[each.name]
            path = paths(np.array([time - motions.epoch]), motions.longest)[:, 0]
            for k, (owner, name, value) in enumerate(zip(each.owners, each.numbers, each.values, strict=True)):
                n = names.index(name)
                moved[index[owner], n % 2] += path[n // 2] * value
                if errors is not None and errors.numbers is not None:
                    responses[index[owner], n % 2] += path[n // 2] * errors.numbers[number + k]
        number += len(each.values)
    return moved, responses


def fitted(motions):
    """The motions of a solution; `InputError` where they were not fitted."""
    if motions is None:
        raise InputError("the motions of the stars were not fitted: call solve with motion='proper'")
    return motions


def add_motions(table, motions, relative, absolute, xy, sky):
    """Add the columns of motions to a table of stars; on the sky, if that is known, named as in the Gaia catalogue.

    Parameters
    ----------
    table : `~astropy.table.QTable`
    motions : StarMotions
    relative, absolute : ndarray, shape (n_stars, 2 + k, 2 + k)
        Covariances of the unknowns of the stars, `legdistort.results.errors.absolute_errors`.
    xy : ndarray, shape (n_stars, 2)
    sky : TangentPlane or None
    """
    k = motions.values.shape[1]
    _add(table, ("vx", "vy"), [UNITS["vx"]] * 2, ("err", "err_abs"), motions.values, relative, absolute)
    _add_correlations(table, ("x", "y", *motions.names), relative)
    table["chi2"], table["n_epochs"], table["span"] = motions.chi2, motions.n_epochs, motions.span * u.yr
    if sky is None:
        return
    mas = sky.pixel_scale * 1000
    turn = np.zeros((len(xy), 2 + k, 2 + k))
    turn[:, :2, :2] = turn[:, 2:4, 2:4] = sky.jacobian(np.nan_to_num(xy)) * u.deg.to(u.mas)
    turn[:, 4:, 4:] = mas
    values = np.einsum("jab,jb->ja", turn[:, 2:4, 2:4], motions.values[:, :2])
    values = np.hstack([values, mas * motions.values[:, 2:]])
    relative, absolute = (turn @ each @ turn.transpose(0, 2, 1) for each in (relative, absolute))
    names = ("pmra", "pmdec", "parallax")[:k]
    _add(table, names, [u.mas / u.yr] * 2 + [u.mas], ("error", "error_abs"), values, relative, absolute)
    _add_correlations(table, ("ra", "dec", *names), relative)


def _add(table, names, units, suffixes, values, relative, absolute):
    """Columns of values (n_stars, k) with their relative and absolute errors."""
    for k, (name, unit) in enumerate(zip(names, units, strict=False)):
        table[name] = values[:, k] * unit
        for suffix, each in zip(suffixes, (relative, absolute), strict=True):
            table[f"{name}_{suffix}"] = np.sqrt(each[:, 2 + k, 2 + k]) * unit


def _add_correlations(table, names, covariance):
    """Columns of the correlations of unknowns, those of the position aside."""
    error = np.sqrt(np.einsum("jaa->aj", covariance))
    for a, b in combinations(range(len(names)), 2):
        if b > 1:
            table[correlation(names[a], names[b])] = covariance[:, a, b] / (error[a] * error[b])
