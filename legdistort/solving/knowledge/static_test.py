"""Whether exposures agree with the static distortion that was given, and if not, which other would agree.

What everything else says of a static distortion, ``S ~ N(s, C)``, comes from exposures that depart from one and the
same distortion of their detector, wherever it was pointed and however turned. A prior ``N(m, V)`` is tested by
``T = (s - m)' (C + V)^-1 (s - m)``, in those directions that the exposures determine better than the prior is large;
and by the part of T that lies along m, which is what a prior that is too large or too small leaves.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special

from ...cameras.stated_errors import FREE
from ...geometry import basis, detector_modes


@dataclass(frozen=True, eq=False)
class StaticTest:
    """A test of the prior of one detector.

    Attributes
    ----------
    information : ndarray, shape (K, K)
        C^-1, perhaps singular.
    slope : ndarray, shape (K,)
        C^-1 (s - m).
    given : ndarray, shape (K,)
        m.
    stated : ndarray, shape (K, K)
        V.
    shape : tuple
        ``(ny, nx)`` of the detector.
    directions : ndarray, shape (k, K)
        Orthonormal rows: those that the exposures determine better than the prior is large.
    dof_scatter : float
        Degrees of freedom of the scatter of exposures that C rests on.
    """

    information: np.ndarray
    slope: np.ndarray
    given: np.ndarray
    stated: np.ndarray
    shape: tuple
    directions: np.ndarray
    dof_scatter: float = np.inf

    @property
    def wrong(self):
        """How far a wrong prior is from the truth (K,): by its mean, or by three of its widths if it has none."""
        return self.given if self.given.any() else 3 * np.sqrt(np.diag(self.stated))

    @cached_property
    def covariance(self):
        """Of s - m in these directions, if the prior is right, (k, k)."""
        d = self.directions
        return np.linalg.inv(d @ self.information @ d.T) + d @ self.stated @ d.T

    @cached_property
    def difference(self):
        """s - m in these directions, (k,)."""
        d = self.directions
        return np.linalg.solve(d @ self.information @ d.T, d @ self.slope)

    def statistic(self, mean=None):
        """T for a mean (K,) in the place of that given."""
        moved = self.difference if mean is None else self.difference + self.directions @ (self.given - mean)
        return float(moved @ np.linalg.solve(self.covariance, moved))

    def chance(self, statistic):
        """Probability that T is larger if the prior is right."""
        k = len(self.directions)
        return float(special.fdtrc(k, self.dof_scatter, statistic / k)) if k else 1.0

    @property
    def along(self):
        """By how much less T is for the best multiple of the prior, and that multiple."""
        towards = self.directions @ self.given
        weighted = np.linalg.solve(self.covariance, towards)
        if not (towards.any() and (square := weighted @ towards) > 0):
            return 0.0, 1.0
        pull = weighted @ self.difference
        return float(pull**2 / square), float(1 + pull / square)

    @property
    def p(self):
        """Probability of such a disagreement by chance: as a whole, or along the prior itself, whichever is less."""
        if not len(self.directions):
            return 1.0
        scaled = float(special.fdtrc(1, self.dof_scatter, self.along[0]))
        return min(1.0, 2 * min(self.chance(self.statistic()), scaled))

    def power(self, alarm):
        """Probability to find a prior that is wrong by its own size, with so many false alarms."""
        k = len(self.directions)
        if not k:
            return 0.0
        wrong, limit = self.directions @ self.wrong, k * special.fdtri(k, self.dof_scatter, 1 - alarm / 2)
        away = float(wrong @ np.linalg.solve(self.covariance, wrong))
        # T is about normal, and so much above the limit that nothing else counts
        return float(special.ndtr((away + k - limit) / np.sqrt(2 * (k + 2 * away))))

    @property
    def rms(self):
        """Rms displacement (per axis) over the detector between what exposures show and what is given, pixels."""
        return float(np.sqrt(self.difference @ self.difference / 8))

    def better(self):
        """What else would agree with the exposures: ``{words: T}`` of maps that are made from the one given.

        Its reflections and turns about the middle of the detector, with either sign, and the best multiple of it.
        """
        others = detector_modes.dynamic_basis(self.shape, (len(self.given) + 4) // 2)
        field, made = (self.given @ others).reshape(2, -1), {}
        for words, turn in _symmetries(self.shape).items():
            mean = others @ turn(field).ravel()
            made[f"with its sign reversed{', ' * bool(words)}{words}"] = self.statistic(-mean)
            if words:
                made[words] = self.statistic(mean)
        gain, factor = self.along
        if factor > 0:
            made[f"times {factor:.2g}"] = self.statistic() - gain
        return made


def static_tests(model, given, spread, shapes):
    """The prior of every detector tested by all else, a list of `StaticTest`.

    Parameters
    ----------
    model : ExposureModel
    given : ndarray, shape (n_groups, K)
        Mean of the prior.
    spread : StaticSpread
        Its covariance; infinite where nothing is stated.
    shapes : list of (ny, nx), by detector
    """
    posterior, sizes = model.posterior, model.posterior.sizes
    seen = posterior.without(model.free_statics)
    known = list(zip(given, spread.directions, spread.variance, shapes, strict=True))
    tests = [_test(posterior, seen, *each) for each in enumerate(known)]
    share = np.zeros((len(sizes) - 1, len(tests)))
    for j in range(len(share)):
        larger = replace(posterior, sizes=np.where(np.arange(len(sizes)) == j, 1.1 * sizes, sizes))
        seen = larger.without(model.free_statics)
        for g, test in enumerate(tests):
            after = _test(larger, seen, g, known[g], test.directions)
            share[j, g] = np.log((test.statistic() + 1e-9) / (after.statistic() + 1e-9)) / np.log(1.1) / 2
    dof = 1 / (share**2 / np.maximum(posterior.determined[:-1, None], 1) + 1e-12).sum(axis=0)
    return [replace(test, dof_scatter=float(n)) for test, n in zip(tests, dof, strict=True)]


def _test(posterior, seen, g, known, directions=None):
    """The test of a detector, whatever the others are; in given directions, or those that are determined.

    `seen` are information and slope of all statics from everything but what is known of them.
    """
    (given, directions_given, variance, shape), (information, slope) = known, seen
    k, stated = len(given), np.isfinite(variance)
    turned, place = np.eye(len(slope)), slice(g * len(given), (g + 1) * len(given))
    turned[place, place] = directions_given
    information, slope = turned.T @ information @ turned, turned.T @ slope
    mine = np.zeros(len(slope), dtype=bool)
    mine[place] = stated
    size = np.full(len(slope), posterior.sizes[-1])
    size[place] = FREE  # of what is not known of this one
    others = information[np.ix_(~mine, ~mine)] + np.diag(size[~mine] ** -2.0)
    across = information[np.ix_(mine, ~mine)]
    solved = np.linalg.solve(others, np.column_stack([across.T, slope[~mine]]))
    whole, pull = np.zeros((k, k)), np.zeros(k)
    whole[np.ix_(stated, stated)] = information[np.ix_(mine, mine)] - across @ solved[:, :-1]
    pull[stated] = slope[mine] - across @ solved[:, -1]
    whole, pull = directions_given @ whole @ directions_given.T, directions_given @ pull
    covariance = directions_given * np.where(stated, variance, 0) @ directions_given.T
    test = StaticTest(whole, pull, given, covariance, shape, directions)
    if directions is not None:
        return test
    values, vectors = np.linalg.eigh(whole)
    return replace(test, directions=vectors[:, values * (test.wrong @ test.wrong) > 1].T)


def _symmetries(shape):
    """Turns and reflections of displacement fields (2, n_modes) about the middle of a detector, by their words."""

    def reflected(field, axes):
        """Mirrored along some axes: u -> -u reverses the modes odd in u, and the displacement along x."""
        i, j = basis.orders(basis.degree_of(field.shape[1]))
        sign = np.ones(field.shape)
        for axis, order in zip((0, 1), (i, j), strict=True):
            if axis in axes:
                sign = sign * (-1.0) ** order
                sign[axis] *= -1
        return sign * field

    def exchanged(field):
        i, j = (np.asarray(each) for each in basis.orders(basis.degree_of(field.shape[1])))
        number = {pair: k for k, pair in enumerate(zip(i.tolist(), j.tolist(), strict=True))}
        return field[::-1, [number[pair] for pair in zip(j.tolist(), i.tolist(), strict=True)]]

    out = {
        "": lambda field: field,
        "mirrored along x": lambda field: reflected(field, (0,)),
        "mirrored along y": lambda field: reflected(field, (1,)),
        "turned by 180 degrees": lambda field: reflected(field, (0, 1)),
    }
    if shape[0] == shape[1]:
        out["with x and y exchanged"] = exchanged
        out["turned by 90 degrees"] = lambda field: reflected(exchanged(field), (0,))
        out["turned by -90 degrees"] = lambda field: reflected(exchanged(field), (1,))
        out["mirrored across the other diagonal"] = lambda field: reflected(exchanged(field), (0, 1))
    return out
