"""Which coefficients are unknowns of their own, and which the exposures of a detector share.

Usually every exposure has coefficients of its own. In a self-calibration (Anderson & King 2003) it has little more than
its pose, and the rest is one static distortion for all exposures of a detector. Either way the normal equations are
built per exposure, and gathered here.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...geometry import basis, detector_modes

_SMALLEST = 1e-6  # pixels: what is exact


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The unknown coefficients of a problem as one vector.

    First those that every exposure has for itself, then those of every group. Exposures always have a similarity of
    their own, which becomes their pose.

    Attributes
    ----------
    degree : int
        Total degree of the distortion.
    own_degree : int or None
        Up to this degree exposures have modes of their own; 0 leaves them the similarity alone; None shares nothing.
    group : ndarray of int, shape (n_exposures,)
        Exposures with the same number share the rest.
    shapes : list of (ny, nx)
        By exposure; one in a group.
    carried : ndarray, shape (n_exposures, 4, 2 n_modes), or None
        What a pose does beside the similarity itself, see `at`.
    """

    degree: int
    own_degree: int | None
    group: np.ndarray
    shapes: list
    carried: np.ndarray | None = None

    def at(self, coefficients):
        """The tangents where exposures have some coefficients (n_exposures, 2, n_all), as another `Unknowns`.

        A similarity is part of the pose, in front of the distortion: a step s of it moves ``q + A b(q)`` by
        ``s + (grad A b) s``. Coefficients that an exposure has for itself take the second part up again; a distortion
        that it shares does not.
        """
        if not self.shared:
            return self
        made = [carried(a, shape, self.degree) for a, shape in zip(coefficients, self.shapes, strict=True)]
        return replace(self, carried=np.stack(made))

    @property
    def shared(self):
        """Whether exposures share anything."""
        return self.own_degree is not None

    @property
    def n_modes(self):
        """Modes per axis of an exposure."""
        return basis.n_modes(self.degree)

    @property
    def gauge_degree(self):
        """Degree of the maps of the reference plane that exposures can compensate."""
        return max(1, self.own_degree) if self.shared else self.degree

    @cached_property
    def _rows(self):
        """Orthonormal rows of what is own and of what is common, per group, (n_groups, k, 2 n_modes) each."""
        n, own, common = self.n_modes, [], []
        for g in range(int(self.group.max()) + 1):
            shape = self.shapes[int(np.argmax(self.group == g))]
            rows = detector_modes.dynamic_basis(shape, n)
            degree = np.concatenate([[1, 1], np.tile(np.add(*basis.orders(self.degree))[3:], 2)])
            mine = degree <= self.own_degree
            own.append(np.concatenate([detector_modes.similarity_basis(shape, n), rows[mine]]))
            common.append(rows[~mine])
        return np.stack(own), np.stack(common)

    @cached_property
    def _own(self):
        """Rows (n_exposures, k, 2 n_modes) of what every exposure has for itself."""
        rows = self._rows[0][self.group]
        if self.carried is not None:
            rows[:, : self.carried.shape[1]] += self.carried
        return rows

    @property
    def n_own(self):
        """Unknowns that every exposure has for itself."""
        return self._rows[0].shape[1] if self.shared else 2 * self.n_modes

    @property
    def n_common(self):
        """Unknowns that exposures share, of all groups."""
        return self._rows[1].shape[0] * self._rows[1].shape[1] if self.shared else 0

    @property
    def size(self):
        """Length of the vector."""
        return len(self.group) * self.n_own + self.n_common

    def spread(self, unknowns):
        """The vector (size,) as coefficients of every exposure, (n_exposures, 2 n_modes)."""
        n = len(self.group)
        if not self.shared:
            return unknowns.reshape(n, -1)
        common, split = self._rows[1], n * self.n_own
        out = np.einsum("ik,ikm->im", unknowns[:split].reshape(n, -1), self._own)
        return out + np.einsum("gk,gkm->gm", unknowns[split:].reshape(len(common), -1), common)[self.group]

    def gather(self, gradient):
        """The transpose of `spread`: (n_exposures, 2 n_modes, ...) -> (size, ...)."""
        rest = gradient.shape[2:]
        if not self.shared:
            return gradient.reshape(-1, *rest)
        columns = gradient.reshape(*gradient.shape[:2], -1)
        mine = np.matmul(self._own, columns)
        theirs = np.matmul(self._rows[1], self._totals(columns))
        return np.concatenate([each.reshape(-1, *rest) for each in (mine, theirs)])

    def _totals(self, each):
        """Sums over the exposures of every group, (n_exposures, ...) -> (n_groups, ...)."""
        return np.stack([each[self.group == g].sum(axis=0) for g in range(len(self._rows[1]))])

    def matrix(self, blocks):
        """Exposure blocks (n_exposures, 2 n_modes, 2 n_modes) as one matrix on the vector, (size, size)."""
        out = np.zeros((self.size, self.size))
        k, split = self.n_own, len(self.group) * self.n_own
        for i, block in enumerate(blocks):
            mine = slice(i * k, (i + 1) * k)
            if not self.shared:
                out[mine, mine] = block
                continue
            own, common = self._own[i], self._rows[1][self.group[i]]
            theirs = slice(split + self.group[i] * len(common), split + (self.group[i] + 1) * len(common))
            out[mine, mine] = own @ block @ own.T
            out[mine, theirs] = own @ block @ common.T
            out[theirs, mine] = out[mine, theirs].T
            out[theirs, theirs] += common @ block @ common.T
        return out

    def common_precision(self, covariance):
        """How a covariance (2 n_modes, 2 n_modes) constrains the common part: (n_exposures, 2 n_modes, 2 n_modes).

        Every exposure has a share. What is exact counts as known to `_SMALLEST` pixels.
        """
        common = self._rows[1]
        v, turned = np.linalg.eigh(common @ covariance @ common.mT)
        whole = turned.mT @ common
        whole = whole.mT / np.maximum(v, _SMALLEST**2)[:, None] @ whole
        return (whole / np.bincount(self.group)[:, None, None])[self.group]

    def conditional_covariances(self, blocks):
        """Inverses of exposure blocks (n_exposures, 2 n_modes, 2 n_modes); what is shared has the data of all.

        The covariance of an exposure's coefficients, stars given; own and common part each given the other.
        """
        if not self.shared:
            return _inverse(blocks)
        own, common = (rows[self.group] for rows in self._rows)
        parts = (own, blocks), (common, self._totals(blocks)[self.group])
        return sum(r.mT @ _inverse(r @ block @ r.mT) @ r for r, block in parts)

    def covariance(self, matrix):
        """Covariance (size, size) of the vector as that of the coefficients, (n_exposures * 2 n_modes,) squared."""
        if not self.shared:
            return matrix
        spread = np.stack([self.spread(unit).ravel() for unit in np.eye(self.size)], axis=1)
        return spread @ matrix @ spread.T


def carried(coefficients, shape, degree):
    """Coefficients (4, 2 n_modes) of ``(grad A b) s`` for the unit similarities s of a detector, A (2, n_all)."""
    n, top = basis.n_modes(degree), basis.degree_of(coefficients.shape[1])
    u, v, w = basis.quadrature(max(top, 1))
    values, by_u, by_v = basis.gradients(top, u, v)
    slope = np.stack([coefficients @ by_u * (2 / shape[1]), coefficients @ by_v * (2 / shape[0])])
    similar = detector_modes.similarity_basis(shape, n)
    moved = similar.reshape(len(similar), 2, n) @ values[:n]
    along = np.einsum("akp,sap->skp", slope, moved)
    return (along @ (values[:n] * w).T).reshape(len(similar), -1)


def _inverse(blocks):
    """Inverse of symmetric matrices (n, k, k); of what is singular, on what it determines."""
    try:
        return np.linalg.inv(blocks)
    except np.linalg.LinAlgError:
        return np.linalg.pinv(blocks, hermitian=True)
