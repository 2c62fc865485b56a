"""Terms found together with everything else, without the solver knowing of them.

To first order numbers c of the terms move what was measured by ``P c``. A fit with the numbers as they are gives their
normal equations with stars and exposures eliminated, ``H = P' W P - G' C G``: P are the displacements by a unit of
each, G their gradients, C what the fit makes of a gradient. They are solved with what is known of the numbers, the
displacements are taken off the positions, and so on until nothing changes: the minimum over everything.

The numbers of a term scatter about zero by a size that is held, or that of the largest restricted likelihood (stars and
distortions integrated out): ``-2 ln L = ln |1 + s H s| - (s b)' (1 + s H s)^-1 (s b)`` for sizes s, b = H c + pull. One
size after the other is taken where it is best, the others held (Tipping & Faul 2003), and what the positions do not
show is left away: a term, or of a term whose owners have sizes of their own (few of many stars that move on orbits) an
owner.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import linalg
from scipy.optimize import minimize_scalar

from ...exceptions import ConvergenceWarning, SolveError, warn
from ...results.diagnostics import FittedTerm
from ...results.errors.camera_errors import CameraErrors, unit_errors
from ...results.errors.coefficient_covariance import with_shared
from ..equations.common_parts import followed, relative_responses, response
from ..equations.elimination import inverse_star_blocks
from ..equations.star_terms import unpacked
from .displaced import FITS, SMALL, Tabled, by_tables, displaced, in_errors, known_tables, taken_off, unclipped
from .field_of_one import FieldOfOne, fit_with_field_of_one
from .observed import Observed
from .random_field import Found
from .term import FIELD_NUMBERS, RandomField
from .turbulence import SHOWN as FIELD_SHOWN
from .turbulence import errors_of, field_of, fit_with_field, with_errors

#: Twice the gain in the logarithm of the likelihood from which a term is there.
SHOWN = 4.0
#: Chance that one of all owners with sizes of their own is called there that is not; sweeps over the sizes at most.
_FALSE, _SWEEPS = 0.05, 300
#: Part of that gain which an owner must show by itself to be looked at beside all others.
_PERHAPS = 0.3
#: Part of what tells numbers below which it is rounding, once positions and motions of stars follow.
_ROUNDING = 1e-9
#: Size that stands for an infinite one, in errors of a number if all others were known.
_FREE = 1e4
#: Numbers of all terms together, at most, and values of their displacements.
_MOST, _VALUES = 3000, 100_000_000


def fit_with(terms, tie, estimate, matches, options, *how):
    """What `estimate` gives, with the terms found beside, and what priors have beside their series taken off.

    Parameters
    ----------
    terms : sequence of Term
    tie : callable or None
        ``tie(fit)`` is the fit tied to a reference; None without one.
    estimate : callable
        ``estimate(matches, options, *how)`` gives a `Fit` and what else there is.
    matches : Matches
    options : SolveOptions
    *how

    Returns
    -------
    Fit
        Its errors have those of the terms, its table the displacements (`DISPLACED`).
    callable
        ``found(scale)`` gives the `FittedTerm` of every term, with errors times a factor.
    rest : tuple
        What else `estimate` gave.

    Raises
    ------
    SolveError
        For more numbers than can be found at once, and a random field beside other terms or a prior with a table.
    """
    tables = known_tables(options.prior, matches)
    if not (terms or tables):
        fit, *rest = estimate(matches, options, *how)
        return fit, lambda _: (), rest
    if any(isinstance(term, RandomField) for term in terms):
        return _fit_with_field(terms, tables, tie, estimate, matches, options, *how)
    values, begun = {}, unclipped(estimate, matches, options, *how)
    for number in range(FITS):
        fit, *rest = begun or estimate(matches, options, *how)
        begun, known = None, by_tables(tables, fit)
        numbers = _Numbers.of(terms, fit, values, known * bool(number))
        taken = np.array([values.get(key, 0.0) for key in numbers.keys])
        step = numbers.step(fit, taken)
        values = dict(zip(numbers.keys, step.values, strict=True))
        moved = known + numbers.patterns @ taken - taken_off(fit) if tables else np.zeros_like(known)
        length = max(step.length, in_errors(fit, moved))
        if number and length < SMALL:
            break
        matches = displaced(fit, numbers.patterns @ step.values + known)
    else:
        warn(f"terms have not settled: the last change was {length:.2g} of an error", ConvergenceWarning)
    fit = replace(_with_errors(fit, step, numbers), tabled=numbers.tabled(fit, taken, tables))
    return fit, partial(numbers.found, step), rest


def forecast(terms, fit):
    """A fit to positions without noise with the errors of terms whose sizes are stated, as `fit_with` states them.

    Parameters
    ----------
    terms : sequence of Term or RandomField
    fit : Fit

    Returns
    -------
    Fit
    ndarray or callable
        Of new positions, as `legdistort.results.accuracy.expected_scatter` takes it.

    Raises
    ------
    SolveError
        For more numbers than can be found at once, and a random field beside other terms.
    """
    if any(isinstance(term, RandomField) for term in terms):
        _check_alone(terms)
        known = Found(terms[0].kernel, np.inf), True
        field, _ = field_of(fit, np.zeros_like(fit.problem.xy), known)
        errors = errors_of(fit, field)
        return with_errors(fit, field, errors), errors
    numbers = _Numbers.of(terms, fit, {}, np.zeros_like(fit.problem.xy))
    made = _with_errors(fit, numbers.step(fit, np.zeros(len(numbers.keys))), numbers)
    return made, with_shared(fit.uncertainty.coefficients, made.camera_errors.coefficients)


def _check_alone(terms):
    if len(terms) > 1:
        others = " and ".join(term.name for term in terms if not isinstance(term, RandomField))
        raise SolveError(f"turbulence cannot be found beside other terms yet: leave out {others}, or turbulence")


def _fit_with_field(terms, tables, tie, estimate, matches, options, *how):
    """`fit_with` of a random field alone."""
    _check_alone(terms)
    if tables:
        raise SolveError(
            "turbulence cannot be found beside a prior that has a table beside its series yet: give the series alone "
            "(dataclasses.replace(prior, table=None)), or leave turbulence out"
        )
    if tie is not None and len(matches.names) == 1:
        fit, field, rest = fit_with_field_of_one(estimate, tie, matches, options, *how)
    else:
        fit, field, rest = fit_with_field(estimate, matches, options, *how)
    numbers, shown, gain = FIELD_NUMBERS, np.zeros(len(FIELD_NUMBERS)), 0.0 if field is None else field.gain
    if field is not None and gain >= FIELD_SHOWN:
        kernel = field.kernel
        shown = np.array([kernel.size, kernel.length, kernel.smoothness, kernel.ratio, kernel.angle])
    if shown[0] and isinstance(field, FieldOfOne):
        numbers, shown = (*numbers, "factor on x errors", "factor on y errors"), np.append(shown, field.factors)
    found = FittedTerm(
        name=terms[0].name, unit=terms[0].unit, owner=terms[0].owner, size=float(shown[0]), gain=float(gain),
        found=True, rms=float(np.sqrt(np.mean(taken_off(fit) ** 2))), n_asked=fit.problem.n_exposures,
        owners=("",) * len(numbers), numbers=numbers, values=tuple(shown.tolist()), errors=(),
    )  # fmt: skip
    return fit, lambda _: (found,), rest


@dataclass(frozen=True, eq=False)
class _Step:
    """Numbers that are most probable, from a linearised problem.

    Attributes
    ----------
    values : ndarray, shape (k,)
    covariance : ndarray, shape (k, k)
    sizes, gains : ndarray, shape (n_groups,)
        Of every group of numbers with a size of its own: this, 0 for one that is not there, and what twice the
        logarithm of the likelihood gains by it beside the others.
    length : float
        Of the largest change, in errors.
    follow : Followed
    """

    values: np.ndarray
    covariance: np.ndarray
    sizes: np.ndarray
    gains: np.ndarray
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
    n_owners : list of int
        Owners of every term that might have numbers of their own size.
    group : ndarray of int, shape (k,)
        What has a size of its own: the term of every number, or its owner.
    term_of : ndarray of int, shape (n_groups,)
    bases : list of tuple
        Of every term, its functions of the place by owner, where it is a part of distortions; else empty.
    root : ndarray, shape (k, k), or None
        Square root of their covariance where every size is 1; None for independent ones.
    patterns : ndarray, shape (2, n, k)
        Displacements by a unit of each, in the order of the problem.
    """

    terms: tuple
    keys: list
    n_owners: list
    group: np.ndarray
    term_of: np.ndarray
    bases: list
    root: np.ndarray | None
    patterns: np.ndarray

    @classmethod
    def of(cls, terms, fit, values, beside):
        """Those of some terms in the observations of a `Fit`, made with values ``{key: value}`` of them.

        What else was taken off the positions are displacements `beside` (2, n).
        """
        keys, n_owners, sizes, roots, bases = [], [], [], [], []
        patterns = [np.zeros((*beside.shape, 0))]
        for term, names, owner, columns, known, functions in _made(terms, fit, values, beside):
            bases.append(functions)
            asked = _asked(fit, term, owner, columns, known) if term.each else np.arange(len(names))
            k, n = len(term.numbers), len(asked)
            if 2 * k * n * len(owner) > _VALUES or k * n > _MOST:
                raise SolveError(
                    f"term {term.name} has {k * n} numbers for {len(owner)} positions, too many to be found together: "
                    f"take fewer, or owner 'set' in place of {term.owner!r}"
                )
            place = np.full(len(names), -1)
            place[asked] = np.arange(n)
            rows = np.flatnonzero(place[owner] >= 0)
            made = np.zeros((2, len(owner), n, k))
            made[:, rows, place[owner[rows]]] = columns[:, :, rows].transpose(1, 2, 0)
            patterns.append(made.reshape(2, len(owner), -1))
            keys += [(term.name, names[j], number) for j in asked for number in term.numbers]
            sizes.append(np.full(n, k) if term.each else [n * k])
            n_owners.append(len(names) if term.each else 1)
            roots += [np.eye(k) if term.covariance is None else np.linalg.cholesky(term.covariance)] * n
        term_of = np.repeat(np.arange(len(terms)), np.array(list(map(len, sizes)), dtype=int))
        group = np.repeat(np.arange(len(term_of)), np.concatenate([[], *sizes]).astype(int))
        root = None if all(term.covariance is None for term in terms) else linalg.block_diag(*roots)
        return cls(terms, keys, n_owners, group, term_of, bases, root, np.concatenate(patterns, axis=2))

    def step(self, fit, values):
        """The `_Step` from a fit with the numbers at some values (k,)."""
        if not self.keys:  # no owner may have any
            return _Step(values, np.zeros((0, 0)), np.zeros(0), np.zeros(0), 0.0, None)
        solve = response(fit.uncertainty.system, fit.result.gauge)
        follow = followed(solve, fit.weighted, fit.blocks, -self.patterns)  # what a term displaces is taken off
        normal, pull = follow.normal, follow.pull + follow.normal @ values
        if self.root is not None:
            normal, pull = self.root.T @ normal @ self.root, self.root.T @ pull
        sizes, gains = self._sizes(normal, pull)
        scale = sizes[self.group]
        covariance, new = _posterior(normal, pull, scale)
        if self.root is not None:
            covariance, new = self.root @ covariance @ self.root.T, self.root @ new
        error, moved = np.sqrt(np.diag(covariance)), np.abs(new - values)
        length = np.max(np.divide(moved, error, out=np.where(moved > 0, np.inf, 0.0), where=error > 0), initial=0.0)
        return _Step(new, covariance, sizes, gains, float(length), follow)

    def _sizes(self, normal, pull):
        """Size of every group, 0 for one that is not there, and its gain beside the others."""
        rows = [np.flatnonzero(self.group == g) for g in range(len(self.term_of))]
        needed = SHOWN + 2 * np.log([n / _FALSE if n > 1 else 1 for n in self.n_owners])[self.term_of]
        unit = np.array([1 / np.sqrt(max(np.median(np.diag(normal)[mine]), 1e-300)) for mine in rows])
        given = np.array([np.nan if self.terms[t].sigma is None else float(self.terms[t].sigma) for t in self.term_of])
        given, sought = np.where(np.isinf(given), _FREE * unit, given), np.isnan(given)
        sizes, known = np.where(sought, 0.0, given), {}

        def best(groups):
            """The best size of each beside the others, and its gain."""
            there = sizes[self.group] * ~np.isin(self.group, groups)
            key = (*groups, there.tobytes())
            if key not in known:
                left, pulled = _left(normal, pull, there)
                parts = [(left[np.ix_(rows[g], rows[g])], pulled[rows[g]]) for g in groups]
                known[key] = [_best_size(*part, unit[g], given[g]) for part, g in zip(parts, groups, strict=True)]
            return known[key]

        for _ in range(_SWEEPS):
            last = sizes.copy()
            for g in np.flatnonzero(sought & (sizes > 0)):
                ((size, gain),) = best([g])
                sizes[g] = size if gain > needed[g] else 0.0
            absent = np.flatnonzero(sizes == 0)
            tried = [(gain - needed[g], size, g) for g, (size, gain) in zip(absent, best(absent), strict=True)]
            above, size, g = max(tried, default=(0, 0, 0))
            if above > 0:
                sizes[g] = size
            elif np.allclose(sizes, last, rtol=1e-3, atol=0):
                break
        gains = np.array([best([g])[0][1] if size else 0.0 for g, size in enumerate(sizes)])
        return sizes, gains

    def shown(self, step, t):
        """Which numbers of a term are told: all of them, or those of the owners that have it."""
        every = np.flatnonzero(self.term_of[self.group] == t)
        return every[step.sizes[self.group[every]] > 0] if self.terms[t].each else every

    def tabled(self, fit, values, tables):
        """What is a part of distortions, as `Tabled`, with the values (k,) in a `Fit` and the tables of priors.

        None for nothing.
        """
        (static, own), beside = _by_detector(tables, fit), np.array(values)
        for t, functions in enumerate(self.bases):
            every = np.flatnonzero(self.term_of[self.group] == t)
            if not functions or not values[every].any():
                continue
            beside[every] = 0
            owners = dict.fromkeys(self.keys[k][1] for k in every)
            for each, owner, mine in zip(functions, owners, np.split(values[every], len(owners)), strict=True):
                found = each.table(mine.reshape(2, -1))
                static[owner] = found + static[owner] if owner in static else found
        return Tabled(fit.problem.in_table_order(self.patterns @ beside), static, own) if static or own else None

    def found(self, step, scale):
        """The `FittedTerm` of every term, with errors times a factor."""
        error, moved = scale * np.sqrt(np.diag(step.covariance)), []
        for t, term in enumerate(self.terms):
            groups, shown = self.term_of == t, self.shown(step, t)
            every = np.flatnonzero(groups[self.group])
            rms = np.sqrt(np.mean((self.patterns[:, :, every] @ step.values[every]) ** 2))
            sizes = step.sizes[groups & (step.sizes > 0)]
            moved.append(
                FittedTerm(
                    name=term.name, unit=term.unit, owner=term.owner,
                    size=float(np.sqrt(np.mean(sizes**2))) if len(sizes) else 0.0,
                    gain=float(step.gains[groups].sum()), found=term.sigma is None, rms=float(rms),
                    n_asked=self.n_owners[t] if term.each else len({self.keys[k][1] for k in every}),
                    owners=tuple(self.keys[k][1] for k in shown), numbers=tuple(self.keys[k][2] for k in shown),
                    values=tuple(step.values[shown].tolist()), errors=tuple(error[shown].tolist()),
                    bases=self.bases[t],
                )
            )  # fmt: skip
        return tuple(moved)


def _left(normal, pull, scale):
    """Normal equations (k, k), (k,) with those numbers eliminated whose size (k,) is not 0."""
    there = scale > 0
    if not there.any():
        return normal, pull
    columns = normal[:, there] * scale[there]
    inner = np.eye(len(columns.T)) + scale[there][:, None] * columns[there]
    taken = columns @ np.linalg.inv(inner)
    return normal - taken @ columns.T, pull - taken @ (scale[there] * pull[there])


def _best_size(normal, pull, unit, given):
    """Size at the largest likelihood, if it is not given, and twice the gain in its logarithm, against none."""
    values, vectors = np.linalg.eigh((normal + normal.T) / 2)
    values, along = np.maximum(values, 0), (vectors.T @ pull) ** 2

    def deviance(log_size):
        square = np.exp(2 * log_size)
        return np.sum(np.log1p(square * values) - square * along / (1 + square * values))

    if np.isfinite(given):
        return given, -float(deviance(np.log(given)))
    tried = np.log(unit) + np.linspace(-4, np.log(_FREE), 30)
    at = int(np.argmin([deviance(each) for each in tried]))
    ends = tried[max(at - 1, 0)], tried[min(at + 1, len(tried) - 1)]
    found = minimize_scalar(deviance, bounds=ends, method="bounded")
    return float(np.exp(found.x)), -float(found.fun)


def _posterior(normal, pull, scale):
    """Covariance (k, k) and mean (k,) of numbers of some sizes (k,)."""
    inner = np.linalg.inv(np.eye(len(scale)) + scale[:, None] * normal * scale)
    covariance = scale[:, None] * inner * scale
    return (covariance + covariance.T) / 2, covariance @ pull


def _made(terms, fit, values, beside):
    """Of every term: itself, names of its owners, that of every observation (n,), columns (k, 2, n), values by owner.

    And the functions of the place by owner, where it is a part of distortions.

    Where a star falls on a pixel is known from the model, without the term itself, better than from its position.
    """
    problem, matches = fit.problem, fit.matches
    table, state = matches.table[problem.order], fit.result.state
    observed = Observed(
        problem, state, table, matches.times[0], matches.sky, matches.camera, matches.stars, problem.terms.epoch
    )
    off = np.stack([np.asarray(table[name].value) - xy for name, xy in zip("xy", problem.xy, strict=True)])
    off, made, moved = off - beside + fit.blocks.residual, [], np.zeros((len(terms), 2, len(table)))
    for _ in range(1 + bool(values)):
        made = []
        for t, term in enumerate(terms):
            names, owner = _owners(term, observed)
            known = np.array([[values.get((term.name, name, each), 0.0) for each in term.numbers] for name in names])
            columns = term.displacements(replace(observed, beside=off - moved.sum(axis=0) + moved[t]))
            moved[t] = np.einsum("kan,nk->an", columns, known[owner])
            made.append((term, names, owner, columns, known, _bases(term, names, owner, observed)))
    return made


def _bases(term, names, owner, observed):
    """Of every owner the functions of the place, where a term is a part of distortions; else none."""
    basis, problem = getattr(term.columns, "basis", None), observed.problem
    if basis is None:
        return ()
    first = [observed.exposure[np.flatnonzero(owner == j)[0]] for j in range(len(names))]
    return tuple(basis(observed, problem.shapes[i]) for i in first)


def _asked(fit, term, owner, columns, known):
    """Which owners may have numbers, by what their own observations say, distortions held; and those that have some."""
    problem, blocks, n = fit.weighted, fit.blocks, len(known)
    (wx, wy, wxy), (x, y) = problem.weight, columns.transpose(1, 0, 2)
    moved = np.stack([wx * x + wxy * y, wxy * x + wy * y])
    pulled = problem.pulled(blocks.coupling)
    at_star = np.einsum("san,kan->skn", pulled, columns)
    left = np.einsum("kan,aln->kln", columns, moved)
    pull = np.einsum("akn,an->kn", moved, blocks.residual)
    k = len(columns)
    normal = np.array([[np.bincount(owner, left[i, j], n) for j in range(k)] for i in range(k)]).transpose(2, 0, 1)
    told = np.einsum("jaa->j", normal)
    if term.owner == "star":  # whose position and motion follow
        alone = np.array([[np.bincount(owner, row, n) for row in rows] for rows in at_star]).transpose(2, 0, 1)
        normal = normal - alone.mT @ unpacked(inverse_star_blocks(blocks.v)) @ alone
    pull = np.array([np.bincount(owner, row, n) for row in pull]).T + np.einsum("jab,jb->ja", normal, known)
    unit = 1 / np.sqrt(np.maximum(np.median(np.einsum("jaa->ja", normal), axis=1), 1e-300))
    gains = np.array([_best_size(*each, np.nan)[1] for each in zip(normal, pull, unit, strict=True)])
    told = np.einsum("jaa->j", normal) > _ROUNDING * told  # with few epochs positions and motions take all of it
    return np.flatnonzero(told & (gains > _PERHAPS * (SHOWN + 2 * np.log(n / _FALSE))) | known.any(axis=1))


def _owners(term, observed):
    """Names of those that have numbers of their own, and the number of that of every observation (n,)."""
    problem = observed.problem
    if term.owner == "exposure":
        return list(problem.names), observed.exposure
    if term.owner == "star":
        return [str(name) for name in observed.stars], problem.star
    if term.owner == "set":
        return [""], np.zeros(len(observed.exposure), dtype=int)
    return _detectors(problem, observed.table, observed.camera)


def _detectors(problem, table, camera):
    """Names of detectors, and the number of that of every observation (n,)."""
    if "detector" in table.colnames:
        names, number = np.unique(np.asarray(table["detector"]).astype(str), return_inverse=True)
        return names.tolist(), number
    number, n = problem.detectors[problem.exposure], int(problem.detectors.max()) + 1
    if camera is not None and len(camera.detectors) == n:
        return list(camera.detectors), number
    return [str(k + 1) for k in range(n)], number


def _by_detector(tables, fit):
    """Tables of exposures as those of detectors where all of a detector have the same, and those that are left."""
    problem, static, own = fit.problem, {}, {}
    names, number = _detectors(problem, fit.matches.table[problem.order], fit.matches.camera) if tables else ([], None)
    for j, name in enumerate(names):
        seen = [problem.names[i] for i in np.unique(problem.exposure[number == j])]
        each = [tables.get(exposure) for exposure in seen]
        if all(table is each[0] for table in each):
            static |= {name: each[0]} if each[0] is not None else {}
        else:
            own |= {exposure: tables[exposure] for exposure in seen if exposure in tables}
    return static, own


def _with_errors(fit, step, numbers):
    """The fit with the errors of the numbers in those of its stars and coefficients."""
    changes = unit_errors(step.covariance)
    if not changes.shape[1]:
        return fit
    weights = fit.uncertainty.weights_beside(step.follow.stars @ changes)
    made = relative_responses(step.follow, changes, fit.result, weights, fit.problem.degree)
    problem, parts = fit.problem, len(fit.matches.camera.detectors)
    errors = fit.camera_errors or CameraErrors.nothing(parts, problem.n_exposures, problem.n_stars, made[1].shape[1])
    freedom = float(np.sum(step.covariance * step.follow.normal))
    told = np.concatenate([numbers.shown(step, t) for t in range(len(numbers.terms))])
    return replace(
        fit, camera_errors=errors.beside(*made, changes[told]), shared_unknowns=fit.shared_unknowns + freedom
    )
