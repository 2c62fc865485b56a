"""What is known of the static distortions of detectors, from a map, a camera or a night, with its covariance."""

from dataclasses import dataclass, replace

import numpy as np
from astropy import units as u
from scipy import linalg, special

from ..cameras.camera import Camera
from ..cameras.detector import map_alone, maps_of_plane, widths_alone
from ..cameras.stated_errors import FREE, resized
from ..exceptions import InputError
from ..geometry import basis, detector_modes
from ..geometry.distortion import Distortion
from ..matching.matches import Matches
from ..priors.prior import Prior
from ..results.errors.common_distortion import NOTHING, common_distortion, scatter_of_mean
from ..results.solution import Solution
from ..solving import single_fit
from ..solving.equations.reduced_system import DIRECT_LIMIT
from ..solving.gauge.constraints import absorb_similarities
from ..solving.knowledge.exposures import RANGE, ExposureModel
from ..solving.knowledge.factors import Factor
from ..solving.knowledge.posterior import Posterior, most_likely
from ..solving.knowledge.reduced_data import drawn, part_of
from ..solving.options import SolveOptions

#: A coefficient of 1 px displaces by sqrt(1/8) px rms per axis: b_m has mean square 1/4.
MEAN_SQUARE = 8
#: Information [pix^-2] from which a direction is determined: its error is 0.3 px at most, rms per axis over a detector.
DETERMINED = 1 / (MEAN_SQUARE * 0.3**2)
#: What depends on time, or on a number, is kept if it makes twice the logarithm of the likelihood larger by so much.
KEPT = 6.0
_ROUNDS = 3
_KEPT = "loss", "motion", "motion_sigma", "motion_epoch", "night_sigma"  # settings of a night
_MOST = 500  # coefficients from which the scatter of exposures is found
_FEWEST = 1  # degrees of freedom of a scatter
_LARGER = 1.1  # sizes, by which a derivative is taken


def chance(chi2, k, dof):
    """Probability of so large a chi2 of k values, whose variances have some degrees of freedom; 1 for no value."""
    if not k:
        return 1.0
    return float(special.fdtrc(k, dof, chi2 / k) if np.isfinite(dof) else special.chdtrc(k, chi2))


@dataclass(frozen=True, eq=False)
class KnownMap:
    """What is known of static distortions, ``{detector: (2, n_modes)}``, of detectors of some shapes.

    Attributes
    ----------
    label : str
    statics, shapes : dict
    covariance : ndarray or None
        Of all coefficients, one detector after the other, x modes first; None where no error is stated.
    dof : float
        Degrees of freedom of a covariance that is estimated from the scatter of exposures.
    degree : int or None
        Modes beyond are not known.
    is_named : bool
        Whether it is a map of one detector that its file names.
    """

    label: str
    statics: dict
    shapes: dict
    covariance: np.ndarray | None = None
    dof: float = np.inf
    degree: int | None = None
    is_named: bool = False

    @property
    def highest(self):
        """Degree of the coefficients that there are."""
        return max(basis.degree_of(each.shape[1]) for each in self.statics.values())


def follows(thing):
    """Whether what a solution, nights, a camera or a prior know is reckoned from a map that they are compared with.

    One detector of which a night shows little is near that, and detectors in a focal plane are after a common map of
    the plane, which their exposures take over where no reference told it.
    """
    if isinstance(thing, Solution):
        return not thing.camera.has_focal_plane or thing.gauge.tie is None
    if isinstance(thing, Camera):
        return thing.common_map is None and _n_found(thing) > 0
    return not isinstance(thing, Prior) and thing.has_focal_plane  # nights


def known_map(thing, label, other=None):
    """What a solution, nights, a camera or a prior know; the `other` is that of what it is compared with."""
    if isinstance(thing, Solution):
        if thing.camera.has_focal_plane:
            return _of_focal_plane(thing, label, other)
        return _of_night(thing, label, next(iter(other.statics.values())) if other else None)
    if isinstance(thing, Camera):
        return _of_camera(thing, label, other)
    if not isinstance(thing, Prior):
        if thing.has_focal_plane:
            return _of_camera(thing.camera(), label, other, thing.static(further_night=True)[1])
        return _of_nights(thing, label)
    covariance = _stated(thing)
    named = thing.source.get("detector") if isinstance(thing.source, dict) else None
    key = named or "1"
    return KnownMap(label, {key: thing.mean}, {key: thing.shape}, covariance, is_named=named is not None)


def _stated(thing):
    """Covariance of the coefficients of a prior, or of a detector that is no part of a focal plane; None without."""
    if thing.static_covariance is not None:
        return np.where(np.isinf(thing.static_covariance), NOTHING**2, thing.static_covariance)
    widths = thing.static_sigma
    return None if widths is None else np.diag(np.minimum(widths.ravel(), NOTHING) ** 2)


def _of_nights(nights, label):
    """What a further night has, with all covariances."""
    static, covariance = nights.static(further_night=True)
    return KnownMap(nights.name if label.startswith("the ") else label, {"1": static}, {"1": nights.shape}, covariance)


def _of_camera(camera, label, other=None, covariance=None):
    """The detectors of a camera, the shear of whose layouts is a part of their maps; perhaps with a joint covariance.

    One that was found from exposures knows nothing of a map that all its detectors share, which these took over, unless
    a reference told it: it is that after which they are nearest to the `other` map.
    """
    n, common = _n_found(camera), camera.common_map
    sigma = NOTHING
    if common is not None:
        n, sigma = common.shape[1], np.minimum(camera.common_sigma.ravel(), NOTHING)
    elif n and other is not None:
        common = _nearest(camera, n, other)
    statics = _statics(camera, common)
    shapes = {key: each.shape for key, each in camera.detectors.items()}
    widths, joint = [each.static_sigma for each in camera.detectors.values()], covariance
    if not camera.has_focal_plane:
        (detector,) = camera.detectors.values()
        covariance = _stated(detector)
    elif any(each is not None for each in widths):
        widths = [widths_alone(each, statics[key].shape[1]) for key, each in camera.detectors.items()]
        alone = np.diag(np.concatenate([np.minimum(each.ravel(), NOTHING) ** 2 for each in widths]))
        if joint is None and len({each.shape for each in widths}) == 1:
            joint = resized(camera.covariance, widths[0].shape[1], 2 * len(widths))
        covariance = alone if joint is None else np.where(np.isinf(joint), NOTHING**2, joint)
        if n:
            maps = [maps_of_plane(each, camera.field, n).reshape(2, n, -1) for each in camera.detectors.values()]
            whole = [np.pad(each, ((0, 0), (0, max(w.shape[1] - n, 0)), (0, 0)))[:, : w.shape[1]]
                     for each, w in zip(maps, widths, strict=True)]  # fmt: skip
            shared = np.concatenate([each.reshape(-1, 2 * n) for each in whole])
            covariance = covariance + (sigma * shared) @ (sigma * shared).T
    return KnownMap(camera.name if label.startswith("the ") else label, statics, shapes, covariance)


def _statics(camera, common):
    """Coefficients of the detectors of a camera after a map of its focal plane, modes (2, n), or None."""
    plane = None if common is None else Distortion(common, camera.field)
    return {key: map_alone(each, plane)[1] for key, each in camera.detectors.items()}


def _nearest(camera, n, other):
    """The map of a focal plane, modes (2, n), after which the detectors of a camera are nearest to another `KnownMap`.

    As `legdistort.assessment.nights.camera_changes` brings the cameras of nights to one: what two have otherwise by a
    map that nothing tells may be large, and is not linear.
    """
    common, both = np.zeros((2, n)), [key for key in camera.detectors if key in other.statics]
    rows = {key: detector_modes.dynamic_basis(camera[key].shape, n) for key in both}
    to_rows = [rows[key] @ maps_of_plane(camera[key], camera.field, n) for key in both]
    for _ in range(_ROUNDS * bool(both)):
        statics = _statics(camera, common)
        away = [
            rows[key] @ np.subtract(*(_pointed(each[key], camera[key].shape, n) for each in (other.statics, statics)))
            for key in both
        ]
        common = common + np.linalg.lstsq(np.vstack(to_rows), np.concatenate(away))[0].reshape(2, n)
    return common


def _pointed(static, shape, n):
    return basis.change_degree(detector_modes.pointed(static, shape), basis.degree_of(n)).ravel()


def _n_found(camera):
    """Number of modes (per axis) of the static distortions that were found from exposures; 0 for another camera."""
    sigmas = [each.static_sigma for each in camera.detectors.values() if each.layout_covariance is not None]
    if len(sigmas) < len(camera.detectors) or any(each is None for each in sigmas):
        return 0
    highest = max(int(np.flatnonzero(np.any(each, axis=0)).max(initial=0)) for each in sigmas)
    return next(n for n in map(basis.n_modes, range(1, basis.MAX_DEGREE + 1)) if n > highest) if highest else 0


def _of_focal_plane(solution, label, other):
    """The detectors of a camera that was fitted, with what its exposures have in common.

    Of layouts that were held nothing is known, nor of what nothing determined of those that were fitted.
    """
    errors, camera = solution.estimate.uncertainty.camera, solution.camera
    if errors is None or not errors.free[:, :, 3:].any():
        raise InputError(
            f"{label} was solved with the static distortions of camera {camera.name} as given, and says nothing of "
            "them: solve it with static='fit' (--static fit)"
        )
    n = int(np.flatnonzero(errors.free.any(axis=(0, 1))).max()) + 1  # what is beyond was given, and not asked
    free = errors.free[:, :, :n]
    maps = np.concatenate([maps_of_plane(each, camera.field, n) for each in camera.detectors.values()])
    mean, covariance, shared = common_distortion(solution, n)
    common = mean.reshape(2, n)
    if solution.gauge.tie is None and other is not None:
        common = _nearest(camera, n, other)
    moved = maps @ shared
    moved[free.ravel()] += errors.changes
    unseen = ~free
    unseen[:, :, :3] |= [np.isinf(each.layout_sigma) if each.layout_sigma is not None else np.ones((2, 3), dtype=bool)
                         for each in camera.detectors.values()]  # fmt: skip
    covariance = maps @ covariance @ maps.T + moved @ moved.T + np.diag(NOTHING**2 * unseen.ravel())
    shapes = {key: each.shape for key, each in camera.detectors.items()}
    statics = {key: detector_modes.pointed(each, shapes[key]) for key, each in _statics(camera, common).items()}
    degree = basis.degree_of(n)
    statics = {key: basis.change_degree(each, degree) for key, each in statics.items()}
    name = camera.name if label.startswith("the ") else label
    dof = _freedom_by_scatter(solution, covariance, maps, shapes.values())
    return KnownMap(name, statics, shapes, covariance, dof, degree)


def _freedom_by_scatter(solution, covariance, maps, shapes):
    """Degrees of freedom of the covariance of detectors, which rests on how exposures scatter about a common map.

    Those by which the scatter tells its determinant, in the directions that count; infinite if it is no part of it.
    """
    scattered, n = scatter_of_mean(solution), maps.shape[1] // 2
    if scattered is None or solution.gauge.tie is None:
        return np.inf
    rows = linalg.block_diag(*[detector_modes.dynamic_basis(each, n) for each in shapes])
    power, directions = np.linalg.eigh(rows @ covariance @ rows.T)
    counted = (power < 1 / DETERMINED) & (power > 0)
    to_plane = directions[:, counted].T @ rows @ maps @ np.kron(np.eye(2), np.eye(n, basis.n_modes(solution.degree)))
    shares = [np.sum(to_plane @ part * to_plane / power[counted, None]) for part, _ in scattered]
    freedom = np.array([max(each, _FEWEST) for _, each in scattered])
    return _joint_freedom(np.array(shares) / max(np.count_nonzero(counted), 1), freedom)


def _of_night(solution, label, other):
    """The static distortion of the exposures of one detector, from all but what was known of it."""
    night = shown_by(solution, label, other)
    sizes, vectors = np.linalg.eigh(night.information)
    covariance = vectors / np.maximum(sizes, NOTHING**-2) @ vectors.T
    rows = detector_modes.dynamic_basis(night.shape, night.around.shape[1])
    return KnownMap(label, {"1": night.around}, {"1": night.shape}, rows.T @ covariance @ rows, night.dof, night.degree)


@dataclass(frozen=True, eq=False)
class Shown:
    """What exposures of one detector show of its static distortion, from all but what was known of it.

    ``-2 ln L = z' information z - 2 pull' z`` for a step z of the coefficients, in the order of
    `legdistort.geometry.detector_modes.dynamic_basis`, from a map; where exposures have a number, z goes on with K
    slopes by it, and the map is that of the mean number.

    Attributes
    ----------
    around : ndarray, shape (2, n_modes)
        That map: what they show where they determine it, the rest as it was.
    information : ndarray, shape (K, K) or (2 K, 2 K)
    pull : ndarray, shape (K,) or (2 K,)
    scatter : ndarray, shape (degree,)
        Of exposures about it, or about their night, by degree, pixels.
    nightly : ndarray, shape (degree,), or None
        Of nights about it, which is in the information; None if there is one night.
    dof : float
        Degrees of freedom of the scatter that the information rests on.
    degree : int
    shape : tuple
    """

    around: np.ndarray
    information: np.ndarray
    pull: np.ndarray
    scatter: np.ndarray
    nightly: np.ndarray | None
    dof: float
    degree: int
    shape: tuple


def shown_by(solution, label, other=None, numbers=None):
    """What the exposures of a solution show of the static distortion of their detector (`Shown`).

    It is solved again around what it shows and, where it shows nothing, around the `other` map (2, n_modes) or None, so
    that a common map of the plane is small, and what is linear in it exact. Exposures and nights scatter about it by
    what they show (`legdistort.solving.knowledge.exposures.ExposureModel`), and depend linearly on `numbers`, a dict by
    exposure, if these are given and the evidence is for it; what they show of the slopes is not left out then either.
    """
    shapes = set(solution.estimate.shapes.values())
    if len(shapes) > 1:
        raise InputError(f"{label} has detectors of several shapes, {sorted(shapes)}: it gives no single map")
    shape, matches = shapes.pop(), _at_errors_in_force(solution)
    if len(matches.names) < 2:
        raise InputError(
            f"{label} has one exposure, {matches.names[0]}, which alone does not tell the static distortion from its "
            "own departure: bring it into a night of others, solve(new, base=night) (legdistort solve TABLE --base "
            "NIGHT), and give what that finds"
        )
    degree, n = solution.degree, basis.n_modes(solution.degree)
    around = solution.coefficients[:, :, :n].mean(axis=0) if other is None else basis.change_degree(other, degree)
    around, rows = detector_modes.pointed(around, shape), detector_modes.dynamic_basis(shape, n)
    kept, fit = {name: getattr(solution.settings, name) for name in _KEPT}, None
    for _ in range(_ROUNDS):
        options = SolveOptions(degree=degree, prior=Prior(around, shape=shape), clip=None, **kept)
        fit = single_fit.estimate(matches, options, near=fit)
        number = None if numbers is None else np.array([numbers[name] for name in fit.problem.names])
        information, pull, sizes_found, dof = _shown(fit, number)
        k = len(rows)
        sizes, vectors = np.linalg.eigh(information[:k, :k])
        found = np.where(sizes > DETERMINED, 1 / np.maximum(sizes, DETERMINED), 0)  # others stay where they are
        step = vectors * found @ vectors.T @ pull[:k]
        around = around + (rows.T @ step).reshape(2, n)
    nightly = None if fit.problem.n_nights == 0 else sizes_found[degree:]
    if nightly is not None and fit.problem.night_sigma is not None:
        nightly = np.full(degree, float(fit.problem.night_sigma))
    pull = pull - information[:, :k] @ step
    return Shown(around, information, pull, sizes_found[:degree], nightly, dof, degree, shape)


def sound(solution):
    """Rows of the residuals that were used, (n,), but for nights that depart farther than the others."""
    nights = solution.nights
    odd = {name for exposures in nights["exposures"][nights["odd"]] for name in exposures.split(", ")}
    table = solution.residuals
    return np.asarray(table["used"]) & ~np.isin(np.asarray(table["exposure"]), list(odd))


def _at_errors_in_force(solution):
    """The matches that were used, but for those of odd nights, with errors as they counted."""
    used = solution.residuals[sound(solution)]
    kept = [name for name in used.colnames if name not in ("dx", "dy", "used")]
    table, covariance = used[kept], solution.diagnostics.errors_of(used)
    for name, variance in zip(("x_err", "y_err"), (covariance[:, 0, 0], covariance[:, 1, 1]), strict=True):
        table[name] = np.sqrt(variance) * u.pix
    if "xy_corr" in kept:
        table["xy_corr"] = covariance[:, 0, 1] / np.sqrt(covariance[:, 0, 0] * covariance[:, 1, 1])
    return Matches.from_table(table, shape=next(iter(solution.estimate.shapes.values())), poses=solution.poses)


def _shown(fit, number=None):
    """What exposures say of their static distortion from the prior: information (K, K), pull (K,), sizes, dof.

    With a number (n_exposures,) also of its slopes: (2 K, 2 K) and (2 K,). Sizes are found with nothing known of it,
    from exposures drawn at random where these are many; with slopes if the evidence is for these. The degrees of
    freedom are those by which they tell the determinant of the information, in the directions that count. Terms beyond
    the degree that exposures have in common are unknowns of a size that is found, so that nothing is known by believing
    that there are none.
    """
    varies = number is not None and np.ptp(number) > 0
    unit = np.std(number) if varies else 1.0
    away = (number - np.mean(number)) / unit if varies else None
    problem, state = fit.weighted, absorb_similarities(fit.weighted, fit.result.state)
    top = 2 * problem.degree - 1 if problem.degree > 1 else None  # a common map of the plane bends as far

    def known(most):
        keep = drawn(problem.detectors, most // (2 * problem.n_modes))
        part = part_of(problem, state, keep)
        model = ExposureModel.of(*part, fit.result.gauge.all_motion[keep], np.zeros(len(keep), dtype=int), top=top)
        return replace(model, number=away[keep]) if varies else model

    model = known(_MOST)
    found, n_sizes = _sizes_of(model), model.n_scatters
    model = known(DIRECT_LIMIT)
    closure = [model.closure(size=n_sizes)] if top else []
    k, free = len(model.degrees), Factor.joined([model.statics(width=FREE), model.slopes(width=FREE)])
    whole = Posterior(model.data, Factor.joined([model.departures, *closure, free]), found.sizes[: n_sizes + bool(top)])
    information, pull = whole.without(free)
    sizes, vectors = np.linalg.eigh(information[:k, :k])
    directions = vectors[:, sizes > DETERMINED].T

    def certain(posterior):
        information = posterior.without(free)[0][:k, :k]
        return np.linalg.slogdet(directions @ information @ directions.T)[1] / max(len(directions), 1)

    larger = whole.sizes * (1 + (_LARGER - 1) * np.eye(n_sizes, len(whole.sizes)))
    share = certain(whole) - np.array([certain(replace(whole, sizes=each)) for each in larger])
    share /= 2 * np.log(_LARGER)
    dof = _joint_freedom(share, np.maximum(_freedom(found)[:n_sizes], _FEWEST))
    if number is not None:
        information, pull = np.pad(information, (0, 2 * k - len(pull))), np.pad(pull, (0, 2 * k - len(pull)))
        per = np.repeat([1.0, unit], k)
        information, pull = per[:, None] * information * per, per * pull
    return information, pull, whole.sizes[:n_sizes], dof


def _sizes_of(model):
    """The posterior at the scatters that are most likely, with slopes of a size that is found if evidence is for it."""
    unit, found = 1 / np.sqrt(np.median(np.diag(model.data.curvature))), None
    for each in (replace(model, number=None), model)[: 1 + (model.n_slopes > 0)]:
        n_sizes = each.n_scatters + (model.n_higher > 0)
        closure = [each.closure(size=each.n_scatters)] if model.n_higher else []
        sloped = each.slopes(size=n_sizes)
        factor = Factor.joined([each.departures, *closure, each.statics(width=FREE), sloped])
        start = np.full(n_sizes + (each.n_slopes > 0), 10 * unit)
        likely = most_likely(each.data, factor, start, unit * np.array(RANGE))
        if found is None or found.cost - likely.cost > KEPT:
            found = likely
    return found


def _joint_freedom(share, freedom):
    """Degrees of freedom of a covariance, from shares of squared sizes in the logarithm of its determinant and theirs.

    Shares are those a direction.
    """
    return float(1 / np.sum(share**2 / freedom + 1e-12))


def _freedom(posterior):
    """Degrees of freedom of squared sizes that were found, (n_sizes,): twice their square over its variance."""
    width, label = posterior.widths, posterior.factor.size
    left = (np.eye(len(width)) - posterior.of_rows / width / width[:, None]) ** 2
    return np.array([left[np.ix_(label == j, label == j)].sum() for j in range(len(posterior.sizes))])
