"""What an instrument measures of a star: the error of its position, from its magnitude."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline

from ...cameras.camera import Camera, check_camera
from ...exceptions import InputError
from ...runtime.checks import check_counts, check_positive
from ...runtime.guards.units import plain_numbers
from ...runtime.notebook import ShownAsPrinted
from ..gridded_psf import places_on_pixel
from .presets import described
from .psf_files import FieldPSF, field_psf

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ...runtime.annotations import StrPath

_PHASES = 4  # places of a star along a pixel that are averaged over
_STEP = 0.25  # magnitudes between which the logarithm of an error is cubic: to 1e-6
_BRIGHT, _FAINT = 30.0, 3.0  # magnitudes from a star of one electron over which curves are known


@dataclass(frozen=True, eq=False)
class _Curve:
    """Logarithms of error and signal to noise against magnitude, of one PSF."""

    log_error: CubicSpline
    log_snr: CubicSpline
    limits: tuple[float, float]


@plain_numbers
@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Instrument(ShownAsPrinted):
    """An instrument, its point-spread function and an exposure: what `legdistort.predict` has the errors from.

    The error of a position is the Cramer-Rao bound, of the mean information on x and y: photon noise of star and sky,
    and read noise. The PSF is known, and the star anywhere on its pixel. Neighbours, flat fields and errors of the PSF
    come on top, as `error_floor`.

    Parameters
    ----------
    camera : Camera
        Its detectors.
    pixel_scale : float
        Of a pixel of the camera [arcsec].
    psf : str, path, EffectivePSF, PupilPSF, GriddedPSF or photutils model
        FITS as ``calc_psf`` or ``psf_grid`` of stpsf, TIPTOP or MAVISIM write it, or what `legdistort.measure` takes.
        Without a file, `~legdistort.simulation.pupil.PupilPSF` is a core at the diffraction limit in a seeing halo.
        Of several PSFs with places in arcsec (TIPTOP, MAVISIM) a star has the nearest; the axes of places are those of
        the focal plane, from its middle. Of a grid in pixels the middle is taken.
    exposure_time : float
        Of one integration [s].
    zero_point : float
        Magnitude of a star that gives 1 electron a second.
    sky_brightness : float
        Magnitudes a square arcsec, at the same zero point; infinite for none.
    read_noise : float
        Of one integration [electrons].
    dark_current : float
        Electrons a second and pixel.
    full_well : float, optional
        Electrons in a pixel above which a star is not measured. None: no star is too bright.
    n_coadds : int
        Integrations that are added up to one exposure.
    min_snr : float
        Stars of a smaller ratio of signal to noise are not measured.
    error_floor : float
        Added to the errors in quadrature [pix].
    psf_scale : float, optional
        Of a sample of the PSF [arcsec], where its file does not state it (MAVISIM).
    name : str

    Raises
    ------
    InputError
        For values out of range, and a PSF that cannot be read.

    See Also
    --------
    legdistort.predict : Plan observations with it.

    Examples
    --------
    >>> import numpy as np
    >>> import legdistort as ld
    >>> y, x = np.mgrid[-40:41, -40:41] / 4  # four samples a pixel
    >>> psf = ld.EffectivePSF.from_array(np.exp(-(x**2 + y**2) / 2 / 1.2**2), oversampling=4)
    >>> micado = ld.Instrument.named("MICADO", filter="Ks", psf=psf, exposure_time=60)
    >>> (1e3 * micado.pixel_scale * micado.position_error([18, 22])).round(4)  # mas
    array([0.0011, 0.009 ])
    """

    camera: Camera
    pixel_scale: float
    psf: Any
    exposure_time: float
    zero_point: float
    sky_brightness: float
    read_noise: float
    dark_current: float = 0.0
    full_well: float | None = None
    n_coadds: int = 1
    min_snr: float = 5.0
    error_floor: float = 0.0
    psf_scale: float | None = None
    name: str = "instrument"
    _psf: FieldPSF = field(init=False)

    def __post_init__(self) -> None:
        check_camera(self.camera)
        positive = {"pixel_scale": "number of arcsec", "exposure_time": "number of seconds", "min_snr": "number"}
        positive["read_noise"] = "number of electrons"
        optional = {"full_well": "number of electrons", "psf_scale": "number of arcsec"}
        positive |= {name: what for name, what in optional.items() if getattr(self, name) is not None}
        for name, what in positive.items():
            check_positive(getattr(self, name), name, what)
        for name in ("dark_current", "error_floor", "zero_point", "sky_brightness"):
            value, signed = getattr(self, name), name in ("zero_point", "sky_brightness")
            finite = isinstance(value, Real) and (np.isfinite(value) or (name == "sky_brightness" and value == np.inf))
            if not finite or (value < 0 and not signed):
                raise InputError(f"{name} must be a number{'' if signed else ', zero or positive'}, got {value!r}")
        check_counts(n_coadds=self.n_coadds)
        made = field_psf(self.psf, pixel_scale=self.pixel_scale, sample_scale=self.psf_scale)
        object.__setattr__(self, "_psf", made)

    @classmethod
    @plain_numbers
    def named(
        cls, name: StrPath, *, psf: Any, exposure_time: float, filter: str | None = None, **changes: Any
    ) -> Instrument:
        """One that is described in a file: GSAOI, MAVIS, MICADO, NIRC2, NIRCam-LW, NIRCam-SW, or a file of your own.

        The files of the presets are in ``legdistort/data/instruments``, with the sources of every number, and what was
        left out because nothing published states it.

        Parameters
        ----------
        name : str or path
            Of a preset, or of a TOML file of the same form.
        psf, exposure_time
            See `Instrument`.
        filter : str, optional
            One of the file; needed if there are several.
        **changes
            Attributes of `Instrument` in the place of those of the file, and those that it lacks.

        Raises
        ------
        InputError
            For a name or filter that is not known, and for what the file does not state and is not given.
        """
        stated = described(name, filter)
        known = {each.name: each for each in fields(cls) if each.init}
        if unknown := sorted(set(changes) - set(known)):
            raise InputError(f"an instrument has no {unknown[0]}: there are {', '.join(known)}")
        words = stated | {"psf": psf, "exposure_time": exposure_time} | changes
        for needed in ("zero_point", "sky_brightness", "read_noise"):
            if needed not in words:
                raise InputError(f"{stated['name']}: {needed} is not stated in its file: give {needed}")
        return cls(**words)

    @property
    def fwhm(self) -> float:
        """Full width at half maximum of the PSF in the middle of the field, pixels included [pix]."""
        return self._psf.psfs[self._middle].fwhm

    @property
    def limits(self) -> tuple[float, float]:
        """Magnitudes of the brightest and the faintest star that is measured in the middle of the field."""
        return self._curves[self._middle].limits

    @plain_numbers
    def position_error(self, mag: ArrayLike, *, at: ArrayLike | None = None) -> np.ndarray:
        """Error of a position in one exposure, per axis, whether a star is too bright or too faint or not.

        Parameters
        ----------
        mag : array_like, shape (n,)
        at : array_like, shape (n, 2), optional
            Where the stars are [arcsec from the middle of the field]. By default in the middle.

        Returns
        -------
        ndarray, shape (n,)
            Pixels.

        Raises
        ------
        InputError
            For magnitudes that are not finite.
        """
        found = self._by_place(mag, at, lambda curve, m: np.exp(curve.log_error(m)))
        return np.hypot(found, self.error_floor)

    @plain_numbers
    def snr(self, mag: ArrayLike, *, at: ArrayLike | None = None) -> np.ndarray:
        """Ratio of signal to noise of the flux, position and sky known, (n,); see `position_error`."""
        return self._by_place(mag, at, lambda curve, m: np.exp(curve.log_snr(m)))

    @plain_numbers
    def measures(self, mag: ArrayLike, *, at: ArrayLike | None = None) -> np.ndarray:
        """Whether stars are neither too bright nor too faint, (n,); see `position_error`."""
        return self._by_place(mag, at, lambda curve, m: (curve.limits[0] <= m) & (m <= curve.limits[1])).astype(bool)

    @property
    def widest_limits(self) -> tuple[float, float]:
        """The same as `limits`, anywhere in the field."""
        bright, faint = np.transpose([curve.limits for curve in self._curves])
        return float(bright.min()), float(faint.max())

    def _by_place(self, mag, at, value):
        mag = np.atleast_1d(np.asarray(mag, dtype=float))
        if mag.ndim != 1 or not np.isfinite(mag).all():
            raise InputError(f"mag must be finite magnitudes, shape (n,), got {mag if mag.size < 4 else mag.shape}")
        if at is None:
            return value(self._curves[self._middle], mag)
        out, which = np.empty(mag.shape), self._psf.nearest(at)
        for k in np.unique(which):
            out[which == k] = value(self._curves[k], mag[which == k])
        return out

    @property
    def _middle(self):
        return int(self._psf.nearest([[0.0, 0.0]])[0])

    @property
    def _noise(self):
        """Sky [electrons a pixel], gain and read noise [electrons] of an exposure."""
        dark = self.n_coadds * self.exposure_time * self.dark_current
        sky = self._electrons(self.sky_brightness) * self.pixel_scale**2 + dark
        return {"sky": sky, "gain": 1.0, "read_noise": self.read_noise * self.n_coadds**0.5}

    def _electrons(self, mag):
        """Electrons of stars in an exposure."""
        return self.n_coadds * self.exposure_time * 10 ** (-0.4 * (mag - self.zero_point))

    @cached_property
    def _curves(self):
        one = self.zero_point + 2.5 * np.log10(self.n_coadds * self.exposure_time)  # a star of one electron
        return [self._curve(psf, np.arange(one - _BRIGHT, one + _FAINT, _STEP)) for psf in self._psf.psfs]

    def _curve(self, psf, mag):
        flux, noise = self._electrons(mag), self._noise
        information = psf.information(flux, phases=_PHASES, **noise)
        half, of_flux = int(np.ceil(4 * psf.fwhm)), 0.0
        pixels = np.arange(-half, half + 1)
        for xy in places_on_pixel(_PHASES):
            light = np.maximum(psf.on_pixels(pixels, pixels, xy), 0)
            variance = noise["sky"] + flux[:, None, None] * light + noise["read_noise"] ** 2
            of_flux = of_flux + np.sum(light**2 / variance, axis=(1, 2)) / _PHASES**2
        log_snr = np.log(flux) + np.log(of_flux) / 2
        faint = float(CubicSpline(-log_snr, mag)(-np.log(self.min_snr)))
        limits = self._brightest(psf), faint
        return _Curve(CubicSpline(mag, -np.log(information) / 2), CubicSpline(mag, log_snr), limits)

    def _brightest(self, psf):
        """Magnitude of a star in the middle of a pixel that fills it."""
        if self.full_well is None:
            return -np.inf
        room = self.full_well * self.n_coadds - self._noise["sky"]
        if room <= 0:
            raise InputError(
                f"{self.name}: sky and dark current alone fill the full_well of {self.full_well:g} electrons in "
                f"{self.exposure_time:g} s: give a shorter exposure_time, and n_coadds of them"
            )
        pixels = np.arange(-2, 3)
        peak = psf.on_pixels(pixels, pixels, (0.0, 0.0)).max()
        return float(self.zero_point - 2.5 * np.log10(room / peak / (self.n_coadds * self.exposure_time)))

    def __repr__(self) -> str:
        coadds = f"{self.n_coadds} x " if self.n_coadds > 1 else ""
        return (
            f"<Instrument {self.name}: {len(self.camera.detectors)} detectors, {1e3 * self.pixel_scale:g} mas/px, "
            f"FWHM {1e3 * self.pixel_scale * self.fwhm:.3g} mas, {coadds}{self.exposure_time:g} s>"
        )

    def __str__(self) -> str:
        bright, faint = self.limits
        shown = np.arange(np.ceil(max(bright, faint - 10)), faint, 1.0)
        rows = zip(shown, self.snr(shown), self.position_error(shown), strict=True)
        from_bright = f"from {bright:.2f} mag (full well) " if np.isfinite(bright) else ""
        return "\n".join(
            [
                repr(self)[1:-1],
                f"stars {from_bright}to {faint:.2f} mag (signal to noise {self.min_snr:g})",
                f"{'mag':>6s}{'S/N':>9s}{'error [px]':>12s}{'[mas]':>10s}",
                *(f"{m:6.1f}{s:9.4g}{e:12.4g}{1e3 * self.pixel_scale * e:10.4g}" for m, s, e in rows),
            ]
        )
