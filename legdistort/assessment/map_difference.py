"""Is an old distortion map still right? The difference of two maps, or of a map and a night, with its error."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy import special

from ..cameras.camera import Camera
from ..exceptions import InputError, some_of
from ..geometry import basis, detector_modes
from ..geometry.similarity import apply, invert
from ..matching.matches import Matches
from ..plots.difference_plots import plot_difference
from ..priors.prior import Prior
from ..results.errors.coefficient_covariance import exposure_blocks
from ..results.solution import Solution
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted
from ..solving.estimation import solve

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Error of a direction [pix], rms per axis over a detector, above which it is not determined.
LIMIT = 0.3
#: Chance below which two maps differ.
ALARM = 0.003
_NOTHING = 1e4  # error of a coefficient of which nothing is known [pix]
_MEAN_SQUARE = 8  # a coefficient of 1 px displaces by sqrt(1/8) px rms per axis: b_m has mean square 1/4
_ROUNDING, _RANK = 1e-4, 1e-9  # error that keeps matrices regular [pix], and relative size of what is rounding
_ROUNDS, _SWEEPS = 2, 30
_EXACT = 1e-6  # error of what is stated without one, beside what has one [pix]
_FREE = 30.0  # size of a common map, in every mode, of which nothing is known [pix]
_MOST = 500  # coefficients from which the scatter of exposures is found


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of static distortions, ``{detector: (2, n_modes)}``, of detectors of some shapes.

    `covariance` of all coefficients, one detector after the other, x modes first; None where no error is stated. Of an
    estimate from the scatter of exposures this has `dof` degrees of freedom. Modes beyond `degree` are not known.
    """

    label: str
    statics: dict
    shapes: dict
    covariance: np.ndarray | None = None
    dof: float = np.inf
    degree: int | None = None


@dataclass(frozen=True, eq=False, repr=False)
class MapDifference(ShownAsPrinted):
    """Difference of two distortion maps, second minus first, a similarity of every detector taken off.

    Made by `legdistort.difference`.

    Attributes
    ----------
    labels : tuple of str
        What was compared.
    coefficients, errors : dict
        ``{detector: (2, n_modes)}``, normalised Legendre modes, x then y, pixels. Directions that are not determined
        are taken off; errors are NaN where most of a mode is not determined, or where neither map states an error.
    shapes : dict
        ``{detector: (ny, nx)}``.
    chi2 : float
        Of the determined directions; NaN where neither map states an error.
    dof : int
        Number of these.
    p : float
        Probability of so large a difference by chance.
    rms_error : float
        Rms of the difference that the errors let expect, per axis, pixels; NaN where none is stated.
    n_undetermined : int
        Directions that are not determined to 0.3 px, rms per axis, and do not count.
    """

    labels: tuple[str, str]
    coefficients: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    shapes: dict[str, tuple[int, int]]
    chi2: float
    dof: int
    p: float
    rms_error: float = np.nan
    n_undetermined: int = 0

    @property
    def rms(self) -> float:
        """Root mean square of the difference over the detectors, per axis, pixels."""
        return float(np.sqrt(np.mean([np.sum(each**2) / _MEAN_SQUARE for each in self.coefficients.values()])))

    @property
    def sigmas(self) -> float:
        """The significance as standard deviations of a normal variable; at most 37."""
        return float(-special.ndtri(max(self.p, 1e-300) / 2)) if np.isfinite(self.p) else np.nan

    @property
    def agrees(self) -> bool | None:
        """Whether the first map is still right; None where no error is stated, or nothing is determined."""
        return None if not (np.isfinite(self.p) and self.dof) else self.p >= ALARM

    @property
    def modes(self) -> QTable:
        """One row a mode and axis: ``detector``, ``axis``, ``x_degree``, ``y_degree``, ``difference``, ``error`` [pix],
        ``significance``; shift, rotation and scale are left out.
        """  # fmt: skip
        rows = []
        for key, values in self.coefficients.items():
            i, j = (np.asarray(each) for each in basis.orders(basis.degree_of(values.shape[1])))
            for axis, name in enumerate("xy"):
                for m in range(1, len(i)):
                    error = self.errors[key][axis, m]
                    rows.append(
                        (key, name, i[m], j[m], values[axis, m], error, values[axis, m] / error if error else 0.0)
                    )
        names = ["detector", "axis", "x_degree", "y_degree", "difference", "error", "significance"]
        out = QTable(rows=rows, names=names) if rows else QTable(names=names)
        for name in ("difference", "error"):
            out[name] = out[name] * u.pix
        return out

    @property
    def sentence(self) -> str:
        """The result in a sentence."""
        first, second = self.labels
        if np.isnan(self.p):
            return (
                f"{second} differs from {first} by {self.rms:.2g} px rms; neither states an error, so no more is known"
            )
        if not self.dof:
            return f"{second} determines nothing of {first}: give exposures at several rolls, or dithers"
        aside = f"; {self.n_undetermined} directions are not determined and do not count" * (self.n_undetermined > 0)
        found = f"chi2 {self.chi2:.1f} for {self.dof}, p = {self.p:.2g}{aside}"
        if self.agrees:
            which = first if first.startswith("the ") else f"the map of {first}"
            return (
                f"{which} is still right: {second} differs from it by {self.rms:.2g} px rms, with errors of "
                f"{self.rms_error:.2g} px ({found})"
            )
        significance = f"{self.sigmas:.1f} sigma" if self.sigmas < 37 else "more than 37 sigma"
        return (
            f"{second} differs from {first} by {self.rms:.2g} px rms ({significance}), mostly in {self._most}; {found}"
        )

    @property
    def _most(self):
        """The mode that differs most significantly, in words."""
        table = self.modes
        k = int(np.nanargmax(np.abs(table["significance"])))
        row = table[k]
        of = f" of detector {row['detector']}" * (len(self.shapes) > 1)
        mode = f"L{row['x_degree']}(x) L{row['y_degree']}(y)"
        found, error = row["difference"].value, row["error"].value
        return f"{mode} along {row['axis']}{of} ({found:+.2g} +- {error:.2g} px a coefficient)"

    def plot(self, *, ax: Axes | None = None, scale: float | None = None) -> Axes:
        """Picture of the difference as arrows, see `legdistort.plots.difference_plots.plot_difference`."""
        return plot_difference(self, ax=ax, scale=scale)

    def __repr__(self) -> str:
        words = f"p = {self.p:.2g}" if np.isfinite(self.p) else "no errors stated"
        return f"<MapDifference: {self.rms:.2g} px rms, {words}>"

    def __str__(self) -> str:
        sentence = self.sentence
        if sentence.startswith("the "):  # and no name of a file
            sentence = "T" + sentence[1:]
        lines = [f"{sentence}.", ""]
        lines.append(f"{'detector':10s} {'axis':4s} {'mode':14s} {'difference [px]':>15s} {'error':>9s} {'sigma':>6s}")
        for row in self.modes:
            mode, error = f"L{row['x_degree']}(x) L{row['y_degree']}(y)", row["error"].value
            shown = f"{error:9.2g} {row['significance']:6.1f}" if np.isfinite(error) else f"{'-':>9s} {'-':>6s}"
            lines.append(f"{row['detector']:10s} {row['axis']:4s} {mode:14s} {row['difference'].value:15.4f} {shown}")
        return "\n".join(lines)


@plain_numbers
def difference(first: Any, second: Any, *, degree: int = 5) -> MapDifference:
    """Compare a distortion map with another, or with a night: is it still right?

    Shift, rotation, scale and parity of either map are conventions and taken off. Of a night counts what its exposures
    determine of the static distortion by dithers and rolls, whatever prior it was solved with: they depart from it by
    their scatter, and a common map of the plane is free.

    Parameters
    ----------
    first, second : path, Camera, Prior, Solution, or anything that `Prior.from_model` takes with all it needs stated
        Paths are of camera files, of solutions or folders with one, and of all that `Prior.from_file` reads.
    degree : int
        Of the Legendre series for what is not one yet.

    Returns
    -------
    MapDifference
        Of the detectors that both have, to the lower degree if one is a night, second minus first.

    Raises
    ------
    InputError
        For maps of different detectors or shapes, and nights of a camera whose static distortions were not fitted.

    See Also
    --------
    legdistort.Prior.from_model : Makes a map of a model, a WCS or a function.
    legdistort.Solution.factors : The tests of what a night was solved with.

    Examples
    --------
    >>> import legdistort as ld
    >>> old = ld.Prior([[0, 0, 0, 0.2, 0, 0], [0, 0, 0, 0, 0.1, 0]], static_sigma=0.02, shape=(2048, 2048))
    >>> ld.difference(old, ld.Prior(old.mean * 1.05)).agrees
    True
    """
    one, two = _opened(first, degree, "first"), _opened(second, degree, "second")
    one = _known(*one, None if isinstance(two[0], Solution) else _known(*two))
    two = _known(*two, one)
    if one.label == two.label:
        one, two = replace(one, label=f"{one.label} (first)"), replace(two, label=f"{two.label} (second)")
    pairs = _paired(one, two)
    limits = [each.degree for each in (one, two) if each.degree is not None]
    n = basis.n_modes(min(limits) if limits else max(_degree(each) for each in (one, two)))
    rows, values = [], []
    for mine, theirs in pairs:
        shape = one.shapes[mine] or two.shapes[theirs]
        rows.append(detector_modes.dynamic_basis(shape, n))
        maps = [_modes(_pointed(each, shape), n) for each in (one.statics[mine], two.statics[theirs])]
        values.append(rows[-1] @ (maps[1] - maps[0]).ravel())
    known = [_in_rows(each, [pair[k] for pair in pairs], rows, n) for k, each in enumerate((one, two))]
    stated = any(each is not None for each in known)
    values, covariance = np.concatenate(values), sum(each for each in known if each is not None)
    if not stated:
        covariance = np.zeros((len(values), len(values)))
    power, directions = np.linalg.eigh(covariance)
    determined = power < _MEAN_SQUARE * LIMIT**2
    inside = directions[:, determined]
    pull = inside.T @ values
    chi2 = float(np.sum(pull**2 / (power[determined] + _EXACT**2))) if stated else np.nan
    k, dof = int(determined.sum()), min(one.dof, two.dof)
    p = (float(special.fdtrc(k, dof, chi2 / k)) if np.isfinite(dof) else float(special.chdtrc(k, chi2))) if k else 1.0
    errors = np.einsum("ik,k,jk->ij", inside, power[determined], inside)
    found, own = _by_detector(inside @ pull, errors if stated else None, inside, rows, [pair[0] for pair in pairs])
    shapes = {mine: one.shapes[mine] or two.shapes[theirs] for mine, theirs in pairs}
    size = float(np.sqrt(np.sum(power[determined]) / _MEAN_SQUARE / len(pairs))) if stated else np.nan
    return MapDifference(
        (one.label, two.label), found, own, shapes, chi2, k if stated else 0, p if stated else np.nan, size,
        int(np.count_nonzero(~determined)),
    )  # fmt: skip


def _by_detector(values, covariance, inside, rows, keys):
    """Coefficients and errors, ``{detector: (2, n_modes)}``, of values of the rows of all detectors."""
    found, errors, begin = {}, {}, 0
    share = inside @ inside.T
    for key, each in zip(keys, rows, strict=True):
        part = slice(begin, begin := begin + len(each))
        found[key] = (each.T @ values[part]).reshape(2, -1)
        whole = np.sum(each**2, axis=0)
        left = np.einsum("ia,ij,ja->a", each, share[part, part], each) < 0.5 * whole
        error = np.full(each.shape[1], np.nan)
        if covariance is not None:
            error = np.sqrt(np.maximum(np.einsum("ia,ij,ja->a", each, covariance[part, part], each), 0))
            error[left] = np.nan
        errors[key] = error.reshape(2, -1)
    return found, errors


def _modes(static, n):
    return basis.change_degree(static, basis.degree_of(n))


def _degree(known):
    return max(basis.degree_of(each.shape[1]) for each in known.statics.values())


def _in_rows(known, keys, rows, n):
    """Covariance of the rows of detectors in some order; None where it is not stated."""
    if known.covariance is None:
        return None
    own, begin = {}, 0
    for key, static in known.statics.items():
        m = static.shape[1]
        own[key] = (begin + np.arange(2 * m)).reshape(2, m)
        begin += 2 * m
    picked, at = np.zeros((sum(map(len, rows)), begin)), 0
    for key, each in zip(keys, rows, strict=True):
        m = min(n, own[key].shape[1])
        wide = each.reshape(len(each), 2, n)
        picked[at : at + len(each), own[key][:, :m].ravel()] = wide[:, :, :m].reshape(len(each), -1)
        at += len(each)
    return picked @ known.covariance @ picked.T


def _paired(one, two):
    """Detectors of both, as pairs of their names."""
    if len(one.statics) == len(two.statics) == 1:
        pairs = [(next(iter(one.statics)), next(iter(two.statics)))]
    else:
        pairs = [(key, key) for key in one.statics if key in two.statics]
    if len(pairs) < max(len(one.statics), len(two.statics)):
        raise InputError(
            f"{one.label} has detectors {some_of(list(one.statics), 6)}, {two.label} has "
            f"{some_of(list(two.statics), 6)}: compare maps of the same detectors"
        )
    for mine, theirs in pairs:
        shapes = one.shapes[mine], two.shapes[theirs]
        if None not in shapes and shapes[0] != shapes[1]:
            raise InputError(
                f"{one.label} is for {shapes[0]} (ny, nx), {two.label} for {shapes[1]}: give maps of one detector"
            )
        if shapes == (None, None):
            raise InputError(
                f"neither {one.label} nor {two.label} states the shape of its detector: give Prior(shape=)"
            )
    return pairs


# -- what is known of a map


def _opened(thing, degree, argument):
    """A solution, camera or prior, and its label."""
    label = f"the {argument} map"
    if isinstance(thing, (str, Path)) or (isinstance(thing, (list, tuple)) and len(thing) == 2):
        label = str(thing) if isinstance(thing, (str, Path)) else f"{thing[0]}, {thing[1]}"
        thing = _read(thing, degree)
    if isinstance(thing, Mapping):
        raise InputError(f"{label} is a dict: compare its maps one by one, or give a Camera")
    if not isinstance(thing, (Solution, Camera, Prior)):
        thing = Prior.from_model(thing, degree=degree)
    if isinstance(thing, Prior) and thing.mean is None:
        raise InputError(f"{label} states only the size of a distortion: give a map")
    return thing, label


def _known(thing, label, other=None):
    """What a solution, camera or prior knows; the `other` is that of what it is compared with."""
    if isinstance(thing, Solution):
        if thing.camera.has_focal_plane:
            return _of_focal_plane(thing, label)
        return _of_night(thing, label, next(iter(other.statics.values())) if other else None)
    if isinstance(thing, Camera):
        return _of_camera(thing, label)
    widths = thing.static_sigma
    covariance = None if widths is None else np.diag(np.minimum(widths.ravel(), _NOTHING) ** 2)
    return _Known(label, {"1": thing.mean}, {"1": thing.shape}, covariance)


def _read(where, degree):
    """The camera, solution or prior in files."""
    if isinstance(where, (str, Path)):
        path = Path(where)
        if path.is_dir():
            return Solution.read(path)
        if path.is_file():
            with path.open("rb") as file:
                start = file.read(1 << 20)  # the arrays come later
            for entry, kind in (
                (b"legdistort_camera", Camera),
                (b"legdistort", Solution),
                (b"legdistort_prior", Prior),
            ):
                if start.startswith(b"#ASDF") and re.search(rb"^" + entry + rb":", start, re.MULTILINE):
                    return kind.read(path)
    return Prior.from_file(where, degree=degree)


def _of_camera(camera, label):
    statics = {key: each.static for key, each in camera.detectors.items()}
    shapes = {key: each.shape for key, each in camera.detectors.items()}
    widths = [each.static_sigma for each in camera.detectors.values()]
    covariance = None
    if any(each is not None for each in widths):
        widths = [np.zeros(s.shape) if w is None else w for w, s in zip(widths, statics.values(), strict=True)]
        covariance = np.diag(np.concatenate([np.minimum(each.ravel(), _NOTHING) ** 2 for each in widths]))
    return _Known(camera.name if label.startswith("the ") else label, statics, shapes, covariance)


def _of_focal_plane(solution, label):
    """The detectors of a camera that was fitted: layouts are free, and a common map of the focal plane."""
    errors, camera = solution.estimate.uncertainty.camera, solution.camera
    if errors is None or not errors.free[:, :, 3:].any():
        raise InputError(
            f"{label} was solved with the static distortions of camera {camera.name} as given, and says nothing of "
            "them: solve it with static='fit' (--static fit)"
        )
    known, n = _of_camera(camera, label), errors.free.shape[2]
    statics = {key: basis.change_degree(each, basis.degree_of(n)) for key, each in known.statics.items()}
    covariance = np.zeros((errors.free.size, errors.free.size))
    free = np.flatnonzero(errors.free.ravel())
    covariance[np.ix_(free, free)] = errors.changes @ errors.changes.T
    of_layouts = np.zeros(errors.free.shape)
    of_layouts[:, :, :3] = _NOTHING**2
    covariance += np.diag(of_layouts.ravel())
    common = np.concatenate([_common_maps(camera, each, n) for each in camera.detectors.values()])
    return replace(
        known, statics=statics, covariance=covariance + _NOTHING**2 * common @ common.T, degree=basis.degree_of(n)
    )


def _common_maps(camera, detector, n):
    """Coefficients (2 n, 2 n) on a detector of the modes of the focal plane."""
    degree, back = basis.degree_of(n), invert(detector.layout)

    def modes(u, v):
        there = apply(back, basis.denormalize(u, v, detector.shape))
        return basis.values(degree, *basis.normalize(there, camera.field))

    alone = basis.project(modes, degree)
    return np.einsum("ab,mk->akbm", detector.layout[:, :2], alone).reshape(2 * n, 2 * n)


def _of_night(solution, label, other):
    """The static distortion of the exposures of one detector, from all but what was known of it.

    It is solved again around what it shows and, where it shows nothing, around the `other` map (2, n_modes) or None, so
    that a common map of the plane is small, and what is linear in it exact.
    """
    shapes = set(solution.estimate.shapes.values())
    if len(shapes) > 1:
        raise InputError(f"{label} has detectors of several shapes, {sorted(shapes)}: it gives no single map")
    shape, asked = shapes.pop(), solution.settings
    table = solution.residuals[np.asarray(solution.residuals["used"])]
    table.keep_columns([name for name in table.colnames if name not in ("dx", "dy", "used")])
    matches = Matches.from_table(table, shape=shape, poses=solution.poses)
    options = {name: getattr(asked, name) for name in ("errors", "error_floor", "loss", "motion", "motion_epoch")}
    n = basis.n_modes(solution.degree)
    around = solution.coefficients[:, :, :n].mean(axis=0) if other is None else _modes(other, n)
    around = _pointed(around, shape)
    for _ in range(_ROUNDS):
        prior = Prior(around, shape=shape)
        with _untold():
            again = solve(matches, degree=solution.degree, prior=prior, clip=None, **options)
        static, covariance, dof = _shown(again, shape)
        known = np.linalg.inv(np.eye(2 * n) + covariance / (_MEAN_SQUARE * LIMIT**2))
        around = around + (known @ (static - around).ravel()).reshape(2, n)
    return _Known(label, {"1": static}, {"1": shape}, covariance, dof, solution.degree)


def _shown(solution, shape):
    """The static distortion (2, n_modes) that exposures show, its covariance and the degrees of freedom of that.

    ``A_i = S + N_i g + d_i + e_i``: S sought, a common map g of the plane free, departures d whose scatter by degree is
    found (REML), errors e of the coefficients; similarities of exposures are their poses.
    """
    gauge, n, count = solution.gauge, basis.n_modes(solution.degree), len(solution.names)
    rows = detector_modes.dynamic_basis(shape, n)
    wide = rows @ _widened(gauge.n_own, n)
    design = np.concatenate([np.hstack([np.eye(len(rows)), wide @ each]) for each in gauge.motion])
    errors = _errors(solution, rows)
    values = np.concatenate([rows @ _pointed(each[:, :n], shape).ravel() for each in solution.coefficients])
    sizes, dof = _scatter(values, design, errors, detector_modes.dynamic_degrees(n))
    mean, covariance = _least_squares(values, design, errors + np.diag(np.tile(sizes, count)), len(rows))
    return (rows.T @ mean).reshape(2, n), rows.T @ covariance @ rows, dof


def _pointed(static, shape):
    """Coefficients of the same map after a similarity, as a pose has it, so that they have no part of one."""
    degree = basis.degree_of(static.shape[1])
    for _ in range(_ROUNDS):
        back = invert(detector_modes.similarity_part(static, shape))

        def displacement(u, v, static=static, back=back):
            there = basis.denormalize(u, v, shape)
            q = apply(back, there)
            return (q - there).T + static @ basis.values(degree, *basis.normalize(q, shape))

        static = basis.project(displacement, degree)
    return static


def _scatter(values, design, errors, degrees):
    """Variance of departures for every row of an exposure, one a degree, by REML, and its degrees of freedom."""
    k = len(degrees)
    exposures = len(values) // k
    some = np.random.default_rng(0).permutation(exposures)[: max(2, _MOST // k)]
    part = (np.sort(some)[:, None] * k + np.arange(k)).ravel()
    values, design, errors = values[part], design[part], errors[np.ix_(part, part)]
    member = np.tile(degrees, len(some)) == np.unique(degrees)[:, None]
    sizes = np.full(len(member), max(np.var(values - np.tile(values.reshape(-1, k).mean(axis=0), len(some))), 1e-12))
    for _ in range(_SWEEPS):
        inverse = np.linalg.inv(errors + np.diag(sizes @ member + _ROUNDING**2))
        left = inverse @ design
        projected = inverse - left @ np.linalg.pinv(design.T @ left, rcond=_RANK, hermitian=True) @ left.T
        pull = projected @ values
        ratio = np.array([np.sum(pull[m] ** 2) / max(np.trace(projected[np.ix_(m, m)]), 1e-300) for m in member])
        sizes = np.maximum(sizes * ratio, 1e-9)
    known = np.array([s**2 * np.sum(projected[np.ix_(m, m)] ** 2) for s, m in zip(sizes, member, strict=True)])
    power = np.array([s * np.trace(projected[np.ix_(m, m)]) for s, m in zip(sizes, member, strict=True)])
    share = power / np.maximum(member.sum(axis=1) - np.count_nonzero(degrees[:, None] == np.unique(degrees), axis=0), 1)
    dof = 1 / np.sum((np.clip(share, 0, 1) * member.sum(axis=1) / member.size * len(member)) ** 2 / (known + 1e-9))
    return (sizes @ member)[:k], dof * exposures / len(some)


def _widened(n_own, n):
    """Matrix (2 n, 2 n_own) that puts the modes of fewer into all."""
    out, m = np.zeros((2, n, 2, n_own)), np.arange(min(n_own, n))
    for axis in (0, 1):
        out[axis, m, axis, m] = 1
    return out.reshape(2 * n, 2 * n_own)


def _errors(solution, rows):
    """Covariance of the rows of all exposures, (n_exposures k,) squared."""
    uncertainty, count, k = solution.estimate.uncertainty, len(solution.names), len(rows)
    given = uncertainty.coefficients
    if given.ndim == 2:
        size = given.shape[0] // count
        pick = rows @ _widened(size // 2, rows.shape[1] // 2)
        out = np.einsum("ka,iajb,lb->ikjl", pick, given.reshape(count, size, count, size), pick, optimize=True)
        out = out.reshape(count * k, count * k)
    else:
        pick = rows @ _widened(given.shape[1] // 2, rows.shape[1] // 2)
        out = np.zeros((count, k, count, k))
        for i, block in enumerate(exposure_blocks(given, count)):
            out[i, :, i] = pick @ block @ pick.T
        out = out.reshape(count * k, count * k)
    if uncertainty.camera is not None:
        shared = uncertainty.camera.coefficients
        pick = rows @ _widened(shared.shape[1] // 2, rows.shape[1] // 2)
        shared = np.einsum("ka,iar->ikr", pick, shared).reshape(count * k, -1)
        out = out + shared @ shared.T
    return out


@contextmanager
def _untold():
    """Solving without a word of how it went."""
    log = logging.getLogger("legdistort.solving.estimation")
    level = log.level
    log.setLevel(logging.WARNING)
    try:
        yield
    finally:
        log.setLevel(level)


def _least_squares(values, design, covariance, k):
    """The first k unknowns and their covariance, where nothing is known of any; the others stay small where free."""
    root = np.linalg.cholesky(covariance + _ROUNDING**2 * np.eye(len(covariance)))
    white = np.linalg.solve(root, np.column_stack([design[:, k:], design[:, :k], values]))
    free = design.shape[1] - k
    bound = np.hstack([np.eye(free) / _FREE, np.zeros((free, k + 1))])
    triangle = np.linalg.qr(np.vstack([white, bound]), mode="r")
    own, pull = triangle[free : free + k, free : free + k], triangle[free : free + k, -1]
    left, sizes, right = np.linalg.svd(own)
    sizes = np.maximum(sizes, 1 / _NOTHING)  # less is rounding
    return right.T @ (left.T @ pull / sizes), right.T / sizes**2 @ right
