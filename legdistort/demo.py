"""A simulated night run through the whole pipeline and compared with its truth."""

from pathlib import Path

from .exceptions import InputError
from .pipeline import check_results, run
from .runtime.outputs import replacing_folder
from .runtime.parallel import check_workers
from .simulation.example_files import published_prior
from .simulation.observations import simulate_exposures


def run_demo(*, out, small=False, camera=None, seed=0, workers=None, overwrite=False, progress=False):
    """Simulate a GSAOI-like night, solve its frames and report how far the result is from the truth.

    The static distortion is that of a GSAOI detector (published polynomials), known beforehand as the prior; every
    exposure adds a dynamic distortion of its own and a header that is 0.3" off. With ``camera="gsaoi"`` all four
    detectors are simulated, in one file an exposure, and solved as one focal plane.

    Parameters
    ----------
    out : str or path
        Folder; gets ``frames/`` with the FITS files beside the results of `legdistort.run`.
    small : bool
        A night of a few seconds.
    camera : str, optional
        "gsaoi": its four detectors, the field of 85" on coarser pixels, dithered over the gaps.
    seed : int
    workers : int, optional
        As of `legdistort.run`.
    overwrite, progress : bool

    Returns
    -------
    Run
        Its summary and report have the figures of `legdistort.assessment.truth.compare_with_truth`.
    """
    out = Path(out)
    check_results(out, overwrite)
    check_workers(workers)
    if (frames := out / "frames").is_symlink():
        raise InputError(f"{frames} is a link, which would lead elsewhere: remove it, or give another folder")
    night = simulate_exposures(small=small, camera=camera, seed=seed, progress=progress)
    truth = night.truth
    with replacing_folder(frames, overwrite=overwrite) as target:
        paths = [frames / path.name for path in night.write(target)]
    known = {"camera": truth.camera, "ext": "SCI"} if camera else {"prior": published_prior(truth.shape)}
    share = {"workers": workers, "progress": progress}
    return run(paths, out=out, **known, truth=truth, overwrite=overwrite, keep=True, **share)  # the frames stay
