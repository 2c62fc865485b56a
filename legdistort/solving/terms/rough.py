"""What the static distortion of a detector has beyond its Legendre series: the term "rough_static"."""

from dataclasses import dataclass

import numpy as np

from ...exceptions import InputError
from ...geometry.tabulated.rough_basis import RoughBasis

#: Splines along an axis by the root of the number of positions on a detector; least and most of them.
_PER_POSITION, _LEAST, _MOST = 0.5, 6, 38
#: Numbers of all detectors together, at most.
_NUMBERS = 2900


@dataclass(frozen=True)
class RoughColumns:
    """Displacements along x and along y by every function of a `RoughBasis`, at undistorted places.

    Attributes
    ----------
    splines : int
        Along either axis.
    """

    splines: int

    def __call__(self, observed):
        """Displacements (2 n_functions, 2, n) by a unit of each number: those along x come first."""
        basis_of, out = {}, np.zeros((2, self.splines**2, 2, len(observed.exposure)))
        for i, shape in enumerate(observed.problem.shapes):
            part = observed.problem.part(i)
            functions = basis_of.setdefault(tuple(shape), self.basis(observed, shape))
            out[0, :, 0, part] = out[1, :, 1, part] = functions(observed.undistorted[part]).T
        return out.reshape(-1, 2, out.shape[3])

    def basis(self, observed, shape):
        """The `RoughBasis` on detectors of a shape: without what the Legendre series of the fit can do.

        Raises
        ------
        InputError
            For detectors in a focal plane, and several that have no names.
        """
        if "detector" not in observed.table.colnames and observed.problem.detectors.max() > 0:
            raise InputError(
                "term rough_static is of every detector: say which detector positions are of, in a column detector"
            )
        if "x_detector" in observed.table.colnames:
            raise InputError(
                "term rough_static is of detectors by themselves, not in a focal plane: take "
                "every detector by itself (dynamic='detector', --dynamic detector)"
            )
        return RoughBasis((self.splines, self.splines), observed.problem.degree, tuple(map(int, shape)))

    def for_table(self, table):
        """The same with as many splines as the positions of a table ask for, and what it changes of its `Term`."""
        n = len(np.unique(np.asarray(table["detector"]).astype(str))) if "detector" in table.colnames else 1
        wanted = round(_PER_POSITION * np.sqrt(len(table) / n))
        splines = int(np.clip(wanted, _LEAST, min(_MOST, int(np.sqrt(_NUMBERS / 2 / n)))))
        return {"columns": RoughColumns(splines), "numbers": names(splines)}


def names(splines):
    """Names of the numbers of so many splines along either axis."""
    return tuple(f"{axis} {k}" for axis in "xy" for k in range(splines**2))
