"""What the ways to solve the normal equations share, whichever side of them is eliminated."""

from copy import copy
from functools import cached_property

import numpy as np

from . import elimination


class Reduced:
    """What all ways share.

    Parameters
    ----------
    problem : Problem
    blocks : Blocks
    gauge : Gauge
    """

    n_weak = 0  # unknowns that the exposures share and that they do not determine
    takes_any_gauge = True  # whether what is factorised serves other constraints too
    moves_exactly = False  # whether steps of a moved one lack nothing

    def __init__(self, problem, blocks, gauge):
        self.problem, self.blocks, self.gauge = problem, blocks, gauge
        self.unknowns = blocks.unknowns
        self.rows = self._on_unknowns(gauge)
        self.inverse = elimination.inverse_star_blocks(blocks.v)

    def _on_unknowns(self, gauge):
        """The constraints as rows on the unknowns; those of the gauge act on the modes up to its own degree."""
        n, size = len(gauge.motion), self.problem.n_modes
        if gauge.n_own == size and not self.problem.unknowns.shared:
            return gauge.orthonormal
        rows = gauge.orthonormal.reshape(gauge.n_constraints, n, 2, -1)
        rows = np.pad(rows, ((0, 0), (0, 0), (0, 0), (0, size - rows.shape[3]))).reshape(-1, n, 2 * size)
        return self.problem.unknowns.gather(rows.transpose(1, 2, 0)).T

    def moved(self, problem, blocks, gauge):
        """The same factors with the gradients of a state nearby, where weights may differ: steps lack a small part.

        Under that gauge; None if another one needs other factors.
        """
        if gauge is not self.gauge and (self.n_weak or not self.takes_any_gauge):
            return None
        out = copy(self)
        for name in ("rhs", "information", "pull", "moves"):
            vars(out).pop(name, None)
        Reduced.__init__(out, problem, blocks, gauge)
        if gauge is self.gauge:
            out.rows = self.rows
        return out

    def _couple(self, d):
        """E d, shape (2 + k, n_stars)."""
        return elimination.to_stars(self.problem, self.blocks, self.unknowns.spread(d))

    def _gradient(self, own, stars):
        """``own - E' V^-1 stars``, shape (n,)."""
        if not stars.any():
            return self.unknowns.gather(own)
        moved = elimination.symmetric_times(self.inverse, stars)
        return self.unknowns.gather(own - elimination.to_exposures(self.problem, self.blocks, moved))

    def _own(self, d):
        """U d."""
        return np.einsum("iab,ib->ia", self.blocks.u, self.unknowns.spread(d))

    def _stars(self, stars):
        """Star step V^-1 (g_star - E d)."""
        return elimination.symmetric_times(self.inverse, stars)

    @cached_property
    def rhs(self):
        """Right-hand side (n,) of the reduced system: the gradient where the stars follow the coefficients."""
        return self._gradient(self.blocks.g_exposure, self.blocks.g_star)

    def follow(self, d):
        """How the stars (2 + k, n_stars) follow a change (n,) of the unknowns."""
        return -self._stars(self._couple(d))

    def resistance(self):
        """`information` and `pull`, with the digits of what is far less than the data tell of anything else."""
        moves = self.moves[: self.gauge.n_constraints]
        products = np.stack([self._gradient(self._own(d), self._couple(d)) for d in moves])
        out = moves @ products.T
        return (out + out.T) / 2, moves @ self.rhs

    @property
    def dof(self):
        """Degrees of freedom under the gauge; widths of a prior not allowed for."""
        n_free = elimination.star_freedom(self.problem, self.blocks)
        return 2 * np.count_nonzero(self.problem.weight[0]) - n_free - self.unknowns.size + len(self.rows)
