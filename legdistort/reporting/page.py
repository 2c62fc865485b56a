"""One HTML page for a finished run, complete in itself: pictures, style and script inside, no network."""

import os
import warnings
from functools import cache
from importlib.metadata import version
from pathlib import Path

from ..assessment.pulls import pulls_of
from ..exceptions import InputError
from ..results.in_tables import layout_errors
from ..runtime.outputs import replacing
from .checks_table import verdict
from .comparison import compared_corrections, compared_stacks
from .cutouts import cut_out
from .facts import BIBTEX, dated_names, facts_of, methods, observed_rows, solution_rows, title, truth_rows
from .pictures import Gallery
from .svg import STYLE
from .tables import count, detectors_table, exposures_table, nights_table, stars_table, stated_table


def write_report(
    path,
    solution,
    *,
    mosaic=None,
    psfs=None,
    summary=None,
    comparison=None,
    stacks=None,
    exposures=(),
    joint=None,
    files=(),
    overwrite=False,
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
        `~legdistort.assessment.stack_quality.Quality` as a dict), ``observed`` (``{"target" | "instrument" | ...:
        text}``, see `legdistort.inputs.exposures.observed`), ``stated`` (what the frames state, see
        `legdistort.inputs.frames.statement.stated_rows`), ``command``, and the figures of
        `legdistort.assessment.truth.compare_with_truth`.
    comparison : dict, optional
        ``{name: Solution}`` of `legdistort.assessment.baselines.compare`: a table and a picture are added.
    stacks : `~legdistort.assessment.stack_quality.Stacks`, optional
        Stacks made with other corrections (`legdistort.assessment.stack_quality.compare_stacks`): a table and zooms
        are added.
    exposures : sequence of Exposure or ExposureFile, optional
        What was co-added: stars of some of them are shown beside those of the mosaic.
    joint : `~legdistort.photometry.catalogue.Catalogue`, optional
        Of all exposures: what it misses is drawn, where artificial stars tell.
    files : sequence of str or path, optional
        Other results, as the page links to them.
    overwrite : bool
        Replace a file that exists.

    Returns
    -------
    `~pathlib.Path`

    Raises
    ------
    InputError
        If the file exists and `overwrite` is false, or its folder does not exist; for `files` that are no names.
    """
    if isinstance(files, str) or not all(isinstance(name, str | os.PathLike) for name in files):
        raise InputError(f"files must be names of results, ('stars.ecsv', 'wcs/'), got {files!r}")
    with replacing(path, overwrite=overwrite) as file:
        shown = {"mosaic": mosaic, "psfs": psfs, "comparison": comparison, "stacks": stacks}
        page = render(solution, summary=summary, **shown, exposures=exposures, joint=joint, files=files)
        file.write(page.encode())
    return Path(path)


def render(
    solution,
    *,
    mosaic=None,
    psfs=None,
    summary=None,
    comparison=None,
    stacks=None,
    exposures=(),
    joint=None,
    files=(),
):
    """The page of `write_report` as a string."""
    from matplotlib import style

    facts = facts_of(solution, summary or {})
    gallery, pulls = Gallery(), pulls_of(solution)
    with style.context(["default", STYLE]), warnings.catch_warnings():  # not the user's style
        warnings.filterwarnings("ignore", message="Glyph .* missing")  # a name in a script that the font lacks
        shown = {
            "title": title(facts),
            "lead": f"Distortion of {count(facts['n_exposures'], 'exposure')}: {count(facts['n_stars'], 'star')}, "
            f"{count(facts['n_observations'], 'position')}, Legendre polynomials of degree {solution.degree}",
            "verdict": verdict(facts["checks"]),
            "observed": observed_rows(solution, facts),
            "facts": solution_rows(solution, facts),
            "truth": truth_rows(facts),
            "methods": methods(solution, facts, stacked=mosaic is not None),
            "bibtex": BIBTEX,
            "files": list(map(str, files)),
            "version": version("legdistort"),
            "names": {"s": [str(n) for n in solution.estimate.star_names], "e": dated_names(solution)},
            "cutouts": cut_out(solution, mosaic, exposures, fwhm=_fwhm(facts)),
            **_pictures(gallery, solution, pulls, mosaic, joint and joint.completeness),
            **_details(gallery, solution, pulls, psfs, facts, comparison, stacks),
        }
    return _template().render(shown)


@cache
def _template():
    """The page with places for what it shows; texts are escaped where they are put in."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("legdistort.reporting")
    options = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, **options).get_template("report.html")


def _pictures(gallery, solution, pulls, mosaic, completeness):
    """What everybody looks at: the steps of the correction, and pairs of pictures that stand side by side."""
    pairs = [
        ("Error of the correction", [gallery.error_map(solution), gallery.mean_residuals(solution)]),
        ("Residuals", [gallery.pulls(pulls, "brightness"), gallery.pulls(pulls, "time")]),
        ("Distortion", [gallery.coefficients(solution)]),
        ("Motions of the stars", list(gallery.motions(solution))),
        ("Mosaic", [gallery.mosaic(solution, mosaic) if mosaic is not None else None]),
        ("Catalogue of all exposures", [gallery.completeness(completeness) if completeness is not None else None]),
    ]
    pairs = [(title, [each for each in pictures if each is not None]) for title, pictures in pairs]
    return {"steps": gallery.steps(solution), "pairs": [pair for pair in pairs if pair[1]]}


def _details(gallery, solution, pulls, psfs, facts, comparison, stacks):
    """What stands in the section that is folded: tables and more pictures."""
    first = next(iter((psfs or {}).items()), None)
    camera = solution.camera
    detectors = None
    if camera.has_focal_plane:
        detectors = camera.name, detectors_table(camera, layout_errors(solution))
    pictures = [
        *([gallery.camera(camera)] if camera.has_focal_plane else []),
        *gallery.distortions(solution),
        *([gallery.trends(solution, pulls, facts.get("quality"))] if len(solution.names) > 2 else []),
        *([gallery.psf(*first)] if first else []),
    ]
    return {
        "compared": [
            *([compared_corrections(comparison, gallery)] if comparison else []),
            *([compared_stacks(stacks, gallery)] if stacks else []),
        ],
        "exposures": exposures_table(solution, (facts.get("quality") or {}).get("exposures")),
        "nights": nights_table(solution),
        "stated": stated_table(facts["stated"]) if facts.get("stated") else None,
        "detectors": detectors,
        "stars": stars_table(solution, pulls),
        "more": pictures,
    }


def _fwhm(facts):
    return (facts.get("quality") or {}).get("fwhm") or 4.0
