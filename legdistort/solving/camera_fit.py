"""Layouts and static distortions of the detectors of a camera, fitted together with stars and exposures.

To first order a change ``ds_c`` of the series of detector c moves what was measured on it by ``-M_c^-1 b ds_c`` in the
focal plane, M_c the linear part of its layout; modes of orders 0 and 1 are its layout. The fit with the camera as it is
gives the normal equations of these changes with stars and exposures eliminated, ``H = P' W P - G' C G``: P are the
displacements by a unit of each, G their gradients, C what the fit makes of a gradient. They are solved, the positions
are carried to the focal plane anew, and so on until nothing changes.

A map of the focal plane can be exchanged between detectors and exposures: directions that H does not determine stay
where they are, which keeps the change of the camera as small as it can be.
"""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from ..cameras.detector import affine_of, moved_by
from ..cameras.stated_errors import errors_of, resized, with_errors
from ..exceptions import AssumptionWarning, ConvergenceWarning, InputError, LegdistortError, SolveError, warn
from ..geometry import basis, similarity
from ..priors.prior import Prior
from ..results.errors.camera_errors import CameraErrors, Departure, unit_errors
from ..results.new_positions import widened_all
from ..runtime.checks import check_choice
from ..runtime.words import CAMERA
from .equations import elimination
from .equations.common_parts import followed, response
from .gauge import hierarchy

#: Part of what the data would determine of a direction alone below which it is not determined beside all else: what
#: detectors and exposures can exchange is so to first order, and by the gradient of one times the other beyond.
_WEAK = 1e-5
#: Part of the variance stated that exposures must take away for a direction to count as tested by them.
_TOLD = 0.1
#: Weights of a change of a layout, its shift and the rest, beside that of a static distortion, where a map can be put
#: into either: shifts are the least known.
_SHIFT_WEIGHT, _LAYOUT_WEIGHT = 0.003, 0.03
#: The same where headers have a detector where it lies, as far as the stars tell: shifts are right to 3 px, the rest to
#: 0.1 px (of 2048 pixels 0.01 degrees), and the static distortions of unknown optics are 1 px.
_STATED_SHIFT, _STATED_LAYOUT = 0.1, 10.0
#: Part of a direction that may be left of it where it counts as one of several.
_LIES_IN = 0.3
#: Unknowns of less than this part of the largest of the directions are not judged in units of their own: what
#: directions have of them is of second order, gradients of distortions, or rounding. With 0.001 directions that
#: exposures can take over counted as unknown where static distortions have pixels and a camera tells the layout.
_ROUNDED = 0.03
#: Size of modes of a map [pix] of which what is not rounding moves stars by more than a pixel.
_CLEAR = 10.0
#: Layouts that agree so well [pix] are the same.
_SAME = 1e-6
#: Steps at most, and their length in standard errors at which they end.
_STEPS, _SMALL = 20, 0.01
#: Steps after which directions that are not determined stay the same. One that is at the limit was so in every other
#: step, went back to where it was beforehand, and fits wandered on.
_CHOOSING = 5
#: Part of a step by which the next one must take it back for half steps to be better.
_BACK = 0.5


@dataclass(frozen=True, eq=False)
class CameraStep:
    """One step of the camera.

    Attributes
    ----------
    change : ndarray, shape (n_detectors, 2, n_modes)
        Of the series of the detectors, pixels.
    covariance : ndarray, shape (k, k)
        Of those that are fitted.
    free : ndarray of bool, shape (n_detectors, 2, n_modes)
    spread : ndarray, shape (2, n_stars, k)
        How the stars follow.
    response : ndarray, shape (n_exposures, 2 n_modes, k)
        How the coefficients follow.
    freedom : float
        Number of changes that the data determine rather than what was known.
    weak : ndarray, shape (m, k)
        Directions that are not determined.
    undetermined : ndarray, shape (m, r)
        The same by the numbers of `Sought.root`.
    """

    change: np.ndarray
    covariance: np.ndarray
    free: np.ndarray
    spread: np.ndarray
    response: np.ndarray
    freedom: float
    weak: np.ndarray
    undetermined: np.ndarray

    @property
    def errors(self):
        """Standard deviations (n_detectors, 2, n_modes) of the changes; zero for what is held."""
        return errors_of(self.free, self.covariance)

    @property
    def length(self):
        """Largest change in units of its error."""
        errors = self.errors[self.free]
        return float(np.max(np.abs(self.change[self.free]) / np.where(errors > 0, errors, np.inf), initial=0))


@dataclass(frozen=True, eq=False)
class Sought:
    """What is sought of a camera.

    Attributes
    ----------
    free : ndarray of bool, shape (n_detectors, 2, n_modes)
        Modes that are fitted; those of orders 0 and 1 are the layout.
    prior : ndarray, same shape
        Standard deviations beforehand; infinite where nothing is known.
    covariance : ndarray, shape (n, n), or None
        That of all modes beforehand, where it is known with what they have in common; else they are independent.
    """

    free: np.ndarray
    prior: np.ndarray
    covariance: np.ndarray | None = None

    @classmethod
    def of(cls, matches, layout, static, degree):
        """From the options of `legdistort.solve`; None where the camera is held. Detectors without a position are held.

        Raises
        ------
        InputError
            For a prior without uncertainties.
        """
        camera = matches.camera
        seen, each = np.isin(list(camera.detectors), camera.ids(matches.table)), list(camera.detectors.values())
        top = max([degree, *(basis.degree_of(detector.static.shape[1]) for detector in each)])
        modes = basis.n_modes(top)
        free, prior = np.zeros((len(each), 2, modes), dtype=bool), np.full((len(each), 2, modes), np.inf)
        for kind, part, name in ((layout, slice(0, 3), "layout"), (static, slice(3, modes), "static")):
            widths = [getattr(detector, f"{name}_sigma") for detector in each]
            known = any(w is not None for w in widths)
            kind = kind or ("prior" if known else "hold")
            check_choice(kind, CAMERA, name)
            if kind == "hold":
                continue
            if kind == "prior" and not known:
                raise InputError(
                    f"{name}='prior' needs the uncertainty of every detector (--{name}-sigma, Detector(..., "
                    f"{name}_sigma=)): give it, or {name}='fit' (--{name} fit)"
                )
            fitted = slice(part.start, basis.n_modes(degree)) if name == "static" and kind == "fit" else part
            free[:, :, fitted] = True
            if kind == "prior":
                for k, w in enumerate(widths):
                    padded = np.zeros((2, modes)) if w is None else basis.change_degree(w, top)
                    prior[k, :, fitted] = padded[:, fitted]
            free[:, :, fitted] &= prior[:, :, fitted] > 0
        free[~seen] = False
        joint = resized(camera.covariance, modes, 2 * len(each))
        return cls(free, prior, joint) if free.any() else None

    @cached_property
    def root(self):
        """Free modes (k, r) by numbers that are independent beforehand: of unit size, or not known (see `stated`).

        A change that the covariance beforehand leaves no room for is none of theirs.
        """
        widths = self.prior[self.free]
        known = np.isfinite(widths)
        if self.covariance is None:
            return np.diag(np.where(known, widths, 1.0))
        rows = np.flatnonzero(self.free)[known]
        scaled = self.covariance[np.ix_(rows, rows)] / np.outer(widths[known], widths[known])
        units = widths[known, None] * unit_errors(scaled)
        return np.concatenate([np.eye(len(known))[:, known] @ units, np.eye(len(known))[:, ~known]], axis=1)

    @property
    def stated(self):
        """Which of the numbers of `root` something is known of beforehand, bool (r,)."""
        rows = np.isinf(self.prior[self.free])
        return ~np.any(self.root[rows] != 0, axis=0)

    @cached_property
    def numbers(self):
        """These numbers by changes of the free modes, (r, k)."""
        return np.linalg.pinv(self.root)

    @property
    def of_common_map(self):
        """Uncertainty (2, n_modes) of the mean distortion of the focal plane, which detectors and exposures share."""
        widths = np.where(self.free, self.prior, 0.0)
        return np.sqrt(np.sum(widths**2, axis=0)) / np.count_nonzero(self.free.any(axis=(1, 2)))


def common_widths(camera, sought):
    """Uncertainty (2, n_modes) of what detectors and exposures share, with that which the camera states; None if none.

    Parameters
    ----------
    camera : Camera
    sought : Sought or None
    """
    widths = [w for w in (camera.common_sigma, sought and sought.of_common_map) if w is not None]
    top = max((basis.degree_of(w.shape[1]) for w in widths), default=0)
    return np.sqrt(sum(basis.change_degree(w, top) ** 2 for w in widths)) if widths else None


class CameraFit:
    """The way to the camera that exposures call for.

    Parameters
    ----------
    sought : Sought
    join : callable, optional
        ``join(fit, statics)``, a fit with what else is known of where its stars lie; ``statics`` whether those of the
        detectors are sought.
    """

    def __init__(self, sought, join=None):
        self.sought, self.step, self._departure = sought, None, np.zeros(sought.free.shape)
        self._stated = np.zeros(len(sought.free), dtype=bool)
        self.join = join or (lambda fit, _: fit)

    def settle(self, matches, estimate, *, layout_alone=False):
        """Matches with the camera with which `estimate`, ``estimate(matches)``, gives a fit that calls for no other.

        With its `layout_alone`, of which nothing is known, for a beginning: where that is wrong by tens of pixels,
        static distortions, and maps that only widths determine, would take up what is of it, and lead astray.
        """
        sought, given = self.sought, matches.camera
        if layout_alone:
            free = sought.free & (np.arange(sought.free.shape[2]) < 3)
            if not free.any() or (np.array_equal(free, sought.free) and np.isinf(sought.prior[free]).all()):
                return matches
            sought = Sought(free, np.full(free.shape, np.inf))
        part, last = 1.0, np.zeros(sought.free.shape)
        for number in range(_STEPS):
            with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):  # the fit that comes last warns
                fit = self.join(estimate(matches), bool(sought.free[:, :, 3:].any()))
            held = self.step.undetermined if number >= _CHOOSING else None
            self.step = camera_step(fit, sought, self._departure, self._stated, held)
            # exposures give way to a change that they can undo, and then it comes back: half of it does not
            comes_back = np.vdot(last, self.step.change) < -_BACK * np.vdot(last, last)
            part = part / 2 if comes_back else min(1.0, 2 * part)
            last = part * self.step.change
            self._departure = self._departure + last
            try:
                matches = in_camera(fit.matches, changed(fit.matches.camera, last))
            except LegdistortError as error:  # it folds, or detectors leave the focal plane
                raise SolveError(self._astray(matches, estimate, sought, error)) from None
            if self.step.length < _SMALL:
                break
        if layout_alone:
            self._stated = _confirmed(given, matches.camera)
        return matches

    def _astray(self, matches, estimate, sought, error):
        """What is wrong, and what to do, where the camera that was found is none."""
        camera = matches.camera
        why = str(error).partition(";")[0]
        words = f"no static distortions of the detectors of camera {camera.name} agree with the stars ({why})"
        if sought.free[:, :, :3].any() or len(camera.detectors) < 2:
            return f"{words}; lower the degree, or give a camera that is nearer to the right one (camera=, --camera)"
        free = np.broadcast_to(np.arange(sought.free.shape[2]) < 3, sought.free.shape)
        found = CameraFit(Sought(free, np.full(free.shape, np.inf)), self.join).settle(matches, estimate).camera
        layout = _beside({key: each.layout for key, each in camera.detectors.items()}, found)
        odd = [f"{layout.names[k]} lies {np.hypot(*layout.shifts[k]):.0f} px" for k in np.flatnonzero(~layout.agree)]
        odd = f"detector {', '.join(odd)}" if odd else f"detectors lie up to {layout.scatter:.2g} px"
        return (
            f"{words}: the layout was taken as exact, and the stars contradict it: {odd} from where it has it; give "
            "layout='fit' (--layout fit), which finds it"
        )

    def finished(self, fit):
        """The fit with the settled camera, with the errors of that: in the camera, and in those of the stars.

        Warns
        -----
        ConvergenceWarning
            If the camera did not settle.
        AssumptionWarning
            Naming detectors whose place these exposures do not determine.
        """
        step = self.step
        if step.length >= _SMALL:
            words = f"layouts and static distortions not, whose last step was {step.length:.2g} of their errors"
            fit = replace(fit, result=replace(fit.result, status=f"{fit.result.status}; {words}"))
            warn(f"{words} (of {_STEPS} steps), and errors do not hold: see the check camera", ConvergenceWarning)
        unknown = _unknown(fit.matches.camera, step)
        _tell_unknown(fit.matches, step, unknown)
        camera = with_errors(fit.matches.camera, step.free, step.covariance, unknown)
        camera = replace(camera, common_sigma=common_widths(camera, self.sought), place_errors=None)
        matches = replace(fit.matches, camera=camera)
        unsettled = step.length if step.length >= _SMALL else 0.0
        errors = replace(_errors(fit, step, unknown), departure=self._from_stated(camera), unsettled=unsettled)
        fit = replace(fit, matches=matches, camera_errors=errors, shared_unknowns=step.freedom)
        return _with_common_map(fit, step) if fit.problem.floats else fit

    def _from_stated(self, camera):
        """The `Departure` of what was found from what was stated, None if nothing was.

        With V of what was stated and C of what was found, ``C = (V^-1 + N^-1)^-1``, the departure of the two has the
        covariance V - C: what was stated tested by the exposures alone, whose covariance is N.
        """
        free, stated = self.sought.free, np.isfinite(self.sought.prior[self.sought.free])
        if not stated.any():
            return None
        numbers = self.sought.numbers[self.sought.stated]
        pull = numbers @ self._departure[free]
        left = np.eye(len(numbers)) - numbers @ self.step.covariance @ numbers.T
        share, along = np.linalg.eigh(left)
        told = share > _TOLD
        far = (self._departure[free][stated] / self.sought.prior[free][stated]) ** 2
        most = np.argmax(np.bincount(np.argwhere(free)[stated, 0], far))
        chi2 = np.sum((along[:, told].T @ pull) ** 2 / share[told])
        return Departure(len(numbers), float(chi2), float(np.count_nonzero(told)), list(camera.detectors)[most])


def _beside(stated, found):
    """The `HeaderLayout` of stated layouts (2, 3) of the detectors of a camera beside where they were found."""
    exact = {"layout_sigma": None, "layout_covariance": None}
    each = {k: replace(found[k], header_layout=layout, **exact) for k, layout in stated.items()}
    return replace(found, detectors=each).headers


def _confirmed(given, found):
    """Detectors (n_detectors,) that began, and lie, where their headers have them, bool.

    A camera file knows static distortions too, and these better than where its detectors lie if that is sought.
    """
    stated = {key: each.header_layout for key, each in given.detectors.items()}
    layout = None if any(each is None for each in stated.values()) else _beside(stated, found)
    if layout is None or layout.is_undecided or _beside(stated, given).scatter > _SAME:
        return np.zeros(len(stated), dtype=bool)
    return layout.agree


def _errors(fit, step, unknown):
    """The `CameraErrors` of a step; `unknown` (m, k) are the directions of the camera that nothing determines."""
    good, usual, gauge = fit.blocks.v[0] > 0, elimination.typical_stars(fit.blocks.v), fit.result.gauge
    plain = gauge.modes_at(fit.result.state.positions.T).T
    inverse = np.linalg.pinv(plain[usual])
    changes = unit_errors(step.covariance)
    stars, unknown_stars = np.zeros((len(good), 2, changes.shape[1])), np.zeros((len(good), 2, len(unknown)))
    spread = step.spread @ changes
    common = inverse @ spread[:, usual]
    stars[good] = spread[:, good].transpose(1, 0, 2)
    for group in _groups(fit) if len(unknown) else [good]:  # errors are relative to what something ties a star to
        own = np.linalg.pinv(plain[group & usual])
        stars[group] -= np.einsum("nm,mak->nak", plain[group] @ own, stars[group & usual])
    motion = widened_all(gauge.motion, fit.problem.degree)
    coefficients = step.response @ changes + motion @ common.reshape(-1, changes.shape[1])
    if len(unknown):
        moved = step.spread @ unknown.T
        moved = (moved - plain @ (inverse @ moved[:, usual]))[:, good]
        unknown_stars[good] = (moved / np.sqrt(np.mean(moved**2, axis=(0, 1)))).transpose(1, 0, 2)
    return CameraErrors(step.free, changes, stars, coefficients, unknown_stars)


def _with_common_map(fit, step):
    """The fit whose gauge has the error of the map that all detectors share, where widths keep exposures from it.

    Elsewhere it is in the departures of exposures, which can be exchanged for it.
    """
    usual, gauge = elimination.typical_stars(fit.blocks.v), fit.result.gauge
    positions = fit.result.state.positions.T
    inverse = np.linalg.pinv(gauge.modes_at(positions[usual]).T)

    def of_plane(changes):
        return (inverse @ (step.spread[:, usual] @ changes)).reshape(2 * gauge.n_modes, -1)

    common, weak = of_plane(unit_errors(step.covariance)), of_plane(step.weak.T)
    weak = _CLEAR * weak / np.maximum(np.sqrt(np.mean(weak**2, axis=0)), np.finfo(float).tiny)
    before = [_CLEAR * each.map for each in gauge.unknown_maps]
    unknown = hierarchy.named(np.column_stack([*before, weak]), gauge, positions)
    gauge = replace(gauge, covariance=gauge.covariance + common @ common.T, unknown_maps=unknown)
    return replace(fit, result=replace(fit.result, gauge=gauge))


def _groups(fit):
    """Masks (n_stars,) of the stars of detectors that are tied to one another by stars."""
    used = fit.matches.table[fit.problem.order][fit.used]
    group = np.full(fit.problem.n_stars, -1)
    group[fit.problem.star[fit.used]] = fit.matches.camera.group_of(used)
    return [group == g for g in range(group.max(initial=-1) + 1)]


def _unknown(camera, step):
    """Directions (m, k), of unit rms over the unknowns, that are not determined and no exposure can take over."""
    exchanged = exchanged_maps(camera, step.free)
    scale = np.abs(step.weak).max(axis=0, initial=0)
    scale = np.maximum(scale, max(_ROUNDED * scale.max(initial=0), np.finfo(float).tiny))
    weak, common = (
        step.weak / scale,
        np.linalg.qr((exchanged / scale).T)[0] if len(exchanged) else np.zeros((len(scale), 0)),
    )
    if not len(weak):
        return weak
    weak = np.linalg.qr(weak.T)[0].T
    rest = weak - (weak @ common) @ common.T
    _, size, directions = np.linalg.svd(rest, full_matrices=False)
    out = directions[size > 0.5] * scale
    return out / np.sqrt(np.mean(out**2, axis=1, keepdims=True))


def exchanged_maps(camera, free, degree=None):
    """Changes (m, k) of the free modes of all detectors by common maps of the focal plane, which exposures can undo.

    Of a `degree`, or of that of the free modes.
    """
    modes, out = free.any(axis=(0, 1)), []
    if not modes[:3].all():
        return np.zeros((0, np.count_nonzero(free)))
    degree = basis.degree_of(np.count_nonzero(modes)) if degree is None else degree
    for axis in (0, 1):
        for mode in range(basis.n_modes(degree)):
            change = np.zeros(free.shape)
            for c, chip in enumerate(camera.detectors.values()):

                def moved(u, v, chip=chip, mode=mode, axis=axis):
                    q = basis.denormalize(u, v, chip.shape)
                    f = similarity.apply(similarity.invert(chip.layout), q)
                    value = basis.values(degree, *basis.normalize(f, camera.field))[mode]
                    return np.outer(chip.layout[:, axis], value)

                change[c, :, : basis.n_modes(degree)] = basis.project(moved, degree)
            out.append(change[free])
    return np.array(out)


def _tell_unknown(matches, step, unknown):
    """Warn of directions of the camera that are not determined."""
    if not len(unknown):
        return
    camera, energy = matches.camera, np.zeros(step.free.shape)
    energy[step.free] = (unknown**2).sum(axis=0)
    keys = np.array(list(camera.detectors))
    named = keys[np.argsort(-energy.sum(axis=(1, 2)), kind="stable")][:4]
    groups = camera.groups(matches.table)
    apart = f" (no star in common: {' | '.join(', '.join(group) for group in groups)})" if len(groups) > 1 else ""
    lie = step.free[:, :, :3].any()
    known = "how well the layout is known (layout_sigma)" if lie else "what is known of them (camera=, --camera)"
    warn(
        f"{len(unknown)} unknowns of camera {camera.name} are not determined by these exposures and stay where they "
        f"were, above all of detector {', '.join(named)}{apart}: stars that one detector sees in one exposure and "
        f"another in the next determine how these {'lie' if lie else 'distort'}; dither over the gaps, or say {known}; "
        "if these dithers are larger than the gaps, the layout is too far off to find such stars (camera=, --camera)",
        AssumptionWarning,
    )


def held(matches, layout, static):
    """Matches whose camera states as exact what is to be held of it ("hold"); all that one exposure is not asked of."""
    if len(matches.names) == 1 and matches.camera.has_focal_plane:  # no star goes from one detector to another
        layout, static = layout or "hold", static or "hold"
    exact = {"layout_sigma": None, "layout_covariance": None} if layout == "hold" else {}
    exact |= {"static_sigma": None, "static_covariance": None} if static == "hold" else {}
    if not exact:
        return matches
    detectors = {key: replace(each, **exact) for key, each in matches.camera.detectors.items()}
    return replace(matches, camera=replace(matches.camera, detectors=detectors))


def with_declared_size(matches, prior, static, *, dynamic, degree):
    """Matches whose detectors have the size of their static distortions that a prior without a mean declares.

    As uncertainty of what they state, with which it is fitted. Also what is left of the prior, the scatter of
    exposures, found where none is given, and what is done about static distortions. Other priors, and those of
    plain images, stay.

    Raises
    ------
    InputError
        For static distortions that are to be held.
    """
    declared = isinstance(prior, Prior) and not prior.states_mean and prior.static_sigma is not None
    if not declared or not matches.camera.has_focal_plane:
        return matches, prior, static
    if static == "hold":
        raise InputError(
            "static='hold' (--static hold) takes static distortions of detectors as exact, and the prior declares "
            "their uncertainty (static_sigma, --static-sigma): leave one of them out"
        )
    degree, detectors = 3 if isinstance(degree, str) else degree, {}
    for key, each in matches.camera.detectors.items():
        known = basis.change_degree(each.static, max(degree, basis.degree_of(each.static.shape[1])))
        sigma = np.where(np.arange(known.shape[1]) < 3, 0.0, np.full(known.shape, np.max(prior.static_sigma)))
        detectors[key] = replace(each, static=known, static_sigma=sigma, static_covariance=None)
    matches = replace(matches, camera=replace(matches.camera, detectors=detectors))
    scatter = Prior(None, sigma="evidence")
    if prior.sigma is not None:
        scatter = scatter.with_sigma(prior.sigma, degree=degree)
    return matches, None if dynamic == "detector" else scatter, static and "prior"


def in_camera(matches, camera):
    """The same matches with positions in the focal plane of another camera with the same detectors."""
    table = camera.in_focal_plane(matches.camera.on_detectors(matches.table))
    return replace(matches, table=table, camera=camera)


def camera_step(fit, sought, departure, stated=False, undetermined=None):
    """The `CameraStep` that a `Fit` calls for.

    Parameters
    ----------
    fit : Fit
    sought : Sought
    departure : ndarray, shape (n_detectors, 2, n_modes)
        Of the camera from where it was beforehand.
    stated : ndarray of bool, shape (n_detectors,)
        Those whose headers nothing contradicts: what is not determined of them stays as these state it.
    undetermined : ndarray, shape (m, r), optional
        What counts as not determined, as `CameraStep` has it; by default what the fit does not determine.
    """
    free, root = sought.free, sought.root
    patterns = _patterns(fit.matches, fit.matches.camera, fit.weighted, free)
    follow = followed(response(fit.uncertainty.system, fit.result.gauge), fit.weighted, fit.blocks, patterns)
    precision, before = sought.stated.astype(float), sought.numbers @ departure[free]
    normal, pull = _told(fit, follow, free)
    pull = root.T @ pull - precision * before
    alone = np.einsum("kr,kl,lr->r", root, follow.alone, root)
    half, undetermined = _root_of_inverse(root.T @ normal @ root, precision, alone, undetermined)
    weak = undetermined @ root.T
    held = held_changes(weak, change_weights(free, stated), _slides(fit, free, weak))
    change = np.zeros(free.shape)
    change[free] = held @ root @ (before + half @ (half.T @ pull)) - departure[free]
    known = held @ root @ half
    covariance = known @ known.T
    freedom = float(np.sum(covariance * normal))
    return CameraStep(change, covariance, free, follow.stars[:2], follow.coefficients, freedom, weak, undetermined)


def _patterns(matches, camera, problem, free):
    """Displacements (2, n, k) of what was measured, in the focal plane, by a unit of each free mode."""
    detector = camera.ids(matches.table)[problem.order]
    xy = np.stack([matches.table[f"{axis}_detector"].value[problem.order] for axis in "xy"], axis=1)
    out, of_detector = np.zeros((2, len(xy), np.count_nonzero(free))), np.argwhere(free)[:, 0]
    units = np.eye(free[0].size).reshape(*free[0].shape, -1)
    for c, (key, chip) in enumerate(camera.detectors.items()):
        rows = detector == key
        moved = moved_by(chip, chip.distortion.invert(xy[rows]), units[:, :, free[c].ravel()])
        out[np.ix_([True, True], rows, of_detector == c)] = moved.transpose(1, 0, 2)
    return out


def _told(fit, follow, free):
    """Normal matrix (k, k) and gradient (k,) of what the data tell: nothing of an affine map that all detectors share.

    Poses and exposures take it up exactly. What is left of it is the error of the linearisation, which widths
    beforehand would be weighed against: a common scale went off by 4 %.
    """
    camera = fit.matches.camera
    seen = np.isin(list(camera.detectors), camera.ids(fit.matches.table))
    if fit.result.gauge.poses_known or not free[seen][:, :, :3].all():
        return follow.normal, follow.pull
    unit = 1 / np.sqrt(np.diag(follow.alone))
    common = np.linalg.qr((exchanged_maps(camera, free, 1) / unit).T)[0]
    left = np.eye(len(unit)) - common @ common.T
    scaled = left @ (follow.normal * np.outer(unit, unit)) @ left
    return scaled / np.outer(unit, unit), left @ (unit * follow.pull) / unit


def _root_of_inverse(normal, precision, alone, weak=None):
    """R of the inverse R R' of the sum, (k, n), on what data or prior determine; directions (m, k) that neither does.

    `alone` (k,) is what the data would determine of each unknown if all others were known. Directions `weak` (m, k), if
    they are given, are those.
    """
    unit = 1 / np.sqrt(alone + precision)
    if weak is None:
        values, vectors = np.linalg.eigh(normal * np.outer(unit, unit) + np.diag(precision > 0))
        good = values > _WEAK
        weak = (vectors[:, ~good] * unit[:, None]).T
        known = vectors[:, good] * unit[:, None]
    else:
        known = np.linalg.qr((weak / unit).T, mode="complete")[0][:, len(weak) :] * unit[:, None]
    root = np.linalg.cholesky(known.T @ (normal + np.diag(precision)) @ known)
    return solve_triangular(root, known.T, lower=True).T, weak


def _slides(fit, free, weak):
    """Shifts (m, k) in the focal plane, by the free modes, of groups of detectors that nothing ties to each other.

    No star, nor a catalogue: to move such a group is one of the directions `weak` (w, k) that are not determined.
    """
    camera = fit.matches.camera
    groups = camera.groups(fit.matches.table[fit.problem.order][fit.used])
    rows, moves = np.zeros((2, len(groups), 2, *free.shape))
    for g, group in enumerate(groups):
        for c, (key, chip) in enumerate(camera.detectors.items()):
            if key in group:
                rows[g, :, c, :, 0] = np.linalg.inv(chip.layout[:, :2]) / len(group)
                moves[g, :, c, :, 0] = chip.layout[:, :2].T
    rows, moves = (each[..., free].reshape(2 * len(groups), np.count_nonzero(free)) for each in (rows, moves))
    along = np.linalg.qr(weak.T)[0]
    left = np.linalg.norm(moves - moves @ along @ along.T, axis=1)
    return rows[(left < _LIES_IN * np.linalg.norm(moves, axis=1)) & (len(groups) > 1)]


def change_weights(free, stated):
    """Weights (k,) of the free modes: what of them is not determined stays where it was, the more the larger.

    Static distortions before layouts, which may be wrong by many pixels, and to shift detectors against one another is
    not to bend the focal plane; but layouts that were `stated` (n_detectors,) and not contradicted before these.
    """
    detector, _, mode = np.nonzero(free)
    near = np.broadcast_to(stated, len(free))[detector]
    shift, rest = np.where(near, _STATED_SHIFT, _SHIFT_WEIGHT), np.where(near, _STATED_LAYOUT, _LAYOUT_WEIGHT)
    return np.select([mode == 0, mode < 3], [shift, rest], 1.0)


def held_changes(weak, weights, slides):
    """What takes directions (m, k) that are not determined off a change of the camera, (k, k).

    Parameters
    ----------
    weak : ndarray, shape (m, k)
    weights : ndarray, shape (k,)
        How much of each unknown stays as it was.
    slides : ndarray, shape (m, k)
        Those of `_slides`: groups that no star ties to each other stay where they were, as far as that can be.
    """
    weights = np.concatenate([np.diag(weights), slides])
    return np.eye(len(weights.T)) - weak.T @ np.linalg.pinv(weights @ weak.T) @ weights


def changed(camera, change):
    """The camera with changes (n_detectors, 2, n_modes) of the series of its detectors."""
    detectors = {}
    for k, (key, each) in enumerate(camera.detectors.items()):
        top = max(basis.degree_of(change.shape[2]), basis.degree_of(each.static.shape[1]))
        low = affine_of(change[k, :, :3], each.shape)
        static = basis.change_degree(each.static, top) + basis.change_degree(change[k], top)
        static[:, :3] = 0.0  # the layout, which moves the static distortion along
        layout = similarity.compose(low, each.layout)
        detectors[key] = replace(each, layout=layout, static=static, **_widened(each, top))
    return replace(camera, detectors=detectors)


def _widened(detector, degree):
    """Uncertainties of the static distortion of a detector with the modes of a degree, which it may not have had."""
    sigma = None if detector.static_sigma is None else basis.change_degree(detector.static_sigma, degree)
    return {"static_sigma": sigma, "static_covariance": resized(detector.static_covariance, basis.n_modes(degree))}
