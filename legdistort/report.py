"""One HTML page for a finished run, complete in itself: no scripts, no links, pictures inside."""

import base64
import io
import warnings
from html import escape
from importlib.metadata import version
from pathlib import Path

import numpy as np

from . import catalogs, comparison_plots, performance, plotting, poses
from .exceptions import FoldError
from .files import replacing
from .findings import in_words

#: An exposure whose residuals exceed the median by this factor is marked.
_MARK = 2.0

_STYLE = """
body { margin: 2rem auto; max-width: 62rem; padding: 0 1.2rem; background: #fff; color: #1d2730;
       font: 16px/1.5 system-ui, "Segoe UI", Helvetica, Arial, sans-serif; }
h1 { font-size: 1.7rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
p.lead { margin: .2rem 0 1.4rem; color: #51606d; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .28rem .7rem; border-bottom: 1px solid #dde3e8; text-align: left; vertical-align: top; }
table.facts th { white-space: nowrap; font-weight: 600; }
table.exposures { width: 100%; }
table.exposures thead th { border-bottom: 2px solid #51606d; vertical-align: bottom; line-height: 1.25; }
table.exposures td + td, table.exposures th + th { text-align: right; white-space: nowrap; }
table.exposures td:first-child { overflow-wrap: anywhere; }
td.high { color: #a84300; font-weight: 700; }
small { font-weight: 400; color: #51606d; }
.wide { overflow-x: auto; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(24rem, 1fr)); gap: 0 1.6rem; align-items: start; }
figure { margin: .8rem 0 1.6rem; break-inside: avoid; }
figure img { display: block; max-width: 100%; height: auto; margin: 0 auto; }
figcaption { font-size: .88rem; color: #3c4a56; margin: .4rem auto 0; max-width: 46rem; }
footer { margin-top: 2.5rem; font-size: .8rem; color: #51606d; }
@media print { body { margin: 0; max-width: none; font-size: 11px; } tr { break-inside: avoid; }
               .wide { overflow: visible; } .pair { grid-template-columns: 1fr 1fr; } }
"""


def write_report(path, solution, *, mosaic=None, summary=None, comparison=None, overwrite=False):
    """Write the report of a run as one self-contained HTML page.

    Parameters
    ----------
    path : str or path
        Of the page.
    solution : `~legdistort.solution.Solution`
        What is reported.
    mosaic : `~legdistort.coaddition.Mosaic`, optional
        The co-added image.
    summary : dict, optional
        Results of the run that replace or complete what follows from the solution: ``n_exposures``, ``n_stars``,
        ``n_observations``, ``chi2``, ``dof``, ``rms_px``, ``sigma_px``, ``max_inverse_error_px``, ``left_out``
        (``{name: reason}``), ``timings`` (``{step: seconds}``).
    comparison : dict, optional
        ``{name: Solution}`` of `legdistort.baselines.compare`: a table and a picture are added.
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
    with replacing(path, overwrite=overwrite) as temporary:
        page = render(solution, mosaic=mosaic, summary=summary, comparison=comparison)
        temporary.write_text(page, encoding="utf-8")
    return Path(path)


def render(solution, *, mosaic=None, summary=None, comparison=None):
    """The page of `write_report` as a string."""
    facts = _facts(solution, summary or {})
    title = f"Distortion of {_count(facts['n_exposures'], 'exposure')}"
    lead = (
        f"{_count(facts['n_stars'], 'star')}, {_count(facts['n_observations'], 'position')}, "
        f"Legendre polynomials of degree {solution.degree}"
    )
    body = [
        f'<h1>{title}</h1><p class="lead">{lead}</p>',
        _facts_table(solution, facts),
        "<h2>Exposures</h2>",
        _exposures_table(solution),
        _comparison(comparison) if comparison else "",
        "<h2>Pictures</h2>",
        _pictures(solution, mosaic),
        f"<footer>Written by legdistort {version('legdistort')}. Pixels count from 0 at the centre of the first; "
        "x is the column. Residuals are measured minus predicted positions on the detector.</footer>",
    ]
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{title}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n" + "\n".join(body) + "\n</body>\n</html>\n"
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
    error = facts["max_inverse_error_px"]
    rows["Largest error of an inverse"] = escape(error) if isinstance(error, str) else f"{error:.1e} px"
    rows["Minimisation"] = escape(str(solution.status))
    rows["Gauge"] = escape(solution.gauge.sentence)
    rows |= {key.capitalize(): escape(sentence) for key, sentence in in_words(solution.settings).items()}
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
        pose = poses.describe(solution.poses[name])
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
        cells = "".join(c if c.startswith("<td") else f"<td>{c}</td>" for c in cells)
        rows.append(f"<tr><td>{escape(name)}</td>{cells}</tr>")
    header = "".join(
        f'<th scope="col">{h}{f"<br><small>{unit}</small>" if unit else ""}</th>' for h, unit in head.items()
    )
    reference = "static distortion" if np.any(solution.prior_mean) else "mean of the exposures"
    return (
        f'<div class="wide"><table class="exposures">\n<thead><tr>{header}</tr></thead>\n<tbody>\n'
        + "\n".join(rows)
        + "\n</tbody></table></div>\n<p><small>Shift, rotation and scale lead from the reference plane to the "
        "detector. Distortion: length of the displacement over the detector, less its mean; dynamic part: the same of "
        f"the departure from the {reference}. Residuals above {_MARK:g} times the median are marked.</small></p>"
    )


def _comparison(comparison):
    """Scatter of corrected positions by correction: table and picture."""
    from matplotlib import style

    rows = ""
    for name, solution in comparison.items():
        s = performance.scatter_summary(solution)
        figures = [str(s["n_stars"]), *(f"{s[key]:.4f}" for key in ("mean", "std", "mean_total", "std_total"))]
        rows += f"<tr><td>{escape(name)}</td>{''.join(f'<td>{figure}</td>' for figure in figures)}</tr>\n"
    with style.context("default"):
        picture = _figure(
            comparison_plots.plot_comparison(comparison, ax=_new_figure(7.0, 5.0).subplots()),
            "Scatter of every star's corrected positions over the exposures, by correction, with the error of one "
            "measured position: a correction is as good as the data allow where its marks lie along the curve.",
        )
    return (
        '<h2>Corrections compared</h2>\n<div class="wide"><table class="exposures">\n<thead><tr><th>correction</th>'
        "<th>stars</th><th>mean<br><small>px per axis</small></th><th>standard deviation<br><small>px per axis</small>"
        "</th><th>mean<br><small>px, both axes</small></th><th>standard deviation<br><small>px, both axes</small></th>"
        f"</tr></thead>\n<tbody>\n{rows}</tbody></table></div>\n<p><small>Scatter of corrected positions over the "
        "exposures, star by star, on the positions that the solution used.</small></p>\n"
        f"{picture}"
    )


def _exposure_rms(solution):
    """Rms of the used residuals in x and y, and their number, by exposure."""
    table = solution.residuals[np.asarray(solution.residuals["used"], dtype=bool)]
    order = {name: i for i, name in enumerate(solution.names)}
    labels, index = np.unique(catalogs.labels(table, "exposure"), return_inverse=True)
    index = np.array([order[str(label)] for label in labels], dtype=int)[index]
    n = np.bincount(index, minlength=len(order))
    squares = (np.bincount(index, catalogs.values(table, d, "pix") ** 2, len(order)) for d in ("dx", "dy"))
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


def _pictures(solution, mosaic):
    from matplotlib import style

    with style.context("default"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # a name in a script that the font lacks
        residuals = _figure(
            plotting.plot_residuals(solution, ax=_new_figure(6.4, 6.4).subplots()),
            "Residuals of all exposures at their places on the detector, magnified: arrows that point the same way "
            "over a region would mean a distortion that the polynomials do not follow.",
        )
        scatter = _figure(
            plotting.plot_scatter(solution, ax=_new_figure(6.4, 5.6).subplots()),
            "Residual scatter of each star against its flux, with the reported errors; a little below the curve is "
            "right, because the fit absorbs some noise, while stars far above it would mean errors stated too small.",
        )
        figures = [f'<div class="pair">{residuals}{scatter}</div>', *_distortion_figures(solution)]
        figures.append(
            _figure(
                plotting.plot_coefficients(solution, fig=_new_figure())[0],
                "Coefficients of the Legendre modes, mean of the exposures with their scatter, beside the prior if "
                "there is one: large values in the highest orders would mean a degree too low or too few stars.",
            )
        )
        if mosaic is not None:
            figures.append(
                _figure(
                    plotting.plot_mosaic(mosaic, ax=_new_figure(7.5, 7.5).subplots()),
                    "The co-added image, pale blue where no exposure contributes: double or elongated stars, more so "
                    "towards one edge, would mean that the exposures are not aligned there.",
                )
            )
    return "\n".join(figures)


def _distortion_figures(solution):
    """Small multiples of the dozen exposures that depart most: whole distortion, and dynamic part over a prior."""
    departing = np.sort(np.argsort(-_sizes(solution)[1], kind="stable")[: plotting.PANELS])
    names = [solution.names[i] for i in departing]
    which = "each exposure" if len(names) == len(solution.names) else f"the {len(names)} exposures that depart most"
    part = "nonlinear" if solution.coefficients.shape[2] > 3 else "total"  # shears would hide the rest
    gentle = plotting.distortion_scale(solution, names, part=part)  # largest displacement a tenth of the detector
    scale = 50 if gentle >= 10 else gentle
    text = (
        f"Distortion of {which}{', without its linear part' * (part == 'nonlinear')}, magnified {scale:g} times: "
        "a regular grid (grey) as the detector sees it; a panel unlike the others, or lines that cross or crowd at an "
        "edge, would be worrying."
    )
    yield _figure(plotting.plot_distortions(solution, names=names, part=part, scale=scale, fig=_new_figure())[0], text)
    if np.any(solution.prior_mean):
        text = (
            "What is left when the static distortion is taken off, on a scale of its own: the same pattern in all "
            "panels would mean that the static distortion is not that of this instrument any more."
        )
        panels = plotting.plot_distortions(solution, names=names, part="dynamic", scale=None, fig=_new_figure())
        yield _figure(panels[0], text)


def _new_figure(*size):
    from matplotlib.figure import Figure

    return Figure(figsize=size or None, layout="constrained")


def _figure(ax, caption):
    """A picture with its sentence, the PNG inside the page."""
    from PIL import Image

    file, small = io.BytesIO(), io.BytesIO()
    ax.figure.savefig(file, format="png", dpi=120)
    # A palette takes a third of the room; "maximum coverage" keeps rare colours, such as the black of stars.
    picture = Image.open(file).convert("RGB").quantize(64, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    picture.save(small, format="png", optimize=True)
    width = round(96 * ax.figure.get_figwidth())
    data = base64.b64encode(small.getvalue()).decode("ascii")
    return (
        f'<figure><img src="data:image/png;base64,{data}" width="{width}" alt="{caption}">'
        f"<figcaption>{caption}</figcaption></figure>"
    )


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


def _count(n, what):
    return f"{n} {what}{'' if n == 1 else 's'}"
