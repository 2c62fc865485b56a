"""What the data cannot tell, and the convention that settles it.

Any map G of the reference plane leaves J (nearly) as it is when every D_i takes it back: the six affine
directions exactly, all 2 n_modes polynomial directions to a part in a million. Left free they are noise, so
they are fixed by as many linear constraints on the coefficients,

    sum_i N_i' W_i (A_i - A_0) = 0,

where N_i tells how a reference-plane mode changes the coefficients of exposure i. With
``W_i = (Lambda + C_i)^-1`` this is the solution with the smallest dynamic part in the metric of its own
scatter Lambda and errors C_i (gauge ``"minimal"``); with ``N_i' W_i = 1`` it is ``sum_i (A_i - A_0) = 0``
(gauge ``"mean"``), which the paper's starting point implies for undithered exposures.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from . import basis
from .criterion import State, complement
from .exceptions import SolveError, check_choice
from .priors import dynamic_basis, similarity_basis, similarity_part
from .scatter import conditional_errors, dynamic_covariance, say

KINDS = ("minimal", "mean")
#: Below this the constraints of the "mean" gauge leave a direction free.
_MEAN_LIMIT = 1e-3
_CORNERS = np.array([[-1, 1, 1, -1.0], [-1, -1, 1, 1.0]])


@dataclass(frozen=True, eq=False)
class Gauge:
    """The convention in which a solution and its errors are given.

    Attributes
    ----------
    kind : {"minimal", "mean"}
    constraint : ndarray, shape (2 n_modes, n_exposures, 2 n_modes)
        Rows of the constraints; they act on A_i - A_0, x modes first.
    motion : ndarray, shape (n_exposures, 2 n_modes, 2 n_modes)
        N_i: displacement modes of the reference plane -> coefficients of exposure i.
    dynamic : ndarray, same shape
        Lambda, covariance of a single exposure's departure from the prior mean, px^2; nothing along its
        similarities.
    box : ndarray, shape (2, 2)
        Centre and half size of the reference-plane box on which the modes are defined, pixels.
    static_sigma : ndarray, shape (2, n_modes), or None
        Uncertainty of the prior mean itself.
    prior : bool
        Whether the prior has widths, which then pin the modes together with the constraint.
    told : ndarray, shape (n_told, 2 n_modes), or None
        Maps of the reference plane, in its modes, that are left to the data, which contradict the convention there.
    told_covariance : ndarray, shape (n_told, n_told), or None
        Covariance of the values `told_rows` of the constraints as the data tell them, px^2.
    values : ndarray, shape (2 n_modes,), or None
        What the orthonormal constraints are held at: zero, but for the combinations that the data tell.
    """

    kind: str
    constraint: np.ndarray
    motion: np.ndarray
    dynamic: np.ndarray
    box: np.ndarray
    static_sigma: np.ndarray | None = None
    prior: bool = False
    told: np.ndarray | None = None
    told_covariance: np.ndarray | None = None
    values: np.ndarray | None = None

    @property
    def n_constraints(self):
        """Number of directions that the convention fixes, 2 n_modes."""
        return self.motion.shape[1]

    @property
    def scatter(self):
        """Dynamic scatter of single exposures per axis and mode (2, n_modes), pixels, mean over the exposures."""
        return np.sqrt(np.einsum("iaa->a", self.dynamic) / len(self.dynamic)).reshape(2, -1)

    @cached_property
    def orthonormal(self):
        """Orthonormal rows that span `constraint`, shape (2 n_modes, n_exposures * 2 n_modes)."""
        return np.linalg.qr(self.constraint.reshape(self.n_constraints, -1).T)[0].T

    def violation(self, departure):
        """How far departures A_i - A_0 (n_exposures, 2 n_modes) are from the values of the orthonormal constraints."""
        return self.orthonormal @ departure.ravel() - (0 if self.values is None else self.values)

    @cached_property
    def _reach(self):
        """Reference-plane modes -> values of the orthonormal constraints, shape (2 n_modes, 2 n_modes)."""
        return self.orthonormal @ self.motion.reshape(-1, self.n_constraints)

    @cached_property
    def affine(self):
        """Combinations of the constraints that settle affine maps, of which the data say nothing; orthonormal columns.

        Those of the similarities, which the poses carry, and what the two shears of the reference plane move.
        """
        size, n = 2 * self.box[1, ::-1], self.n_constraints // 2
        similar = self.constraint[-len(similarity_basis(size, n)) :].reshape(-1, self.orthonormal.shape[1])
        shears = dynamic_basis(size, n)[:2]
        return np.linalg.qr(np.hstack([self.orthonormal @ similar.T, self._reach @ shears.T]))[0]

    @property
    def told_rows(self):
        """Combinations of the constraints that are left to the data, orthonormal columns."""
        moved = self._reach @ (np.zeros((0, self.n_constraints)) if self.told is None else self.told).T
        return np.linalg.qr(moved - self.affine @ (self.affine.T @ moved))[0]

    def left_to_data(self, combinations):
        """Maps of the reference plane (k, 2 n_modes) that stand for combinations of the constraints (2 n_modes, k)."""
        return np.linalg.solve(self._reach, combinations).T

    def modes_at(self, xy):
        """Values (n_modes, n) of the reference-plane modes at reference positions (n, 2)."""
        degree = basis.degree_of(self.n_constraints // 2)
        u, v = ((np.asarray(xy) - self.box[0]) / self.box[1]).T
        return basis.values(degree, u, v)

    @cached_property
    def absolute_covariance(self):
        """Covariance (2 n_modes, 2 n_modes) of the reference-plane modes that the convention hides.

        The mean dynamic distortion of the set, with the observed scatter per mode, and the uncertainty of
        the static distortion, if given; both as they pass through the constraint. Where the data tell, their error.
        The similarities, which are a matter of pointing, are left out.
        """
        rows = self.orthonormal.reshape(self.n_constraints, len(self.motion), -1).transpose(1, 0, 2)
        inside = np.einsum("iab,ibc,idc->ad", rows, self.dynamic, rows, optimize=True)
        if self.static_sigma is not None:
            common = rows.sum(axis=0)
            inside += common * np.ravel(self.static_sigma) ** 2 @ common.T
        if self.told is not None:
            told = self.told_rows
            kept = np.eye(len(inside)) - told @ told.T
            inside = kept @ inside @ kept + told @ self.told_covariance @ told.T
        back = np.linalg.pinv(self._reach)
        out = back @ inside @ back.T
        similar = similarity_basis(2 * self.box[1, ::-1], self.n_constraints // 2)
        keep = np.eye(len(out)) - similar.T @ similar
        return keep @ out @ keep

    def absolute_errors(self):
        """What the convention hides, per degree of the common map: rms error over the field and axis, pixels.

        Returns
        -------
        list of (str, int, float)
            Name, number of modes, error; the similarities first, with NaN.
        """
        degree = basis.degree_of(self.n_constraints // 2)
        variance = np.diag(self.absolute_covariance).reshape(2, -1).sum(axis=0) / 8  # b_m has mean square 1/4
        rows = [("shift, rotation, scale" if degree else "shift", 4 if degree else 2, np.nan)]
        for d in range(1, degree + 1):
            part = slice(basis.n_modes(d - 1), basis.n_modes(d))
            rows.append((f"degree {d}" if d > 1 else "shear", 2 * (d + 1) if d > 1 else 2, variance[part].sum() ** 0.5))
        return rows

    @property
    def sentence(self):
        """The convention in a sentence."""
        how = {
            "minimal": "the smallest dynamic part, weighted by its scatter and errors",
            "mean": "dynamic parts that sum to zero",
        }[self.kind]
        hidden = np.sqrt(np.nansum([error**2 for *_, error in self.absolute_errors()]))
        return (
            f"{self.kind}: {self.n_constraints} modes of a map common to all exposures, which the data do not tell, "
            f"are fixed by {how}{self._told_in_words()}; they hide {hidden:.2g} px rms per axis, pointing aside"
        )

    def _told_in_words(self):
        return (
            ""
            if self.told is None
            else f", but for {len(self.told)} that the data do tell, by 5 standard errors or more"
        )

    def __repr__(self):
        return f"<Gauge {self.kind!r}: {self.n_constraints} constraints, {len(self.motion)} exposures>"

    def __str__(self):
        convention = {
            "minimal": "the constraint (smallest dynamic part, weighted by its scatter and errors)",
            "mean": "the constraint (dynamic parts that sum to zero)",
        }[self.kind]
        if self.prior:
            convention += " and the prior widths"
        degree = basis.degree_of(self.n_constraints // 2)
        dynamic = np.sqrt(np.sum(self.scatter**2) / 8)
        lines = [
            f"Gauge {self.kind!r}. A map of the reference plane of degree {degree} that every exposure takes back "
            f"changes nothing in the data: {self.n_constraints} modes, {min(6, self.n_constraints)} of them exactly.",
            f"{'modes':24s} {'number':>6s} {'absolute error':>15s}  pinned by",
        ]
        for name, number, error in self.absolute_errors():
            if np.isnan(error):
                lines.append(f"{name:24s} {number:6d} {'not known':>15s}  the nominal poses, mean over exposures")
            else:
                lines.append(f"{name:24s} {number:6d} {f'{error:.2g} px':>15s}  {convention}")
        if self.told is not None:
            lines.append(
                f"The data contradict the constraint along {len(self.told)} combinations of these modes, by 5 standard "
                "errors or more: there they decide, and the absolute error is theirs."
            )
        source = "the scatter of single exposures" + (
            " and the uncertainty of the static distortion" if self.static_sigma is not None else ""
        )
        lines.append(
            f"Absolute errors (rms over the field, per axis) come from {source}; single exposures depart from the "
            f"prior mean by {dynamic:.2g} px rms per axis. No external reference was used."
        )
        return "\n".join(lines)


def make(kind, problem, state, blocks, *, told=None):
    """The gauge at a state, its weights from the blocks of the criterion and the scatter seen there.

    Maps `told` (n_told, 2 n_modes) of the reference plane are left to the data: see `Gauge`.

    Raises
    ------
    InputError
        For an unknown kind.
    SolveError
        If the "mean" gauge leaves a direction free, as for rolls that cancel.
    """
    check_choice(kind, KINDS, "gauge")
    box = reference_box(problem, state)
    motion = _motion(problem, state.poses, box)
    if kind == "mean":
        _check_mean(motion)
    similar = _by_shape(similarity_basis, problem)
    others = _by_shape(dynamic_basis, problem)
    held = np.array([problem.has_widths(i) for i in range(problem.n_exposures)])
    error = conditional_errors(blocks.u_data, np.where(held[:, None, None], blocks.u_data, blocks.u))
    dynamic = dynamic_covariance(problem, state, error, motion, others)
    if kind == "mean":
        constraint = np.broadcast_to(np.eye(motion.shape[1])[:, None], (motion.shape[1], *motion.shape[:2])).copy()
    else:
        constraint = _minimal_constraint(motion, error, dynamic, similar, others, box, held=held)
    return Gauge(kind, constraint, motion, dynamic, box, problem.static_sigma, bool(held.any()), told)


def _minimal_constraint(motion, error, dynamic, similar, others, box, *, held):
    """Rows ``N_i' W_i``: those of all but the common similarities see the departures without their similarity part.

    With prior widths (exposures `held`) the weight is that of the prior alone: the constraint is then where the prior
    by itself would settle, and the covariance under it that of truths drawn from the prior.
    """
    spread = dynamic + np.where(held, 0, 1)[:, None, None] * error
    inner = others @ spread @ others.transpose(0, 2, 1)
    weight = others.transpose(0, 2, 1) @ np.linalg.solve(inner, others) if others.shape[1] else np.zeros_like(error)
    weight = np.where(held, 1, say(error, others))[:, None, None] * weight
    pose_weight = say(error, similar)[:, None, None] * (similar.transpose(0, 2, 1) @ similar)
    common = similarity_basis(2 * box[1, ::-1], motion.shape[1] // 2)
    pulled = motion.transpose(0, 2, 1)
    rows = np.concatenate([complement(common) @ pulled @ weight, common @ pulled @ pose_weight], axis=1)
    return rows.transpose(1, 0, 2)


def reference_box(problem, state):
    """Centre and half size (2, 2) of the box of the reference plane that all detectors cover."""
    scale = np.sqrt(np.abs(np.linalg.det(state.poses[:, :, :2])))
    usual = np.abs(np.log(scale / np.median(scale))) < np.log(2)  # a mismatched exposure may have any scale
    ends = _by_shape(lambda shape, _: basis.denormalize(_CORNERS[0], _CORNERS[1], shape), problem)[usual]
    pose_list = state.poses[usual]
    corners = _apply_inverse(pose_list, ends).reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return np.stack([(low + high) / 2, (high - low) / 2])


def _by_shape(function, problem):
    """``function(shape, n_modes)`` of every exposure, computed once a shape, stacked."""
    made = {shape: function(shape, problem.n_modes) for shape in set(problem.shapes)}
    return np.stack([made[shape] for shape in problem.shapes])


def _motion(problem, pose_list, box):
    """N_i, to first order in the distortion: a displacement g of the reference plane moves q by R g(T^-1 q)."""
    degree, size = problem.degree, problem.n_modes
    u, v, w = basis.quadrature(degree)
    nodes = _by_shape(lambda shape, _: basis.denormalize(u, v, shape), problem)
    linear = pose_list[:, :, :2]
    back = _apply_inverse(pose_list, nodes)
    reference = basis.values(degree, *np.moveaxis((back - box[0]) / box[1], -1, 0))
    mixing = np.einsum("mk,nik->imn", basis.values(degree, u, v) * w, reference, optimize=True)
    return np.einsum("iab,imn->iambn", linear, mixing).reshape(-1, 2 * size, 2 * size)


def _check_mean(motion):
    """Refuse the "mean" gauge where the mean of N_i loses a direction that single exposures have."""
    mean = motion.mean(axis=0)
    power = np.einsum("iba,ibc->ac", motion, motion) / len(motion)
    ratio = np.linalg.eigvals(np.linalg.solve(power, mean.T @ mean)).real.min()
    if ratio < _MEAN_LIMIT:
        raise SolveError(
            "gauge='mean' leaves a common map of the reference plane free: the orientations of these exposures cancel "
            f"in the mean (ratio {max(ratio, 0):.1e}), as for rolls of 0, 90, 180 and 270 degrees; use gauge='minimal'"
        )


def absorb_similarities(problem, state):
    """Move the similarity part of every dynamic distortion into its pose; D_i stays what it is.

    ``q' = S q`` and ``A' b(q') = q - q' + A b(S^-1 q')``, a polynomial of the same degree, so the change is exact
    (prior modes beyond the fitted degree excepted: they stay with the detector).

    Returns
    -------
    State
    float
        Largest move of a detector corner, pixels.
    """
    n_modes = problem.n_modes
    degree = basis.degree_of(state.coefficients.shape[2])
    u, v, w = basis.quadrature(degree)
    project = (basis.values(degree, u, v) * w).T
    nodes = _by_shape(lambda shape, _: basis.denormalize(u, v, shape), problem)
    ends = _by_shape(lambda shape, _: basis.denormalize(_CORNERS[0], _CORNERS[1], shape), problem)
    pixels = np.array(problem.shapes)[:, None, ::-1]
    coefficients, pose_list, largest = state.coefficients.copy(), state.poses, 0.0
    for _ in range(4):
        departure = (coefficients - problem.prior_mean)[:, :, :n_modes]
        shift = similarity_part(departure, problem.shapes)
        move = float(np.abs(_apply(shift, ends) - ends).max())
        largest = max(largest, move)
        if move < 1e-9:
            break
        linear = np.linalg.inv(shift[:, :, :2])
        old = (nodes - shift[:, None, :, 2]) @ linear.transpose(0, 2, 1)
        values = basis.values(degree, *np.moveaxis((2 * old + 1) / pixels - 1, -1, 0))
        changed = ((old - nodes).transpose(0, 2, 1) + np.einsum("iam,mik->iak", coefficients, values)) @ project
        coefficients[:, :, :n_modes] = changed[:, :, :n_modes]
        turned = shift[:, :, :2] @ pose_list
        turned[:, :, 2] += shift[:, :, 2]
        pose_list = turned
    return State(state.positions, coefficients, pose_list), largest


def _apply(pose_list, xy):
    """Poses (n, 2, 3) applied to positions (n, k, 2)."""
    return xy @ pose_list[:, :, :2].transpose(0, 2, 1) + pose_list[:, None, :, 2]


def _apply_inverse(pose_list, xy):
    """Positions (n, k, 2) carried back through poses (n, 2, 3)."""
    return (xy - pose_list[:, None, :, 2]) @ np.linalg.inv(pose_list[:, :, :2]).transpose(0, 2, 1)
