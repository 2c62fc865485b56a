"""How far exposures and nights scatter around their static distortion, how well each is known, and its weight."""

import numpy as np

from ...cameras.stated_errors import StaticSpread
from ...geometry.detector_modes import dynamic_degrees
from ..equations.elimination import inverse_exposure_blocks

_ROUNDS, _NEWTON = 20, 50  # at most
#: Weights, in exposures, of the mean of a degree in the variance of its modes, and of the other degrees in that mean.
#: Measured: squared true over reported error 0.8 to 1.2 for 4 to 11 exposures (tests/benchmarks/calibration_table.py);
#: with 1 for the second, cubic modes of four exposures were taken to scatter 1.4 times too much, and it was 0.71 with
#: rolls.
_SHARED, _BORROWED = 10.0, 0.3

#: Degrees of freedom of Student's t distribution of the departures of exposures and nights, which up to so many
#: standard deviations of the sum of their squares are those of a Gaussian.
TAILS, CHANCE = 4.0, 3.0
#: Nights scatter if the squares of their means exceed what is expected of independent exposures by so many standard
#: deviations.
SEEN = 2.5

#: A static distortion is at most so many times what is seen: one far beyond, undone by a bend of the plane that nearly
#: equal dithers hardly tell from none, would explain whatever two nights differ by.
_LARGE = 10.0

_SMALLEST = 1e-6  # scatter, pixels: where none is seen beyond the errors, Lambda stays invertible


def conditional_errors(u_data):
    """C_i, covariance of the coefficients if the stars were known; huge where the data do not determine them."""
    size = u_data.shape[1]
    ridge = 1e-12 * np.trace(u_data, axis1=1, axis2=2)[:, None, None] / size + 1e-300
    return inverse_exposure_blocks(u_data + ridge * np.eye(size))


def dynamic_covariance(problem, state, error, moved, others, night, group, static):
    """Lambda of every exposure: from the prior if it has widths, else from the scatter seen beyond the errors.

    And the variances (n_nights, K) of what exposures of a night have in common, from the scatter of their means, if
    that is more than chance; and whether anything tells these.

    A common map of the reference plane is fitted to the departures A_i - A_0 and taken out, so that the result does not
    depend on the gauge of the state; with it what of the static distortion of every detector is not known beforehand.
    Then, mode by mode (shears for the linear ones), the variance that makes the weighted squares of what is left their
    degrees of freedom (Paule & Mandel 1982), the leverage of what was fitted counted.

    Parameters
    ----------
    problem : Problem
    state : State
    error : ndarray, shape (n_exposures, 2 n, 2 n)
        C_i.
    moved : ndarray, shape (n_exposures, K, m)
        How the m maps of the reference plane change the K modes `others` of every exposure.
    others : ndarray, shape (n_exposures, K, 2 n)
    night, group : ndarray of int, shape (n_exposures,)
        See `legdistort.solving.gauge.hierarchy.Hierarchy`.
    static : StaticSpread
        Covariance of the static distortion of every detector: infinite where it is not known, zero where it is exact.
    """
    n_modes = problem.n_modes
    departure = (state.coefficients - problem.prior_mean)[:, :, :n_modes].reshape(problem.n_exposures, -1)
    own = np.einsum("ika,ia->ik", others, departure)
    variance = (others @ error * others).sum(axis=2)
    counts = variance <= 10 * np.median(variance, axis=0)  # values less certain would add noise and nothing else
    nightly, told = np.zeros((0 if night is None else night.max() + 1, own.shape[1])), False
    if nightly.size:
        scatter2, nightly, told = _of_nights(problem, own, variance, counts, moved, night, group, static)
    if not nightly.any():
        scatter2, _ = _scatter(own, variance, counts, moved, group, static)
    out = others.transpose(0, 2, 1) * scatter2 @ others
    for i in range(problem.n_exposures):
        if problem.has_widths(i):
            width = problem.prior_sigma[i].ravel()
            seen = np.maximum(np.diag(out[i]), _SMALLEST**2)
            given = np.where(np.isfinite(width) & (width > 0), width**2, seen)
            out[i] = others[i].T @ (others[i] * given @ others[i].T) @ others[i]
    return out, nightly, told


def _of_nights(problem, own, variance, counts, moved, night, group, static):
    """Variance (K,) of exposures about their nights, that (n_nights, K) of nights, zero if it is chance; is it told?

    Parameters are those of `_scatter`, of exposures, and `night` and `group` of `dynamic_covariance`.
    """
    shape = night.max() + 1, own.shape[1]
    scatter2, _ = _scatter(own, variance, counts, moved, night, StaticSpread.of_rows(np.full(shape, np.inf)))
    if problem.night_sigma is not None:
        return scatter2, np.full(shape, problem.night_sigma**2), True
    weight = counts / (variance + scatter2 + 1e-300)
    total = _sums(weight, night) + 1e-300
    means, moved = _sums(weight * own, night) / total, _sums(weight[:, :, None] * moved, night) / total[:, :, None]
    owner, counts = group[np.unique(night, return_index=True)[1]], _sums(weight, night) > 0
    left, variance = _fitted(*_common(means, moved, owner, static), counts * total, means)
    dof = np.maximum(counts.sum(axis=0) - (counts * total * variance).sum(axis=0), 0.0).sum()
    if dof > 1 and np.sum(counts * total * left**2) < dof + SEEN * np.sqrt(2 * dof):
        return scatter2, np.zeros(shape), True
    falling = _falling(scatter2)
    unit = np.sqrt(falling)
    terms = means / unit, 1 / (total * falling), counts, moved / unit[:, None], owner, static.divided(unit)
    found, odd = _scatter(*terms, robust=True)
    return scatter2, odd[:, None] ** 2 * found * falling, dof > 1


def _falling(variance):
    """Mean variance (K,) of the degree of every mode, or of a higher one if that is larger.

    Few nights tell little of how they scatter by degree: as exposures do, as long as nothing else is seen.
    """
    degree = dynamic_degrees(len(variance) // 2 + 2)
    mean = np.bincount(degree, variance) / np.maximum(np.bincount(degree), 1)
    return np.maximum.accumulate(mean[::-1])[::-1][degree] + _SMALLEST**2


def _common(own, moved, owner, static):
    """Design (n, K, m) of maps and of what those of an owner have in common, and inverse variances (m,) known of it."""
    each = zip(static.directions, static.variance, strict=True)
    common = [(owner == g)[:, None, None] * columns[:, of > 0] for g, (columns, of) in enumerate(each)]
    known = np.minimum(static.variance[static.variance > 0], _LARGE**2 * np.sum(own**2) / max(own.size, 1) + 1e-300)
    return np.concatenate([moved, *common], axis=2), np.concatenate([np.zeros(moved.shape[2]), 1 / known])


def _scatter(own, variance, counts, moved, owner, static, *, robust=False):
    """Variance (K,) by mode of values (n, K) beyond that of their errors, about what those of an owner have in common.

    Parameters
    ----------
    own, variance : ndarray, shape (n, K)
    counts : ndarray of bool, shape (n, K)
        Which of them count.
    moved : ndarray, shape (n, K, m)
        How maps of the reference plane change them, which are fitted and taken out.
    owner : ndarray of int, shape (n,)
    static : StaticSpread
        Covariance of what is common to those of an owner.
    robust : bool
        Give each of the n a factor of its own on the scatter.

    Returns
    -------
    ndarray, shape (K,)
    ndarray, shape (n,)
        These factors.
    """
    design, stated = _common(own, moved, owner, static)
    scatter2, odd = np.mean((own - own.mean(axis=0)) ** 2, axis=0), np.ones(len(own))
    for _ in range(_ROUNDS if own.size else 0):
        wide = odd[:, None] ** 2
        weight = counts / (variance + wide * scatter2 + 1e-300)
        left, fitted = _fitted(design, stated, weight, own)
        dof = np.maximum(counts.sum(axis=0) - (weight * fitted).sum(axis=0), 0.0)
        terms = left / odd[:, None], variance / wide, counts
        new = _pooled(_by_degree(*terms, dof) if robust else _excess(*terms, dof), dof, np.mean(own**2))
        change, scatter2 = np.abs(new - scatter2).max(initial=0), new
        if robust:
            before, odd = odd, _oddness(left, variance, fitted, counts, wide, new)
            change = max(change, np.abs(np.log(odd / before)).max() * new.max(initial=0))
        if change <= 1e-3 * new.max(initial=0):  # equal where exposures do not scatter, as at a start
            break
    return scatter2, odd


def _by_degree(left, variance, counts, dof):
    """`_excess` of all modes of a degree together: few values scatter too widely to be floored one by one."""
    degree, out = dynamic_degrees(left.shape[1] // 2 + 2), np.zeros(left.shape[1])
    for d in np.unique(degree):
        of = degree == d
        out[of] = _excess(*(each[:, of].reshape(-1, 1) for each in (left, variance, counts)), dof[of].sum())
    return out


def _oddness(left, variance, fitted, counts, wide, scatter2):
    """Factors (n,) on the scatter of values (n, K), as for Student's t distribution (Lange, Little & Taylor 1989).

    The variance of what was `fitted` to a value counts: what a night draws to itself tells nothing of how odd it is.
    One where the squares are no larger than by chance, from there on without a jump, and those of the distribution from
    twice that excess on.
    """
    prior = wide * scatter2 + 1e-300
    share = prior / (prior + variance)
    square = (counts * (share**2 * (left**2 + fitted) + share * variance) / (prior / wide)).sum(axis=1)
    count = counts.sum(axis=1)
    beyond = (square - count) / (CHANCE * np.sqrt(2 * count) + 1e-300)
    return ((TAILS + square) / (TAILS + count)) ** (np.clip(beyond - 1, 0, 1) / 2)


def _sums(values, label):
    """Sums of values (n, ...) by their labels, integers (n,)."""
    out = np.zeros((label.max() + 1, *values.shape[1:]))
    np.add.at(out, label, values)
    return out


def _fitted(design, stated, weight, own):
    """What a weighted fit leaves of values (n, K), and the variance of what was fitted to each.

    `stated` is the inverse variance that is known beforehand of every column of the design.
    """
    columns, weight = design.reshape(own.size, design.shape[2]), weight.reshape(-1, 1)
    curvature, vectors = np.linalg.eigh((weight * columns).T @ columns + np.diag(stated))
    determined = curvature > 1e-10 * curvature.max(initial=0)
    columns = columns @ (vectors[:, determined] / np.sqrt(curvature[determined]))
    left = own - (columns @ (columns.T @ (weight.ravel() * own.ravel()))).reshape(own.shape)
    return left, np.sum(columns**2, axis=1).reshape(own.shape)


def _pooled(variance, dof, largest):
    """Variance per mode, shears first, drawn towards the mean of its degree by the weight of `_SHARED` exposures.

    A handful of exposures determines the scatter of a single mode badly, and weights that follow its noise make
    positions worse and reported errors too small. A degree of which nothing is determined (shears, in four exposures
    without rolls) is taken to scatter with twice the variance of the degree that scatters most: distortions fall with
    the degree. Where nothing is determined of any degree, exposures may scatter by as much as they depart from the
    prior mean, the mean square of which is `largest`. `dof` (K,) are the degrees of freedom that a fit leaves to every
    mode.
    """
    degree = dynamic_degrees(len(variance) // 2 + 2)
    number, total = np.bincount(degree, dof), np.bincount(degree, dof * variance)
    seen = (total / np.maximum(number, 1e-300))[number > 1]
    most = 2 * seen.max() if seen.size else largest
    usual = ((total + _BORROWED * most) / (number + _BORROWED))[degree]
    return (dof * variance + _SHARED * usual) / (dof + _SHARED)


def _excess(a, variance, counts, dof):
    """Variance per column of a (n, K) beyond the given ones that makes the weighted squares `dof`; never below zero.

    By Newton's method for the inverse of the squares, which is concave: from below it never goes too far.
    """
    power, goal, variance = counts * a**2, np.maximum(dof, 0.1), variance + 1e-100
    extra = np.maximum(power.sum(axis=0) / goal - variance.max(axis=0, initial=0), 0.0)
    for _ in range(_NEWTON):
        terms = power / (variance + extra)
        squares, slope = terms.sum(axis=0), (terms / (variance + extra)).sum(axis=0)
        step = np.maximum(squares * (squares / goal - 1) / (slope + 1e-300), 0.0)
        extra += step
        if np.all(step <= 1e-12 * extra):
            break
    return extra


def influence(error, rows):
    """Weight of each exposure (n_exposures,): 1, fading where the variance exceeds ten times the usual one.

    The scatter of a convention over a bad exposure's errors would move every star for no gain.
    """
    if not rows.shape[1]:
        return np.ones(len(error))
    own = (rows @ error * rows).sum(axis=2).mean(axis=1)
    return 1 / (1 + (own / (10 * np.median(own))) ** 2)
