"""The whole pipeline: frames -> positions -> matches -> solution -> WCS files, mosaic and report."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .assessment import baselines, run_checks, stack_quality
from .assessment.truth import compare_with_truth
from .cameras.camera import Camera, check_camera
from .coaddition.mosaic_header import is_mosaic
from .coaddition.mosaicking import coadd
from .coaddition.options import CoaddOptions
from .exceptions import AssumptionWarning, InputError, LegdistortError, warn
from .inputs import exposure_files, table_files
from .inputs.exposure_names import left_out_by, whole_name
from .inputs.exposures import observed, stated_numbers
from .inputs.frames.statement import stated_rows
from .inputs.references.gaia import is_gaia
from .matching.matcher import match
from .matching.matches import alone
from .matching.options import MatchOptions, check_enough
from .measurement.earlier import DETECTIONS, EarlierRun, write_detections
from .measurement.options import MeasureOptions
from .measurement.positions import measure_with_psfs, write_psfs
from .measurement.unfinished import Unfinished
from .priors.prior import HEADER, HeaderPrior
from .reporting.page import write_report
from .reporting.summary import rounded, summarise
from .results import accuracy
from .results.check import Check
from .runtime import checks, outputs, parallel, provenance
from .runtime.guards.units import plain_numbers
from .runtime.notebook import ShownAsPrinted
from .runtime.progress import Bar
from .runtime.trees.codec import to_tree
from .runtime.words import CATALOGUES
from .simulation.truth import Truth
from .solving.estimation import solve
from .solving.options import CLIP, DEGREE, SolveOptions, check_detectors, check_reference, prior_as_asked
from .wcs.storage import write_wcs

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import Table
    from astropy.time import Time
    from astropy.units import Quantity

    from .coaddition.mosaic import Mosaic
    from .photometry.catalogue import Catalogue
    from .priors.prior import Prior
    from .results.solution import Solution
    from .runtime.annotations import Extension, Images, StrPath

log = logging.getLogger(__name__)

#: What `write_results` leaves of every solution.
SOLVED = "solution.asdf", "stars.ecsv", "wcs/*.asdf"
#: What `run` leaves with ``catalogue="joint"``.
CATALOGUE = "catalogue.ecsv", "photometry.ecsv"
#: What `run` and the command ``solve`` leave in their folder, and replace or remove there.
RESULTS = (
    *SOLVED, "psf/*.fits", "mosaic.fits", *CATALOGUE, "report.html", "summary.json", "detections.ecsv", "matched.ecsv",
)  # fmt: skip

#: When the command began that calls, its options for another run, and how to call it again; without one None.
_command: ContextVar[tuple[float | None, dict[str, Any], str | None]] = ContextVar("_command", default=(None, {}, None))


@dataclass(frozen=True, eq=False)
class Run(ShownAsPrinted):
    """What `run` made.

    Attributes
    ----------
    out : Path
        Folder with ``solution.asdf``, ``stars.ecsv``, ``wcs/NAME.asdf``, ``mosaic.fits``, ``report.html``.
    solution : Solution
    mosaic : Mosaic or None
    summary : dict
        Plain numbers and strings, see `legdistort.reporting.summary.summarise`.
    catalogue : Catalogue or None
        Of all exposures together, if it was asked for and can be made.
    """

    out: Path
    solution: Solution
    mosaic: Mosaic | None
    summary: dict[str, Any]
    catalogue: Catalogue | None = None

    @property
    def checks(self) -> tuple[Check, ...]:
        """The checks of the solution, and those of images and stack: a tuple of `~legdistort.results.check.Check`."""
        return tuple(Check(**each) for each in self.summary["checks"])

    def __repr__(self) -> str:
        return f"<Run: {self.solution!r} in {self.out}>"


@plain_numbers
def run(
    paths: Images | None = None,
    *,
    out: StrPath,
    earlier: StrPath | None = None,
    ext: Extension | None = None,
    dq_good: int | str | Sequence[int] | None = None,
    weight_maps: str | None = None,
    degree: int = DEGREE,
    prior: Prior | Mapping[str, Prior] | str | HeaderPrior | None = None,
    camera: Camera | None = None,
    min_exposures: int = 4,
    without: str | Sequence[str] = (),
    clip: float | None = CLIP,
    psf: Any = "auto",
    reference: Table | SkyCoord | Solution | StrPath | None = None,
    reference_error: float | Quantity | str | None = None,
    reference_degree: int | None = None,
    epoch: float | Time | None = None,
    pixel_scale: float | None = None,
    measuring: Mapping[str, Any] | None = None,
    matching: Mapping[str, Any] | None = None,
    solving: Mapping[str, Any] | None = None,
    coadding: Mapping[str, Any] | None = None,
    mosaic: bool = True,
    catalogue: str = "none",
    artificial: int | None = None,
    compare: bool = False,
    truth: Truth | None = None,
    stop_at_bad: bool = False,
    overwrite: bool = False,
    keep: bool = False,
    workers: int | None = None,
    progress: bool = False,
) -> Run:
    """Solve a set of frames and co-add them.

    Parameters
    ----------
    paths : str, path, HDUList, NDData or a sequence of them
        See `legdistort.read_exposures`. By default the frames of an `earlier` run.
    out : str or path
        Folder for the results; made if it does not exist. Nothing is left there if the run fails; what it has measured
        of files, be it killed, is then in the folder ``OUT.measured`` beside it, for `earlier`, and the error says so.
    earlier : str or path, optional
        Folder of an earlier run, whose measured positions are taken instead of measuring anew. All options but those of
        reading and measuring may differ, and are those of this call (the command ``run --from`` repeats those of the
        earlier one); of cameras that of the earlier run holds unless one with the same detectors is given. Its frames,
        or those of them that are given, must be unchanged.
    ext : int, str or (str, int), optional
        Extension to read from every file.
    dq_good : int, str or sequence of int, optional
        Flags with which a pixel is used nevertheless.
    weight_maps : str, optional
        Weight maps beside the frames, see `legdistort.read_exposures`.
    degree : int
        Total degree of the distortion.
    prior : Prior, dict, "header" or HeaderPrior, optional
        Static distortion. "header": that of the headers, see `legdistort.Prior.from_headers`.
    camera : Camera, optional
        Where exposures have several detectors: `ext` is the name of several extensions, or each detector has a file of
        its own (`legdistort.Camera.of_detectors`). By default the layout of the detectors is that of the headers
        to begin with, and found with the rest.
    min_exposures : int
        Stars seen in fewer exposures are not used.
    without : str or sequence of str
        Exposures to leave out, by name; ``*`` stands for any letters.
    clip : float or None
        Leave out observations beyond this many standard errors, see `legdistort.solve`.
    psf : str, EffectivePSF, path, photutils model or dict of those
        What the stars are fitted with, see `legdistort.measure`.
    reference, reference_error, reference_degree, epoch, pixel_scale : optional
        Catalogue whose positions are known, or "gaia", see `legdistort.solve`.
    measuring, matching, solving, coadding : dict, optional
        Further arguments of `legdistort.measure`, `match`, `solve` and `coadd`, all of them checked before a frame is
        read. The stack is ``"clipped"`` here: hot pixels and cosmic rays do not get into it.
    mosaic : bool
        Co-add the frames; without it there is no ``mosaic.fits``, and nothing is said of the sharpness of a stack.
    catalogue : {'none', 'joint'}
        'joint': also every star measured in all exposures at once (`legdistort.catalogue`), with what measuring was
        told of detector and PSF, in ``catalogue.ecsv`` and ``photometry.ecsv``. Where none can be made there is a
        warning, and all else is there.
    artificial : int, optional
        So many artificial stars for the catalogue: its column ``flux_bias``, and what it misses in the report.
    compare : bool
        Also correct by shifts, by the prior's static distortion and shifts, and by a relative polynomial
        (`legdistort.assessment.baselines`), and report the scatter and the sharpness of the stack that each of them
        leaves.
    truth : Truth, optional
        The truth of simulated frames (`legdistort.simulate_exposures`): summary and report then state how far the
        result is from it.
    stop_at_bad : bool
        Raise `InputError` for blank, truncated or damaged frames, naming all of them; else they are left out with a
        warning.
    overwrite : bool
        Replace the results of an earlier run, with their folder. See the page on files.
    keep : bool
        Keep other files that are in the folder; they are refused otherwise.
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

    See Also
    --------
    legdistort.measure, legdistort.match, legdistort.solve, legdistort.coadd, legdistort.catalogue : Its steps.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    >>> result = ld.run(night.write("night"), out="results", psf="moffat")
    >>> result.solution.names
    ('exp00', 'exp01', 'exp02', 'exp03')
    >>> sorted(path.name for path in result.out.iterdir() if path.suffix == ".asdf")
    ['solution.asdf']
    """
    check_results(out, overwrite)
    measuring = _step_options(MeasureOptions, measuring, "measuring", psf=psf)
    matching = _step_options(MatchOptions, matching, "matching", min_exposures=min_exposures, progress=progress)
    own = {"degree": degree, "prior": _known_prior(prior), "clip": clip, "pixel_scale": pixel_scale}
    solving = _step_options(SolveOptions, solving, "solving", **own)
    coadding = _step_options(CoaddOptions, coadding, "coadding", defaults={"method": "clipped"}, wanted=mosaic)
    tying = _tying(reference, reference_error, reference_degree, epoch)
    asked = _checked_others(workers, truth, catalogue, artificial)
    reading = {"ext": ext, "dq_good": dq_good, "weight_maps": weight_maps, "camera": camera}
    paths, reading, before = _where_to_begin(paths, earlier, measuring, **reading)
    how = {"measuring": before.measuring if before else measuring, **reading}
    share, timings, at_work = {"workers": workers, "progress": progress}, _of_start(), _unfinished(out := Path(out))
    with at_work, outputs.replacing_folder(out, results=RESULTS, keep=keep) as target:
        check_results(out, overwrite)  # again: nobody else writes there any more
        with timed(timings, "read"):
            exposures, bad = _opened(paths, before, without, min_exposures, stop_at_bad, progress, reference, **reading)
            solving = _known_of(exposures, solving, prior, reading["camera"])
            stated_numbers({whole_name(e): e.header for e in exposures}, matching.keywords)  # refuses what none states
        with timed(timings, "measure"):
            detections, psfs = _detected(exposures, before, how, share, at_work)
        with timed(timings, "match"):
            matches = match(detections, exposures=exposures, camera=reading["camera"], **vars(matching))
            matches = replace(matches, left_out=bad | matches.left_out)
        with timed(timings, "solve"):
            solution = solve(matches, **vars(solving), **tying, progress=progress)
            solution = provenance.with_inputs(solution, exposure_files.file_checksums(exposures))
        kept = [exposure for exposure in exposures if whole_name(exposure) in solution.names]
        stack, quality = _coadded(kept, solution, coadding, share, timings) if mosaic else (None, None)
        joint = _catalogued(asked, kept, solution, how["measuring"], psfs, coadding.scratch, timings, progress)
        comparison, stacks = _compared(compare, matches, solution, solving, quality and stack, kept, coadding, timings)
        summary = summarise(solution, timings=timings) | _counted(joint)
        summary |= _assessed(solution, kept, stack, quality, comparison, stacks, truth, joint)
        shown = {"mosaic": stack, "psfs": psfs, "comparison": comparison, "stacks": stacks, "exposures": kept}
        with parallel.beside(partial(_report, target, solution, summary, shown, joint), workers=workers) as report:
            with timed(timings, "write"):
                write_results(solution, target, psfs=psfs, mosaic=stack, joint=joint, progress=progress)
                write_detections(target / DETECTIONS, detections, exposures, out, **how)
                write_matched(target / "matched.ecsv", matches, solution.provenance["inputs"])
            summary = _written_summary(target, summary, timings, report)
    return Run(out, solution, stack, summary, joint)


def _coadded(exposures, solution, coadding, share, timings):
    """The stack, and how sharp it is, if that can be judged."""
    with timed(timings, "coadd"):
        stack = coadd(exposures, solution, **vars(coadding), **share)
    with timed(timings, "assess"):
        return stack, _if_possible(stack_quality.assess, stack, solution, exposures=exposures)


def _catalogued(asked, exposures, solution, measuring, psfs, scratch, timings, progress):
    """The catalogue of all exposures; None if none is asked for, and with a warning where there can be none."""
    if asked is None:
        return None
    from .photometry.catalogue import catalogue  # it loads numba

    told = {name: getattr(measuring, name) for name in ("fwhm", "gain", "read_noise", "saturation")}
    psf = {exposure.name: psfs.get(exposure.name, "moffat") for exposure in exposures} if psfs else measuring.psf
    try:
        with timed(timings, "catalogue"):
            return catalogue(exposures, solution, **told, psf=psf, **asked, scratch=scratch, progress=progress)
    except LegdistortError as error:
        warn(f"no catalogue of all exposures together: {error}", AssumptionWarning)
        return None


def _counted(joint):
    """The entry of the summary on the catalogue of all exposures, if there is one."""
    if joint is None:
        return {}
    meta = joint.stars.meta
    counts = {name: meta[name] for name in ("n_new", "n_lost", "n_rejected", "n_images", "noise_peaks", "threshold")}
    return {"catalogue": {"n_stars": len(joint.stars)} | counts}


def _report(target, solution, summary, shown, joint):
    """The report of all that `run` leaves, whether it is there yet or written beside it."""
    absent = CATALOGUE * ("catalogue" not in summary) + ("psf/*.fits",) * (not shown["psfs"])
    absent += ("mosaic.fits",) * (shown["mosaic"] is None)
    files = linked_files(name for name in RESULTS if name not in absent)
    write_report(target / "report.html", solution, summary=summary, **shown, joint=joint, files=files)


def _written_summary(target, summary, timings, report):
    """The summary with all times, once the report is there, and what there is to check the files by; writes it."""
    with timed(timings, "report"):
        report()
    begun, asked, _ = _command.get()
    summary = summary | {"timings": rounded(timings)} | ({} if begun is None else {"options": asked})
    summary |= outputs.listed_files(target)
    outputs.write_summary(target / "summary.json", summary)
    return summary


@contextmanager
def called_by(begun, options, again):
    """Context in which `run` counts the time of a command since it began (`time.perf_counter`) as the step "start".

    And leaves its options, ``{flag: text or None}``, in the summary, for a run that goes on from there. `again` is the
    command for such a run where this one fails, but for the folder that it goes on from.
    """
    token = _command.set((begun, options, again))
    try:
        yield
    finally:
        _command.reset(token)


def _unfinished(out):
    """What keeps what a run measures until its results are there."""
    begun, asked, again = _command.get()
    return Unfinished(out, {} if begun is None else {"options": asked}, again)


def _of_start():
    """Seconds by step, to begin with: what the command took that calls, if it is one."""
    since, *_ = _command.get()
    return {} if since is None else {"start": time.perf_counter() - since}


def _opened(paths, before, without, min_exposures, stop_at_bad, progress, reference, *, camera, **reading):
    """Exposures that can be solved together, called as `before`, and the others as ``{name: reason}``."""
    bad = {}
    options = {"left_out": bad, "stop_at_bad": stop_at_bad, "progress": progress}
    exposures = exposure_files.open_exposures(paths, **options, **reading)
    exposures = camera.of_detectors(exposures) if camera else exposures
    exposures = before.named(exposures) if before else exposures
    asked = left_out_by(without, list(dict.fromkeys(map(whole_name, exposures))))
    exposures, bad = [each for each in exposures if whole_name(each) not in asked], bad | asked
    _check_exposures(exposures, min_exposures, bad, reference is not None)
    return exposures, bad


def _known_of(exposures, solving, prior, camera):
    """The options of `solve` with the prior of these exposures; choices about a camera are refused without one."""
    several = camera.has_focal_plane if camera else any(exposure.exposure for exposure in exposures)
    check_detectors(several, solving.layout, solving.static, solving.dynamic, solving.layout_sigma)
    if several and isinstance(prior, str | HeaderPrior):
        raise InputError(
            "prior='header' (--prior header) is for frames of one detector: static='fit' (--static fit) finds the "
            "distortions of several, or a camera (--camera) states them"
        )
    known = _known_prior(prior, exposures, solving.degree)
    if camera is None and not several and solving.model is None:
        prior_as_asked(known, solving.static)  # refuses before anything is measured
    return replace(solving, prior=known)


def _where_to_begin(paths, earlier, measuring, **reading):
    """Frames, how they are read, and the earlier run that has measured them, or None."""
    camera = reading["camera"]
    check_camera(camera)
    if earlier is None and paths is None:
        raise InputError("give frames, or the folder of an earlier run to go on from (earlier=, --from)")
    if earlier is None:
        return paths, reading, None
    usual = dict.fromkeys(reading) | vars(MeasureOptions())
    for name, value in (reading | vars(measuring)).items():
        if name != "camera" and value is not usual[name] and value != usual[name]:
            raise InputError(
                f"{name} is not to be given with an earlier run: that of {earlier} holds, or measure the frames again"
            )
    before = EarlierRun.read(earlier)
    return before.frames if paths is None else paths, before.reading | {"camera": camera or before.camera}, before


def _tying(reference, error, degree, epoch):
    """What ties the solution to the sky, as arguments of `solve`; Gaia is asked there."""
    known, epoch = check_reference(reference, error=error, degree=degree, epoch=epoch)
    tying = {"reference": known, "epoch": epoch}
    return tying | ({"reference_error": error, "reference_degree": degree} if is_gaia(known) else {})


def _known_prior(prior, exposures=None, degree=3):
    """The prior; that of the headers is read from the exposures, or has a stand-in for checks before there are any."""
    if isinstance(prior, str) and prior == HEADER:
        prior = HeaderPrior()
    if not isinstance(prior, HeaderPrior):
        return prior
    return prior.stand_in if exposures is None else prior.read(exposures, degree)


def _step_options(kind, given, argument, *, defaults=None, wanted=True, **own):
    """The frozen options of a step: from its dict, from what `run` takes itself, and from the defaults of `run`."""
    kind(**own)  # errors of these are raised without a mention of the dict
    given = {} if given is None else given
    if isinstance(given, dict):
        usual = vars(kind()) | (defaults or {}) | {"scratch": given.get("scratch")}  # which the catalogue uses too
        idle = [name for name, value in given.items() if name in usual and value != usual[name]]
        if idle and not wanted:
            raise InputError(f"without a mosaic (mosaic=False, --no-mosaic) nothing is co-added: leave {idle[0]} out")
        for name in own.keys() & given:
            raise InputError(f"{argument} has the option {name!r}: give it as the argument {name} of run itself")
        given = (defaults or {}) | own | given
    return checks.options_from(kind, given, argument)


def _checked_others(workers, truth, catalogue, artificial):
    """What is asked of a catalogue, None without one; `InputError` for arguments that no step looks at before."""
    parallel.check_workers(workers)
    checks.check_choice(catalogue, CATALOGUES, "catalogue")
    if artificial is not None:
        checks.check_counts(artificial=artificial)
        if catalogue == "none":
            raise InputError(
                "artificial stars tell what a catalogue misses: give catalogue='joint' (--catalogue joint)"
            )
    if truth is not None and not isinstance(truth, Truth):
        raise InputError(
            f"truth must be that of a simulation (simulate_exposures(...).truth), got {type(truth).__name__}"
        )
    return None if catalogue == "none" else {"artificial": artificial}


def _assessed(solution, exposures, stack, quality, comparison, stacks, truth, joint):
    """The entries of the summary on images, mosaic and other corrections, as far as known, with all checks."""
    checked = solution.checks + run_checks.check_run(solution, quality, stacked=stack is not None, joint=joint)
    figures = {"checks": [to_tree(check) for check in checked], "fwhm_ratio": quality and quality.fwhm_ratio}
    figures |= {"observed": observed(exposures), "stated": stated_rows(exposures)}
    if quality:
        figures["quality"] = asdict(quality)
    if comparison:
        figures["comparison"] = {name: accuracy.scatter_summary(made) for name, made in comparison.items()}
    if stacks:
        figures["stacks"] = stacks.figures()
    return figures if truth is None else figures | compare_with_truth(solution, truth)


def write_matched(path, matches, inputs, *, overwrite=False):
    """Write matches with all that is known of their exposures, and the checksums of what they were made from."""
    table = matches.table.copy()
    table.meta = matches.to_meta() | {"inputs": inputs}
    table_files.write_table(table, path, overwrite=overwrite)


def write_results(solution, target, *, psfs=None, mosaic=None, joint=None, progress=False):
    """Write ``solution.asdf``, ``stars.ecsv``, ``wcs/NAME.asdf``, ``psf/NAME.fits``, ``mosaic.fits`` into a folder.

    And ``catalogue.ecsv``, ``photometry.ecsv``, where there is a joint catalogue. Of a camera the WCSs are those of its
    detectors, ``wcs/NAME-DETECTOR.asdf``.
    """
    solution.write(target / "solution.asdf")
    table_files.write_stars(solution, target / "stars.ecsv")
    (target / "wcs").mkdir()
    for view in Bar(list(solution), desc="writing", unit="WCS", disable=not progress):
        for part in view.parts:
            if part.fold:
                warn(f"no WCS of {part.label}: {part.fold}", AssumptionWarning)
            else:
                write_wcs(part, target / "wcs" / f"{part.label}.asdf")
    write_psfs(psfs or {}, target / "psf")
    if mosaic is not None:
        mosaic.write(target / "mosaic.fits")
    if joint is not None:
        joint.write(target / CATALOGUE[0])


def linked_files(made):
    """Some of `RESULTS` as the report beside them links to them: files, and folders of many."""
    parts = (Path(name).parts for name in made if name != "report.html")
    return [first + "/" * len(more) for first, *more in parts]


def _compared(wanted, matches, solution, solving, mosaic, kept, coadding, timings):
    """Other corrections, and the stacks that they make where that of the run could be judged; None where not wanted."""
    if not wanted:
        return None, None
    with timed(timings, "compare"):
        comparison = baselines.compare(matches, solution, prior=solving.prior)
        stacks = mosaic and _if_possible(
            stack_quality.compare_stacks, kept, comparison, mosaic=mosaic, **vars(coadding)
        )
    return comparison, stacks


def _if_possible(judge, *args, **kwargs):
    """The result of a judgement of the mosaic, or None: a run does not fail because no star can be measured in it."""
    try:
        return judge(*args, **kwargs)
    except InputError as error:
        log.warning("no figures of the mosaic's quality: %s", error)
        return None


def check_results(out, overwrite):
    """Raise `InputError` if `out` cannot be a folder, or holds results and `overwrite` is false."""
    outputs.check_folder(out)
    out = Path(out)
    there = [name for name in dict.fromkeys(Path(each).parts[0] for each in RESULTS) if (out / name).exists()]
    folders = {"wcs", "psf"}
    for name in there:
        if (out / name).is_dir() is not (name in folders) or (name in folders and (out / name).is_symlink()):
            raise InputError(f"{out / name} is in the place of a result: move it away, or give another folder")
    if there and not overwrite:
        raise InputError(
            f"{out} already holds {', '.join(there)}; give overwrite=True (--overwrite) to replace a run, or another "
            "folder"
        )


def _check_exposures(exposures, min_exposures, bad, tied):
    """There are enough, and all show one detector: a run on a mixture would co-add nonsense."""
    n_frames = len({whole_name(exposure) for exposure in exposures})
    if n_frames < 2 and not tied:
        raise alone(whole_name(exposures[0]))
    detectors = {}
    for exposure in exposures:
        first = detectors.setdefault(exposure.detector, exposure)
        if exposure.shape != first.shape:
            mosaics = [each.path or each.name for each in (exposure, first) if is_mosaic(each.header)]
            raise InputError(
                f"exposure {exposure.name} has shape {exposure.shape}, {first.name} has {first.shape} (ny, nx): "
                + (
                    f"{mosaics[0]} is no frame but a mosaic that legdistort made; leave it out"
                    if mosaics
                    else "give frames of one detector, or solve their tables with a shape for each"
                )
            )
    if n_frames > 1:
        check_enough(n_frames, min_exposures, "usable exposures" if bad else "exposures")


def _detected(exposures, before, how, share, at_work):
    """Detections and PSFs, from an earlier run or measured now; `InputError` if there is no star at all.

    What is measured now is put into the `Unfinished`.
    """
    if before and before.is_whole:
        detections, psfs = before.of(exposures)
    else:
        at_work.begin(exposures, before, how)
        detections, psfs = measure_with_psfs(exposures, how["measuring"], kept=at_work, **share)
        at_work.complete(detections, psfs)
    if len(detections) == 0:
        raise InputError(
            f"no star was detected in any of the {len(exposures)} frames: look at one of them; if there are stars, "
            "lower the limit of detection (default 5), measuring={'threshold': 3} (--threshold 3), or give the width "
            "of the stars in pixels, measuring={'fwhm': ...} (--fwhm PIXELS)"
        )
    return detections, psfs


@contextmanager
def timed(timings, step):
    """Log when a step begins and how long it took, and add its seconds to ``{step: seconds}``."""
    log.info("%s ...", step)
    begin = time.perf_counter()
    yield
    timings[step] = timings.get(step, 0.0) + time.perf_counter() - begin
    log.info("%s: %.1f s", step, timings[step])
