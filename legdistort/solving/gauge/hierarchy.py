"""What is known of a map common to all exposures, and what only a convention holds.

A bend of the reference plane that every exposure takes back leaves all residuals as they are, so the positions alone
never tell it. What tells it is that single exposures depart from one static distortion by little::

    A_i = A_0 + N_i g + d_i,      d_i ~ N(0, Lambda_i + C_i)

A_i are the coefficients as they come out with the plane bent by g, N_i says how a bend changes those of exposure i,
Lambda is the scatter of single exposures and C_i the error of A_i. A_0, one for each detector, has the caller's prior:
nothing (flat), a mean with its uncertainty, or a mean that is exact. With A_0 integrated out, g has a Gaussian posterior
whose mean is linear in the A_i: it is where ``R (A - A_0) = 0`` with the rows ``R = M' (D + 1 S 1')^-1``, M the N_i one
upon another, D the block diagonal of Lambda_i + C_i and S the variance of A_0. These rows are the constraints of the
gauge, so that the positions and coefficients published are the posterior mean, and the variance of g under them is the
absolute error.

Without a prior the rows see only that in which the N_i differ, which dithers and rolls bring about. What they do not
tell to `LIMIT` pixels, rms over the stars, is *unknown*: there a convention holds the plane (the smallest dynamic part,
or dynamic parts that sum to zero, around the prior mean), and no error is quoted. Shears, for instance, are unknown to
any number of exposures of one orientation. Residuals of second order can tell such a direction after all, where an
unknown static distortion of many pixels meets very precise positions; then it is left to them
(`legdistort.solving.minimisers`), if they tell it to the same limit.

Shift, rotation and scale are always those of the nominal poses, or of a reference catalogue.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ...geometry import basis
from ...geometry.detector_modes import similarity_basis
from ..equations.problem import complement

#: A direction whose posterior standard deviation exceeds so many pixels, rms over the stars and axes, is unknown.
LIMIT = 1.0
#: Share of a pattern that must lie among the unknown maps for one of these to have its name.
_ALIKE = 0.9


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Departures of the exposures from a common static distortion, as a linear model of a common map.

    Attributes
    ----------
    motion : ndarray, shape (n_exposures, 2 n, 2 n)
        N_i.
    others : ndarray, shape (n_exposures, K, 2 n)
        Orthonormal rows of all modes but the similarities, which the poses carry.
    dynamic : ndarray, shape (n_exposures, 2 n, 2 n)
        Lambda_i.
    weight : ndarray, shape (n_exposures, K, K)
        Inverse of Lambda_i + C_i on these rows.
    group : ndarray of int, shape (n_exposures,)
        Detector of every exposure.
    static : ndarray, shape (n_groups, K)
        Variance of A_0 by detector: infinite where there is no prior, zero where it is exact.
    size : tuple
        ``(ny, nx)`` of the box of the reference plane on which the modes are defined, pixels.
    values : ndarray, shape (n, n_stars)
        Modes of the reference plane at the stars.
    """

    motion: np.ndarray
    others: np.ndarray
    dynamic: np.ndarray
    weight: np.ndarray
    group: np.ndarray
    static: np.ndarray
    size: tuple
    values: np.ndarray

    @property
    def similarities(self):
        """Orthonormal rows (4, 2 n): shift in x and y, scale, rotation of the plane."""
        return similarity_basis(self.size, self.motion.shape[1] // 2)

    def rows(self, static):
        """Rows of the constraints M' (D + 1 S 1')^-1 for a variance (n_groups, K) of A_0, (2 n - 4, n_exposures, 2 n)."""
        moved = self.others @ self.motion @ complement(self.similarities).T
        weighted = self.weight @ moved
        for g, variance in enumerate(static):
            mine = self.group == g
            if not mine.any():
                continue
            total, pulled = self.weight[mine].sum(axis=0), weighted[mine].sum(axis=0)
            known = np.isfinite(variance)
            root = np.sqrt(np.where(known, variance, 1.0))
            # (S^-1 + sum W)^-1 without dividing by a variance of zero; a flat one has no S^-1
            inner = np.diag(np.where(known, 1.0, 0.0)) + root[:, None] * total * root
            weighted[mine] -= self.weight[mine] @ (root[:, None] * np.linalg.solve(inner, root[:, None] * pulled))
        return np.einsum("ika,ikb->bia", self.others, weighted, optimize=True)

    def metric(self):
        """Mean square displacement of the stars, per axis, by maps (2 n - 4) once a similarity is taken off."""
        n = self.values.shape[1]
        values = np.kron(np.eye(2), self.values.T)
        others, similar = values @ complement(self.similarities).T, values @ self.similarities.T
        others = others - similar @ np.linalg.lstsq(similar, others, rcond=None)[0]
        out = others.T @ others / (2 * n)
        return out + 1e-9 * np.trace(out) / len(out) * np.eye(len(out))

    def convention(self, kind):
        """Rows (2 n - 4, n_exposures, 2 n) of the convention by itself: A_0 at the prior mean."""
        if kind == "mean":
            pulled = complement(self.similarities)[:, None, :]
            return np.broadcast_to(pulled, (pulled.shape[0], *self.motion.shape[:2]))
        return self.rows(np.zeros_like(self.static))

    def solve(self, kind):
        """What is known and what is not: `Knowledge`."""
        others = complement(self.similarities)
        held = self.convention(kind)
        if not self.static.any():  # exact everywhere: nothing to determine but the scatter of the exposures
            return Knowledge(held, others.T, np.zeros((others.shape[1], 0)))
        rows = self.rows(self.static)
        information = np.einsum("bia,iac,dc->bd", rows, self.motion, others, optimize=True)
        curvature, vectors = eigh((information + information.T) / 2, self.metric())
        unknown = np.isinf(self.static).any() & (curvature * LIMIT**2 < 1)
        known = vectors[:, ~unknown].T, vectors[:, unknown].T
        rows = np.concatenate([np.tensordot(known[0], rows, 1), np.tensordot(known[1], held, 1)])
        return Knowledge(rows, (known[0] @ others).T, (known[1] @ others).T)

    def covariance(self, rows, maps, n_known):
        """Covariance (2 n, 2 n) of the common map under constraints `rows`, what is unknown and similarities left out.

        Parameters
        ----------
        rows : ndarray, shape (2 n, n_exposures, 2 n)
        maps : ndarray, shape (2 n, 2 n)
            Columns: the `n_known` known ones first, unknown ones, similarities.
        n_known : int
        """
        inside = np.einsum("bia,iac,dic->bd", rows, self.dynamic, rows, optimize=True)
        on_modes = np.einsum("bia,ika->bik", rows, self.others, optimize=True)
        for g, variance in enumerate(self.static):
            common = on_modes[:, self.group == g].sum(axis=1)
            inside += common * np.where(np.isfinite(variance), variance, 0) @ common.T
        reach = np.einsum("bia,iac,cd->bd", rows, self.motion, maps, optimize=True)
        back = np.linalg.inv(reach)[:n_known]
        return maps[:, :n_known] @ back @ inside @ back.T @ maps[:, :n_known].T


@dataclass(frozen=True, eq=False)
class Knowledge:
    """Constraints on all of a common map but its similarity, and which of them hold what is unknown.

    Attributes
    ----------
    rows : ndarray, shape (2 n - 4, n_exposures, 2 n)
        First those that determine the known maps.
    known, unknown : ndarray, shape (2 n, k) and (2 n, 2 n - 4 - k)
        Maps as columns, of unit rms over stars and axes where something is unknown.
    """

    rows: np.ndarray
    known: np.ndarray
    unknown: np.ndarray


def named(maps, metric, size):
    """Unknown maps with names: turned, as far as they allow, into those that have one.

    Parameters
    ----------
    maps : ndarray, shape (2 n, m)
        Columns of unit rms over the stars, orthogonal in the metric.
    metric : ndarray, shape (2 n, 2 n)
        Mean square displacement of the stars, similarities taken off.
    size : tuple
        ``(ny, nx)`` of the box of the reference plane, pixels.

    Returns
    -------
    list of (str, int, ndarray of shape (2 n,))
        Name, degree and map.
    """
    found, left = [], np.eye(maps.shape[1])
    for name, degree, pattern in _patterns(maps.shape[0] // 2, size):
        inside = left @ (left.T @ (maps.T @ metric @ pattern))
        if inside @ inside > _ALIKE * (pattern @ metric @ pattern):
            inside /= np.linalg.norm(inside)
            found.append((name, degree, maps @ inside))
            left = left @ complement((left.T @ inside)[None]).T
    degrees = np.tile(np.add(*basis.orders(basis.degree_of(maps.shape[0] // 2))), 2)
    for rest in (maps @ left).T:
        power = np.bincount(degrees, rest**2)
        power[:2] = 0
        degree = int(power.argmax()) if power.any() else 1
        found.append((f"degree {degree}" if degree > 1 else "shear", degree, rest))
    return sorted(found, key=lambda each: each[1])


def _patterns(n, size):
    """Maps with a name: the shears, and by degree those that keep angles, z^d of the complex plane z = x + iy."""
    top = basis.degree_of(n)
    u, v, w = basis.quadrature(top)
    z = (u * size[1] + 1j * v * size[0]) / max(size)
    project = (basis.values(top, u, v) * w).T
    fields = [("shear", 1, np.conj(z)), ("shear", 1, 1j * np.conj(z))] if top else []
    for d in range(2, top + 1):
        fields += [(f"z^{d}", d, z**d), (f"i z^{d}", d, 1j * z**d)]
    for name, degree, field in fields:
        yield name, degree, np.concatenate([field.real @ project, field.imag @ project])
