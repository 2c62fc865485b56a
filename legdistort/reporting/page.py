"""One HTML page for a finished run, complete in itself: no scripts, no links, pictures inside."""

import warnings
from dataclasses import asdict
from html import escape
from importlib.metadata import version
from pathlib import Path

import numpy as np

from ..exceptions import FoldError
from ..geometry import similarity
from ..inputs import column_contract
from ..plots import motion_plots, psf_plots, solution_plots, stack_plots
from ..runtime.outputs import replacing
from .checks_table import verdict
from .comparison import compared_corrections, compared_stacks, sharpness
from .html import STYLE, count, detached_figure, figure, wide_table

#: An exposure whose residuals exceed the median by this factor is marked.
_MARK = 2.0


def write_report(
    path, solution, *, mosaic=None, psfs=None, summary=None, comparison=None, stacks=None, overwrite=False
):
    """Write the report of a run as one self-contained HTML page.

    Parameters
    ----------
    path : str or path
        Of the page.
    solution : `~legdistort.results.solution.Solution`
        What is reported.
    mosaic : `~legdistort.coaddition.mosaic.Mosaic`, optional
        The co-added image.
    psfs : dict, optional
        ``{name: EffectivePSF}``: the PSFs that stars were measured with; that of the first exposure is drawn.
    summary : dict, optional
        Results of the run that replace or complete what follows from the solution: ``n_exposures``, ``n_stars``,
        ``n_observations``, ``chi2``, ``dof``, ``rms_px``, ``sigma_px``, ``max_inverse_error_px``, ``left_out``
        (``{name: reason}``), ``checks`` (dicts of
        `~legdistort.results.check.Check`), ``timings`` (``{step: seconds}``), ``quality`` (of the mosaic, a
        `~legdistort.assessment.stack_quality.Quality` as a dict).
    comparison : dict, optional
        ``{name: Solution}`` of `legdistort.assessment.baselines.compare`: a table and a picture are added.
    stacks : `~legdistort.assessment.stack_quality.Stacks`, optional
        Stacks made with other corrections (`legdistort.assessment.stack_quality.compare_stacks`): a table and zooms
        are added.
    overwrite : bool
        Replace a file that exists.

    Returns
    -------
    `~pathlib.Path`

    Raises
    ------
    InputError
        If the file exists and `overwrite` is false, or its folder does not exist.
    """
    with replacing(path, overwrite=overwrite) as file:
        shown = {"mosaic": mosaic, "psfs": psfs, "comparison": comparison, "stacks": stacks}
        page = render(solution, summary=summary, **shown)
        file.write(page.encode())
    return Path(path)


def render(solution, *, mosaic=None, psfs=None, summary=None, comparison=None, stacks=None):
    """The page of `write_report` as a string."""
    from matplotlib import style

    facts = _facts(solution, summary or {})
    title = f"Distortion of {count(facts['n_exposures'], 'exposure')}"
    lead = (
        f"{count(facts['n_stars'], 'star')}, {count(facts['n_observations'], 'position')}, "
        f"Legendre polynomials of degree {solution.degree}"
    )
    with style.context("default"), warnings.catch_warnings():  # not the user's style
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # a name in a script that the font lacks
        body = [
            f'<h1>{title}</h1><p class="lead">{lead}</p>',
            verdict(facts["checks"]),
            _facts_table(solution, facts),
            "<h2>Exposures</h2>",
            _exposures_table(solution),
            _detectors_table(solution.camera) if solution.camera is not None else "",
            compared_corrections(comparison) if comparison else "",
            compared_stacks(stacks) if stacks else "",
            "<h2>Pictures</h2>",
            _pictures(solution, mosaic, psfs),
            f"<footer>Written by legdistort {version('legdistort')}. Pixels count from 0 at the centre of the first; "
            "x is the column. Residuals are measured minus predicted positions on the detector.</footer>",
        ]
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n" + "\n".join(body) + "\n</body>\n</html>\n"
    )


def _facts(solution, summary):
    facts = {
        "n_exposures": len(solution.names),
        "n_stars": len(solution.star_names),
        "n_observations": int(np.count_nonzero(solution.residuals["used"])),
        "chi2": solution.chi2,
        "dof": solution.dof,
        "rms_px": solution.rms,
        "left_out": solution.left_out,
        "checks": [asdict(check) for check in solution.checks],
    } | summary
    if "max_inverse_error_px" not in facts:
        try:
            facts["max_inverse_error_px"] = solution.max_inverse_error
        except FoldError as error:
            facts["max_inverse_error_px"] = str(error)
    return facts


def _facts_table(solution, facts):
    not_used = len(solution.residuals) - np.count_nonzero(solution.residuals["used"])
    rows = {
        "Exposures": str(facts["n_exposures"]),
        "Stars": str(facts["n_stars"]),
        "Positions used": f"{facts['n_observations']} <small>({not_used} not used)</small>",
        "&chi;&sup2; / degrees of freedom": f"{facts['chi2']:.1f} / {facts['dof']} = {_ratio(facts)} "
        "<small>(1 where the stated errors are right)</small>",
        "Residuals, rms": _per_axis(facts["rms_px"]),
    }
    if facts.get("sigma_px") is not None:
        rows["Scatter of corrected positions"] = _per_axis(facts["sigma_px"])
    if facts.get("quality"):
        rows["Stars in the mosaic"] = sharpness(facts["quality"])
    error = facts["max_inverse_error_px"]
    rows["Largest error of an inverse"] = escape(error) if isinstance(error, str) else f"{error:.1e} px"
    rows["Minimisation"] = escape(str(solution.status))
    if solution.camera is not None:
        rows["Camera"] = escape(solution.camera_sentence)
    rows["Gauge"] = escape(solution.gauge.sentence)
    rows |= {key.capitalize(): escape(sentence) for key, sentence in solution.diagnostics.in_words().items()}
    if solution.motions is not None:
        rows["Motions"] = escape(solution.motions.sentence)
    rows["Sky"] = escape(solution.sky_sentence)
    rows["Left out"] = (
        "<br>".join(f"{escape(str(n))}: {escape(str(r))}" for n, r in facts["left_out"].items()) or "none"
    )
    if facts.get("timings"):
        rows["Time"] = ", ".join(f"{escape(str(step))} {seconds:.2f} s" for step, seconds in facts["timings"].items())
    cells = "".join(f'<tr><th scope="row">{name}</th><td>{value}</td></tr>\n' for name, value in rows.items())
    return f'<table class="facts">\n{cells}</table>'


def _exposures_table(solution):
    """One row an exposure: pose, number of stars, residuals, size of the distortion."""
    dx, dy, n = _exposure_rms(solution)
    distortion, dynamic = _sizes(solution)
    head = {
        "exposure": "",
        "shift x": "px",
        "shift y": "px",
        "rotation": "deg",
        "scale": "",
        "stars": "",
        "rms x": "px",
        "rms y": "px",
        "distortion": "rms, px",
        "dynamic part": "rms, px",
    }
    rows = []
    for i, name in enumerate(solution.names):
        pose = similarity.describe(solution.poses[name])
        cells = [
            f"{pose['dx']:.2f}",
            f"{pose['dy']:.2f}",
            f"{pose['rotation']:.4f}{', mirrored' if pose['parity'] < 0 else ''}",
            f"{pose['scale']:.6f}",
            f"{n[i]}",
            *(_marked(rms, i) for rms in (dx, dy)),
            f"{distortion[i]:.3f}",
            f"{dynamic[i]:.3f}",
        ]
        rows.append([name, *cells])
    reference = "static distortion" if np.any(solution.prior_mean) else "mean of the exposures"
    return (
        f"{wide_table(head, rows)}\n<p><small>Shift, rotation and scale lead from the reference plane to the "
        "detector. Distortion: length of the displacement over the detector, less its mean; dynamic part: the same of "
        f"the departure from the {reference}. Residuals above {_MARK:g} times the median are marked.</small></p>"
    )


def _detectors_table(camera):
    """One row a detector: where it lies, with the errors of that, and the size of its static distortion."""
    head = {"detector": "", "centre x": "px", "centre y": "px", "rotation": "deg", "scale": "", "static": "rms, px"}
    rows = []
    for key, each in camera.detectors.items():
        place, errors = each.place, each.place.errors or ("", "", "")
        errors = ["" if e == "" else " ± unknown" if np.isinf(e) else f" ± {e:.2g}" for e in errors]
        values = f"{place.x:.3f}", f"{place.y:.3f}", f"{place.rotation:.5f}"
        cells = [value + error for value, error in zip(values, errors, strict=True)]
        rows.append([key, *cells, f"{place.scale:.6f}", f"{each.rms:.3f}"])
    return (
        f"<h2>Detectors of camera {escape(camera.name)}</h2>\n{wide_table(head, rows)}\n<p><small>Centres in the focal "
        "plane. Errors, where the layout was fitted, are standard deviations after one affine map of all detectors "
        "together, which exposures can take over.</small></p>"
    )


def _exposure_rms(solution):
    """Rms of the used residuals in x and y, and their number, by exposure."""
    table = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    order = {name: i for i, name in enumerate(solution.names)}
    labels, index = np.unique(column_contract.labels(table, "exposure"), return_inverse=True)
    index = np.array([order[str(label)] for label in labels], dtype=int)[index]
    n = np.bincount(index, minlength=len(order))
    squares = (np.bincount(index, column_contract.values(table, d, "pix") ** 2, len(order)) for d in ("dx", "dy"))
    with np.errstate(invalid="ignore"):  # 0 / 0 = NaN where nothing was used
        dx, dy = (np.sqrt(total / n) for total in squares)
    return dx, dy, n


def _sizes(solution):
    """Rms length over the detector of each distortion and of its dynamic part, without the constant mode, pixels.

    The basis is orthonormal on a square of area 4: the mean square is the sum of squared coefficients over 4.
    """
    static = solution.prior_mean
    if not np.any(static):
        static = np.mean(solution.coefficients, axis=0)
    parts = solution.coefficients, solution.coefficients - static
    return [np.sqrt(np.sum(part[:, :, 1:] ** 2, axis=(1, 2))) / 2 for part in parts]


def _pictures(solution, mosaic, psfs):
    place = "on the detector" if solution.camera is None else "in the focal plane, with its detectors"
    residuals = figure(
        solution_plots.plot_residuals(solution, ax=detached_figure(6.4, 6.4).subplots()),
        f"Residuals of all exposures at their places {place}, magnified: arrows that point the same way "
        "over a region would mean a distortion that the polynomials do not follow.",
    )
    scatter = figure(
        solution_plots.plot_scatter(solution, ax=detached_figure(6.4, 5.6).subplots()),
        "Residual scatter of each star against its flux, with the reported errors; a little below the curve is "
        "right, because the fit absorbs some noise, while stars far above it would mean errors stated too small.",
    )
    coefficients = figure(
        solution_plots.plot_coefficients(solution, fig=detached_figure())[0],
        "Coefficients of the Legendre modes, mean of the exposures with their scatter, beside the prior if "
        "there is one: large values in the highest orders would mean a degree too low or too few stars.",
    )
    if solution.camera is not None:
        scatter += figure(
            solution.camera.plot(ax=detached_figure(6.4, 6.4).subplots()),
            "The detectors in the focal plane with their static distortion, common to all exposures.",
        )
    figures = [f'<div class="pair">{residuals}{scatter}</div>', *_distortion_figures(solution), coefficients]
    figures += _error_figure(solution)
    figures += _motion_figures(solution)
    for name, psf in list((psfs or {}).items())[:1]:
        figures.append(
            figure(
                psf_plots.plot_psf(psf, fig=detached_figure())[0],
                f"The effective PSF of {name}, what it leaves of the stars that made it, and how it varies over the "
                "field: rings or lobes of more than some per cent that are left would mean positions that depend on "
                "brightness.",
            )
        )
    if mosaic is not None:
        figures.append(
            figure(
                stack_plots.plot_mosaic(mosaic, ax=detached_figure(7.5, 7.5).subplots()),
                "The co-added image, pale blue where no exposure contributes: double or elongated stars, more so "
                "towards one edge, would mean that the exposures are not aligned there.",
            )
        )
    return "\n".join(figures)


def _error_figure(solution):
    """The error of the correction over the exposure with the most stars; none where its distortion folds."""
    name = solution.names[int(np.argmax(_exposure_rms(solution)[2]))]
    try:
        drawn = solution.sigma_map(name)
    except FoldError:
        return
    text = (
        "Relative error of the correction, rms per axis, over the exposure with the most stars: what it adds to that "
        "of a new position, once a common map of the fitted degree is taken off. White is outside the stars, where the "
        "correction is extrapolated. Absolute errors are those of the row Gauge above."
    )
    yield figure(solution_plots.plot_sigma_map(*drawn, ax=detached_figure(6.4, 5.4).subplots()), text)


def _motion_figures(solution):
    """Proper motions, where they were fitted."""
    if solution.motions is None or not np.isfinite(solution.motions.values).any():
        return
    origin = "tied to those of the reference" if solution.gauge.drift.n_tied else "relative to the mean of the stars"
    points = figure(
        motion_plots.plot_motions(solution, ax=detached_figure(6.0, 6.0).subplots()),
        f"Proper motion of every star with its relative errors, {origin}: groups are stars "
        "that belong together; single ones far off may be mismatched.",
    )
    errors = figure(
        motion_plots.plot_motion_errors(solution, ax=detached_figure(6.4, 5.6).subplots()),
        "Errors of the motions against brightness: stars far above the others are seen less often, or over a "
        "shorter time.",
    )
    yield f'<div class="pair">{points}{errors}</div>'


def _distortion_figures(solution):
    """Small multiples of the dozen exposures that depart most: whole distortion, and dynamic part over a prior."""
    departing = np.sort(np.argsort(-_sizes(solution)[1], kind="stable")[: solution_plots.PANELS])
    names = [solution.names[i] for i in departing]
    which = "each exposure" if len(names) == len(solution.names) else f"the {len(names)} exposures that depart most"
    part = "nonlinear" if solution.coefficients.shape[2] > 3 else "total"  # shears would hide the rest
    gentle = solution_plots.distortion_scale(solution, names, part=part)  # largest displacement a tenth of the detector
    scale = 50 if gentle >= 10 else gentle
    text = (
        f"Distortion of {which}{', without its linear part' * (part == 'nonlinear')}, magnified {scale:g} times: "
        "a regular grid (grey) as the detector sees it; a panel unlike the others, or lines that cross or crowd at an "
        "edge, would be worrying."
    )
    yield figure(
        solution_plots.plot_distortions(solution, names=names, part=part, scale=scale, fig=detached_figure())[0], text
    )
    if np.any(solution.prior_mean):
        text = (
            "What is left when the static distortion is taken off, on a scale of its own: the same pattern in all "
            "panels would mean that the static distortion is not that of this instrument any more."
        )
        panels = solution_plots.plot_distortions(
            solution, names=names, part="dynamic", scale=None, fig=detached_figure()
        )
        yield figure(panels[0], text)


def _marked(rms, i):
    high = np.isfinite(rms[i]) and rms[i] > _MARK * np.nanmedian(rms)
    text = f"{rms[i]:.4f}" if np.isfinite(rms[i]) else "–"
    return f'<td class="high">{text}</td>' if high else f"<td>{text}</td>"


def _per_axis(value):
    value = np.ravel(value)
    if len(value) == 1:
        return f"{value[0]:.4f} px per axis"
    return f"{value[0]:.4f} px in x, {value[1]:.4f} px in y"


def _ratio(facts):
    return f"{facts['chi2'] / facts['dof']:.3f}" if facts["dof"] > 0 else "undefined"
