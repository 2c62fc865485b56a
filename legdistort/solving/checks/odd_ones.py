"""Which of several departures is odd: each compared with all others, by how far these scatter."""

import numpy as np
from scipy import special


def beyond_chance(a, noise, degrees, alarm, *, fewest):
    """Which of departures (n, k) are left out, the least probable first, until all others are alike, or half are left.

    Several odd ones would hide behind one another. At least `fewest` are left.
    """
    out, left = [], np.arange(len(a))
    while len(left) > max(fewest, len(a) / 2):
        ratio, _, p = compared(a[left], noise[left], degrees)
        worst = np.lexsort([-ratio, p])[0]
        if p[worst] >= alarm:
            break
        out.append(int(left[worst]))
        left = np.delete(left, worst)
    return out


def with_others(a, out, k):
    """Indices of a departure and of all that are not left out; of these departures (n, k) the k-th is compared."""
    return np.delete(np.arange(len(a)), [i for i in out if i != k])


def compared(a, noise, degrees):
    """Departures (n, k), with variances of errors and degrees (k,), each by the others: ratio, chi2 and p, (n,)."""
    n = len(a)
    squares = (a - a.mean(axis=0)) ** 2
    square, p = squares * (n / (n - 1)) ** 2, []  # from the mean of the others
    for degree in (each := np.unique(degrees)):
        of = degrees == degree
        m = np.count_nonzero(of)
        whole = (squares[:, of].sum() - squares[:, of].sum(axis=1) * n / (n - 1)) / (m * (n - 2))
        errors = (noise[:, of].sum() - noise[:, of].sum(axis=1)) / (m * (n - 1))
        scatter = np.maximum(whole - errors, 0)
        square[:, of] /= (scatter + whole / (n - 1))[:, None] + noise[:, of]
        p.append(special.fdtrc(m, m * (n - 2), square[:, of].mean(axis=1)))
    return np.sqrt(square.mean(axis=1)), square.sum(axis=1), np.minimum(1, len(each) * np.min(p, axis=0))
