"""A simulated GSAOI night: its settings, and the truth drawn from them."""

from dataclasses import dataclass, fields, replace
from datetime import datetime, timedelta
from functools import cached_property

import numpy as np
from astropy.io import fits
from astropy.time import Time

from ..cameras.camera import GSAOI_SCALE, Camera
from ..exceptions import InputError
from ..geometry import basis, similarity
from ..geometry.gsaoi import GSAOI_SIZE, GsaoiMap
from ..geometry.tangent_plane import TangentPlane
from ..runtime.checks import check_counts
from . import rendering
from .pupil import PupilPSF
from .truth import (
    Truth,
    checked_epochs,
    draw_coefficients,
    draw_motions,
    draw_poses,
    draw_stars,
    exposure_names,
    fit_static,
    footprint,
    mode_orders,
    shifted,
    within,
)

_YEAR = 365.25 * 86400  # seconds


@dataclass(frozen=True)
class Night:
    """Settings of a simulated GSAOI night in the likeness of Bernard et al. (2017, section 5).

    Attributes
    ----------
    n_exposures, n_stars : int
        Every star lies on at least one exposure.
    size : int
        Pixels along a side; other than 2048 it is the same field on coarser pixels.
    dither : float
        Rms length of the dithers, pixels (5 arcsec at 20 mas are 250); uniform in a square.
    dynamic_rms : float
        Rms over the detector of the displacement, both axes together, that an exposure adds to the static
        distortion, pixels. Degrees 1 to 3; coefficients of degree l have standard deviations that go as 1/l.
    residue_rms : float
        Rms of the same kind, pixels, of a dynamic part of degrees 4 to 6, all modes alike, which a fit of degree 3
        cannot follow.
    zero_mean : bool
        Subtract the mean over the exposures from these.
    detector : int
        Of GSAOI, for its static distortion: 2 is the lower left one.
    camera : str or None
        "gsaoi": all four detectors of `size` pixels along a side, each in an extension ``SCI``. What an exposure adds
        to the static distortions then is one distortion of the focal plane.
    pointing_error : float
        How far every header is off on the sky, arcsec, in random directions.
    sigma_range : tuple of float
        Position errors of the brightest and of the faintest star, pixels; they set the fluxes.
    fwhm, beta, ellipticity : float
        Moffat profile: pixels, exponent, 1 - axis ratio. Exposures scatter about them (5 %, 0, 30 %).
    psf : object, optional
        Instead of these: a `~legdistort.simulation.pupil.PupilPSF`, about which exposures scatter; anything else that
        `~legdistort.simulation.rendering.as_psf` takes, the same in all; a list with one for every exposure; or a
        function of the exposure's number that returns one.
    sky : float
        ADU a pixel.
    gain, read_noise, saturation : float
        Electrons per ADU, electrons, ADU.
    exptime : float
        Seconds; for the header only.
    motion : float or array_like, shape (n_stars, 2)
        Proper motions, pixels a year: the scatter per axis of those drawn, or themselves.
    parallax : float or array_like, shape (n_stars,)
        Pixels: the scatter of those drawn, or themselves.
    epochs : sequence of float, optional
        Years of the exposures; those of one year follow each other as in a night. None: one night.
    """

    n_exposures: int = 11
    n_stars: int = 120
    size: int = 2048
    dither: float = 250.0
    dynamic_rms: float = 0.4
    residue_rms: float = 0.0
    zero_mean: bool = False
    detector: int = 2
    camera: str | None = None
    pointing_error: float = 0.3
    sigma_range: tuple = (0.002, 0.14)
    fwhm: float = 4.5
    beta: float = 2.8
    ellipticity: float = 0.1
    psf: object = None
    sky: float = 200.0
    gain: float = 2.0
    read_noise: float = 15.0
    saturation: float = 50000.0
    exptime: float = 60.0
    motion: float = 0.0
    parallax: float = 0.0
    epochs: tuple | None = None

    def __post_init__(self):
        check_counts(n_stars=self.n_stars, n_exposures=self.n_exposures, size=self.size)
        lo, hi = self.sigma_range
        if not 0 < lo <= hi:
            raise InputError(f"sigma_range must be (smallest, largest) error in pixels, got {self.sigma_range!r}")
        if self.camera not in (None, "gsaoi"):
            raise InputError(f"camera must be 'gsaoi' or None, got {self.camera!r}")
        if not self.residue_rms >= 0:
            raise InputError(f"residue_rms must not be negative, got {self.residue_rms!r}")
        if isinstance(self.psf, (list, tuple)) and len(self.psf) != self.n_exposures:
            raise InputError(f"psf lists {len(self.psf)} for {self.n_exposures} exposures")
        if self.psf is not None:
            object.__setattr__(self, "fwhm", self._middle.fwhm)

    @property
    def cadence(self):
        """Seconds from exposure to exposure."""
        return self.exptime + 20

    def psf_of(self, exposure, rng=None):
        """What renders one exposure, by its number; what scatters from exposure to exposure is drawn from `rng`."""
        if isinstance(self.psf, (list, tuple)):
            return self.psf[exposure]
        if callable(self.psf) and not rendering.is_psf(self.psf):
            return self.psf(exposure)
        psf = rendering.Moffat(self.fwhm, self.beta, self.ellipticity) if self.psf is None else self.psf
        return psf.varied(rng) if rng is not None and isinstance(psf, (rendering.Moffat, PupilPSF)) else psf

    @cached_property
    def _middle(self):
        """The PSF of the first exposure, in the middle of the field."""
        psf, shape = self.psf_of(0), (self.size, self.size)
        return psf.over(shape, nodes=1) if isinstance(psf, PupilPSF) else rendering.as_psf(psf, shape)

    def position_error(self, flux):
        """Smallest possible position error [pix] at these fluxes [ADU], in the middle of the field."""
        camera = {"sky": self.sky, "gain": self.gain, "read_noise": self.read_noise}
        return rendering.position_error(flux, psf=self._middle, **camera)


#: A night that is rendered and reduced in seconds.
SMALL_NIGHT = Night(n_exposures=6, n_stars=70, size=512, dither=60.0)
#: What changes where all detectors are simulated: as many pixels, over the field of 85 arcsec, in all.
_OF_CAMERA = {False: {"n_stars": 300, "size": 1024, "dither": 125.0}, True: {"size": 256, "dither": 35.0}}


def make_night(small, *, camera=None, **settings):
    """`SMALL_NIGHT` or the default `Night` with some attributes changed; `InputError` for what is none of them."""
    if camera:
        settings = _OF_CAMERA[bool(small)] | settings | {"camera": camera}
    known = [field.name for field in fields(Night)]
    unknown = sorted(settings.keys() - known)
    if unknown:
        raise InputError(f"unknown setting {unknown[0]!r}; a night has {', '.join(known)}")
    return replace(SMALL_NIGHT if small else Night(), **settings)


def draw_night(night, seed):
    """The truth of a night, and the generator for what is left to draw (profiles and noise).

    Parameters
    ----------
    night : Night
    seed : int
        Seed of everything.

    Returns
    -------
    truth : `~legdistort.simulation.truth.Truth`
    rng : `~numpy.random.Generator`
    """
    star_rng, map_rng, pose_rng, noise_rng, motion_rng = np.random.default_rng(seed).spawn(5)
    names = exposure_names(night.n_exposures)
    if night.camera:
        camera, instrument = Camera.gsaoi(size=night.size), None
        shape, pixel_scale = camera.field, GSAOI_SCALE * GSAOI_SIZE / night.size
    else:
        camera, instrument = None, GsaoiMap(night.detector, night.size)
        shape, pixel_scale = (night.size, night.size), instrument.pixel_scale
    true_poses = draw_poses(pose_rng, names, shape, night.dither)
    dynamic = _draw_dynamic(map_rng, night)
    sky = _sky(pixel_scale, shape)
    epochs = night.epochs
    if epochs is not None:
        epochs = checked_epochs(epochs, night.n_exposures) + np.arange(night.n_exposures) * night.cadence / _YEAR
    moving = draw_motions(motion_rng, night.n_stars, night.n_exposures, night.motion, night.parallax, epochs, sky)
    truth = Truth(
        names=names,
        shape=shape,
        positions=np.empty((0, 2)),
        flux=_draw_flux(star_rng, night),
        static=fit_static(instrument, shape, basis.degree_of(dynamic.shape[2])) if instrument else 0 * dynamic[0],
        dynamic=dynamic,
        poses=true_poses,
        nominal_poses=_point_wrongly(pose_rng, true_poses, night.pointing_error / pixel_scale),
        instrument=instrument,
        sky=sky,
        camera=camera,
        **moving,
    )
    positions = draw_stars(
        star_rng,
        night.n_stars,
        footprint(true_poses.values(), shape),
        lambda xy: stars_inside(truth, night, xy),
        1,
        separation=10 * night.fwhm,
    )
    return replace(truth, positions=positions), noise_rng


def _draw_dynamic(rng, night):
    low = _draw_degrees(rng, night, night.dynamic_rms, range(1, 4), power=-1)
    if night.residue_rms == 0:
        return low
    high = _draw_degrees(rng, night, night.residue_rms, range(4, 7), power=0)
    high[:, :, : low.shape[2]] = low
    return high


def _draw_degrees(rng, night, rms, degrees, *, power):
    """Coefficients of some degrees l, standard deviations as l**power, for this rms displacement of both axes."""
    total = np.sum(mode_orders(max(degrees)), axis=1)
    spectrum = np.where(np.isin(total, degrees), np.maximum(total, 1.0) ** power, 0)
    # a coefficient a displaces by a/2 rms over the detector, on each of two axes
    spectrum *= rms / np.sqrt(2 * np.sum(spectrum**2) / 4)
    return draw_coefficients(rng, spectrum, max(degrees), night.n_exposures, "dynamic_rms", zero_mean=night.zero_mean)


def _point_wrongly(rng, true_poses, error):
    """Poses as headers know them: `error` pixels off in random directions."""
    angle = rng.uniform(0, 2 * np.pi, len(true_poses))
    shifts = error * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return {name: shifted(pose, shift) for (name, pose), shift in zip(true_poses.items(), shifts, strict=True)}


def stars_inside(truth, night, xy):
    """Which positions lie at least 3 FWHM inside each exposure, on any detector, bool (n_exposures, n)."""
    margin = 3 * night.fwhm
    if not truth.camera:
        return np.array([within(truth.distort(name, xy), truth.shape, margin) for name in truth.names])
    keys, size = truth.camera.detectors, (night.size, night.size)
    on = [[within(truth.on_detector(name, key, xy), size, margin) for key in keys] for name in truth.names]
    return np.any(on, axis=1)


def _draw_flux(rng, night):
    """Fluxes within `night.sigma_range`, three times as many for every factor of 40 fainter."""
    grid = np.geomspace(1, 1e12, 500)
    error = night.position_error(grid)
    bright, faint = np.exp(np.interp(np.log(night.sigma_range), np.log(error[::-1]), np.log(grid[::-1])))
    slope = 0.3
    a, b = faint**-slope, bright**-slope
    return (a + (b - a) * rng.random(night.n_stars)) ** (-1 / slope)


def _sky(pixel_scale, shape):
    """N159W, as in the paper: north up, east left, tangent point in the middle of the reference plane."""
    s, (y, x) = pixel_scale / 3600, (np.array(shape) - 1) / 2
    return TangentPlane(84.916667, -69.765278, np.array([[-s, 0, s * x], [0, s, -s * y]]))


def header(truth, name, night, index, detector=None):
    """FITS header of one exposure, the `index`-th of the night, or of a `detector`, with the nominal TAN WCS."""
    sky, pose = truth.sky, truth.nominal_poses[name]
    if detector is not None:
        pose = similarity.compose(truth.camera[detector].layout, pose)
    tangent = similarity.apply(pose, similarity.invert(sky.matrix)[:, 2])
    cd = sky.matrix[:, :2] @ np.linalg.inv(pose[:, :2])
    start = datetime(2014, 12, 8, 3) + index * timedelta(seconds=night.cadence)
    if truth.years is not None:
        start = Time(Time(truth.years[index], format="jyear", scale="utc").isot, scale="utc").to_datetime()  # ms
    return fits.Header(
        [
            ("FILENAME", f"{name}.fits"),
            ("OBJECT", "SIMULATED", "simulated star field"),
            *([("CCDCHIP", int(detector))] if detector else []),
            ("DATE-OBS", start.isoformat(timespec="auto" if truth.years is None else "milliseconds")),
            ("MJD-OBS", round((start - datetime(1858, 11, 17)) / timedelta(days=1), 8)),
            ("EXPTIME", night.exptime, "[s]"),
            ("GAIN", night.gain, "[electron/adu]"),
            ("RDNOISE", night.read_noise, "[electron]"),
            ("SATURATE", night.saturation, "[adu]"),
            ("BUNIT", "adu"),
            ("CTYPE1", "RA---TAN"),
            ("CTYPE2", "DEC--TAN"),
            ("CUNIT1", "deg"),
            ("CUNIT2", "deg"),
            ("RADESYS", "ICRS"),
            ("CRVAL1", sky.lon),
            ("CRVAL2", sky.lat),
            ("CRPIX1", tangent[0] + 1),
            ("CRPIX2", tangent[1] + 1),
            *((f"CD{i + 1}_{j + 1}", cd[i, j]) for i in (0, 1) for j in (0, 1)),
        ]
    )
