"""Simulated catalogues and images, seeded, with their truth: the direct model of Bernard et al. (2017, section 2).

One source of synthetic truth for tests, demonstrations and benchmarks.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable

from ..exceptions import InputError
from ..geometry import similarity
from ..inputs.table_files import write_table
from ..matching.matches import Matches
from ..runtime import checks, outputs
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import ShownAsPrinted
from ..runtime.progress import Bar
from . import gsaoi_night, rendering
from .truth import (
    Truth,
    draw_coefficients,
    draw_motions,
    draw_poses,
    draw_stars,
    exposure_names,
    footprint,
    shifted,
    within,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..geometry.tangent_plane import TangentPlane
    from ..runtime.annotations import Shape, StrPath


@dataclass(frozen=True, eq=False)
class Simulation(ShownAsPrinted):
    """A simulated catalogue: `matches`, as they would be measured, and the `truth`."""

    matches: Matches
    truth: Truth

    def __repr__(self) -> str:
        return f"<Simulation: {self.matches!r}>"


@dataclass(frozen=True, eq=False)
class SimulatedExposures(ShownAsPrinted):
    """Simulated images.

    Attributes
    ----------
    hdus : dict
        ``{name: HDUList}``, image in the primary HDU, or those of the detectors of a camera in extensions ``SCI``.
    truth : Truth
    psfs : dict
        ``{name: PSF}``, what `~legdistort.simulation.rendering.render` was given for each.
    """

    hdus: dict[str, fits.HDUList]
    truth: Truth
    psfs: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: StrPath) -> list[Path]:
        """Write ``NAME.fits`` for every exposure and ``truth.ecsv``; return the paths of the images."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{name}.fits" for name in self.hdus]
        for path, hdulist in zip(paths, self.hdus.values(), strict=True):
            with outputs.replacing(path, overwrite=True) as file:
                hdulist.writeto(file)
        write_table(self.truth.table(), folder / "truth.ecsv", overwrite=True)
        return paths

    def __repr__(self) -> str:
        ny, nx = self.truth.shape
        return f"<SimulatedExposures: {len(self.hdus)} images of {ny} x {nx} pixels, {len(self.truth.positions)} stars>"


@plain_numbers
def simulate_matches(
    *,
    n_stars: int = 30,
    n_exposures: int = 10,
    degree: int = 3,
    sigma: ArrayLike = 0.14,
    shape: Shape = (2048, 2048),
    static: ArrayLike = 1.5,
    dynamic: ArrayLike = 0.9,
    zero_mean: bool = True,
    dither: float = 0.0,
    rotations: ArrayLike | None = None,
    flips: ArrayLike | None = None,
    seen: float = 1.0,
    margin: float = 0.0,
    min_exposures: int | None = None,
    pose_error: float = 0.0,
    noise: float = 1.0,
    corr: float = 0.0,
    motion: ArrayLike = 0.0,
    parallax: ArrayLike = 0.0,
    epochs: ArrayLike | None = None,
    sky: TangentPlane | None = None,
    seed: int = 0,
) -> Simulation:
    """Catalogues of the same stars in several distorted exposures.

    The default is Simulation 1 of Bernard et al. (2017, section 4.1). What is drawn for stars, distortions, poses and
    noise comes from separate streams of the seed: another `sigma` keeps the same stars and distortions.

    Parameters
    ----------
    n_stars, n_exposures : int
        Counts.
    degree : int
        Total degree of the distortions.
    sigma : float or array_like
        Error of a position per axis, pixels; broadcast to (n_exposures, n_stars), or with a last axis of 2 for
        different errors in x and y.
    shape : tuple of int
        ``(ny, nx)`` of the detector.
    static, dynamic : float or array_like
        Standard deviation of the coefficients, pixels: one for all, per mode (n_modes,), or (2, n_modes).
    zero_mean : bool
        Subtract the mean over the exposures from the dynamic part.
    dither : float
        Rms length of the shifts of the exposures, pixels; uniform in a square.
    rotations : array_like, shape (n_exposures,), optional
        Degrees, about the middle of the detector.
    flips : array_like of bool, shape (n_exposures,), optional
        Exposures seen in a mirror (x reversed).
    seen : float
        Probability that a star on the detector is measured.
    margin : float
        Stars nearer to the detector's edge than this many undistorted pixels are not measured.
    min_exposures : int, optional
        Every star is on the detector in so many exposures at least; default 4 as in the paper, or all if fewer.
    pose_error : float
        Rms error of each component of the nominal shifts that the matches carry, pixels.
    noise : float
        Factor on the noise drawn: 0 leaves the positions exact while their stated errors stay.
    corr : float
        Correlation of the errors in x and y, in (-1, 1).
    motion : float or array_like, shape (n_stars, 2)
        Proper motions, pixels a year: the scatter per axis of those drawn, or themselves.
    parallax : float or array_like, shape (n_stars,)
        Pixels: the scatter of those drawn, or themselves.
    epochs : array_like, shape (n_exposures,), optional
        When the exposures are taken, years; positions are those of their mean.
    sky : `~legdistort.geometry.tangent_plane.TangentPlane`, optional
        Where the field lies, which parallaxes need.
    seed : int
        The same seed gives the same simulation.

    Returns
    -------
    Simulation
        Stars are numbered from 0, the rows of ``truth.positions``.

    Raises
    ------
    InputError
        For arguments out of range.

    See Also
    --------
    simulate_exposures : Images of such a night.
    legdistort.predict : Expected errors without a draw.

    Examples
    --------
    >>> import legdistort as ld
    >>> ld.simulate_matches(n_stars=50, n_exposures=8, sigma=0.02, seed=1)
    <Simulation: <Matches: 400 observations of 50 stars in 8 exposures>>
    """
    checks.check_counts(n_stars=n_stars, n_exposures=n_exposures)
    if not (0 < seen <= 1 and -1 < corr < 1 and dither >= 0 and noise >= 0):
        raise InputError(
            "seen must be in (0, 1], corr in (-1, 1), dither and noise not negative, got "
            f"{seen=}, {corr=}, {dither=}, {noise=}"
        )
    sigma = position_errors(sigma, n_exposures, n_stars)
    star_rng, map_rng, pose_rng, noise_rng, motion_rng = np.random.default_rng(seed).spawn(5)
    moving = draw_motions(motion_rng, n_stars, n_exposures, motion, parallax, epochs, sky)
    static = draw_coefficients(map_rng, static, degree, 1, "static")[0]
    dynamic = draw_coefficients(map_rng, dynamic, degree, n_exposures, "dynamic", zero_mean=zero_mean)
    names = exposure_names(n_exposures)
    true_poses = draw_poses(pose_rng, names, shape, dither, rotations=rotations, flips=flips)
    nominal = {name: shifted(pose, pose_error * pose_rng.normal(size=2)) for name, pose in true_poses.items()}

    def inside(xy):
        # judged by the undistorted position, so that the polynomials are never extrapolated
        return np.array([within(similarity.apply(pose, xy), shape, margin) for pose in true_poses.values()])

    least = min(4, n_exposures) if min_exposures is None else min_exposures
    positions = draw_stars(star_rng, n_stars, footprint(true_poses.values(), shape), inside, least)
    truth = Truth(names, tuple(shape), positions, None, static, dynamic, true_poses, nominal, sky=sky, **moving)
    observed = inside(positions) & (noise_rng.random((n_exposures, n_stars)) < seen)
    return Simulation(matches_from(truth, observed, sigma, noise_rng, noise=noise, corr=corr, sky=sky), truth)


@plain_numbers
def simulate_exposures(
    *,
    small: bool = False,
    camera: str | None = None,
    noise: bool = True,
    seed: int = 0,
    progress: bool = False,
    **settings: Any,
) -> SimulatedExposures:
    """Images of a simulated GSAOI night.

    Stars are drawn with at least 10 FWHM between them; with ``motion`` and ``epochs`` they move, and the headers state
    when. Their true pixels are ``D(q) + d_i(q)``: the published static
    distortion D of the real detector, inverted by Newton's method, and a dynamic Legendre part. With
    ``camera="gsaoi"`` they are those of four detectors in one focal plane, to which the dynamic part belongs.

    Parameters
    ----------
    small : bool
        Six exposures of 512 x 512 pixels instead of eleven of 2048 x 2048; of a camera that has so many in all.
    camera : str, optional
        "gsaoi": its four detectors.
    noise : bool
        Photon and read noise; without it the images are float32 and not clipped at saturation.
    seed : int
        The same seed gives the same night.
    progress : bool
        Show a progress bar.
    **settings
        Any attribute of `~legdistort.simulation.gsaoi_night.Night`.

    Returns
    -------
    SimulatedExposures
        Images in ADU (uint16), headers with GAIN, RDNOISE, SATURATE and a TAN WCS that is off by
        `~legdistort.simulation.gsaoi_night.Night.pointing_error`.

    Raises
    ------
    InputError
        For an unknown setting or one out of range.

    See Also
    --------
    simulate_matches : Positions without images.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=2, seed=1)
    >>> [path.name for path in night.write("night")]
    ['exp00.fits', 'exp01.fits']
    """
    night = gsaoi_night.make_night(small, camera=camera, **settings)
    truth, rng = gsaoi_night.draw_night(night, seed)
    hdus, psfs = {}, {}
    for i, name in enumerate(Bar(truth.names, desc="simulate", disable=not progress)):
        psfs[name] = psf = night.psf_of(i, rng)
        if not truth.camera:
            xy = truth.distort(name, truth.place(name))
            image = _image(night, truth.shape, xy, truth.flux, psf, rng, noise)
            hdus[name] = fits.HDUList([fits.PrimaryHDU(image, gsaoi_night.header(truth, name, night, i))])
            continue
        hdus[name] = fits.HDUList([fits.PrimaryHDU(header=fits.Header({"INSTRUME": "GSAOI"}))])
        for version, (key, chip) in enumerate(truth.camera.detectors.items(), start=1):
            xy = truth.on_detector(name, key, truth.place(name))
            seen = np.isfinite(xy[:, 0])
            image = _image(night, chip.shape, xy[seen], truth.flux[seen], psf, rng, noise)
            header = gsaoi_night.header(truth, name, night, i, detector=key)
            hdus[name].append(fits.ImageHDU(image, header, name="SCI", ver=version))
    return SimulatedExposures(hdus, truth, psfs)


def _image(night, shape, xy, flux, psf, rng, noise):
    """One image of a night; float32 without noise."""
    image = rendering.render(shape, xy, flux, psf=psf, sky=night.sky)
    if not noise:
        return image.astype(np.float32)
    image = rendering.add_noise(image, rng, gain=night.gain, read_noise=night.read_noise)
    return np.rint(np.clip(image, 0, min(night.saturation, 65535))).astype(np.uint16)


def simulate_gsaoi_matches(*, small=False, seed=0, **settings):
    """The catalogue of the same night: positions with the errors of an ideal fit, drawn without images.

    Parameters are those of `simulate_exposures`, and so are the truth, stars and nominal poses of a seed. A star is
    measured where it lies at least 3 FWHM inside the edge; a star measured on fewer than four exposures (or all, if
    there are fewer) is left out, as in the paper.

    Returns
    -------
    Simulation
    """
    night = gsaoi_night.make_night(small, **settings)
    if night.camera:
        raise InputError("camera is for images: simulate_exposures, whose detectors measure finds")
    truth, rng = gsaoi_night.draw_night(night, seed)
    observed = gsaoi_night.stars_inside(truth, night, truth.positions)
    observed &= np.count_nonzero(observed, axis=0) >= min(4, night.n_exposures)
    sigma = np.broadcast_to(night.position_error(truth.flux)[None, :, None], (*observed.shape, 2))
    return Simulation(matches_from(truth, observed, sigma, rng, sky=truth.sky), truth)


def position_errors(sigma, n_exposures, n_stars):
    """Errors as (n_exposures, n_stars, 2)."""
    sigma = np.asarray(sigma, dtype=float)
    full = (n_exposures, n_stars, 2)
    try:
        out = np.broadcast_to(sigma if sigma.ndim == 3 else sigma[..., None], full)
    except ValueError:
        raise InputError(
            f"sigma must broadcast to {full[:2]} (exposures, stars) or to {full}, got shape {sigma.shape}"
        ) from None
    if not np.all(out > 0):
        raise InputError("sigma must be positive everywhere; for positions without noise use noise=0")
    return out


def matches_from(truth, observed, sigma, rng, *, noise=1.0, corr=0.0, sky=None):
    """Matches from truth: `observed` (n_exposures, n_stars) bool, `sigma` (n_exposures, n_stars, 2) pixels."""
    drawn = rng.normal(size=sigma.shape)
    drawn[..., 1] = corr * drawn[..., 0] + np.sqrt(1 - corr**2) * drawn[..., 1]
    xy = np.stack([truth.distort(name, truth.place(name)) for name in truth.names]) + noise * sigma * drawn
    exposure, star = np.nonzero(observed)
    (x, y), (x_err, y_err) = (values[exposure, star].T * u.pix for values in (xy, sigma))
    names = np.array(truth.names)[exposure]
    table = QTable({"exposure": names, "star": star, "x": x, "y": y, "x_err": x_err, "y_err": y_err})
    if corr:
        table["xy_corr"] = np.full(len(star), float(corr))
    if truth.flux is not None:
        table["flux"] = truth.flux[star]
    if truth.years is not None:
        table["epoch"] = truth.years[exposure] * u.yr
    return Matches.from_table(table, shape=truth.shape, poses=truth.nominal_poses, sky=sky, allow_copies=not noise)
