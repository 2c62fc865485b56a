"""What is known beforehand of unknowns: combinations of them, where they are expected, and how well."""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

#: Number of the size of rows whose width is given.
GIVEN = -1


@dataclass(frozen=True, eq=False)
class Factor:
    """Combinations of the unknowns z that are expected to be zero: ``value + rows z ~ N(0, width^2)``.

    Attributes
    ----------
    name : str
    rows : sparse array, shape (k, n)
    value : ndarray, shape (k,)
        At z = 0, less what is expected.
    width : ndarray, shape (k,)
        Given; not used where a size is found in its place.
    size : ndarray of int, shape (k,)
        Number of the size that is the width of a row, or `GIVEN`.
    stretch : ndarray, shape (k,), or None
        Factors on all widths; None: one.
    """

    name: str
    rows: sparse.csr_array
    value: np.ndarray
    width: np.ndarray
    size: np.ndarray
    stretch: np.ndarray | None = None

    def __post_init__(self):
        if self.stretch is None:
            object.__setattr__(self, "stretch", np.ones(len(self.value)))

    def widths(self, sizes):
        """Width of every row (k,) at some sizes."""
        return self.stretch * np.where(self.size == GIVEN, self.width, np.append(sizes, np.nan)[self.size])

    def part(self, keep):
        """Some of its rows (k,) alone."""
        each = (getattr(self, name)[keep] for name in ("rows", "value", "width", "size", "stretch"))
        return Factor(self.name, *each)

    @classmethod
    def joined(cls, factors):
        """Several factors as one."""
        parts = zip(*((f.value, f.width, f.size, f.stretch) for f in factors), strict=True)
        rows = sparse.vstack([f.rows for f in factors], format="csr")
        return cls(", ".join(f.name for f in factors), rows, *map(np.concatenate, parts))
