"""The sentences of a report: what was observed, the figures of the solution, and a paragraph for a paper."""

import numpy as np
from astropy.time import Time
from markupsafe import Markup, escape

from ..exceptions import reasons_of
from ..results import in_tables
from ..results.check import WRONG
from ..results.nights import blocks
from ..runtime.trees.codec import to_tree
from .tables import count

#: The paper whose method this is.
BIBTEX = """@article{Bernard2018,
  author  = {Bernard, A. and Neichel, B. and Mugnier, L. M. and Fusco, T.},
  title   = {Optimal correction of distortion for High Angular Resolution images. Application to GeMS data},
  journal = {Monthly Notices of the Royal Astronomical Society},
  year    = {2018},
  volume  = {473},
  pages   = {2590},
  eprint  = {1709.08567},
  archivePrefix = {arXiv},
}"""


def facts_of(solution, summary):
    """Figures of the solution, replaced and completed by those of a summary."""
    facts = {
        "n_exposures": len(solution.names),
        "n_stars": int(np.count_nonzero(np.isfinite(solution.estimate.positions[:, 0]))),
        "n_observations": int(np.count_nonzero(solution.residuals["used"])),
        "chi2": solution.chi2,
        "dof": solution.dof,
        "rms_px": in_tables.rms(solution),
        "left_out": solution.left_out,
        "checks": [to_tree(check) for check in solution.checks],
        "observed": {},
    } | summary
    if "max_inverse_error_px" not in facts:
        facts["max_inverse_error_px"] = in_tables.largest_inverse_error(solution)
    return facts


def title(facts):
    """What was observed, and with what, as far as it is known."""
    seen = facts["observed"]
    what = ", ".join(seen[key] for key in ("target", "instrument", "filter") if seen.get(key))
    return what or f"Distortion of {count(facts['n_exposures'], 'exposure')}"


def dated_names(solution):
    """Names of the exposures, with their dates where these are known."""
    years = blocks(solution)[2]
    dates = [
        f", {Time(year, format='jyear').isot[:16].replace('T', ' ')}" if np.isfinite(year) else "" for year in years
    ]
    return [f"{name}{date}" for name, date in zip(solution.names, dates, strict=True)]


def observed_rows(solution, facts):
    """Target, instrument, dates, command and versions, as far as they are known: ``{name: text}``."""
    rows = {name.capitalize(): text for name, text in facts["observed"].items()}
    if facts.get("command"):
        rows["Command"] = Markup("<code>{}</code>").format(facts["command"])
    origin = solution.provenance
    if origin.get("created"):
        rows["Solved"] = str(origin["created"])
    if origin.get("versions"):
        rows["Versions"] = ", ".join(f"{name} {number}" for name, number in origin["versions"].items())
    return rows


def solution_rows(solution, facts):
    """Figures of the solution: ``{name: text}``."""
    not_used = len(solution.residuals) - np.count_nonzero(solution.residuals["used"])
    lost = np.count_nonzero(np.isnan(solution.estimate.positions[:, 0]))
    stars = Markup("{} <small>({} more without a position)</small>").format(facts["n_stars"], lost)
    rows = {
        "Exposures": facts["n_exposures"],
        "Stars": stars if lost else facts["n_stars"],
        "Positions used": Markup("{} <small>({} not used)</small>").format(facts["n_observations"], not_used),
        "χ² / degrees of freedom": Markup(
            "{:.1f} / {:.0f} = {} <small>(1 where the stated errors are right)</small>"
        ).format(facts["chi2"], facts["dof"], _ratio(facts)),
        "Residuals, rms": per_axis(facts["rms_px"]),
    }
    if facts.get("sigma_px") is not None:
        rows["Scatter of corrected positions"] = per_axis(facts["sigma_px"])
    if facts.get("quality"):
        rows["Stars in the mosaic"] = _sharpness(facts["quality"])
    if joint := facts.get("catalogue"):
        rows["Catalogue of all exposures"] = "{n_stars} stars, {n_new} of them new".format(**joint)
    error, folded = facts["max_inverse_error_px"], "; ".join(in_tables.folds(solution).values())
    rows["Largest error of an inverse"] = folded or f"{error:.1e} px"
    rows["Minimisation"] = solution.status
    if camera := in_tables.camera_sentence(solution):
        rows["Camera"] = camera
    rows["Gauge"] = solution.gauge.sentence
    rows |= {key.capitalize(): sentence for key, sentence in solution.diagnostics.in_words().items()}
    if solution.estimate.motions is not None:
        rows["Motions"] = solution.estimate.motions.sentence
    if angles := in_tables.mas_sentence(solution):
        rows["Angles"] = angles
    rows["Sky"] = in_tables.sky_sentence(solution)
    lines = [escape(f"{name}: {reason}") for name, reason in facts["left_out"].items()]
    rows["Left out"] = Markup("<br>").join(lines) if lines else "none"
    if facts.get("timings"):
        rows["Time"] = ", ".join(f"{step} {seconds:.2f} s" for step, seconds in facts["timings"].items())
    return rows


def truth_rows(facts):
    """How far a simulated set is from its truth, beside what was expected: ``(name, found, expected)``."""
    if "b_px" not in facts:
        return []
    pairs = {
        "Star positions, common map of the fitted degree removed": ("b_px", "b_bound_px", "Cramér-Rao bound"),
        "Star positions after a common shift, rotation and scale": ("b_abs_px", "b_abs_err_px", "reported"),
        "Scatter of new positions": ("sigma_new_px", "sigma_new_expected_px", "expected"),
    }
    return [
        (name, f"{facts[found]:.4f} px", f"{word} {facts[expected]:.4f} px")
        for name, (found, expected, word) in pairs.items()
    ]


def methods(solution, facts, *, stacked):
    """A paragraph on how the result was made, for a paper, with the figures of this run."""
    seen = facts["observed"]
    what = "".join(
        f" {word} {seen[key]}" for key, word in {"target": "of", "instrument": "with"}.items() if key in seen
    )
    what += f" (filter {seen['filter']})" if "filter" in seen else ""
    software = f"legdistort {solution.provenance.get('versions', {}).get('legdistort', '')}".strip()
    not_used = len(solution.residuals) - np.count_nonzero(solution.residuals["used"])
    static = " around a static distortion known beforehand" if np.any(solution.estimate.prior_mean) else ""
    parts = [
        f"Star positions were measured in {count(facts['n_exposures'], 'exposure')}{what}. Positions free of "
        f"distortion and the distortion of every exposure were determined together with {software}, by the method of "
        f"Bernard et al. (2018): the distortion of an exposure is a series of Legendre polynomials of total degree "
        f"{solution.degree} in each axis{static}, and all its coefficients and the positions of all stars minimise the "
        f"weighted squares of the residuals. {count(facts['n_observations'], 'position')} of "
        f"{count(facts['n_stars'], 'star')} were used{f', {not_used} were not' if not_used else ''}. "
        f"The residuals are {per_axis(facts['rms_px'])} rms, with chi2 = {facts['chi2']:.1f} for {facts['dof']:.0f} "
        "degrees of freedom.",
    ]
    if facts.get("sigma_px") is not None:
        parts.append(
            f"Corrected positions of a star scatter by {per_axis(facts['sigma_px'])} (rms) over the exposures."
        )
    if facts["left_out"]:
        parts.append(f"Left out: {reasons_of(facts['left_out'], 6)}.")
    for check in facts["checks"]:
        if check["name"] == "nights" and check["state"] in WRONG:
            parts.append(f"{check['sentence'][0].upper()}{check['sentence'][1:]}.")
    parts.append(f"Convention for what is common to all exposures: {solution.gauge.sentence}.")
    if solution.estimate.motions is not None:
        parts.append(f"Motions of the stars: {solution.estimate.motions.sentence}.")
    if stacked:
        quality = facts.get("quality")
        sharp = (
            f"; stars in it have a FWHM {quality['fwhm_ratio']:.2f} times that in single exposures" if quality else ""
        )
        parts.append(f"The exposures were resampled to the distortion-free plane and co-added{sharp}.")
    return " ".join(parts)


def per_axis(value):
    """A number of pixels, or one for each axis, in words."""
    value = np.ravel(value)
    if len(value) == 1:
        return f"{value[0]:.4f} px per axis"
    return f"{value[0]:.4f} px in x, {value[1]:.4f} px in y"


def _sharpness(quality):
    """Figures of the mosaic in a line, from a `~legdistort.assessment.stack_quality.Quality` as a dict."""
    return Markup(
        "{stars}: FWHM {fwhm:.2f} px, {fwhm_ratio:.3f} times that of single exposures; peak over flux {peak_ratio:.3f} "
        "times; ellipticity {ellipticity:.3f}; {position:.4f} px per axis off the positions solved "
        "<small>(medians over the brighter half)</small>"
    ).format(stars=count(quality["n_stars"], "star"), **quality)


def _ratio(facts):
    return f"{facts['chi2'] / facts['dof']:.3f}" if facts["dof"] > 0 else "undefined"
