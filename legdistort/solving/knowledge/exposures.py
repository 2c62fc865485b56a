"""Departures of exposures from the static distortion of their detector, and what is known of that, as factors.

``A_i = S_g + B_n + d_i`` with ``d_i ~ N(0, Lambda)``, Lambda by degree, ``B_n ~ N(0, Lambda_n)`` for the night n of
exposure i, where there are several, and ``S_g ~ N(m_g, V_g)`` for its detector g. Where a number x_i of every exposure
is given, S_g + x_i T_g takes the place of S_g. Similarities of single exposures are free.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from ...geometry import basis
from ...geometry.detector_modes import dynamic_basis, dynamic_degrees
from .factors import GIVEN, Factor
from .posterior import most_likely
from .reduced_data import ReducedData, reduced_data

#: Sizes are sought within these factors of the typical error of a coefficient.
RANGE = 1e-2, 1e6


@dataclass(frozen=True, eq=False)
class ExposureModel:
    """Data on the coefficients of exposures, and the static distortions that these scatter about.

    The unknowns are the coefficients of every exposure but its similarity, from where they are, by exposure and in the
    order of `dynamic_basis`; then what those of a detector have in common beyond their degree, if that is unknown; then
    what those of a night have in common; then those of the statics, from the prior mean; then those of their slopes, if
    there are any.

    Attributes
    ----------
    data : ReducedData
    departure : ndarray, shape (n_exposures, K)
        A_i - m_g where the data are linear.
    group : ndarray of int, shape (n_exposures,)
        Number of the static distortion that every exposure departs from.
    degrees : ndarray of int, shape (K,)
        Of every coefficient.
    night : ndarray of int, shape (n_exposures,), or None
        See `Problem.nights`.
    night_sigma : float or None
        Scatter of nights; None: found.
    number : ndarray, shape (n_exposures,), or None
        Of every exposure, on which the static distortions depend linearly; None: they do not.
    higher : ndarray, shape (n_higher,), or None
        What all exposures of a detector have in common beyond the degree where the data are linear; None: it is no
        unknown.
    """

    data: ReducedData
    departure: np.ndarray
    group: np.ndarray
    degrees: np.ndarray
    night: np.ndarray | None = None
    night_sigma: float | None = None
    number: np.ndarray | None = None
    higher: np.ndarray | None = None

    @classmethod
    def of(cls, problem, state, motion, group, *, top=None):
        """That of a fit.

        Parameters
        ----------
        problem : Problem
            With the weights in force.
        state : State
        motion : ndarray
            Of its gauge, see `reduced_data`.
        group : ndarray of int, shape (n_exposures,)
            Number of the static distortion that every exposure departs from.
        top : int, optional
            Degree up to which exposures of a detector have unknowns in common, beyond that of their own.
        """
        problem = replace(problem, prior_sigma=None, static_covariance=None)
        n, others = problem.n_modes, [dynamic_basis(shape, problem.n_modes) for shape in problem.shapes]
        departure = (state.coefficients - problem.prior_mean)[:, :, :n].reshape(problem.n_exposures, -1)
        departure = np.stack([mine @ a for mine, a in zip(others, departure, strict=True)])
        k, higher = len(others[0]), None
        if top is None:
            rows = np.zeros((problem.n_exposures, k, problem.n_exposures, 2 * n))
            for i, mine in enumerate(others):
                rows[i, :, i] = mine
            rows = rows.reshape(-1, problem.n_exposures * 2 * n)
        else:
            problem, state = _with_common(problem, state, top)
            size, first = problem.unknowns.size, np.unique(problem.detectors, return_index=True)[1]
            similar = np.arange(problem.n_exposures * 2 * n) % (2 * n) < 2 * n - k
            rows = np.eye(size)[np.flatnonzero(~np.pad(similar, (0, size - len(similar))))]
            higher = state.coefficients[first, :, n : problem.n_modes].ravel()
        data = reduced_data(problem, state, rows, motion)
        return cls(data, departure, group, dynamic_degrees(n), problem.nights, problem.night_sigma, higher=higher)

    @property
    def n_groups(self):
        """Number of static distortions."""
        return int(self.group.max()) + 1

    @property
    def n_higher(self):
        """Number of unknowns beyond the degree."""
        return 0 if self.higher is None else len(self.higher)

    @property
    def n_nights(self):
        """Number of nights that have something in common."""
        return 0 if self.night is None else int(self.night.max()) + 1

    @property
    def n_slopes(self):
        """Number of slopes of static distortions."""
        return 0 if self.number is None else self.n_groups

    @property
    def n_scatters(self):
        """Number of sizes that are scatters of exposures and nights."""
        return int(self.degrees.max(initial=0)) * (1 + (self.n_nights > 0 and self.night_sigma is None))

    @cached_property
    def departures(self):
        """The factor on A_i - S_g - x_i T_g - B_n, and that on B_n, whose sizes are numbered by degree."""
        n, k = self.departure.shape
        parts, ones = [sparse.eye_array(n * k, n * k + self.n_higher)], np.ones(n)
        for owner, count, share in (
            (self.night, self.n_nights, ones),
            (self.group, self.n_groups, ones),
            (self.group, self.n_slopes, self.number),
        ):
            if count:
                theirs = sparse.csr_array((-share, (range(n), owner)), (n, count))
                parts.append(sparse.kron(theirs, np.eye(k)))
        size = np.tile(self.degrees - 1, n)
        rows = sparse.hstack(parts, format="csr")
        own = Factor("departures of the exposures", rows, self.departure.ravel(), np.ones(n * k), size)
        return Factor.joined([own, self.nights]) if self.n_nights else own

    @cached_property
    def nights(self):
        """The factor on B_n."""
        k = len(self.degrees)
        m, rows = self.n_nights * k, self._rows(0, self.n_nights)
        found = self.night_sigma is None
        size = np.tile(self.degrees - 1 + self.degrees.max(), self.n_nights) if found else np.full(m, GIVEN)
        return Factor("nights", rows, np.zeros(m), np.full(m, 1.0 if found else self.night_sigma), size)

    def statics(self, *, size=GIVEN, width=np.nan, directions=None):
        """The factor on S_g - m_g: of one size that is found, or of given widths (n_groups, K).

        Widths are those along `directions` (n_groups, K, K), columns; of the coefficients if they are not given.
        """
        k = len(self.degrees)
        m, rows = self.n_groups * k, self._rows(self.n_nights, self.n_groups)
        if directions is not None:
            rows = sparse.csr_array(sparse.block_diag(np.linalg.inv(directions)) @ rows)
        widths = np.broadcast_to(width, (self.n_groups, k)).ravel()
        return Factor("static distortion", rows, np.zeros(m), widths, np.full(m, size))

    def slopes(self, *, size=GIVEN, width=np.nan):
        """The factor on T_g: of one size that is found, or of a given width."""
        m = self.n_slopes * len(self.degrees)
        rows = self._rows(self.n_nights + self.n_groups, self.n_slopes)
        return Factor("slopes of the static distortion", rows, np.zeros(m), np.full(m, width), np.full(m, size))

    def closure(self, *, size):
        """The factor on what exposures have in common beyond the degree, of a size that is found."""
        m = self.n_higher
        rows = sparse.eye_array(m, self._n_unknowns, k=self.departure.size, format="csr")
        return Factor("static distortion beyond the degree", rows, self.higher, np.ones(m), np.full(m, size))

    @property
    def _n_unknowns(self):
        owners = self.n_nights + self.n_groups + self.n_slopes
        return self.departure.size + self.n_higher + owners * len(self.degrees)

    def _rows(self, first, count):
        """The unknowns of so many nights, statics or slopes, from the first on: rows (count K, n)."""
        k, before = len(self.degrees), self.departure.size + self.n_higher
        return sparse.eye_array(count * k, self._n_unknowns, k=before + first * k, format="csr")

    @cached_property
    def posterior(self):
        """That with all sizes found, those of the departures by degree, then that of the statics."""
        factor = Factor.joined([self.departures, self.free_statics])
        unit = 1 / np.sqrt(np.median(np.diag(self.data.curvature)))
        scatter = max(float(np.sqrt(np.mean(self.departure**2))), unit)
        return most_likely(self.data, factor, np.full(self.n_scatters + 1, scatter), unit * np.array(RANGE))

    @cached_property
    def free_statics(self):
        """The factor on S_g - m_g of a size that is found."""
        return self.statics(size=self.n_scatters)


def _with_common(problem, state, top):
    """Problem and state with all terms beyond the degree, up to another, unknowns that exposures have in common."""
    mean, given = (
        basis.change_degree(each, max(top, basis.degree_of(each.shape[2])))
        for each in (problem.prior_mean, state.coefficients)
    )
    problem = replace(problem, degree=top, own_degree=problem.degree, prior_mean=mean)
    return problem, replace(state, coefficients=given)


def stated(problem):
    """Mean (n_priors, K) and `StaticSpread` of every prior, that of each exposure, and the first exposure of each.

    Exposures of one detector with one prior depart from one distortion.
    """
    others = np.stack([dynamic_basis(shape, problem.n_modes) for shape in problem.shapes])
    mean = problem.prior_mean[:, :, : problem.n_modes].reshape(problem.n_exposures, -1, 1)
    errors = problem.errors_of_statics
    given, number = (others @ mean)[:, :, 0], {}
    correlated = [number.setdefault(None if c is None else c.tobytes(), len(number)) for c in errors.covariances or ()]
    keys = [problem.detectors, given, errors.sigma.reshape(len(given), -1), *[correlated] * bool(correlated)]
    _, first, group = np.unique(np.column_stack(keys), axis=0, return_index=True, return_inverse=True)
    return given[first], errors.spread(others[first], first), group.ravel(), first
