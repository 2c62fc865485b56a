"""A simulated night run through the whole pipeline and compared with its truth."""

from pathlib import Path

from .pipeline import check_results, run
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
    night = simulate_exposures(small=small, camera=camera, seed=seed, progress=progress)
    truth = night.truth
    out.mkdir(parents=True, exist_ok=True)
    paths = night.write(out / "frames")
    known = {"camera": truth.camera, "ext": "SCI"} if camera else {"prior": published_prior(truth.shape)}
    return run(paths, out=out, **known, truth=truth, workers=workers, overwrite=overwrite, progress=progress)
