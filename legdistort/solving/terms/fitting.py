"""Terms found together with everything else, without the solver knowing of them.

To first order numbers c of the terms move what was measured by ``P c``. A fit with the numbers as they are gives their
normal equations with stars and exposures eliminated, ``H = P' W P - G' C G``: P are the displacements by a unit of
each, G their gradients, C what the fit makes of a gradient. They are solved with what is known of the numbers, the
displacements are taken off the positions, and so on until nothing changes: the minimum over everything.

The numbers of a term scatter about zero by a size that is held, or that of the largest restricted likelihood (stars and
distortions integrated out): ``-2 ln L = ln |1 + s H s| - (s b)' (1 + s H s)^-1 (s b)`` for sizes s, b = H c + pull. A
term of which the positions show nothing is left away.
"""

from dataclasses import dataclass, replace

import numpy as np
from astropy import units as u
from scipy import linalg
from scipy.optimize import minimize

from ...exceptions import ConvergenceWarning, SolveError, warn
from ...matching.matches import DISPLACED
from ...results.diagnostics import FittedTerm
from ...results.errors.camera_errors import CameraErrors, unit_errors
from ..equations.common_parts import followed, relative_responses, response
from .observed import Observed

#: Twice the gain in the logarithm of the likelihood from which a term is there.
SHOWN = 4.0
#: Fits at most, and the largest change of a number, in errors, at which they end.
_FITS, _SMALL = 10, 0.02
#: Size that stands for an infinite one, in errors of a number if all others were known.
_FREE = 1e4
#: Numbers of all terms together, at most, and values of their displacements.
_MOST, _VALUES = 3000, 100_000_000


def fit_with(terms, estimate, matches, *how):
    """What `estimate` gives, with the terms found beside.

    Parameters
    ----------
    terms : sequence of Term
    estimate : callable
        ``estimate(matches, *how)`` gives a `Fit` and what else there is.
    matches : Matches
    *how

    Returns
    -------
    Fit
        Its errors have those of the terms, its table the displacements (`DISPLACED`).
    tuple of FittedTerm
    rest : tuple
        What else `estimate` gave.

    Raises
    ------
    SolveError
        For more numbers than can be found at once.
    """
    values = {}
    for _ in range(_FITS):
        fit, *rest = estimate(matches, *how)
        if not terms:
            return fit, (), rest
        numbers = _Numbers.of(terms, fit, values)
        step = numbers.step(fit, np.array([values.get(key, 0.0) for key in numbers.keys]))
        values = dict(zip(numbers.keys, step.values, strict=True))
        if step.length < _SMALL:
            break
        matches = _displaced(fit, numbers.patterns @ step.values)
    else:
        warn(f"terms have not settled: the last change was {step.length:.2g} of an error", ConvergenceWarning)
    return _with_errors(fit, step), numbers.found(step), rest


@dataclass(frozen=True, eq=False)
class _Step:
    """Numbers that are most probable, from a linearised problem.

    Attributes
    ----------
    values : ndarray, shape (k,)
    covariance : ndarray, shape (k, k)
    sizes : tuple of float
        Of every term; 0 for one that is not there.
    gains : tuple of float
        In twice the logarithm of the likelihood, of every term beside the others.
    length : float
        Of the largest change, in errors.
    follow : Followed
    """

    values: np.ndarray
    covariance: np.ndarray
    sizes: tuple
    gains: tuple
    length: float
    follow: object


@dataclass(frozen=True, eq=False)
class _Numbers:
    """The numbers of all terms at once, k of them.

    Attributes
    ----------
    terms : tuple of Term
    keys : list of (str, str, str)
        Term, owner and name of every number.
    part : ndarray of int, shape (k,)
        Term of every number.
    root : ndarray, shape (k, k)
        Square root of their covariance where every size is 1.
    patterns : ndarray, shape (2, n, k)
        Displacements by a unit of each, in the order of the problem.
    """

    terms: tuple
    keys: list
    part: np.ndarray
    root: np.ndarray
    patterns: np.ndarray

    @classmethod
    def of(cls, terms, fit, values):
        """Those of some terms in the observations of a `Fit`, made with values ``{key: value}`` of them."""
        problem, matches = fit.problem, fit.matches
        table, state = matches.table[problem.order], fit.result.state
        observed = Observed(problem, state, table, matches.times[0], matches.sky, matches.camera)
        owners = [_owners(term, observed) for term in terms]
        keys = [[(term.name, name, each) for name in names for each in term.numbers]
                for term, (names, _) in zip(terms, owners, strict=True)]  # fmt: skip
        for term, mine in zip(terms, keys, strict=True):
            if 2 * len(mine) * len(table) > _VALUES or len(mine) > _MOST:
                raise SolveError(
                    f"term {term.name} has {len(mine)} numbers for {len(table)} positions, too many to be found "
                    f"together: take fewer, or owner 'set' in place of {term.owner!r}"
                )
        known = [np.array([values.get(key, 0.0) for key in mine]) for mine in keys]
        # where a star falls on a pixel is known from the model better than from its position, without the term itself
        off = np.stack([np.asarray(table[name].value) - xy for name, xy in zip("xy", problem.xy, strict=True)])
        off = off + fit.blocks.residual
        moved = np.zeros((len(terms), 2, len(table)))
        for _ in range(1 + bool(values)):
            patterns = []
            for t, (term, (names, owner)) in enumerate(zip(terms, owners, strict=True)):
                others = moved.sum(axis=0) - moved[t]
                made = np.zeros((2, len(owner), len(names), len(term.numbers)))
                columns = term.displacements(replace(observed, beside=off - others))
                made[:, np.arange(len(owner)), owner] = np.moveaxis(columns, 0, 2)
                patterns.append(made.reshape(2, len(owner), -1))
            moved = np.stack([each @ mine for each, mine in zip(patterns, known, strict=True)])
        part = np.repeat(np.arange(len(terms)), [len(mine) for mine in keys])
        roots = [
            np.eye(len(term.numbers)) if term.covariance is None else np.linalg.cholesky(term.covariance)
            for term, (names, _) in zip(terms, owners, strict=True)
            for _ in names
        ]
        return cls(
            terms,
            [key for mine in keys for key in mine],
            part,
            linalg.block_diag(*roots),
            np.concatenate(patterns, axis=2),
        )

    def step(self, fit, values):
        """The `_Step` from a fit with the numbers at some values (k,)."""
        solve = response(fit.uncertainty.system, fit.result.gauge)
        follow = followed(solve, fit.weighted, fit.blocks, -self.patterns)  # what a term displaces is taken off
        normal, pull = (self.root.T @ follow.normal @ self.root, self.root.T @ (follow.pull + follow.normal @ values))
        unit = 1 / np.sqrt(np.maximum(np.diag(self.root.T @ np.diag(follow.alone) @ self.root), 1e-300))
        sizes, gains = self._sizes(normal, pull, unit)
        scale = sizes[self.part]
        inner = np.linalg.inv(np.eye(len(scale)) + scale[:, None] * normal * scale)
        covariance = self.root @ (scale[:, None] * inner * scale) @ self.root.T
        new = self.root @ (scale * (inner @ (scale * pull)))
        error = np.sqrt(np.diag(covariance))
        moved = np.abs(new - values)
        length = np.max(np.divide(moved, error, out=np.where(moved > 0, np.inf, 0.0), where=error > 0), initial=0.0)
        return _Step(new, covariance, tuple(map(float, sizes)), tuple(map(float, gains)), float(length), follow)

    def _sizes(self, normal, pull, unit):
        """Size of every term, 0 for one that is not there, and its gain beside the others."""
        typical = np.array([np.median(unit[self.part == t]) for t in range(len(self.terms))])
        given = np.array([np.nan if term.sigma is None else float(term.sigma) for term in self.terms])
        sizes = np.where(np.isinf(given), _FREE * typical, given)
        there = np.ones(len(sizes), dtype=bool)
        while True:
            found = self._most_likely(normal, pull, np.where(there, sizes, 0.0), typical)
            whole = self._deviance(normal, pull, found)
            gains = np.array([self._deviance(normal, pull, np.where(np.arange(len(found)) == t, 0.0, found)) - whole
                              for t in range(len(found))])  # fmt: skip
            weak = there & np.isnan(sizes) & (gains < SHOWN)
            if not weak.any():
                return found, gains
            there[np.argmin(np.where(weak, gains, np.inf))] = False

    def _most_likely(self, normal, pull, sizes, typical):
        """Sizes with those that are NaN at the largest likelihood."""
        sought = np.isnan(sizes)
        if not sought.any():
            return sizes
        best = np.inf, np.where(sought, 0.0, sizes)
        for start in (1.0, 30.0):

            def of(logs):
                out = sizes.copy()
                out[sought] = np.exp(logs) * typical[sought]
                return out

            bounds = [(np.log(1e-3), np.log(_FREE))] * np.count_nonzero(sought)
            found = minimize(
                lambda logs: self._deviance(normal, pull, of(logs)),
                np.full(np.count_nonzero(sought), np.log(start)),
                method="L-BFGS-B",
                bounds=bounds,
            )
            best = min(best, (found.fun, of(found.x)), key=lambda each: each[0])
        return best[1]

    def _deviance(self, normal, pull, sizes):
        """Minus twice the logarithm of the restricted likelihood of sizes of the terms, against none of them."""
        scale = sizes[self.part]
        inner, weighed = np.eye(len(scale)) + scale[:, None] * normal * scale, scale * pull
        return np.linalg.slogdet(inner)[1] - weighed @ np.linalg.solve(inner, weighed)

    def found(self, step):
        """The `FittedTerm` of every term."""
        error, moved = np.sqrt(np.diag(step.covariance)), []
        for t, term in enumerate(self.terms):
            mine = np.flatnonzero(self.part == t)
            rms = np.sqrt(np.mean((self.patterns[:, :, mine] @ step.values[mine]) ** 2))
            owners, numbers = zip(*(self.keys[k][1:] for k in mine), strict=True)
            moved.append(
                FittedTerm(
                    name=term.name, unit=term.unit, owner=term.owner, size=step.sizes[t], gain=step.gains[t],
                    found=term.sigma is None, rms=float(rms), owners=owners, numbers=numbers,
                    values=tuple(step.values[mine].tolist()), errors=tuple(error[mine].tolist()),
                )
            )  # fmt: skip
        return tuple(moved)


def _owners(term, observed):
    """Names of those that have numbers of their own, and the number of that of every observation (n,)."""
    problem = observed.problem
    if term.owner == "exposure":
        return list(problem.names), observed.exposure
    if term.owner == "set":
        return [""], np.zeros(len(observed.exposure), dtype=int)
    if "detector" in observed.table.colnames:
        names, number = np.unique(np.asarray(observed.table["detector"]).astype(str), return_inverse=True)
        return names.tolist(), number
    number = problem.detectors[observed.exposure]
    return [str(k + 1) for k in range(problem.detectors.max() + 1)], number


def _displaced(fit, displacements):
    """The matches of a fit with displacements (2, n), in the order of its problem, taken off their positions."""
    table = fit.matches.table.copy(copy_data=False)
    for name, values in zip(DISPLACED, fit.problem.in_table_order(displacements), strict=True):
        table[name] = values * u.pix
    return replace(fit.matches, table=table, observations=None)


def _with_errors(fit, step):
    """The fit with the errors of the numbers in those of its stars and coefficients."""
    changes = unit_errors(step.covariance)
    if not changes.shape[1]:
        return fit
    made = relative_responses(step.follow, changes, fit.result, fit.uncertainty, fit.problem.degree)
    problem, parts = fit.problem, len(fit.matches.camera.detectors)
    errors = fit.camera_errors or CameraErrors.nothing(parts, problem.n_exposures, problem.n_stars, made[1].shape[1])
    freedom = float(np.sum(step.covariance * step.follow.normal))
    return replace(fit, camera_errors=errors.beside(*made), shared_unknowns=fit.shared_unknowns + freedom)
