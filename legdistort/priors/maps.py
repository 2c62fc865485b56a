"""A static distortion as FITS maps of the shift of every pixel in x and in y, with maps of their standard errors.

What IRAF's task ``drizzle`` and KAI read: the shift is added to the position of a pixel in the raw image to give the
undistorted one. `legdistort.priors.from_files` reads them.
"""

from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.time import Time
from scipy.interpolate import RectBivariateSpline

from ..cameras.camera import IMAGE
from ..exceptions import InputError
from ..geometry import basis
from ..geometry.detector_modes import similarity_basis
from ..geometry.distortion import Distortion
from ..results.errors import absolute_errors
from ..results.solution import Solution
from ..runtime.outputs import check_file, replacing
from ..runtime.provenance import checksums
from .storage import FURTHER_NIGHT, ONE_NIGHT

#: Places along each axis where errors are made, between which splines run; how many of them, and pixels, at once.
_PLACES, _TOGETHER, _PIECE = 65, 500, 1 << 18
#: What is added to the name of a file, and what the file holds.
_FILES = {
    "x": "shift in x, added to a pixel's position to undistort it",
    "y": "shift in y, added to a pixel's position to undistort it",
    "x_err": "standard error of the shift in x",
    "y_err": "standard error of the shift in y",
}


_UNNAMED = IMAGE, "camera"  # names of cameras that have none
#: Of what the errors are, by the word in the header.
_ERRORS_OF = {
    FURTHER_NIGHT: "of a further night: the error of the mean of the nights and the scatter between nights",
    ONE_NIGHT: "of the one night that the map is of, which does not tell how far nights scatter",
    "exposure": "of an exposure of the night that the map is of, which does not tell how far nights scatter",
    "stated": "as stated of the static distortion (static_sigma)",
}


def errors_of(prior):
    """Of what the errors of the maps of a prior are, if they have errors: a word, and it in a sentence."""
    of = prior.source.get("errors_of", "stated") if isinstance(prior.source, dict) else "stated"
    of = "exposure" if prior.static_sigma is None else of
    return of, f"errors are those {_ERRORS_OF[of]}"


def map_paths(path):
    """``NAME_x.fits``, ``NAME_y.fits``, ``NAME_x_err.fits`` and ``NAME_y_err.fits`` of ``NAME.fits``."""
    path = Path(path)
    return [path.with_name(f"{path.stem}_{word}{path.suffix}") for word in _FILES]


def write_maps(prior, path, *, solution=None, overwrite=False):
    """Write the static distortion of a prior as two maps and, where it has errors, two of these.

    The errors are those by its `static_covariance`, or by its `static_sigma`, every coefficient by itself. Without any,
    those of the solution that it was made of, given or in the file that it states: the mean over exposures of the
    variance of their maps, terms that are a part of these and what is known of the common map counted in, a shift,
    rotation and scale left out.

    Parameters
    ----------
    prior : Prior
    path : path
        ``NAME.fits``, which becomes the names of `map_paths`.
    solution : Solution, optional
        That of which the prior is `Prior.from_solution`, for the errors that this has not if it is of one night.
    overwrite : bool

    Returns
    -------
    list of path
        Two or four.

    Raises
    ------
    InputError
        For a prior without a mean or the shape of the detector, errors that are infinite or not determined, and files
        that exist.
    """
    paths = map_paths(path)
    for each in paths:
        check_file(each, overwrite=overwrite)
    if prior.shape is None or not prior.states_mean:
        raise InputError(f"{path}: maps need a static distortion and the size of its detector: give a prior with both")
    solution = _solution_of(prior) if solution is None else solution
    distortion = Distortion(prior.mean, prior.shape, table=prior.table)
    maps = list(_shifts(distortion))
    if prior.static_sigma is not None or solution is not None:
        maps += list(_errors(prior, solution, distortion, path))
    stated = _stated(prior, len(maps) > 2)
    for each, (word, what), values in zip(paths, _FILES.items(), maps, strict=False):
        hdu = fits.PrimaryHDU(values)
        hdu.header["BUNIT"] = "pix"
        hdu.header["EXTNAME"] = word.upper()
        hdu.header.extend(stated)
        hdu.header["COMMENT"] = f"legdistort: {what}"
        with replacing(each, overwrite=overwrite) as file:
            hdu.writeto(file)
    for stale in paths[len(maps) :]:
        stale.unlink(missing_ok=True)
    return paths[: len(maps)]


def _stated(prior, with_errors):
    """Cards on the camera and the dates of a map, where they are known, and on what its errors are of."""
    known, out = prior.source if isinstance(prior.source, dict) else {}, fits.Header()
    if known.get("camera") not in (None, *_UNNAMED):
        out["CAMERA"] = (known["camera"], "the distortion is of this camera")
    dates = [Time(year, format="jyear").isot[:10] for year in known.get("dates", ())]
    if len(set(dates)) == 1:
        out["DATE-AVG"] = (dates[0], "mean of the exposures")
    elif dates:
        out["DATE-BEG"], out["DATE-END"] = (dates[0], "of the first exposures"), (dates[1], "of the last ones")
    if with_errors:
        out["ERRORSOF"], words = errors_of(prior)
        out["HISTORY"] = words
    return out


def _solution_of(prior):
    """The solution in the file that a prior was made of; None without one, or if that has another by now."""
    made_of = prior.source if isinstance(prior.source, dict) and prior.source.get("kind") == "solution" else {}
    path = Path(made_of.get("name", ""))
    if not path.is_file() or checksums(path) != made_of.get("files"):
        return None
    return Solution.read(path)


def _pixels(shape):
    """Pixels (n, 2) of a detector in pieces."""
    ny, nx = shape
    rows = max(1, _PIECE // nx)
    for first in range(0, ny, rows):
        y, x = np.mgrid[first : min(first + rows, ny), 0:nx]
        yield np.column_stack([x.ravel(), y.ravel()]).astype(float)


def _shifts(distortion):
    """Shifts (2, ny, nx) of all pixels of a detector."""
    shifts = [distortion.invert(p) - p for p in _pixels(distortion.shape)]
    return np.concatenate(shifts).T.reshape(2, *distortion.shape)


def _errors(prior, solution, distortion, path):
    """Standard errors (2, ny, nx) of the shifts of all pixels."""
    ny, nx = prior.shape
    x, y = (np.linspace(-0.5, n - 0.5, _PLACES) for n in (nx, ny))
    q = distortion.invert(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    if prior.static_sigma is not None:
        values = basis.values(prior.degree, *basis.normalize(q, prior.shape))
        with np.errstate(invalid="ignore"):
            variance = prior.static_sigma**2 @ values**2
        if (covariance := prior.static_covariance) is not None:
            blocks = covariance.reshape(2, len(values), 2, -1)
            variance = np.stack([np.einsum("mp,mn,np->p", values, blocks[k, :, k], values) for k in range(2)])
    else:
        pieces = [_of_solution(solution, q[first : first + _TOGETHER]) for first in range(0, len(q), _TOGETHER)]
        variance = np.concatenate(pieces, axis=1)
    if not np.isfinite(variance).all():
        raise InputError(
            f"{path}: the exposures do not determine some of the static distortion, so that its errors are not known: "
            "state how well it is known (static_sigma of the prior, --static-sigma)"
        )
    grid = np.sqrt(np.maximum(variance, 0)).reshape(2, _PLACES, _PLACES)
    return np.stack([np.maximum(RectBivariateSpline(y, x, each)(np.arange(ny), np.arange(nx)), 0) for each in grid])


def _of_solution(solution, q):
    """Variance (2, n) of the distortion of an exposure at undistorted pixels q (n, 2), NaN if it is not determined."""
    estimate, first = solution.estimate, next(iter(solution))
    gauge, uncertainty, n_modes = solution.gauge, estimate.uncertainty, solution.coefficients.shape[2]
    if gauge.plane is not None:
        return np.full((2, len(q)), np.nan)
    values = basis.values(solution.degree, *basis.normalize(q, first.shape)).T
    similar = similarity_basis(first.shape, n_modes)
    response = np.kron(np.eye(2), values) @ (np.eye(2 * n_modes) - similar.T @ similar)
    known = []
    for i in range(len(solution.names)):
        block = response @ absolute_errors.own_coefficients(gauge, uncertainty, i) @ response.T
        known.append(absolute_errors.coefficient_variance(gauge, block, i, response))
    variance = np.mean(known, axis=0)
    if camera := uncertainty.camera:
        common = response @ camera.coefficients.mean(axis=0)
        moved = common.reshape(2, len(q), -1) - camera.of_measured(first, q).transpose(1, 0, 2)
        variance = variance + np.sum(moved**2, axis=2)
    return variance
