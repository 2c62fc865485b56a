"""Errors of static distortions as callers state them, widths or a covariance, and as they count in a solution.

Also those of layouts and static distortions of all detectors of a camera together, as solutions find them.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..exceptions import InputError
from ..geometry import basis
from ..geometry.detector_modes import row_variances

#: Error of a coefficient, or of a combination of them, from which on nothing is known of it [pix].
UNKNOWN = 100.0
#: Error of what nothing is known of, where digits count [pix].
FREE = 1e3
_EXACT = 1e-15  # variance, of the largest, that is rounding
_ROUNDING = 1e-9  # of the largest variance


def undetermined_degree(camera):
    """Highest degree of the maps of the focal plane that were not determined when a camera was found; 0 without any.

    Exposures of a lower degree cannot take over what these have of it.
    """
    if camera.common_sigma is None:
        return 0
    orders = np.add(*basis.orders(basis.degree_of(camera.common_sigma.shape[1])))
    return int(orders[np.isinf(camera.common_sigma).any(axis=0)].max(initial=0))


def as_widths(value, n, name):
    """Standard deviations given as a number, per mode or per axis and mode, as (2, n); None as None.

    Raises
    ------
    InputError
        For other shapes, and what is negative or NaN.
    """
    if value is None:
        return None
    out = _numbers(value, f"{name} must be widths in pixels")
    try:
        out = np.broadcast_to(out, (2, n)).copy()
    except ValueError:
        raise InputError(
            f"{name} must be a number, one per mode ({n},) or per axis and mode (2, {n}), got shape {out.shape}"
        ) from None
    if not np.all(out >= 0):
        raise InputError(f"{name} must be 0 or more (a standard deviation in pixels), got {value!r}")
    return out


def as_covariance(value, n, name):
    """A covariance (2 n, 2 n) of coefficients, symmetric, infinite variances by themselves; None as None.

    Raises
    ------
    InputError
        For what is none.
    """
    if value is None:
        return None
    out = _numbers(value, f"{name} must be numbers, a covariance in px^2")
    if out.shape != (2 * n, 2 * n):
        raise InputError(f"{name} must be a covariance of shape ({2 * n}, {2 * n}) in px^2, got shape {out.shape}")
    unknown = np.isposinf(np.diag(out))
    out[unknown] = out[:, unknown] = 0.0
    if not np.isfinite(out).all():
        raise InputError(f"{name} must be numbers, but for infinite variances of coefficients that are not known")
    largest = np.abs(np.diag(out)).max(initial=0)
    if np.abs(out - out.T).max(initial=0) > _ROUNDING * largest:
        raise InputError(f"{name} must be a covariance in px^2, and is not symmetric")
    out = (out + out.T) / 2
    if np.linalg.eigvalsh(out).min(initial=0) < -_ROUNDING * largest:
        raise InputError(f"{name} must be a covariance in px^2, and gives a combination a negative variance")
    out[unknown, unknown] = np.inf
    return out


def _numbers(value, wanted):
    """An array of our own; `InputError` with what is wanted for what is none."""
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"{wanted}, got {value!r}") from None


def as_errors(widths, covariance, n, names):
    """Both `as_widths` (2, n) and `as_covariance` (2 n, 2 n), of which one is given; the widths are its diagonal then.

    Infinite from `UNKNOWN` pixels on.

    Raises
    ------
    InputError
        As these do; if both are given and differ.
    """
    sigma, covariance = as_widths(widths, n, names[0]), as_covariance(covariance, n, names[1])
    if covariance is None:
        return sigma, None
    out = np.sqrt(np.maximum(np.diag(covariance), 0)).reshape(2, n)
    out = np.where(out < UNKNOWN, out, np.inf)
    if sigma is not None and not np.allclose(sigma, out, rtol=1e-6, atol=0):
        raise InputError(f"{names[0]} and {names[1]} differ: give one of them, and the other as None")
    return out, covariance


def resized(covariance, n, parts=2):
    """A covariance of the modes of `parts` axes for another number n of each, those beyond exact; None as None."""
    if covariance is None:
        return None
    m = len(covariance) // parts
    out, kept = np.zeros((parts, n, parts, n)), min(n, m)
    out[:, :kept, :, :kept] = covariance.reshape(parts, m, parts, m)[:, :kept, :, :kept]
    return out.reshape(parts * n, parts * n)


@dataclass(frozen=True, eq=False)
class StaticErrors:
    """Errors of the static distortion that is stated for every exposure.

    Attributes
    ----------
    sigma : ndarray, shape (n_exposures, 2, n_modes)
        Standard deviations: infinite where nothing is stated, zero where it is exact.
    covariances : tuple of ndarray (2 n_modes, 2 n_modes) or None, or None
        Those of exposures whose prior has one; None without any.
    """

    sigma: np.ndarray
    covariances: tuple | None = None

    @classmethod
    def of(cls, priors, degree):
        """Those of priors, or None, of every exposure."""
        free = np.full((2, basis.n_modes(degree)), np.inf)
        made = {p: (free, None) if p is None else (p.static_widths(degree), p.static_covariance_to(degree))
                for p in dict.fromkeys(priors)}  # fmt: skip
        several = any(covariance is not None for _, covariance in made.values())
        return cls(np.stack([made[p][0] for p in priors]), tuple(made[p][1] for p in priors) if several else None)

    def part(self, keep):
        """Those of some exposures (k,)."""
        covariances = self.covariances and tuple(self.covariances[i] for i in keep)
        return StaticErrors(self.sigma[keep], covariances)

    def to_modes(self, n):
        """Those of the first n modes."""
        kept = (np.arange(2)[:, None] * self.sigma.shape[2] + np.arange(n)).ravel()
        covariances = self.covariances and tuple(c if c is None else c[np.ix_(kept, kept)] for c in self.covariances)
        return StaticErrors(self.sigma[:, :, :n], covariances)

    @cached_property
    def knows_nothing(self):
        """Whether nothing is stated of any mode of any exposure."""
        correlated = self.covariances is not None and any(c is not None for c in self.covariances)
        return not correlated and bool(np.isinf(self.sigma).all())

    def spread(self, rows, first):
        """The `StaticSpread` of some exposures (k,), on rows (k, K, 2 n_modes) of `dynamic_basis`."""
        some = self.part(first)
        return StaticSpread.of(rows, some.sigma.reshape(len(some.sigma), -1), some.covariances)


@dataclass(frozen=True, eq=False)
class StaticSpread:
    """Covariances ``V_g = D_g diag(v_g) D_g'`` of static distortions, on the rows of `dynamic_basis`.

    Attributes
    ----------
    directions : ndarray, shape (n, K, K)
        Columns of D.
    variance : ndarray, shape (n, K)
        Infinite along what is not known, zero along what is exact.
    """

    directions: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, rows, sigma, covariances=None):
        """That by widths (n, 2 n_modes), or by covariances where these are not None.

        Parameters
        ----------
        rows : ndarray, shape (n, K, 2 n_modes)
        sigma : ndarray, shape (n, 2 n_modes)
        covariances : sequence of n ndarray (2 n_modes, 2 n_modes) or None, optional
        """
        out = cls.of_rows(row_variances(rows, sigma))
        if covariances is None:
            return out
        directions, variance = out.directions.copy(), out.variance
        for g, covariance in enumerate(covariances):
            if covariance is not None:
                known = np.where(np.isinf(covariance), FREE**2, covariance)
                v, directions[g] = np.linalg.eigh(rows[g] @ known @ rows[g].T)
                v = np.where(v > _EXACT * v.max(initial=0), v, 0.0)
                variance[g] = np.where(v < UNKNOWN**2, v, np.inf)
        return cls(directions, variance)

    @classmethod
    def of_rows(cls, variance):
        """That by variances (n, K) of the rows themselves."""
        return cls(np.broadcast_to(np.eye(variance.shape[1]), (*variance.shape, variance.shape[1])), variance)

    def exact(self):
        """As if all were exact."""
        return replace(self, variance=np.zeros_like(self.variance))

    def divided(self, size):
        """Those of coefficients that are divided by some sizes (K,)."""
        directions = self.directions / size[:, None]
        length = np.linalg.norm(directions, axis=1)
        return StaticSpread(directions / length[:, None], self.variance * length**2)

    @property
    def finite(self):
        """V (n, K, K), nothing of what is not known."""
        known = np.where(np.isfinite(self.variance), self.variance, 0.0)
        return self.directions * known[:, None] @ self.directions.mT


def joint_covariance(value, detectors):
    """A covariance (2 n_detectors n, same) of all modes of detectors; None as None, and where their widths are others.

    Raises
    ------
    InputError
        For what is none.
    """
    if value is None:
        return None
    rows = 2 * len(detectors)
    try:
        n = len(value) // rows
        basis.degree_of(n)
    except (TypeError, ValueError):
        n = 0
    if n < 3 or len(value) != rows * n:
        raise InputError(
            f"covariance must be that of as many modes, 3 or more an axis, of each of {len(detectors)} detectors; for "
            "other detectors than it was made for leave it out (covariance=None)"
        )
    out, widths = as_covariance(value, rows * n // 2, "covariance"), _widths(detectors, n)
    same = widths is not None and np.allclose(np.sqrt(np.maximum(np.diag(out), 0)), widths.ravel(), rtol=1e-6, atol=0)
    return out if same else None


def _widths(detectors, n):
    """Standard deviations (n_detectors, 2, n) of layouts and statics, exact ones 0; None if there are more modes."""
    out = np.zeros((len(detectors), 2, n))
    for k, each in enumerate(detectors):
        for first, widths in ((0, each.layout_sigma), (3, each.static_sigma)):
            if widths is None:
                continue
            if np.any(widths[:, n:]):
                return None
            known = widths[:, first:n]
            out[k, :, first : first + known.shape[1]] = known
    return out


def errors_of(free, covariance):
    """Standard deviations (n_detectors, 2, n_modes) of the free modes, of a covariance (k, k); zero for others."""
    out = np.zeros(free.shape)
    out[free] = np.sqrt(np.diag(covariance))
    return out


def with_errors(camera, free, covariance, unknown):
    """The camera with the errors of its free modes, of a covariance (k, k), infinite along `unknown` directions (m, k).

    Detectors of which nothing is free keep theirs.
    """
    errors, index = errors_of(free, covariance), np.full(free.shape, -1)
    errors[free] = np.where(np.any(np.abs(unknown) > errors[free], axis=0), np.inf, errors[free])
    index[free] = np.arange(np.count_nonzero(free))
    detectors = {}
    for k, (key, each) in enumerate(camera.detectors.items()):
        detectors[key] = each
        if not free[k].any():
            continue
        low, places = free[k, :, :3].ravel(), index[k, :, :3].ravel()
        of_layout = np.zeros((6, 6))
        of_layout[np.ix_(low, low)] = covariance[np.ix_(places[low], places[low])]
        lost = np.isinf(errors[k, :, :3].ravel())
        of_layout[lost] = of_layout[:, lost] = 0.0
        of_layout[lost, lost] = np.inf
        top = max(basis.degree_of(free.shape[2]), basis.degree_of(each.static.shape[1]))
        widths = basis.change_degree(np.where(np.arange(free.shape[2]) < 3, 0.0, errors[k]), top)
        static = basis.change_degree(each.static, top)
        known = {"static_sigma": widths, "static_covariance": None}
        detectors[key] = replace(each, layout_covariance=of_layout, static=static, **known)
    return replace(camera, detectors=detectors, covariance=_of_all(detectors.values(), free, covariance))


def _of_all(detectors, free, covariance):
    """Covariance of all modes of detectors, of one (k, k) of the free ones; others are independent, by their widths."""
    top = max([basis.degree_of(free.shape[2]), *(basis.degree_of(each.static.shape[1]) for each in detectors)])
    widths = _widths(list(detectors), basis.n_modes(top))
    rows = np.zeros(widths.shape, dtype=bool)
    rows[:, :, : free.shape[2]] = free
    known, rows = np.isfinite(widths[rows]), np.flatnonzero(rows)
    out = np.diag(widths.ravel() ** 2)
    out[np.ix_(rows[known], rows[known])] = covariance[np.ix_(known, known)]
    return out


def with_errors_times(camera, free, factor):
    """The camera with the errors of what was fitted, `free` (n_detectors, 2, n_modes), times a factor."""
    detectors, times = dict(camera.detectors), np.where(free.any(axis=(1, 2)), factor, 1.0)
    for (key, each), fitted in zip(camera.detectors.items(), free, strict=True):
        if fitted.any():
            covariance, sigma = factor**2 * each.layout_covariance, factor * each.static_sigma
            detectors[key] = replace(each, layout_covariance=covariance, static_sigma=sigma)
    joint = camera.covariance
    if joint is not None:
        each = np.repeat(times, len(joint) // len(times))
        joint = joint * np.outer(each, each)
    return replace(camera, detectors=detectors, covariance=joint)
