"""A solution in tables and words: its stars, and what `print` and notebooks show of it."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time

from ..cameras import places, ties
from ..cameras.star_scales import flux_factors
from ..exceptions import by_reason, some_of
from ..geometry import basis
from ..geometry.epochs import year
from ..inputs import column_contract
from ..runtime.notebook import Column, Fact, Grid, Heading, Sentence
from ..runtime.words import UNSTATED
from . import accuracy, new_positions, nights
from . import motions as star_motions
from .check import in_facts
from .errors import absolute_errors, common_maps, pose_errors


def stars(solution, time=None):
    """`Solution.stars`, or `Solution.stars_at` a time; see there."""
    estimate, sky, motions = solution.estimate, solution.sky, solution.estimate.motions
    xy, at = estimate.positions, epoch(solution) if time is None else year(time)
    variance = absolute_errors.relative_variance(solution.gauge, estimate.uncertainty, xy)
    absolute, known = (_absolute(solution, without_unknown) for without_unknown in (False, True))
    covariances = () if motions is None else _unknowns(solution)
    if time is not None:
        bent, more = _along_paths(solution, at)
        xy = xy + star_motions.fitted(motions).displacement(at, sky) + bent
        before, covariances = covariances, [motions.carried(each, at, sky) + more for each in covariances]
        added = [absolute_errors.variances(late - early) for early, late in zip(before, covariances, strict=True)]
        variance, absolute, known = variance + added[0], absolute + added[1], known + added[1]
    table = _places(solution, xy, err=variance, err_abs=absolute, err_known=known)
    used = solution.residuals[solution.residuals["used"]]
    index = np.searchsorted(estimate.star_names, used["star"])
    table["n"] = np.bincount(index, minlength=len(table))
    if (tie := solution.gauge.tie) is not None and tie.known is not None:
        table["reference_used"] = np.isin(estimate.star_names, tie.stars[tie.used])
    if solution.gauge.n_fields > 1:
        known = np.isfinite(estimate.positions[:, 0])
        table["field"] = np.where(known, 1 + solution.gauge.plane_modes().fields_of(estimate.positions), 0)
    if solution.camera.has_focal_plane and _are_apart(solution, used):
        table["group"] = np.full(len(table), -1)
        table["group"][index] = solution.camera.group_of(used)
    factors = flux_factors(solution)
    if "flux" in used.colnames:
        flux = used["flux"] * factors.of_rows(used, solution.camera)
        with np.errstate(invalid="ignore"):
            table["flux"] = np.bincount(index, flux, len(table)) / table["n"]
    obstime = None if at is None else Time(at, format="jyear")
    if sky is not None:
        new_positions.add_sky(table, sky, xy, variance, absolute)
        table["sky"] = SkyCoord(table["ra"], table["dec"], frame="icrs", obstime=obstime)
    if motions is not None:
        covariances[1] = absolute_errors.without_unknown_motions(solution.gauge, covariances[1])
        star_motions.add_motions(table, motions, *covariances, xy, sky)
        if sky is not None:
            moving = {"pm_ra_cosdec": table["pmra"], "pm_dec": table["pmdec"]}
            table["sky"] = SkyCoord(table["ra"], table["dec"], **moving, frame="icrs", obstime=obstime)
    table.meta = _meta(solution) | {"epoch": at}
    return column_contract.describe_stars(table, one_scale=not factors.unknown)


def _along_paths(solution, time):
    """What paths that are not straight add at a time: displacements (n_stars, 2), covariances (n_stars, 2 + k, 2 + k).

    Their errors go with those of position and motion.
    """
    estimate = solution.estimate
    bent, responses = star_motions.curved(solution, time)
    if not responses.any():
        return bent, 0.0
    change = estimate.motions.change(time, solution.sky)
    straight = change @ estimate.uncertainty.camera.of_stars(len(change)).transpose(1, 0, 2)
    whole = straight.copy()
    whole[:, :2] += common_maps.without_positions(solution.gauge, estimate, responses)
    return bent, whole @ whole.mT - straight @ straight.mT


def _are_apart(solution, used):
    """Whether nothing determines how groups of detectors lie to each other, by the observations used."""
    errors = solution.estimate.uncertainty.camera
    return errors is not None and errors.unknown.shape[2] > 0 and len(solution.camera.groups(used)) > 1


def higher_static(solution):
    """See `Solution.higher_static`."""
    errors, n = solution.estimate.uncertainty.camera, basis.n_modes(solution.degree)
    if errors is None or errors.owner is None:
        return None
    owners, first = np.unique(errors.owner, return_index=True)
    values = solution.estimate.prior_mean[first, :, n:]
    error = np.sqrt(np.sum(errors.changes**2, axis=1)).reshape(values.shape)
    m_order, n_order = (orders[n:] for orders in basis.orders(basis.degree_of(n + values.shape[2])))
    out = QTable()
    out["detector"] = np.repeat([solution[solution.names[i]].detectors[0] for i in first], values.shape[2])
    out["m"], out["n"] = np.tile(m_order, len(owners)), np.tile(n_order, len(owners))
    for suffix, each in (("", values), ("_err", error)):
        out[f"x{suffix}"], out[f"y{suffix}"] = each.swapaxes(0, 1).reshape(2, -1) * u.pix
    return out


def terms(solution):
    """See `Solution.terms`."""
    rows = [
        (each.name, owner, number, value, error, each.unit, each.size, each.gain)
        for each in solution.diagnostics.terms
        for owner, number, value, error in zip(
            each.owners, each.numbers, each.values, each.errors or [np.nan] * len(each.values), strict=True
        )
    ]
    names = ("term", "owner", "number", "value", "error", "unit", "size", "gain")
    return QTable(rows=rows or None, names=names, dtype=[str] * 3 + [float] * 2 + [str] + [float] * 2)


def epoch(solution):
    """Julian year of the positions of the stars, or None."""
    motions = solution.estimate.motions
    return solution.diagnostics.epoch if motions is None else motions.epoch


def _places(solution, xy, **variances):
    """Table of the stars at positions (n_stars, 2), with errors of variances xx, yy, xy (3, n_stars) by suffix."""
    table = QTable({"star": solution.estimate.star_names, "x": xy[:, 0] * u.pix, "y": xy[:, 1] * u.pix})
    for suffix, each in variances.items():
        table[f"x_{suffix}"], table[f"y_{suffix}"] = np.sqrt(each[:2]) * u.pix
    xx, yy, both = variances["err"]
    table["xy_corr"] = both / np.sqrt(xx * yy)
    return table


def _absolute(solution, without_unknown):
    estimate = solution.estimate
    return absolute_errors.absolute_variance(
        solution.gauge, estimate.uncertainty, estimate.positions, without_unknown=without_unknown
    )


def _unknowns(solution):
    """Relative and absolute covariance (n_stars, 2 + k, 2 + k) of positions, motions and parallaxes."""
    known = solution.gauge, solution.estimate.uncertainty, solution.estimate.positions
    return [absolute_errors.relative_blocks(*known), absolute_errors.absolute_blocks(*known)]


def _meta(solution):
    """What must be known of a table of stars by itself, in words and numbers that any file can hold."""
    prior = solution.settings.prior
    if isinstance(prior, dict):
        prior = prior.get("source", "one for each detector or exposure")
    if isinstance(prior, dict):
        prior = prior.get("name", "")
    meta = {
        "frame": "reference plane" if solution.sky is None else "ICRS",
        "epoch": epoch(solution),
        "gauge": solution.gauge.kind,
        "motions": solution.gauge.rates_in_words or None,
        "degree": solution.degree,
        "pixel_scale": pixel_scale(solution),
        "prior": None if solution.settings.prior is None else str(prior or "given"),
        "version": f"legdistort {solution.provenance.get('versions', {}).get('legdistort', '')}".strip(),
    }
    return {key: value for key, value in meta.items() if value is not None}


def rms(solution):
    """Unweighted rms residual (2,) per axis of the used observations, pixels."""
    used = solution.residuals["used"]
    return np.array([np.sqrt(np.mean(solution.residuals[d][used].to_value(u.pix) ** 2)) for d in ("dx", "dy")])


def pixel_scale(solution):
    """Arcsec a pixel: that of the sky if there is one, else that stated; None without either."""
    stated = solution.settings.pixel_scale if solution.sky is None else solution.sky.pixel_scale
    return None if stated is None else float(stated)


def in_mas(solution):
    """Figures in mas where the sky is known or a pixel scale was stated; else None.

    ``pixel_scale_arcsec``; ``rms_mas``, residuals per axis; medians over the stars of ``error_mas``, ``error_abs_mas``,
    ``motion_error_mas_yr``, ``motion_error_abs_mas_yr``: None where nothing is known.
    """
    scale = pixel_scale(solution)
    if scale is None:
        return None
    stars, found = (
        solution.stars,
        {"pixel_scale_arcsec": scale, "rms_mas": 1000 * scale * float(np.sqrt(np.mean(rms(solution) ** 2)))},
    )
    for name, kind in (("error", "_err"), ("error_abs", "_err_abs")):
        for prefix, axes, unit in (("", "xy", "_mas"), ("motion_", ("vx", "vy"), "_mas_yr")):
            columns = [stars[f"{axis}{kind}"].value for axis in axes if axis in stars.colnames]
            known = np.concatenate([each[np.isfinite(each)] for each in columns]) if columns else np.zeros(0)
            found[f"{prefix}{name}{unit}"] = 1000 * scale * float(np.median(known)) if len(known) else None
    return found


def mas_sentence(solution):
    """The same in words; empty without a pixel scale."""
    found = in_mas(solution)
    if found is None:
        return ""
    out = f"at {found['pixel_scale_arcsec']:.6g} arcsec a pixel: residuals {found['rms_mas']:.3g} mas rms per axis"
    for what, unit in (("error", "mas"), ("motion_error", "mas_yr")):
        own, whole = (found[f"{what}{kind}_{unit}"] for kind in ("", "_abs"))
        if own is not None:
            subject = "median errors of stars" if what == "error" else "of motions"
            out += f"; {subject} {own:.3g} {unit.replace('_', '/')}"
            out += ", absolute not known" if whole is None else f", absolute {whole:.3g}"
    return out


def folds(solution):
    """Images whose map cannot be inverted, ``{label of the view: reason}``."""
    return {part.label: part.fold for view in solution for part in view.parts if part.fold}


def largest_inverse_error(solution):
    """Largest certified round-trip error over all exposures that can be inverted, pixels; NaN without one."""
    inverted = [view for view in solution if not all(part.fold for part in view.parts)]
    return max((view.distortion.inverse.error for view in inverted), default=np.nan)


def sky_sentence(solution):
    """Where the reference plane lies on the sky, and how that is known."""
    sky = solution.sky
    if sky is None:
        return "not known: no WCS in the headers that proved right, no reference catalogue with ra, dec"
    source = {"exposures": "from the headers", "reference": "from the reference"}.get(solution.diagnostics.sky, "")
    tied = ", tied to the reference" if source and solution.gauge.tie is not None and "head" in source else ""
    odd = () if solution.camera.headers is None else solution.camera.headers.odd
    odd = odd or (() if solution.diagnostics.pointing is None else tuple(solution.diagnostics.pointing.detectors))
    if "head" in source and not tied and odd:
        source += f" of all detectors but {some_of(odd, 6)}"
    pointing = None if solution.gauge.poses_known else solution.diagnostics.pointing
    if source == "from the headers" and not tied and pointing is not None and pointing.off:
        source += f" of {pointing.n_used} of {pointing.n_used + len(pointing.off)} exposures"
    camera = solution.camera
    of_camera = (camera.name, camera.header_errors) if camera.states_scale else ()
    told = pointing is not None and "head" in source and not tied
    known = pointing.error(sky.pixel_scale, *of_camera) if told else ""
    source += f"; {known}" if known else ""
    words = f"tangent point {sky.lon:.6f} {sky.lat:+.6f} deg, {sky.pixel_scale:.5g} arcsec/px"
    return f"{words}{', ' * bool(source)}{source}{tied}"


def camera_sentence(solution):
    """Which camera it is, and what of it the exposures do not determine; empty without one."""
    camera = solution.camera
    if not camera.has_focal_plane:
        return ""
    ny, nx = camera.field
    ids = ", ".join(camera.detectors)
    words = f"{camera.name}, detectors {ids}; positions in its focal plane, {nx} x {ny} px"
    if apart := ties.apart(camera, solution.residuals):
        words += f"; {apart}"
        held = any(np.isinf(each.place.errors).any() for each in camera.detectors.values() if each.place.errors)
        words += ", so that their places relative to each other are not determined" * held
    words += f"; {common}" if (common := _common_stars(camera, solution.residuals)) else ""
    common = camera.common_sigma
    if common is not None and np.isinf(common[:, 1:3]).any() and "shear" in solution.gauge.unknown_names:
        words += (
            "; a shear of all detectors together is not determined: the exposures are not turned enough against one "
            "another"
        )
    return words


def _common_stars(camera, table):
    """How many stars pairs of detectors have in common, the fewest first, in words; empty without any."""
    listed = []
    for each in sorted(ties.pairs(camera, table), key=lambda pair: pair["n_used"]):
        of = f" of {each['n_stars']}" if each["n_used"] < each["n_stars"] else ""
        listed.append(f"{' and '.join(each['detectors'])} {each['n_used']}{of}")
    return f"stars used on both of two detectors: {some_of(listed, 6)}" if listed else ""


def goodness(fit):
    """Chi2 of a solution, or of a fit, in words."""
    if fit.dof < 0.5:
        return "as many unknowns as data, which nothing tests"
    return f"chi2 {fit.chi2:.1f} for {fit.dof:.0f} degrees of freedom"


def parts(solution):
    """What `print` and a notebook show: verdict, facts, a row for every exposure."""
    used, motions, n = solution.residuals["used"], solution.estimate.motions, len(solution.residuals)
    both = rms(solution)
    facts = {
        "status": solution.status,
        "camera": camera_sentence(solution),
        "fields": _fields_in_words(solution),
        "static": _static_in_words(solution),
        "odd": next((c.sentence for c in solution.checks if c.name == "dynamic part" and c.tests), ""),
        "gauge": solution.gauge.sentence,
        "sky": sky_sentence(solution),
        "stars": motions.sentence if motions is not None else "",
        "rms": f"{both[0]:.4f}, {both[1]:.4f} px in x, y; {np.count_nonzero(used)} of {n} observations used",
        "angles": mas_sentence(solution),
    }
    out = [
        Heading(repr(solution)[1:-1]),
        *in_facts(solution.checks),
        *(Fact(*each) for each in (*facts.items(), *solution.diagnostics.in_words().items())),
        Sentence(),
        *_exposure_parts(solution),
        *nights.parts(solution),
    ]
    if solution.camera.has_focal_plane:
        out += [Sentence(), *places.parts(solution.camera), Fact("", layout_errors(solution))]
    left_out = by_reason(solution.left_out).items()
    return out + [Sentence(f"left out {some_of(names, 6)}: {reason}") for reason, names in left_out]


def _exposure_parts(solution):
    """The table of the exposures, and how well their poses are known."""
    numbers = pose_errors.pose_numbers(solution)
    distortion, dynamic = accuracy.sizes(solution)
    table = solution.residuals
    used = [table[table["used"] & (table["exposure"] == name)] for name in solution.names]
    rms = [[np.sqrt(np.mean(rows[k].to_value(u.pix) ** 2)) if len(rows) else np.nan for rows in used] for k in _RMS]

    def pose(head, name, unit=""):
        return Column(head, [each.text(name) for each in numbers], 9, unit)

    columns = [
        Column("exposure", solution.names, max(16, *map(len, solution.names)), words=True),
        Column("stars", [str(len(rows)) for rows in used], 5),
        pose("shift x", "dx", "px"), pose("shift y", "dy", "px"), pose("rotation", "rotation", "deg"),
        pose("scale", "scale"),
        *(Column(f"rms {axis}", [f"{each:.4f}" for each in rms[k]], 7, "px") for k, axis in enumerate("xy")),
        Column("dynamic", [f"{each:.3f}" for each in dynamic], 8, "px"),
        Column("distortion", [f"{each:.3f}" for each in distortion], 10, "px"),
    ]  # fmt: skip
    if solution.sky is not None:
        columns += [pose("PA", "position_angle", "deg"), pose("scale", "pixel_scale", "arcsec/px")]
    return [Grid(columns), Fact("poses", pose_errors.in_words(numbers))]


_RMS = "dx", "dy"


def layout_errors(solution):
    """What the errors of a layout that was fitted leave out, in words; empty where none was."""
    errors, camera = solution.estimate.uncertainty.camera, solution.camera
    common = camera.common_sigma
    if errors is None or not solution.camera.has_focal_plane or not errors.free[:, :, :3].any():
        return ""
    degree = 1
    if common is not None:  # infinite where exposures take over what detectors have in common
        orders = np.add(*basis.orders(basis.degree_of(common.shape[1])))
        degree = orders[np.isinf(common).any(axis=0)].max(initial=1)
    known = solution.settings.prior
    if places.exchanges_a_bend(camera) and solution.gauge.tie is None and known and known.get("source") == UNSTATED:
        degree = max(degree, solution.degree)  # nothing is known of what exposures scatter about
    unknown = f", and {solution.gauge.unknown_in_words}" if solution.gauge.unknown_names else ""
    bend = ""
    if camera.place_errors is not None and places.exchanges_a_bend(camera):
        bend = "; a bend of all together, as the reference tells it, is in places and errors"
    elif words := places.bend_in_words(camera, degree):
        bend = f"; {words}"
    unsettled = "; the fit did not settle, and these errors do not hold" * bool(errors.unsettled)
    return (
        f"{places.relative_in_words(degree)}{unknown} (not determined): places and rotations in the focal plane are "
        f"not known so well{bend}{unsettled}"
    )


def _fields_in_words(solution):
    n = solution.gauge.n_fields
    return f"{n} without a common star, each with a plane of its own; they lie side by side" if n > 1 else ""


def _static_in_words(solution):
    if solution.settings.static != "fit" or solution.camera.has_focal_plane:
        return ""
    own = solution.settings.exposure_degree
    mine = f"modes up to degree {own}" if own else "its pose alone"
    return f"fitted: one distortion for all exposures of a detector, {mine} for every exposure"
