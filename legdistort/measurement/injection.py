"""Stars of known position put into real images, in places free of stars, and measured again."""

import logging
import zlib
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from astropy import units as u
from astropy.stats import biweight_scale
from astropy.table import QTable
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from ..exceptions import InputError
from .flags import UNUSABLE
from .noise_curves import NoiseCurves
from .profiles import frame_fit, moffat
from .profiles.cutouts import Stamps, box_half
from .profiles.location import locate_stars

log = logging.getLogger(__name__)

#: Distance of injected stars from one another and from the detections of the frame, in FWHM.
APART, AWAY = 8.0, 3.0
#: Fewest for which a frame must have space at a time.
ROOM = 4
#: Fluxes that are tried by default.
N_FLUXES = 12

_TRIES = 20  # places drawn for each one wanted
_FAINTEST = 1.5  # lowest flux, in units of that at the detection limit
_RANGE = 1000  # highest flux, at least so many times the lowest: both regimes show
_BELOW_SATURATION = 0.8


def calibrate_frame(exposure, remeasure, *, psf=None, threshold=5.0, widths=None, fluxes=None, n_positions=100, seed=0):
    """Errors of positions in one frame, from stars put into it and measured.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
    remeasure : callable
        ``remeasure(exposure)`` and ``remeasure(exposure, fwhm=...)``: table of detections.
    psf : `~legdistort.measurement.effective.model.EffectivePSF`, optional
        What is put in; by default the median Moffat profile of the frame.
    threshold : float
        Detection limit of `remeasure`.
    widths : sequence of float, optional
        FWHM of the Moffat profiles put in [pix]; by default that of the frame's own.
    fluxes : sequence of float, optional
        By default from the detection limit to the brightest star of the frame or a thousand times the limit, but
        below saturation.
    n_positions : int
        For every width and flux.
    seed : int
        Of the random numbers, which depend on the name of the exposure too.

    Returns
    -------
    `~legdistort.measurement.noise_curves.NoiseCurves`

    Raises
    ------
    InputError
        For a frame without stars if `widths` or the gain are missing, without space for stars, or saturated at the
        faintest stars.
    """
    name, rng = exposure.name, np.random.default_rng([seed, zlib.crc32(exposure.name.encode())])
    frame, centres, shape = locate_stars(exposure, threshold=threshold)
    if not len(centres) and widths is None:
        raise InputError(f"{name}: no star above {threshold:g} times the noise shows how wide stars are; give fwhm")
    photon = _photon_noise(frame, exposure, centres, shape)
    own = psf or (MoffatStars(shape) if len(centres) else None)
    profiles = [own] if widths is None else [MoffatStars(scaled(shape, width)) for width in widths]
    rows = []
    for profile, width in zip(profiles, widths or [own.fwhm], strict=True):
        levels = np.sort(fluxes if fluxes is not None else default_fluxes(exposure, frame, centres, profile, threshold))
        again = remeasure if own and width == own.fwhm else partial(remeasure, fwhm=width)
        each = np.repeat(levels[::-1], n_positions)  # stars of about the same flux come into one frame
        off = _offsets(exposure, centres, each, profile, photon=photon, again=again, rng=rng)
        log.info("%s: FWHM %.2f px, %d stars put in at %d fluxes", name, width, len(each), len(levels))
        known = {"exposure": name, "fwhm": width * u.pix}
        for flux in levels:
            made = off[each == flux]
            rows.append(known | {"flux": flux} | statistics(made[:, :2], made[:, 2:], {"x": u.pix, "y": u.pix}))
    return NoiseCurves(QTable(rows, meta={"fwhm": {name: own and own.fwhm}, "photon": {name: float(photon)}}))


@dataclass(frozen=True, eq=False)
class MoffatStars:
    """Moffat profiles of one shape, as stars to be put into a frame; an `EffectivePSF` serves as well.

    Attributes
    ----------
    shape : ndarray, shape (4,)
        Shape parameters of `legdistort.measurement.profiles.moffat`.
    """

    shape: np.ndarray

    @property
    def fwhm(self):
        """Full width at half maximum [pix]."""
        return float(moffat.fwhm(self.shape))

    @property
    def reach(self):
        """How far from the star there is light [pix]."""
        return int(np.ceil(8 * self.fwhm))

    def on_stamps(self, centres, offsets, half):
        """Parts of the light on square stamps, see `EffectivePSF.on_stamps`; averaged over every pixel of the core."""
        nodes = moffat.quadrature(min(self.fwhm, 2.0))  # 3 or 5 points a pixel, however wide
        params = moffat.parameters(np.ones(len(centres)), self.shape, offsets)
        params[:, 2] /= moffat.flux(params)
        core = min(half, box_half(self.fwhm))
        out = moffat.evaluate(params, half, moffat.CENTRES)
        inner = np.flatnonzero((np.abs(np.mgrid[-half : half + 1, -half : half + 1]) <= core).all(axis=0))
        out[:, inner] = moffat.evaluate(params, core, nodes)
        return out


def _photon_noise(frame, exposure, centres, shape):
    """Variance per unit of star light: by the gain, or by the uncertainty plane or the fits of the brighter stars."""
    if exposure.gain:
        return 1 / exposure.gain
    if not len(centres):
        raise InputError(f"{exposure.name}: neither a gain nor stars that would determine the photon noise; give gain")
    if not frame.noise_given:
        return frame_fit.fit_stars(Stamps(frame, centres, box_half(moffat.fwhm(shape))), shape)[-1]
    x, y = centres[:50].T
    above = frame.variance[y, x] - np.median(frame.variance[frame.good])
    return max(float(np.median(above / np.maximum(frame.signal[y, x], 1e-30))), 0.0)


def default_fluxes(exposure, frame, centres, profile, threshold):
    """Fluxes from the detection limit to bright stars, evenly spaced in their logarithm; see `calibrate_frame`."""
    middle = np.array(exposure.shape[::-1])[None] // 2
    unit = profile.on_stamps(middle, np.zeros((1, 2)), box_half(profile.fwhm))[0]
    lowest = _FAINTEST * threshold * np.sqrt(np.median(frame.variance[frame.good]) / (unit**2).sum())
    highest = _RANGE * lowest
    if len(centres):
        highest = max(highest, frame.signal[centres[:, 1], centres[:, 0]].max() / unit.max())
    if exposure.saturation:
        sky = np.median(exposure.data[frame.good] - frame.signal[frame.good])
        highest = min(highest, _BELOW_SATURATION * (exposure.saturation - sky) / unit.max())
    if highest < 2 * lowest:
        raise InputError(f"{exposure.name}: stars saturate before they are detected; give fluxes, or check saturation")
    return np.geomspace(lowest, highest, N_FLUXES)


def _offsets(exposure, centres, flux, profile, *, photon, again, rng):
    """Measured less true positions and errors stated (n, 4): x, y, x_err, y_err; NaN for stars not found."""
    fwhm, n, done = profile.fwhm, len(flux), 0
    out = np.full((n, 4), np.nan)
    while done < n:
        xy = free_positions(exposure, centres, fwhm, n=n - done, rng=rng)
        if len(xy) < min(ROOM, n - done):
            raise InputError(
                f"{exposure.name}: no space for injected stars of FWHM {fwhm:.3g} px: only {len(xy)} places lie "
                f"{AWAY:g} FWHM from its {len(centres)} detections, clear of edges and bad pixels; give a smaller "
                "fwhm, another frame, or a higher threshold"
            )
        part = slice(done, done + len(xy))
        table = again(inject(exposure, xy, flux[part], profile, photon=photon, rng=rng))
        table = table[(table["flags"] & UNUSABLE) == 0]
        if len(table):
            found = np.column_stack([table[name].value for name in ("x", "y", "x_err", "y_err")])
            distance, nearest = cKDTree(found[:, :2]).query(xy)
            found = found[nearest]
            found[:, :2] -= xy
            out[part] = np.where((distance < max(1.5, fwhm))[:, None], found, np.nan)
        done += len(xy)
    return out


def statistics(off, error, units):
    """How the stars of a group were found, as columns of `NoiseCurves`.

    Parameters
    ----------
    off, error : ndarray, shape (n, k)
        Measured less true values, and errors stated; NaN for stars not found.
    units : dict
        Of the k values, by name.

    Returns
    -------
    dict
        Their number ``n``, the part ``found``, and of every value the ``_rms``, ``_sigma`` (robust), ``_bias`` (median)
        of the deviations, ``_err``, the median error stated, and ``_ratio``, stated over true errors (robust).
    """
    there = np.isfinite(off[:, 0])
    out = {"n": len(off), "found": there.sum() / max(len(off), 1)}
    for name, unit, d, err in zip(units, units.values(), off[there].T, error[there].T, strict=True):
        sigma, pull = (biweight_scale(v, M=np.zeros(1)) if len(d) > 2 else np.nan for v in (d, d / err))
        figures = {
            "rms": np.sqrt(np.mean(d**2)) if len(d) else np.nan,
            "sigma": sigma,
            "bias": np.median(d) if len(d) else np.nan,
            "err": np.median(err) if len(d) else np.nan,
        }
        out |= {f"{name}_{key}": value * unit for key, value in figures.items()} | {f"{name}_ratio": 1 / pull}
    return out


def scaled(shape, fwhm):
    """Shape parameters (4,) of a profile brought to another FWHM [pix]; ellipticity and beta stay."""
    shape = np.array(shape, dtype=float)
    shape[:2] += 2 * np.log(moffat.fwhm(shape) / fwhm)
    return shape


def free_positions(exposure, taken, fwhm, *, n, rng):
    """Random positions at which nothing but sky was detected.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
    taken : ndarray, shape (m, 2)
        Positions of everything detected.
    fwhm : float
        Of the stars that shall stand there [pix].
    n : int
        So many, or as many as there is space for, `APART`, `AWAY` from the detections, their boxes free of bad pixels.
    rng : `~numpy.random.Generator`

    Returns
    -------
    ndarray, shape (at most n, 2)
    """
    ny, nx = exposure.shape
    half = box_half(fwhm)
    if min(ny, nx) < 2 * half + 2:
        return np.zeros((0, 2))
    bad = exposure.mask if not exposure.saturation else exposure.mask | (exposure.data >= exposure.saturation)
    if bad.any():
        bad = maximum_filter(bad, 2 * half + 1)
    cells = int(np.ceil(nx * ny / (APART * fwhm) ** 2))
    xy = rng.uniform(half, np.array([nx, ny]) - 1 - half, (_TRIES * min(n, cells), 2))
    columns, rows = np.round(xy).astype(int).T
    xy = xy[~bad[rows, columns]]
    if len(taken):
        xy = xy[cKDTree(taken).query(xy)[0] > AWAY * fwhm]
    if not len(xy):
        return xy
    return xy[distant(xy, APART * fwhm, n)]


def distant(xy, distance, n):
    """The first n of some places (m, 2) that lie so far from one another; their rows, at most n."""
    tree, keep, near = cKDTree(xy), [], np.zeros(len(xy), dtype=bool)
    for i, place in enumerate(xy):  # who came first stays
        if not near[i]:
            keep.append(i)
            if len(keep) == n:
                break
            near[tree.query_ball_point(place, distance)] = True
    return keep


def inject(exposure, xy, flux, profile, *, photon, rng):
    """An exposure with stars added, and their photon noise.

    Parameters
    ----------
    exposure : `~legdistort.inputs.exposures.Exposure`
    xy : ndarray, shape (n, 2)
        Centres [pix].
    flux : ndarray, shape (n,)
        Of the whole profiles, in units of the data.
    profile : MoffatStars or `~legdistort.measurement.effective.model.EffectivePSF`
    photon : float
        Variance per unit of star light (1 / gain); 0 adds no noise.
    rng : `~numpy.random.Generator`

    Returns
    -------
    `~legdistort.inputs.exposures.Exposure`
        A copy; its uncertainty plane, if there is one, has the photon noise too.
    """
    light = _light(exposure.shape, xy, flux, profile)
    seen = np.maximum(light, 0)  # an effective PSF may dip below the sky
    added = with_photons(light, photon, rng)
    before = exposure.uncertainty
    uncertainty = None if before is None else np.sqrt(before**2 + photon * seen)
    return replace(exposure, data=exposure.data + added, uncertainty=uncertainty)


def with_photons(light, photon, rng):
    """Light with the noise of its photons, whose variance is `photon` times the light."""
    seen = np.maximum(light, 0)
    return light if not photon else light - seen + photon * rng.poisson(seen / photon)


def _light(image_shape, xy, flux, profile):
    (ny, nx), wide = image_shape, profile.reach
    offset = np.arange(-wide, wide + 1)
    out = np.zeros(ny * nx)
    for k in range(0, len(xy), 100):
        part = slice(k, k + 100)
        pixel = np.round(xy[part]).astype(int)
        stamp = flux[part, None] * profile.on_stamps(pixel, xy[part] - pixel, wide)
        x = (pixel[:, :1, None] + offset) + np.zeros((len(offset), 1), dtype=int)
        y = (pixel[:, 1:, None] + offset[:, None]) + np.zeros(len(offset), dtype=int)
        inside = ((x >= 0) & (x < nx) & (y >= 0) & (y < ny)).reshape(stamp.shape)
        np.add.at(out, (y * nx + x).reshape(stamp.shape)[inside], stamp[inside])
    return out.reshape(image_shape)
