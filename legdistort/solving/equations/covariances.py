"""Covariances of a solution in its gauge, computed when first asked for."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...exceptions import AssumptionWarning, SolveError, warn
from ...results.errors.coefficient_covariance import exposure_block, times
from ...results.errors.common_maps import CommonFit, modes_for, of_normal, plain_maps
from ...results.gauge import UnknownDirection
from . import criterion, elimination, reduced_system
from .problem import State
from .star_system import OnStars
from .star_terms import packed, unpacked

if TYPE_CHECKING:
    from ...results.errors.camera_errors import CameraErrors
    from ...results.gauge import Gauge

#: Beyond this many coefficients the dense covariance is replaced by its diagonal blocks.
DENSE_LIMIT = 8000
#: Coefficients from which on they are coupled through the stars where that is less, and numbers of that at most.
COUPLED_FROM, _MOST_COUPLED = 2000, 5e7
#: Stars whose errors by approximated blocks are compared with exact ones.
_N_CHECKED = 50


class Uncertainty:
    """Errors of coefficients and star positions (relative: in the gauge).

    ``cov(A) = S^-1`` on the constraints of the gauge and
    ``cov(X_j) = V_j^-1 + V_j^-1 E cov(A) E' V_j^-1``.

    Parameters
    ----------
    problem : Problem
    blocks : Blocks
        At the solution.
    gauge : Gauge
    scale : float
        Factor on all standard deviations (1: the stated errors are taken as they are).
    coefficients : ndarray, optional
        Covariance of the coefficients, if they were found in another way than with the stars, `scale` in it.
    shared_errors : ndarray, shape (3, n_stars), optional
        Covariance xx, yy, xy of star positions by errors that exposures share, beside that of independent ones, px^2.
    camera : `legdistort.results.errors.camera_errors.CameraErrors`, optional
        What the errors of a camera do to stars and coefficients, at the stated errors.
    system : Direct, OnStars or Iterative, optional
        The reduced system of these, if it is there already.
    """

    def __init__(
        self,
        problem: Any,
        blocks: Any,
        gauge: Gauge,
        *,
        scale: float = 1.0,
        coefficients: Any = None,
        shared_errors: Any = None,
        camera: CameraErrors | None = None,
        system: Any = None,
    ) -> None:
        self._problem, self._blocks, self._gauge, self._scale = problem, blocks, gauge, scale
        self._given, self._shared = coefficients, 0.0 if shared_errors is None else shared_errors
        self.camera: CameraErrors | None = None if camera is None else camera.scaled(scale)
        if system is not None:
            self.system = system

    @cached_property
    def coefficients(self) -> np.ndarray:
        """Covariance of the fitted coefficients, shape (n_exposures * 2 n_modes,) squared, px^2; x modes first.

        A camera is taken as known.
        Beyond `COUPLED_FROM`, of few stars, `Coupled` through these, and beyond `DENSE_LIMIT` else one block an
        exposure, shape (n_exposures, 2 n_modes, 2 n_modes): `legdistort.results.errors.coefficient_covariance` reads
        all.
        """
        if self._given is not None:
            return self._given
        if self._is_coupled:
            coupled = self._on_stars.coupled()
            return replace(coupled, own=self._scale**2 * coupled.own, core=self._scale**2 * coupled.core)
        if self._is_dense:
            return self._scale**2 * self._direct.covariance()
        if self._on_stars is not None:
            return self._own
        return self._scale**2 * self._approximated

    def of_exposure(self, i: int, n_exposures: int) -> np.ndarray:
        """That of exposure i of so many alone, shape (2 n_modes, 2 n_modes), without that between them if possible."""
        if "coefficients" not in vars(self) and self._on_stars is not None:
            return self._own[i]
        return exposure_block(self.coefficients, n_exposures, i)

    @cached_property
    def _own(self):
        """Covariance of the coefficients of every exposure, from that of all stars."""
        return self._scale**2 * self._on_stars.covariance_blocks()

    @cached_property
    def _direct(self):
        """The reduced matrix, factorised."""
        if isinstance(self.system, reduced_system.Direct):
            return self.system
        return reduced_system.Direct(self._problem, self._blocks, self._gauge)

    @property
    def _is_dense(self):
        if self._given is not None:
            return isinstance(self._given, np.ndarray) and self._given.ndim == 2
        return self._problem.n_exposures * 2 * self._problem.n_modes <= DENSE_LIMIT

    @property
    def _is_coupled(self):
        """Whether there are many coefficients, and few stars through which they are coupled."""
        n = self._problem.n_exposures * 2 * self._problem.n_modes
        return n > COUPLED_FROM and self._on_stars is not None and self._on_stars.coupling_size <= _MOST_COUPLED

    @cached_property
    def _on_stars(self):
        """The equations with the coefficients eliminated, where that is less work; None elsewhere."""
        problem = self._problem
        if self._given is not None:
            return None
        if isinstance(self.system, OnStars):
            return self.system
        if self._is_dense and not reduced_system.has_fewer_stars(problem):
            return None
        return reduced_system.solved_on_stars(problem, self._blocks, self._gauge)

    @cached_property
    def _approximated(self):
        """Covariance of the coefficients of every exposure as if the stars were known, and in words how good it is."""
        problem, blocks = self._problem, self._blocks
        n = problem.n_exposures * 2 * problem.n_modes
        out = problem.unknowns.conditional_covariances(blocks.u)
        ratio = self._checked(out)
        warn(
            f"{n} coefficients, {problem.n_stars} stars: the covariance of the coefficients is approximated by one "
            f"block an exposure (stars taken as known); {ratio}",
            AssumptionWarning,
        )
        return out

    def _checked(self, covariance):
        """Errors of `_N_CHECKED` stars with a covariance of the coefficients against exact ones, in words."""
        problem, blocks = self._problem, self._blocks
        if problem.unknowns.shared:
            return "not checked where exposures share a distortion"
        seen = np.flatnonzero(blocks.v[0] > 0)
        stars = np.sort(np.random.default_rng(0).choice(seen, min(_N_CHECKED, len(seen)), replace=False))
        n, system, exact = len(stars), reduced_system.Iterative(problem, blocks, self._gauge), np.empty(len(stars))
        for k, star in enumerate(stars):
            pull = np.zeros((problem.n_star, problem.n_stars))
            pull[k % 2, star] = 1
            exact[k] = system.settle(np.zeros_like(blocks.g_exposure), pull, accuracy=1e-3)[0][k % 2, star]
        inverse, spread = self._spread(stars, 2)
        rows = spread.reshape(2, n, -1)[np.arange(n) % 2, np.arange(n)]
        known = inverse[np.arange(n), np.arange(n) % 2, np.arange(n) % 2] + (rows.T * times(covariance, rows.T)).sum(0)
        ratio = np.sqrt(exact / known)
        return (
            f"errors of {n} stars solved exactly are {np.median(ratio):.4f} times those that follow from it "
            f"({ratio.min():.4f} to {ratio.max():.4f})"
        )

    @cached_property
    def stars(self) -> np.ndarray:
        """Covariance xx, yy, xy of every star's position in the gauge, shape (3, n_stars), px^2."""
        return self.star_unknowns[:3] + self._shared

    @cached_property
    def star_unknowns(self) -> np.ndarray:
        """Covariance of the unknowns of every star in the gauge, packed: position [px^2] and what moves it.

        Shape (m, n_stars). NaN for what the observations of a star do not determine.
        """
        problem, blocks, n_star = self._problem, self._blocks, self._problem.n_star
        inverse, index = elimination.inverse_star_blocks(blocks.v), packed(n_star)
        out = np.empty_like(inverse)
        if self._on_stars is not None:
            whole = np.einsum("ajbj->abj", self._on_stars.star_covariance)
        else:
            roots, factors = elimination.star_roots(blocks.v), elimination.star_factors(problem, blocks)
            if self._given is None and self._is_dense:  # half the work of the covariance of the coefficients
                inner = np.concatenate([self._direct.within(each, n_star) for each in factors], axis=2)
            else:
                inner = np.concatenate([_block_diagonal(each, self.coefficients, n_star) for each in factors], axis=2)
                inner /= self._scale**2
            whole = np.einsum("apj,pqj,bqj->abj", roots, inner, roots, optimize=True)
            whole += unpacked(inverse).transpose(1, 2, 0)
        common = np.zeros((n_star, 1, 1)) if self.camera is None else self.camera.of_stars(n_star)
        for a in range(n_star):
            for b in range(a + 1):
                out[index[a, b]] = self._scale**2 * whole[b, a] + np.sum(common[a] * common[b], axis=1)
        for row, diagonal in zip(index, np.diag(index), strict=True):
            lost = np.flatnonzero(inverse[diagonal] <= 0)
            out[row[:, None], lost] = np.nan
        out[:, blocks.v[0] <= 0] = np.nan
        return out

    @cached_property
    def system(self) -> Any:
        """The reduced system at the solution."""
        return reduced_system.reduced_system(self._problem, self._blocks, self._gauge)

    @cached_property
    def directions(self) -> np.ndarray:
        """See `legdistort.results.gauge.Gauge.directions`."""
        return self._directions(self._moving)

    @property
    def _moving(self):
        """The reduced system in which maps move the plane."""
        return self._of_maps(self._blocks, self.system)

    def _of_maps(self, blocks, system):
        """That in which maps move the plane: widths about a mean that is not exact move along.

        Parameters
        ----------
        blocks : Blocks
        system : ReducedSystem
            Of these, with the widths.
        """
        if self._problem.prior_sigma is None or self._gauge.static == "exact":
            return system
        problem, blocks = replace(self._problem, prior_sigma=None), replace(blocks, u=blocks.u_data)
        with contextlib.suppress(SolveError):  # exposures of few stars have widths alone
            return reduced_system.reduced_system(problem, blocks, self._gauge)
        return system

    def _directions(self, system):
        gauge = self._gauge
        moved = np.stack([system.follow(d)[:2] for d in system.moves[: gauge.n_constraints]], axis=2)
        out = -(moved @ gauge.reach).transpose(1, 0, 2)
        tie, catalogue = gauge.tie, self._problem.terms.catalogue
        if tie is None or catalogue is None or not (tie.moves or tie.own):
            return out
        follow = np.eye(2 * gauge.n_modes) if tie.own is None else tie.own.follow
        precision = unpacked(catalogue.precision)[:, :, :2]
        moved = plain_maps(gauge, self._blocks.stars[:2].T, len(follow) // 2)[:, :2, : len(follow)] @ follow
        for column, move in enumerate(moved.transpose(2, 0, 1)):
            pull = np.einsum("nab,nb->an", precision, move)
            out[:, :, column] += system.settle(np.zeros_like(self._blocks.g_exposure), pull)[0][:2].T
        return out

    @cached_property
    def drift_directions(self) -> np.ndarray:
        """How modes of the common map and of `Drift` change the unknowns of the stars, (n_stars, 2 + k, 2 n_modes + q).

        See `directions`. A map that stays the same changes motions in second order, by its gradient, and one that
        changes with time the positions of stars that move.
        """
        gauge, system, terms = self._gauge, self._moving, self._problem.terms
        moved = np.stack([system.follow(d) for d in system.moves[: gauge.n_constraints]], axis=2)
        out = -(moved @ np.hstack([gauge.reach, gauge.drift_reach])).transpose(1, 0, 2)
        if terms.is_held and gauge.drift.n_tied:  # the motion that is most probable beforehand moves with the map
            values = gauge.modes_at(self._blocks.stars[:2].T)
            for k, m in np.ndindex(2, gauge.n_modes):
                pull = np.zeros((self._problem.n_star, self._problem.n_stars))
                pull[2 + k] = terms.precision[k] * values[m]
                column = 2 * gauge.n_modes + k * gauge.n_modes + m
                out[:, :, column] += system.settle(np.zeros_like(self._blocks.g_exposure), pull)[0].T
        return out

    def unknown_at(self, positions: np.ndarray, coefficients: np.ndarray, poses: Any) -> np.ndarray:
        """How the directions of `Gauge.unknown` move the stars where the solution has moved to: (2 n_stars, m).

        All x first; each for the same change of what holds the solution as here. They turn as the solution moves along
        them, which is of second order.
        """
        n, (blocks, system) = self._gauge.n_constraints, self._at(positions, coefficients, poses)
        maps = self._directions(self._of_maps(blocks, system))
        columns = [(maps @ each.map).T.ravel() for each in self._gauge.unknown_maps]
        here, there = self.system.moves[n:], system.moves[n:]
        if self.weak:
            columns += [
                system.follow(d)[:2].ravel() / self._unit(self.system.follow(h)[:2])
                for h, d in zip(here, there, strict=True)
            ]
        return np.stack(columns, axis=1)

    def directions_at(self, positions: np.ndarray, coefficients: np.ndarray, poses: Any) -> np.ndarray:
        """`directions` where the solution has moved to, (2 n_stars, 2 n_modes), all x first."""
        maps = self._directions(self._of_maps(*self._at(positions, coefficients, poses)))
        return maps.transpose(1, 0, 2).reshape(2 * len(maps), -1)

    def _at(self, positions, coefficients, poses):
        """Normal equations and reduced system there, with the same constraints."""
        stars = np.concatenate([positions.T, self._blocks.stars[2:]])
        blocks = criterion.linearise(self._problem, State(stars, coefficients, poses))
        rows = self.system.rows[self._gauge.n_constraints :]
        return blocks, reduced_system.reduced_system(self._problem, blocks, self._gauge, rows)

    def _unit(self, stars):
        """Rms per axis of what moves the stars (2, n_stars)."""
        return np.sqrt(np.mean(stars[:, self._blocks.v[0] > 0] ** 2))

    @cached_property
    def common(self) -> CommonFit | None:
        """The common maps that fit the errors of the stars, for their relative errors.

        None for a simpler correction, and where the covariance of the coefficients is approximated.
        """
        if self._gauge.plane is not None or not (self._is_dense or self._given is not None or self._on_stars):
            return None
        weights = self.star_weights
        unknown = max((each.degree for each in self._gauge.unknown_maps), default=0)
        positions = self._blocks.stars[:2].T
        n = modes_for(self._gauge.plane_modes(), positions[weights[:, 0, 0] != 0], unknown)
        maps = plain_maps(self._gauge, positions, n)
        weighted = weights @ maps
        stars, coefficients = self._follow(weighted)
        fit = of_normal(maps, weights)
        covariance = fit @ np.einsum("jam,jan->mn", weighted, stars) @ fit
        parts = weights, stars @ fit, coefficients @ fit, (covariance + covariance.T) / 2
        return CommonFit(*map(np.ascontiguousarray, parts))

    @cached_property
    def star_weights(self) -> np.ndarray:
        """W_j (n_stars, 2 + k, 2 + k): what observations say of position, of motion and of parallax of every star.

        The numbers of terms that move it are errors of it.
        """
        has_terms = self.camera is not None and self.camera.numbers is not None
        return self.weights_beside(self.camera.of_stars(self._problem.n_star) / self._scale if has_terms else None)

    def weights_beside(self, responses: np.ndarray | None = None) -> np.ndarray:
        """W_j of stars that have other errors too, to units of which they respond, (2 + k, n_stars, r)."""
        v, catalogue = self._blocks.v, self._problem.terms.catalogue
        inverse = unpacked(elimination.inverse_star_blocks(v if catalogue is None else v - catalogue.precision))
        if responses is not None:
            determined = np.einsum("jaa->ja", inverse) > 0
            more = np.einsum("ajr,bjr->jab", responses, responses)
            inverse = inverse + more * (determined[:, :, None] & determined[:, None, :])
        out, determined = np.zeros_like(inverse), np.einsum("jaa->ja", inverse) > 0
        whole, field = determined.all(axis=1), self._problem.field_of_stars
        # where others move, a star that may have moved by any amount tells nothing of a common map
        counts = whole | ~np.isin(field, field[whole])
        for part in (slice(0, 2), slice(2, 4), slice(4, 5)):
            known = counts & determined[:, part].all(axis=1)
            out[known, part, part] = np.linalg.inv(inverse[known, part, part])
        return out

    def _follow(self, pulls):
        """Covariance of stars (n_stars, 2 + k, c) and coefficients (n_exposures, 2 n_modes, c) with sums over stars.

        Of pulls (n_stars, 2 + k, c) times their unknowns.
        """
        problem, blocks, shape = self._problem, self._blocks, self._blocks.g_exposure.shape
        if self._on_stars is not None:
            found = [self._on_stars.settle(np.zeros(shape), each.T) for each in np.moveaxis(pulls, 2, 0)]
            stars, coefficients = (self._scale**2 * np.stack(each, axis=-1) for each in zip(*found, strict=True))
            return stars.transpose(1, 0, 2), coefficients
        inverse = unpacked(elimination.inverse_star_blocks(blocks.v))
        alone = inverse @ pulls
        moved = [elimination.to_exposures(problem, blocks, each.T) for each in np.moveaxis(alone, 2, 0)]
        moved = np.stack(moved, axis=-1).reshape(*shape, -1)
        if self._given is None:
            coefficients = -(self._scale**2) * self._direct.respond(moved)
        else:
            coefficients = -times(self._given, moved.reshape(-1, moved.shape[2])).reshape(moved.shape)
        following = [elimination.to_stars(problem, blocks, each) for each in np.moveaxis(coefficients, 2, 0)]
        return self._scale**2 * alone - inverse @ np.stack(following, axis=-1).transpose(1, 0, 2), coefficients

    @cached_property
    def weak(self) -> tuple[UnknownDirection, ...]:
        """Directions of a distortion that exposures share and do not determine, as a tuple of `UnknownDirection`."""
        problem = self._problem
        if not problem.unknowns.shared or problem.static_covariance is not None or not self.system.n_weak:
            return ()
        system = self.system
        made = []
        for d in system.moves[self._gauge.n_constraints :]:
            whole, coefficients = system.follow(d), problem.unknowns.spread(d)
            unit = self._unit(whole[:2])
            stars, motions = whole[:2].T / unit, whole[2:].T / unit if problem.terms.n else None
            coefficients = (coefficients / unit).reshape(len(coefficients), 2, -1)
            made.append(UnknownDirection("static", stars, coefficients, motions))
        return tuple(made)

    @cached_property
    def star_matrix(self) -> np.ndarray:
        """Covariance between all star positions in the gauge, shape (2 n_stars,) squared, px^2; all x first."""
        return self.covariance_between(np.arange(self._problem.n_stars), 2)

    def covariance_between(self, stars: np.ndarray, size: int) -> np.ndarray:
        """Covariance between the first `size` unknowns of some stars in the gauge, (size * n,) squared; all x first.

        Parameters
        ----------
        stars : ndarray of int, shape (n,)
        size : int
            2 for the positions, 2 + k for all unknowns.
        """
        n = len(stars)
        shared = np.zeros((n, size, size))
        shared[:, :2, :2] = unpacked(np.broadcast_to(self._shared, (3, self._problem.n_stars))[:, stars])
        if self._on_stars is not None:
            out = self._on_stars.star_covariance[:size, stars][:, :, :size, stars].reshape(size * n, -1)
            out, own = self._scale**2 * out, shared
        else:
            inverse, spread = self._spread(stars, size)
            out, own = spread @ times(self.coefficients, spread.T), self._scale**2 * inverse[:, :, :size] + shared
        if self.camera is not None:
            common = self.camera.of_stars(size)[:, stars].reshape(size * n, -1)
            out += common @ common.T
        index = np.arange(size * n).reshape(size, n).T
        out[index[:, :, None], index[:, None, :]] += own
        return out

    def _spread(self, stars, size):
        """V^-1 (n, size, 2 + k) of stars (n,), and how coefficients move their first unknowns, (size * n, n_coeffs)."""
        problem, blocks, n = self._problem, self._blocks, len(stars)
        inverse = unpacked(elimination.inverse_star_blocks(blocks.v[:, stars]))[:, :size]
        where = np.full(problem.n_stars, -1)
        where[stars] = np.arange(n)
        coupling = np.zeros((problem.n_star, n, problem.n_exposures, 2 * problem.n_modes))
        for i in range(problem.n_exposures):
            part, seen = problem.part(i), where[problem.star[problem.part(i)]]
            on = seen >= 0
            f, b = blocks.coupling[:, :, part][:, :, on], blocks.values[:, part][:, on]
            pulled = problem.terms.pull(i, np.einsum("can,mn->camn", f, b))
            coupling[:, seen[on], i] = np.moveaxis(pulled, 3, 1).reshape(problem.n_star, b.shape[1], coupling.shape[-1])
        coupling = coupling.reshape(problem.n_star, n, -1)
        return inverse, np.concatenate([np.einsum("jb,bjk->jk", inverse[:, a], coupling) for a in range(size)])


def _block_diagonal(factor, covariance, n_star):
    """Diagonal blocks (k, k, n_stars) of ``factor' C factor`` for factors (n, k n_stars)."""
    product = times(covariance, factor).reshape(len(factor), n_star, -1)
    return np.einsum("naj,nbj->abj", factor.reshape(product.shape), product)
