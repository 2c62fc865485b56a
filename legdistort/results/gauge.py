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

from ..geometry import basis
from ..geometry.detector_modes import dynamic_basis, similarity_basis


@dataclass(frozen=True, eq=False)
class Gauge:
    """The convention in which a solution and its errors are given.

    Attributes
    ----------
    kind : {"minimal", "mean"} or str
        Or the name of a simpler correction, which comes with a `plane`.
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
        What the orthonormal constraints are held at: zero, but for what the data or a reference tell.
    shears : bool
        Whether exposures take back shears, of which the data then say nothing.
    tie : `legdistort.results.catalogue_tie.Tie` or None
        How a reference catalogue measured the maps that the data do not tell.
    plane : str or None
        What the plane of a simpler correction is, in words. How far it is from the sky is not known then, and `dynamic`
        is NaN.
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
    shears: bool = True
    tie: object = None
    plane: str | None = None

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

        Those of the similarities, which the poses carry, and what the two shears of the reference plane move, unless
        exposures share theirs.
        """
        size, n = 2 * self.box[1, ::-1], self.n_constraints // 2
        similar = self.constraint[-len(similarity_basis(size, n)) :].reshape(-1, self.orthonormal.shape[1])
        shears = dynamic_basis(size, n)[: 2 * self.shears]
        return np.linalg.qr(np.hstack([self.orthonormal @ similar.T, self._reach @ shears.T]))[0]

    @property
    def told_rows(self):
        """Combinations of the constraints that are left to the data, orthonormal columns."""
        moved = self._reach @ (np.zeros((0, self.n_constraints)) if self.told is None else self.told).T
        return np.linalg.qr(moved - self.affine @ (self.affine.T @ moved))[0]

    def left_to_data(self, combinations):
        """Maps of the reference plane (k, 2 n_modes) that stand for combinations of the constraints (2 n_modes, k)."""
        return np.linalg.solve(self._reach, combinations).T

    def modes_at(self, xy, n_modes=None):
        """Values (n_modes, n) of the reference-plane modes, by default of the gauge, at reference positions (n, 2)."""
        degree = basis.degree_of(self.n_constraints // 2 if n_modes is None else n_modes)
        u, v = ((np.asarray(xy) - self.box[0]) / self.box[1]).T
        return basis.values(degree, u, v)

    def common_map(self, departure):
        """The map (2 n_modes,) of the reference plane, similarities aside, to which departures A_i - A_0 amount."""
        similar = similarity_basis(2 * self.box[1, ::-1], self.n_constraints // 2)
        out = -np.linalg.pinv(self._reach) @ self.orthonormal @ departure.ravel()
        return out - similar.T @ (similar @ out)

    @cached_property
    def absolute_covariance(self):
        """Covariance (2 n_modes, 2 n_modes) of the reference-plane modes that the convention hides.

        The mean dynamic distortion of the set, with the observed scatter per mode, and the uncertainty of
        the static distortion, if given; both as they pass through the constraint. Where the data tell, their error.
        The similarities, which are a matter of pointing, are left out. With a reference it is what that leaves open,
        similarities included.
        """
        if self.tie is not None:
            return self.tie.covariance
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
            Name, number of modes, error; the similarities first, NaN unless a reference tells them.
        """
        if self.tie is not None:
            return self.tie.errors(2 * self.box[1, ::-1])
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
        if self.plane is not None:
            return f"{self.kind}: the plane is {self.plane}; absolute errors are not available"
        how = {
            "minimal": "the smallest dynamic part, weighted by its scatter and errors",
            "mean": "dynamic parts that sum to zero",
        }[self.kind]
        hidden = np.sqrt(np.nansum([error**2 for *_, error in self.absolute_errors()]))
        return (
            f"{self.kind}: {self.n_constraints} modes of a map common to all exposures, which the data do not tell, "
            f"are fixed by {how}{self._told_in_words()}; "
            + (
                f"they hide {hidden:.2g} px rms per axis, pointing aside"
                if self.tie is None
                else f"{self.tie.sentence}; absolute to {hidden:.2g} px rms per axis"
            )
        )

    def _told_in_words(self):
        return "" if self.told is None else f", but for {len(self.told)} that the data do tell"

    def __repr__(self):
        return f"<Gauge {self.kind!r}: {self.n_constraints} constraints, {len(self.motion)} exposures>"

    def __str__(self):
        if self.plane is not None:
            return self.sentence
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
        measured = {} if self.tie is None else self.tie.words(convention)
        for name, number, error in self.absolute_errors():
            if name in measured:
                lines.append(f"{name:24s} {number:6d} {f'{error:.2g} px':>15s}  {measured[name]}")
            elif np.isnan(error):
                lines.append(f"{name:24s} {number:6d} {'not known':>15s}  the nominal poses, mean over exposures")
            else:
                lines.append(f"{name:24s} {number:6d} {f'{error:.2g} px':>15s}  {convention}")
        if self.told is not None:
            lines.append(
                f"The data tell {len(self.told)} combinations of these modes: they contradict the constraint by 5 "
                "standard errors or more, or what is fixed cannot take these maps back; there they decide, and the "
                "absolute error is theirs."
            )
        source = "the scatter of single exposures" + (
            " and the uncertainty of the static distortion" if self.static_sigma is not None else ""
        )
        lines.append(
            f"Absolute errors (rms over the field, per axis) come from {source}; single exposures depart from the "
            f"prior mean by {dynamic:.2g} px rms per axis. "
            + ("No external reference was used." if self.tie is None else self.tie.statement)
        )
        return "\n".join(lines)
