"""How stars move from exposure to exposure: linear terms beside the position.

A star is at ``X_j(i) = X_j + sum_k c_jk phi_k(i)``, linear in its unknowns, with displacements ``phi_k(i)`` of the
reference plane that are known for every exposure: the time along each axis for a proper motion, the parallax factors
for a parallax. Each term adds one unknown to every star, whose derivatives are those of the position times phi; all
else of the normal equations stays as it is.
"""

from dataclasses import dataclass, replace

import numpy as np

#: Terms of each kind of motion.
TERMS = {"proper": ("vx", "vy"), "parallax": ("vx", "vy", "parallax")}


@dataclass(frozen=True, eq=False)
class StarPrior:
    """What is known beforehand of single stars, as of those of a reference catalogue: a normal distribution of each.

    Attributes
    ----------
    mean : ndarray, shape (2 + k, n_stars)
    precision : ndarray, shape (m, n_stars)
        Inverse covariances, packed (`packed`); zero for what is not known.
    """

    mean: np.ndarray
    precision: np.ndarray

    @classmethod
    def of(cls, n_stars, rows, values, covariance):
        """That of some stars with values (n, 2 + k), NaN for what is not known, and covariances (n, 2 + k, 2 + k)."""
        size = values.shape[1]
        mean, precision = np.zeros((size, n_stars)), np.zeros((n_stars, size, size))
        mean[:, rows] = np.nan_to_num(values).T
        precision[rows] = known_precision(values, covariance)
        lower = np.tril_indices(size)
        out = np.zeros((size * (size + 1) // 2, n_stars))
        out[packed(size)[lower]] = precision[:, *lower].T
        return cls(mean, out)


def known_precision(values, covariance):
    """Inverse covariances (n, s, s) of values (n, s), with zeros for those that are NaN or have no error."""
    size = values.shape[1]
    known = np.isfinite(values) & np.isfinite(np.einsum("jaa->ja", covariance))
    both = known[:, :, None] & known[:, None, :]
    filled = np.where(both, covariance, np.eye(size))
    return np.where(both, np.linalg.inv(filled), 0.0)


@dataclass(frozen=True, eq=False)
class StarTerms:
    """Terms of the stars of a problem; none by default.

    Attributes
    ----------
    columns : ndarray, shape (n_exposures, 2, k)
        phi, reference-plane pixels for a unit of every unknown.
    precision : ndarray, shape (k, n_stars) or (k, 1)
        Inverse variance of what is known beforehand of the unknowns.
    names : tuple of str
        Of the unknowns: "vx", "vy" [pix/yr], "parallax" [pix].
    years : ndarray, shape (n_exposures,), or None
        When the exposures were taken.
    epoch : float or None
        Year of the positions.
    mean : ndarray, shape (k, n_stars), or float
        Most probable values of the unknowns beforehand.
    catalogue : StarPrior or None
        What is known beforehand of single stars, positions and unknowns.
    """

    columns: np.ndarray
    precision: np.ndarray
    names: tuple = ()
    years: np.ndarray | None = None
    epoch: float | None = None
    mean: np.ndarray | float = 0.0
    catalogue: StarPrior | None = None

    @classmethod
    def none(cls, n_exposures):
        """Stars that stay where they are."""
        return cls(np.zeros((n_exposures, 2, 0)), np.zeros((0, 1)))

    @classmethod
    def of_motion(cls, kind, years, epoch, *, factors=None, sigma=None):
        """Proper motions, and parallaxes with ``kind="parallax"``.

        Parameters
        ----------
        kind : {"proper", "parallax"}
        years : ndarray, shape (n_exposures,)
        epoch : float
            Year of the positions.
        factors : ndarray, shape (n_exposures, 2), optional
            Parallax factors along the axes of the reference plane.
        sigma : float, optional
            Scatter of the motions of stars per axis, pixels a year; None: nothing is known of it.
        """
        columns = (np.asarray(years, dtype=float) - epoch)[:, None, None] * np.eye(2)
        if kind == "parallax":
            columns = np.concatenate([columns, np.asarray(factors)[:, :, None]], axis=2)
        precision = np.zeros((columns.shape[2], 1))
        precision[:2] = 0.0 if sigma is None else 1 / sigma**2
        return cls(np.ascontiguousarray(columns), precision, TERMS[kind], np.asarray(years), float(epoch))

    @property
    def n(self):
        """Unknowns of a star beside its position."""
        return self.columns.shape[2]

    @property
    def is_held(self):
        """Whether something is known beforehand of how the unknowns scatter over the stars."""
        return bool(np.any(self.precision))

    def hold(self, stars, v, g_star):
        """Add what is known beforehand to packed blocks (m, n_stars) and gradients, (2 + k, n_stars) as `stars`.

        Returns
        -------
        float
            Its part of J.
        """
        part = 0.0
        if self.is_held:
            off = stars[2:] - self.mean
            v[np.diag(packed(2 + self.n))[2:]] += self.precision
            g_star[2:] -= self.precision * off
            part += float((self.precision * off**2).sum())
        if self.catalogue is not None:
            off = stars - self.catalogue.mean
            pull = symmetric_times(self.catalogue.precision, off)
            v += self.catalogue.precision
            g_star -= pull
            part += float((pull * off).sum())
        return part

    def done_by_prior(self, inverse):
        """Number of unknowns that what is known beforehand determines, from inverse packed blocks (m, n_stars)."""
        places = np.diag(packed(2 + self.n))
        number = float((self.precision * inverse[places[2:]]).sum())
        if self.catalogue is not None:
            twice = np.full((len(inverse), 1), 2.0)  # off the diagonal entries count for both of theirs
            twice[places] = 1.0
            number += float((twice * self.catalogue.precision * inverse).sum())
        return number

    def lift(self, n_modes):
        """Fields of the unknowns -> displacement fields of every exposure, (n_exposures, 2 n, (2 + k) n), n modes."""
        columns = np.concatenate([np.broadcast_to(np.eye(2), (len(self.columns), 2, 2)), self.columns], axis=2)
        return np.einsum("iak,mn->iamkn", columns, np.eye(n_modes)).reshape(len(columns), 2 * n_modes, -1)

    def subset(self, exposures):
        """Those of some exposures."""
        return replace(
            self, columns=self.columns[exposures], years=None if self.years is None else self.years[exposures]
        )

    def place(self, i, stars):
        """Positions (2, n, ...) in exposure i of stars with unknowns (2 + k, n, ...)."""
        out = stars[:2]
        for k in range(self.n):
            out = out + np.multiply.outer(self.columns[i, :, k], stars[2 + k])
        return out

    def pull(self, i, values):
        """The transpose of `place`: gradients (2, n, ...) of positions in exposure i -> (2 + k, n, ...)."""
        if not self.n:
            return values
        extra = [self.columns[i, 0, k] * values[0] + self.columns[i, 1, k] * values[1] for k in range(self.n)]
        return np.concatenate([values, np.stack(extra)])

    def place_covariance(self, i, blocks):
        """Covariance xx, yy, xy (3, n) of positions in exposure i from packed blocks (m, n) of the unknowns."""
        if not self.n:
            return blocks
        rows = np.concatenate([np.eye(2), self.columns[i]], axis=1)
        x, y = (symmetric_times(blocks, row[:, None]) for row in rows)
        return np.stack([rows[0] @ x, rows[1] @ y, rows[1] @ x])


def packed(size):
    """Place of every entry of a symmetric block (size, size) in its packed form: xx, yy, xy, then row by row."""
    out = np.zeros((size, size), dtype=int)
    out[1, 1], out[0, 1], out[1, 0] = 1, 2, 2
    for k in range(2, size):
        out[k, : k + 1] = k * (k + 1) // 2 + np.arange(k + 1)
        out[: k + 1, k] = out[k, : k + 1]
    return out


def size_of(blocks):
    """Unknowns of a star whose packed blocks (m, n) are given."""
    return int((np.sqrt(8 * len(blocks) + 1) - 1) / 2)


def symmetric_times(blocks, x):
    """Symmetric packed blocks (m, n) times vectors (k, n)."""
    rows = []
    for row in packed(size_of(blocks)):
        total = blocks[row[0]] * x[0]
        for where, each in zip(row[1:], x[1:], strict=True):
            total = total + blocks[where] * each
        rows.append(total)
    return np.stack(rows)


def outer_packed(columns):
    """``c c'`` of vectors (k, n) as packed blocks (m, n)."""
    index = packed(len(columns))
    out = np.empty((len(columns) * (len(columns) + 1) // 2, *columns.shape[1:]))
    for a in range(len(columns)):
        for b in range(a + 1):
            out[index[a, b]] = columns[a] * columns[b]
    return out


def unpacked(blocks):
    """Packed blocks (m, n) as matrices (n, k, k)."""
    return np.moveaxis(np.asarray(blocks)[packed(size_of(blocks))], -1, 0)
