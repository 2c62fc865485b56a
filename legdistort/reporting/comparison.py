"""Sections of the report: corrections and stacks compared."""

from ..plots import stack_plots
from ..results import accuracy
from . import comparison_plots
from .html import count, figure, new_figure, wide_table


def corrections(comparison):
    """Scatter of corrected positions by correction: table and picture."""
    from matplotlib import style

    head = {
        "correction": "",
        "stars": "",
        "mean": "px per axis",
        "standard deviation": "px per axis",
        "mean ": "px, both axes",
        "standard deviation ": "px, both axes",
    }
    rows = []
    for name, solution in comparison.items():
        s = accuracy.scatter_summary(solution)
        rows.append([name, str(s["n_stars"]), *(f"{s[key]:.4f}" for key in ("mean", "std", "mean_total", "std_total"))])
    with style.context("default"):
        picture = figure(
            comparison_plots.plot_comparison(comparison, ax=new_figure(7.0, 5.0).subplots()),
            "Scatter of every star's corrected positions over the exposures, by correction, with the error of one "
            "measured position: a correction is as good as the data allow where its marks lie along the curve.",
        )
    return (
        f"<h2>Corrections compared</h2>\n{wide_table(head, rows)}\n<p><small>Scatter of corrected positions over the "
        "exposures, star by star, on the positions that the solution used.</small></p>\n"
        f"{picture}"
    )


def stacks(made):
    """Sharpness of stacks made with other corrections: table and zooms.

    Parameters
    ----------
    made : `~legdistort.assessment.stack_quality.Stacks`
    """
    from matplotlib import style

    head = {
        "image": "",
        "FWHM": "px",
        "FWHM ratio": "to single exposures",
        "peak ratio": "to single exposures",
        "ellipticity": "",
        "positions": "px per axis",
    }
    rows = []
    for name, q in made.qualities.items():
        ratios = (q.fwhm, q.fwhm_ratio, q.peak_ratio, q.ellipticity)
        rows.append([name, *(f"{value:.3f}" for value in ratios), f"{q.position:.4f}"])
    n = next(iter(made.qualities.values())).n_stars
    removed = "similarity" if made.removed == "similarity" else f"map of degree {made.removed}"
    picture = ""
    if made.zooms:
        with style.context("default"):
            picture = figure(
                stack_plots.plot_zooms(made.zooms, fig=new_figure())[0, 0],
                "The same stars towards the corners of the field in every stack, each row in one stretch, cores "
                "saturated to show the wings; the line is half the height of the star: wide, long or ragged outlines "
                "are stars that the correction smeared.",
            )
    return (
        f"<h2>Stacks compared</h2>\n{wide_table(head, rows)}\n<p><small>Medians over the {count(n, 'star')} of the "
        "brighter half, isolated and unsaturated, that were measured in all stacks; the stacks differ in nothing but "
        "the correction. Peak: height over flux. Positions: scatter about those solved, in single exposures after "
        f"correction, in stacks after a common {removed}, which the images do not tell, was taken out."
        f"</small></p>\n{picture}"
    )


def sharpness(quality):
    """Figures of the mosaic in a line, from a `~legdistort.assessment.stack_quality.Quality` as a dict."""
    return (
        "{stars}: FWHM {fwhm:.2f} px, {fwhm_ratio:.3f} times that of single exposures; peak over flux {peak_ratio:.3f} "
        "times; ellipticity {ellipticity:.3f}; {position:.4f} px per axis off the positions solved "
        "<small>(medians over the brighter half)</small>"
    ).format(stars=count(quality["n_stars"], "star"), **quality)
