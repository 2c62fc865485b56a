"""The whole road: frames -> positions -> matches -> solution -> WCS files, mosaic and report."""

import json
import logging
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .assessment import baselines, stack_quality
from .coaddition.mosaicking import coadd
from .exceptions import InputError, MatchError
from .inputs.exposure_files import open_exposures
from .inputs.exposures import expand_paths
from .inputs.table_files import write_stars
from .matching.matcher import match
from .measurement.positions import measure
from .reporting.page import write_report
from .results import accuracy
from .runtime import outputs, provenance
from .solving.estimation import solve
from .solving.options import SolveOptions, check_reference
from .wcs.files import write_wcs

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Run:
    """What `run` made.

    Attributes
    ----------
    out : Path
        Folder with ``solution.asdf``, ``stars.ecsv``, ``wcs/NAME.asdf``, ``mosaic.fits``, ``report.html``.
    solution : Solution
    mosaic : Mosaic
    summary : dict
        Plain numbers and strings, see `summarise`.
    """

    out: Path
    solution: object
    mosaic: object
    summary: dict

    def __repr__(self):
        return f"<Run: {self.solution!r} in {self.out}>"


def run(
    paths,
    *,
    out,
    ext=None,
    degree=3,
    prior=None,
    min_exposures=4,
    clip=5.0,
    reference=None,
    epoch=None,
    pixel_scale=None,
    measuring=None,
    matching=None,
    solving=None,
    coadding=None,
    compare=False,
    overwrite=False,
    workers=None,
    progress=False,
):
    """Solve a set of frames and co-add them.

    Parameters
    ----------
    paths : str, path, HDUList, CCDData or a sequence of them
        See `legdistort.read_exposures`.
    out : str or path
        Folder for the results; made if it does not exist. Nothing is left there if the run fails.
    ext : int, str or (str, int), optional
        Extension to read from every file.
    degree : int
        Total degree of the distortion.
    prior : Prior, optional
        Static distortion.
    min_exposures : int
        Stars seen in fewer exposures are not used.
    clip : float or None
        Leave out observations beyond this many standard errors.
    reference, epoch, pixel_scale : optional
        Catalogue to tie the positions to, see `legdistort.solve`.
    measuring, matching, solving, coadding : dict, optional
        Further arguments of `legdistort.measure`, `match`, `solve` and `coadd`. The stack is ``"clipped"`` here:
        hot pixels and cosmic rays do not get into it.
    compare : bool
        Also correct by shifts, by the prior's static distortion and shifts, and by a relative polynomial
        (`legdistort.assessment.baselines`), and report the scatter and the sharpness of the stack that each of them
        leaves.
    overwrite : bool
        Replace the results of an earlier run.
    workers : int, optional
        Cores to use. None = the current ``dask.distributed.Client`` if there is one, else one. Results do not depend
        on it.
    progress : bool
        Show progress bars.

    Returns
    -------
    Run

    Raises
    ------
    LegdistortError
        With the file, exposure or argument at fault.
    """
    out = Path(out)
    check_folder(out, overwrite)
    SolveOptions(degree=degree, clip=clip, **(solving or {}))
    method = (solving or {}).get("method", "joint")
    reference, epoch = check_reference(reference, epoch=epoch, pixel_scale=pixel_scale, method=method)
    timings = {}
    with _timed(timings, "read"):
        exposures = open_exposures(paths, ext=ext, progress=progress)
        _check_shapes(exposures)
        if min_exposures > len(exposures):
            raise InputError(
                f"min_exposures is {min_exposures}, but there are {len(exposures)} exposures: "
                f"give min_exposures={len(exposures)} (--min-exposures) or less"
            )
    with _timed(timings, "measure"):
        share = {"workers": workers, "progress": progress}
        detections = measure(exposures, **share, **(measuring or {}))
    with _timed(timings, "match"):
        matches = match(detections, exposures=exposures, min_exposures=min_exposures, **(matching or {}))
    with _timed(timings, "solve"):
        tying = {"reference": reference, "epoch": epoch, "pixel_scale": pixel_scale}
        solution = solve(matches, degree=degree, prior=prior, clip=clip, **tying, **(solving or {}))
        solution = provenance.with_inputs(solution, provenance.checksums(expand_paths(paths)))
    comparison = None
    if compare:
        with _timed(timings, "compare"):
            comparison = baselines.compare(matches, solution, prior=prior)
    coadding = {"method": "clipped"} | (coadding or {})
    with _timed(timings, "coadd"):
        kept = [exposure for exposure in exposures if exposure.name in solution.names]
        mosaic = coadd(kept, solution, **share, **coadding)
    with _timed(timings, "assess"):
        judged = _if_possible(stack_quality.assess, mosaic, solution, exposures=kept)
    stacks = None
    if comparison and judged:
        with _timed(timings, "compare"):
            stacks = _if_possible(stack_quality.compare_stacks, kept, comparison, mosaic=mosaic, **coadding)
    with outputs.replacing_folder(out) as target:
        with _timed(timings, "write"):
            write_results(solution, target)
            mosaic.write(target / "mosaic.fits")
        summary = summarise(solution, timings=timings) | {"fwhm_ratio": judged and judged.fwhm_ratio}
        if judged:
            summary["quality"] = asdict(judged)
        if comparison:
            summary["comparison"] = {name: accuracy.scatter_summary(made) for name, made in comparison.items()}
        if stacks:
            summary["stacks"] = stacks.figures()
        shown = {"mosaic": mosaic, "summary": summary, "comparison": comparison, "stacks": stacks}
        write_report(target / "report.html", solution, **shown)
        write_summary(target / "summary.json", summary)
    return Run(out, solution, mosaic, summary)


def write_results(solution, target):
    """Write ``solution.asdf``, ``stars.ecsv`` and ``wcs/NAME.asdf`` of a solution into an existing folder."""
    solution.write(target / "solution.asdf")
    write_stars(solution, target / "stars.ecsv")
    (target / "wcs").mkdir()
    for name in solution.names:
        write_wcs(solution, name, target / "wcs" / f"{name}.asdf")


def write_summary(path, summary):
    """Write figures as JSON, in the place of those that are there."""
    with outputs.replacing(path, overwrite=True) as file:
        file.write(f"{json.dumps(summary, indent=1)}\n".encode())


def summarise(solution, *, timings=None):
    """Figures of a solution as plain numbers and strings, as ``--json`` prints them.

    ``rms_px``: unweighted rms residual per axis, used observations. ``sigma_px``: the paper's sigma (section 3.4) over
    the fitted stars, per axis.
    """
    found, sigma = solution.diagnostics, accuracy.scatter(accuracy.corrected_positions(solution))
    return {
        "n_exposures": len(solution.names),
        "n_stars": int(np.count_nonzero(np.isfinite(solution.positions[:, 0]))),
        "n_observations": int(np.count_nonzero(solution.observations["used"])),
        "chi2": float(solution.chi2),
        "dof": int(solution.dof),
        "rms_px": float(np.sqrt(np.mean(solution.rms**2))),
        "sigma_px": float(np.sqrt(np.nanmean(sigma**2))),
        "gauge": solution.gauge.sentence,
        "unknown": list(solution.gauge.unknown_names),
        "sky": solution.sky_sentence,
        "reference": found.reference and asdict(found.reference),
        "max_inverse_error_px": float(solution.max_inverse_error),
        "left_out": dict(solution.left_out),
        **found.summary(),
        "timings": {step: round(seconds, 3) for step, seconds in (timings or {}).items()},
    }


def _if_possible(judge, *args, **kwargs):
    """What a judgement of the mosaic says, or None: a run does not fail because no star can be measured in it."""
    try:
        return judge(*args, **kwargs)
    except InputError as error:
        log.warning("no figures of the mosaic's quality: %s", error)
        return None


def check_folder(out, overwrite):
    """Raise `InputError` if `out` cannot be a folder, or holds results and `overwrite` is false."""
    outputs.check_folder(out)
    there = [name for name in outputs.RESULTS if (Path(out) / name).exists()]
    if there and not overwrite:
        raise InputError(
            f"{out} already holds {', '.join(there)}; give overwrite=True (--overwrite) to replace a run, or another "
            "folder"
        )


def _check_shapes(exposures):
    """All frames of a run show one detector; a run on a mixture would co-add nonsense."""
    if len(exposures) < 2:
        raise MatchError(
            f"only one exposure ({exposures[0].name}): the distortion is found from the differences between "
            "exposures, give at least two of the same field"
        )
    first = exposures[0]
    for exposure in exposures[1:]:
        if exposure.shape != first.shape:
            raise InputError(
                f"exposure {exposure.name} has shape {exposure.shape}, {first.name} has {first.shape} (ny, nx): "
                "give frames of one detector, or solve their tables with a shape for each"
            )


@contextmanager
def _timed(timings, step):
    log.info("%s ...", step)
    begin = time.perf_counter()
    yield
    timings[step] = timings.get(step, 0.0) + time.perf_counter() - begin
    log.info("%s: %.1f s", step, timings[step])
