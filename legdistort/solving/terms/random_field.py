"""A smooth random field of displacements: its covariance, and how likely some displacements are in it.

Turbulence bends wavefronts; what it displaces is the gradient of these, so that its field has no curl. With a potential
of Matern covariance, of smoothness nu + 1, displacements have

    K(d) = size^2 M' (A(w) 1 - B(w) e e') M / |det M|,   w = |M d|, e = M d / w,

``A(w) = 2^(1 - nu) / Gamma(nu) w^nu K_nu(w)``, ``B = -w dA/dw``: K is minus the matrix of second derivatives of the
covariance of the potential. M has the length of correlation and, where the wind draws the field out along one
direction, an axis ratio and an angle (as Fortino et al. 2021, AJ 162, 106, have it of von Karman's spectrum). Averages
over aperture and time make fields smoother than that; nu is the likeliest of a few.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy import linalg, special
from scipy.optimize import minimize

#: Smoothness that is tried, from rough to smooth.
SMOOTHNESS = 1 / 2, 5 / 6, 3 / 2, 5 / 2
#: Lengths beyond which nothing is correlated any more, and nodes of tables of covariances, by the logarithm.
_FAR, _NEAR, _NODES = 40.0, 1e-5, 4000
#: Lengths that are sought, by the size of what is seen, and sizes by the noise.
_LENGTHS, _SIZES = (1e-2, 3.0), (1e-2, 1e4)
#: Twice the gain in the logarithm of the likelihood from which a field is drawn out along one direction.
DRAWN_OUT = 10.0
#: Width of coefficients of which nothing is known, in lengths of the field's displacements.
_FREE = 1e4


@dataclass(frozen=True)
class Kernel:
    """The covariance of a field that is the same everywhere.

    Attributes
    ----------
    size : float
        Standard deviation along an axis, pixels, of a field that is not drawn out.
    length : float
        Of correlation, pixels.
    smoothness : float
    stretch : tuple
        Logarithm of the axis ratio times cosine and sine of twice the angle of the long axis from x.
    """

    size: float
    length: float
    smoothness: float
    stretch: tuple[float, float] = (0.0, 0.0)

    @property
    def ratio(self) -> float:
        """Of the long axis to the short one."""
        return float(np.exp(np.hypot(*self.stretch)))

    @property
    def angle(self) -> float:
        """Of the long axis from x towards y, degrees."""
        return float(np.degrees(np.arctan2(self.stretch[1], self.stretch[0]) / 2))

    @property
    def metric(self) -> np.ndarray:
        """M (2, 2)."""
        ratio, angle = np.hypot(*self.stretch), np.arctan2(self.stretch[1], self.stretch[0]) / 2
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return np.exp([[-ratio / 2], [ratio / 2]]) * turn / self.length

    def __call__(self, places: np.ndarray, others: np.ndarray) -> np.ndarray:
        """Covariance (2 n, 2 m) of displacements at places (n, 2) and others (m, 2), pixels^2; x and y of each."""
        blocks = self.blocks(*(np.subtract.outer(places @ row, others @ row) for row in self.metric))
        return blocks.transpose(0, 2, 1, 3).reshape(2 * len(places), 2 * len(others))

    def blocks(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Covariances (..., 2, 2) of displacements that are M d = (u, v) apart."""
        shape = self.size * self.metric * self.length
        far = np.sqrt(u * u + v * v)
        same, less = _radial(self.smoothness, far)
        less = less / np.maximum(far, _NEAR) ** 2
        turned = u * shape[0, 0] + v * shape[1, 0], u * shape[0, 1] + v * shape[1, 1]
        square, out = shape.T @ shape, np.empty((*far.shape, 2, 2))
        for a, b in ((0, 0), (0, 1), (1, 1)):
            out[..., a, b] = out[..., b, a] = same * square[a, b] - less * turned[a] * turned[b]
        return out


def _radial(nu, far):
    """A and B of a smoothness at distances in lengths."""
    if nu == 0.5:
        same = np.exp(-far)
        return same, far * same
    if nu == 1.5:
        same = np.exp(-far)
        return (1 + far) * same, far**2 * same
    if nu == 2.5:
        same = np.exp(-far)
        return (1 + far + far**2 / 3) * same, far**2 * (1 + far) / 3 * same
    first, step, tables = _tables(nu)
    at = (np.log(np.maximum(far, _NEAR)) - first) / step
    low = np.minimum(at.astype(int), _NODES - 2)
    part = np.minimum(at - low, 1)
    return tuple(table[low] * (1 - part) + table[low + 1] * part for table in tables)


@cache
def _tables(nu):
    """A and B at distances whose logarithms are regular."""
    logs = np.linspace(np.log(_NEAR), np.log(_FAR), _NODES)
    far, scale = np.exp(logs), 2 ** (1 - nu) / special.gamma(nu)
    tables = scale * far**nu * special.kv(nu, far), scale * far ** (nu + 1) * special.kv(nu - 1, far)
    return logs[0], logs[1] - logs[0], tables


@dataclass(frozen=True, eq=False)
class Seen:
    """What one exposure says of its field: displacements at n places, and what else displaces them.

    Attributes
    ----------
    places : ndarray, shape (n, 2)
        Undistorted pixels.
    offsets : ndarray, shape (n, 2)
        Measured minus model, without the field, pixels.
    noise : ndarray, shape (n, 2, 2)
        Covariance of a measurement.
    star : ndarray of int, shape (n,)
        Each at most once.
    slopes : ndarray, shape (n, 2, p)
        Of what is measured by the p numbers of the star.
    values : ndarray, shape (n_modes, n)
        Of the basis of the distortion of the exposure.
    """

    places: np.ndarray
    offsets: np.ndarray
    noise: np.ndarray
    star: np.ndarray
    slopes: np.ndarray
    values: np.ndarray

    def subset(self, rows):
        """With some rows alone."""
        names = "places", "offsets", "noise", "star", "slopes"
        return replace(self, **{name: getattr(self, name)[rows] for name in names}, values=self.values[:, rows])

    @property
    def y(self):
        """Offsets (2 n,), x and y of each."""
        return self.offsets.ravel()

    @property
    def design(self):
        """Of the coefficients, (2 n, 2 n_modes), those of x first."""
        m, n = self.values.shape
        out = np.zeros((n, 2, 2, m))
        out[:, 0, 0] = out[:, 1, 1] = self.values.T
        return out.reshape(2 * n, 2 * m)

    def covariance(self, kernel):
        """Of the offsets (2 n, 2 n) by field and measurement; no field for a kernel of None."""
        n = len(self.places)
        out = np.zeros((2 * n, 2 * n)) if kernel is None else kernel(self.places, self.places)
        block = out.reshape(n, 2, n, 2)
        block[np.arange(n), :, np.arange(n)] += self.noise
        return out


def deviance(seen, kernel, held):
    """Minus twice the logarithm of the restricted likelihood: nothing is known of distortions and free stars.

    Parameters
    ----------
    seen : list of Seen
    kernel : Kernel or None
    held : ndarray, shape (n_stars, p, p)
        What else holds the stars: inverse covariances.

    Returns
    -------
    float
        Up to a constant, with the squares beside: the part by determinants, the squares, and the degrees of freedom.
    """
    s, p = held.shape[:2]
    normal, pull = np.zeros((s, p, s, p)), np.zeros((s, p))
    normal[np.arange(s), :, np.arange(s)] = held
    lengths, squares, freedom = 0.0, 0.0, -np.count_nonzero(np.diagonal(held, axis1=1, axis2=2) == 0)
    for each in seen:
        n, design, y = len(each.star), each.design, each.y
        factor = linalg.cho_factor(each.covariance(kernel), lower=True, check_finite=False)
        inverse = linalg.cho_solve(factor, np.eye(2 * n), check_finite=False)
        through = inverse @ design
        own = design.T @ through
        own[np.diag_indices_from(own)] += 1 / (_FREE * np.abs(each.offsets).max(initial=1e-12)) ** 2
        root = linalg.cho_factor(own, lower=True, check_finite=False)
        inverse = inverse - through @ linalg.cho_solve(root, through.T, check_finite=False)
        lengths += 2 * np.log(np.diag(factor[0])).sum() + 2 * np.log(np.diag(root[0])).sum()
        left = inverse @ y
        squares, freedom = squares + y @ left, freedom + len(y) - len(own)
        blocks = np.einsum("nap,namb,mbq->npmq", each.slopes, inverse.reshape(n, 2, n, 2), each.slopes, optimize=True)
        normal[each.star[:, None], :, each.star[None]] += blocks.transpose(0, 2, 1, 3)
        pull[each.star] += np.einsum("nap,na->np", each.slopes, left.reshape(n, 2))
    whole = normal.reshape(s * p, s * p)
    diagonal = np.diag(whole)
    unit = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1))
    root = linalg.cho_factor(unit[:, None] * whole * unit + 1e-12 * np.eye(s * p), lower=True)
    solved = linalg.cho_solve(root, unit * pull.ravel())
    lengths += 2 * np.log(np.diag(root[0]) / unit).sum()
    return lengths, squares - solved @ (unit * pull.ravel()), freedom


@dataclass(frozen=True)
class Found:
    """The most likely field.

    Attributes
    ----------
    kernel : Kernel
    gain : float
        By which twice the logarithm of the likelihood is larger with it.
    """

    kernel: Kernel
    gain: float


def most_likely(seen, held, *, scale=False, start=None):
    """The field that makes displacements most likely, `Found`.

    Parameters
    ----------
    seen : list of Seen
    held : ndarray, shape (n_stars, p, p)
    scale : bool
        Whether errors have a common factor of which nothing is known.
    start : Kernel, optional
        Near which it is sought, of the same smoothness.
    """
    noise = np.sqrt(np.median(np.concatenate([each.noise[:, [0, 1], [0, 1]].ravel() for each in seen])))
    extent = max(np.ptp(each.places, axis=0).max() for each in seen)

    def cost(kernel):
        lengths, squares, freedom = deviance(seen, kernel, held)
        return lengths + (freedom * np.log(squares / max(freedom, 1)) if scale else squares)

    def sought(nu, x0, free):
        def kernel_of(x):
            return Kernel(*np.exp(x[:2]), nu, tuple(x[2:]) if len(x) > 2 else (0.0, 0.0))

        bounds = [np.log(noise * np.array(_SIZES)), np.log(extent * np.array(_LENGTHS))] + [(-4, 4)] * (free - 2)
        found = minimize(lambda x: cost(kernel_of(x)), x0[:free], method="L-BFGS-B", bounds=bounds,
                         options={"ftol": 1e-7, "maxiter": 30, "eps": 1e-4})  # fmt: skip
        return float(found.fun), kernel_of(found.x), found.x

    nothing = cost(None)
    if start is None:
        x0 = np.array([np.log(max(_excess(seen, noise), noise / 2)), np.log(extent / 5), 0.0, 0.0])
        k, tried = SMOOTHNESS.index(3 / 2), {}
        for nu in (SMOOTHNESS[k], SMOOTHNESS[k - 1]):
            tried[nu] = sought(nu, x0, 2)
        further = SMOOTHNESS[k + 1] if tried[SMOOTHNESS[k]][0] < tried[SMOOTHNESS[k - 1]][0] else SMOOTHNESS[k - 2]
        tried[further] = sought(further, x0, 2)
        nu = min(tried, key=lambda each: tried[each][0])
        best = tried[nu]
    else:
        nu, x0 = start.smoothness, np.array([np.log(start.size), np.log(start.length), *start.stretch])
        best = sought(nu, x0, 2)
    drawn = sought(nu, np.array([*best[2][:2], *(x0[2:] if np.any(x0[2:]) else (0.1, 0.1))]), 4)
    if best[0] - drawn[0] > DRAWN_OUT:
        best = drawn
    return Found(best[1], nothing - best[0])


def _excess(seen, noise):
    """Scatter of the offsets beyond the noise, pixels."""
    squares = np.concatenate([each.offsets.ravel() for each in seen])
    return np.sqrt(max(np.mean(squares**2) - noise**2, 0.0))
