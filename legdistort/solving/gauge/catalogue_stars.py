"""Stars of a reference catalogue as what is known beforehand of them, while a camera is fitted."""

from dataclasses import replace

import numpy as np

from ...exceptions import InputError
from ...geometry import similarity
from ...geometry.similarity import robust_similarity
from ..equations import elimination
from ..equations.star_terms import StarPrior, unpacked
from . import bent_reference, catalogue_map
from .moved_fields import moved_by, similarities

#: Stars of a reference off by so many times the median of those on the same detectors join nothing: of Rayleigh's
#: distribution that is chance below 1e-19, and maps that the exposures leave open make the median larger.
_MISMATCH = 8.0
#: Fits at most in which deviant stars of a reference are found at one camera; part by which a factor on errors is the
#: same.
_JOINS, _SAME_FACTOR = 4, 0.05
_FEWEST = 3  # stars on detectors that tell a similarity and what departs from it


def offered(found, k, factor):
    """Positions and motions in a reference: values (n, 2 + k) and covariances, NaN for what it does not have."""
    n = len(found.rows)
    values, covariance = np.full((n, 2 + k), np.nan), np.full((n, 2 + k, 2 + k), np.nan)
    known = found.xy if found.motion is None else np.hstack([found.xy, found.motion])
    m = min(known.shape[1], 2 + k)
    values[:, :m], covariance[:, :m, :m] = known[:, :m], found.covariance[:, :m, :m]
    values[~np.isfinite(np.einsum("jaa->ja", covariance))] = np.nan
    return values, factor**2 * covariance


class Joining:
    """Makes of the fit of a camera one with the stars of a reference as a prior, by which J determines the plane too.

    Static distortions of detectors are then those at the minimum of all that is known: found without the reference,
    about another plane, they would be off by what this moves them and distortions of exposures against one another,
    which is no map of the degree. And the stars tie detectors that no star ties. From one fit to the next it keeps
    which stars of the reference deviate, and the factor on its errors where these are sought.

    Parameters
    ----------
    reference : Reference
    find : callable
        ``find(fit, reference, pixel_scale)``: its stars that a fit has,
        `legdistort.matching.cross_identification.Identified`.
    solve : callable
        `legdistort.solving.minimisers.solve_joint`.
    epoch, pixel_scale : float, optional
        As `legdistort.solve` takes them.
    """

    def __init__(self, reference, *, find, solve, epoch=None, pixel_scale=None):
        self.reference, self.epoch, self.pixel_scale = reference, epoch, pixel_scale
        self.find, self.solve = find, solve
        self.deviant, self.factor = (), 1.0

    def __call__(self, fit, statics):
        """The fit joined, if `statics` of the detectors are sought or no star ties some of these; else as it is.

        Statics where stars move are found without the reference: it is no prior on stars of precise visits that holds
        the maps which these have apart.
        """
        group = np.full(fit.problem.n_stars, -1)
        group[fit.problem.star[fit.used]] = fit.matches.camera.group_of(fit.matches.table[fit.problem.order][fit.used])
        if group.max() < 1 and not (statics and not fit.problem.terms.n):
            return fit
        terms, of = fit.problem.terms, fit.options
        epoch = terms.epoch if terms.n else fit.matches.epoch if self.epoch is None else self.epoch
        try:
            found = self.find(fit, self.reference.at(epoch, moving=terms.n > 0), self.pixel_scale)
        except InputError:
            if group.max() < 1:  # its stars may lie elsewhere until these are found; if not, `tie` tells
                return fit
            raise
        found = found.subset(_nearly_agrees(fit, found, group))
        if self.reference.degree:
            found = bent_reference.without_own_map(found, fit.result, self.reference.degree)
        positions = fit.result.state.positions.T[found.rows]
        rough = similarities(fit.problem, found.rows, positions, found.xy, self.reference.label)
        state = moved_by(fit.problem, fit.result.state, rough)
        for _ in range(_JOINS):
            used = ~np.isin(found.rows, self.deviant)
            values, covariance = offered(found.subset(used), terms.n, self.factor)
            catalogue = StarPrior.of(fit.problem.n_stars, found.rows[used], values, covariance)
            problem = replace(fit.problem, moving=replace(terms, catalogue=catalogue))
            weighted = problem.scaled(fit.used.astype(float))
            result = self.solve(weighted, state, loss=of.loss, max_iterations=of.max_iterations)
            if not self._judged(found, fit, result, catalogue):
                break
            state = result.state
        return replace(fit, problem=problem, result=result)

    def _judged(self, found, fit, result, catalogue):
        """Find which stars of the reference deviate, and the factor on its errors; whether that is something else."""
        own = unpacked(elimination.inverse_star_blocks(fit.blocks.v))[found.rows]
        off = found.xy - result.state.positions.T[found.rows]
        pull = unpacked(catalogue.precision)[found.rows] @ (catalogue.mean - result.state.stars).T[found.rows, :, None]
        off = off + (own @ pull)[:, :2, 0]  # from where the exposures have them
        own, theirs = own[:, :2, :2], found.covariance[:, :2, :2]

        def lengths(factor):
            return np.sqrt(np.einsum("na,nab,nb->n", off, np.linalg.inv(own + factor**2 * theirs), off))

        used = ~np.isin(found.rows, self.deviant)
        factor = catalogue_map.factor_of(lengths, used, self.reference.finds_errors)
        deviant = found.rows[lengths(factor) > catalogue_map.CLIP]
        if not self.reference.finds_errors:  # weights by a factor that a wrong camera called for would leave it wrong
            factor = 1.0
        same = np.array_equal(deviant, self.deviant) and abs(np.log(factor / self.factor)) < _SAME_FACTOR
        if not same and 2 * len(deviant) < len(found.rows):
            self.deviant, self.factor = deviant, factor
        return not same


def _nearly_agrees(fit, found, group):
    """Which stars of a reference, bool (n,), are off by as much as others on the same `group` of detectors."""
    positions, agrees = fit.result.state.positions.T, np.ones(len(found.rows), dtype=bool)
    for g in range(group.max() + 1):
        mine = np.flatnonzero(group[found.rows] == g)
        if len(mine) > _FEWEST:
            source, target = positions[found.rows[mine]], found.xy[mine]
            off = np.hypot(*(similarity.apply(robust_similarity(source, target), source) - target).T)
            agrees[mine] = off < _MISMATCH * np.median(off)
    return agrees
