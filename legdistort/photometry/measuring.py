"""The stars of a catalogue found, fitted in all exposures at once, and judged by the fluxes of single exposures."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from ..measurement.flags import Flag
from ..measurement.profiles.cutouts import Stamps
from ..measurement.profiles.frame_fit import pixel_flags
from ..measurement.scene.confusion import confusion
from ..measurement.scene.search import search
from ..measurement.scene.shared_psf import moffat_field
from . import transmissions
from .blends import pairs
from .extended_sources import merge_extended
from .joint_scene import CONFIRMED, LESS

_DEGREE = 2  # of the shape of the stars over a frame
_SCATTER, _CHANCE = 3.0, 1e-4  # chi2 per degree of freedom of the fluxes, and the chance of it, beyond which they vary
_FAINT = 30.0  # signal-to-noise ratio: of brighter stars the error of the PSF is larger than that of the fluxes
_SEEN = 3.0  # signal-to-noise ratio at which an exposure confirms a star
_CLOSE = 2.0  # FWHM of blended stars
# standard deviations of a pixel in the core of a star that is too bright in one exposure alone, and of those beside it
_DEVIATES, _SKIRT = 4.0, 2.0
_SEARCHED = 3.0  # FWHM from a place around which it was searched
# chi2 of the core of a faint source that is no star's; sharpness that is none's, and so many errors of it more
_NO_STAR, _SHARP = 2.5, (0.5, 5.0)


@dataclass(frozen=True, eq=False)
class Measured:
    """What the exposures tell of the stars, n of them, one by one (m images) and together.

    Attributes
    ----------
    flux, flux_err : ndarray, shape (m, n)
        By image, in the unit of the flux of the stars; the error is infinite where an image does not see a star.
    flags : ndarray of int, shape (m, n)
    zero_err : ndarray, shape (m,)
        Relative errors of the transmissions.
    varying : ndarray of bool, shape (n,)
    rejected : int
        What was found and is no star: seen by one exposure alone, or by none.
    """

    flux: np.ndarray
    flux_err: np.ndarray
    flags: np.ndarray
    zero_err: np.ndarray
    varying: np.ndarray
    rejected: int

    @property
    def seen(self):
        """Which image sees which star, (m, n)."""
        return np.isfinite(self.flux_err)


def measure_field(field, xy, left_out, threshold):
    """Stars of known places fitted, the rest searched for more.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
        Without stars.
    xy : ndarray, shape (n, 2)
        Those that are known, in the reference plane.
    left_out : ndarray of bool, shape (m, n)
        Images that do not tell where a star is.
    threshold : float
        Of the summed likelihood.

    Returns
    -------
    Measured
    """
    transmissions.start(field, xy, left_out)
    search(field, threshold, _retune, pairs)
    places = merge_extended(field)
    if len(places):
        search(field, threshold, None, pairs, settled=True, around=places)
    field.update_sky()
    errors, rejected = transmissions.update(field), field.rejected
    changed, first = np.ones(len(field.flux), dtype=bool), True
    while changed.any():
        field.fit(changed, 2)
        rows, (gone, wrong) = np.flatnonzero(changed), np.zeros((2, len(changed)), dtype=bool)
        flux, error, (gone[rows], _, spoiled) = _by_fluxes(field, threshold, rows)
        few, unlike = _few(field, error, rows)
        if first:  # once: what is left of a star that follows no PSF would be taken off pixel by pixel
            wrong[rows] = _masked(field, rows, spoiled | (unlike & np.isfinite(error)))
            first = False
        else:
            gone[rows] |= unlike | (few & (field.snr(rows) < threshold))
        changed = _near(field.xy[~gone], field.xy[gone | wrong], _SEARCHED * field.fwhm)
        field.remove(gone)
        rejected += int(gone.sum())
    flux, error, (_, varying, spoiled) = _by_fluxes(field, threshold)
    flags = image_flags(field) | np.where(spoiled, Flag.DEFECT, 0)
    return Measured(flux, error, flags, errors, varying, rejected)


def _near(xy, places, reach):
    """Which stars (n, 2) lie so near to some places (m, 2); (n,)."""
    return np.zeros(len(xy), dtype=bool) if not len(places) else cKDTree(places).query(xy)[0] < reach


def measure_again(field, threshold, around=None):
    """A field that was measured searched for more after a change of its pixels.

    PSFs and transmissions stay, which a few stars do not change.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
    threshold : float
        Of the summed likelihood.
    around : ndarray, shape (m, 2), optional
        Places near which alone it is searched.
    """
    search(field, threshold, None, pairs, settled=True, around=around)
    reach = _SEARCHED * field.fwhm
    while True:
        near = np.ones(len(field.flux), dtype=bool) if around is None else _near(field.xy, around, reach)
        rows, gone = np.flatnonzero(near), np.zeros(len(near), dtype=bool)
        _, error, (lone, _, _) = _by_fluxes(field, threshold, rows)
        gone[rows] = lone | _few(field, error, rows)[1]
        if not gone.any():
            return
        field.remove(gone)


def _by_fluxes(field, threshold, rows=None):
    """Fluxes by image of stars, all or some, their errors, and what they tell of the stars (`judged`)."""
    flux, error = by_image(field, rows)
    mean = field.flux if rows is None else field.flux[rows]
    return flux, error, judged(flux, error, mean, field.snr(rows), threshold)


def _few(field, error, rows):
    """Stars that too few images see to be judged by fluxes, and those of them that pixels show to be none; (n,)."""
    few = np.isfinite(error).sum(axis=0) < CONFIRMED
    unlike, some = few.copy(), rows[few]
    sharp, its = field.sharpness(some)
    unlike[few] = (field.core_chi2(some) > _NO_STAR) & (field.snr(some) < _FAINT)
    unlike[few] |= sharp > _SHARP[0] + _SHARP[1] * its
    return few, unlike


def _masked(field, rows, spoiled):
    """Pixels that make stars (n,) too bright in some images (m, n) are bad from now on; which stars have some; (n,)."""
    out = np.zeros(len(rows), dtype=bool)
    for layer, stars in zip(field.layers, spoiled, strict=True):
        there, own = layer.own(rows[stars])
        if not len(own):
            continue
        scene = layer.scene
        params, _, pixels, inside = scene.on_stamps(own)
        ratio = scene.residual_at(pixels) * np.sqrt(scene.weights.ravel()[pixels]) * (inside & scene.near(params))
        high = (ratio > _SKIRT) & (ratio > _DEVIATES).any(axis=1)[:, None]
        scene.mask(*np.unravel_index(pixels[high], scene.light.shape))
        out[np.flatnonzero(stars)[there[high.any(axis=1)]]] = True
    return out


def _retune(field):
    """PSFs and transmissions by the stars that there are."""
    for layer in field.layers:
        if layer.retuned:
            layer.scene.use(moffat_field(layer.scene, layer.shape, _DEGREE), render=False)
    field.refresh()
    transmissions.update(field)


def by_image(field, rows=None):
    """Fluxes of the stars, or some, by image and their errors, positions fixed, (m, n) each; infinite if not seen."""
    rows = np.arange(len(field.flux)) if rows is None else rows
    flux, error = np.zeros((len(field.layers), len(rows))), np.full((len(field.layers), len(rows)), np.inf)
    for k, layer in enumerate(field.layers):
        there, own = layer.own(rows)
        flux[k, there], error[k, there] = field.fluxes(layer, own)
    return flux, error


def judged(flux, error, mean, snr, threshold):
    """What is no star, since one exposure alone shows it, which stars vary, and which exposures are spoiled.

    What no exposure sees is none either: its light comes from beyond the pixels that count, where nothing holds its
    flux. A star that three exposures see stands without the strongest of them. Below a signal-to-noise ratio of 30 its
    fluxes scatter as their errors state; or those of all exposures but one do, in which it is too bright; or two
    exposures confirm it by themselves and it varies.

    Parameters
    ----------
    flux, error : ndarray, shape (m, n)
        By exposure; the error is infinite where it does not see the star.
    mean, snr : ndarray, shape (n,)
        Of the star.
    threshold : float

    Returns
    -------
    gone, varying : ndarray of bool, shape (n,)
    spoiled : ndarray of bool, shape (m, n)
    """
    weight = 1 / error**2
    ratio = np.where(weight > 0, flux / error, -np.inf)
    count, stars = (weight > 0).sum(axis=0), np.arange(flux.shape[1])
    _, rest, total = _without(weight, flux, ratio.argmax(axis=0))
    lone = (count >= CONFIRMED) & (rest * np.sqrt(total) < threshold - LESS)
    scatter = (count >= CONFIRMED) & (snr < _FAINT) & _scatter(weight, flux, mean)
    highest = np.where(weight > 0, (flux - mean) / error, -np.inf).argmax(axis=0)
    others, rest, _ = _without(weight, flux, highest)
    spoiled = np.zeros(flux.shape, dtype=bool)
    spoiled[highest, stars] = scatter & ~lone & ~_scatter(others, flux, rest)
    varying = scatter & ~spoiled.any(axis=0)
    confirmed = (ratio > _SEEN).sum(axis=0) >= 2
    gone = lone | (count == 0)
    return gone | (varying & ~confirmed), varying & confirmed & ~gone, spoiled


def _without(weight, flux, left_out):
    """Weights (m, n) without an exposure of each star (n,), the mean flux by them, and their sum."""
    weight = weight.copy()
    weight[left_out, np.arange(len(left_out))] = 0
    total = np.maximum(weight.sum(axis=0), 1e-30)
    return weight, (weight * flux).sum(axis=0) / total, total


def _scatter(weight, flux, mean):
    """Whether fluxes (m, n) scatter by more than their errors; (n,)."""
    chi2, dof = (weight * (flux - mean) ** 2).sum(axis=0), np.maximum((weight > 0).sum(axis=0) - 1, 1)
    return chi2 > np.maximum(_SCATTER * dof, chdtri(dof, _CHANCE))


def image_flags(field):
    """Flags of the stars by image, (m, n)."""
    out = np.zeros((len(field.layers), len(field.flux)), dtype=int)
    for k, layer in enumerate(field.layers):
        scene = layer.scene
        if len(layer.stars):
            params, centres, _, _ = scene.on_stamps(np.arange(len(scene.flux)))
            stamps = Stamps(scene.frame, centres, scene.half)
            out[k, layer.stars] = pixel_flags(stamps, params, stamps.good, scene.fwhm)
    return out


def star_flags(field, measured):
    """Flags of the stars: what is so in every image that sees them, neighbours, and whether they vary; (n,)."""
    flags = np.where(measured.seen, measured.flags, -1)
    common = np.bitwise_and.reduce(flags, axis=0) if len(flags) else flags
    common = np.where(measured.seen.any(axis=0), common, 0)
    near = cKDTree(field.xy).query(field.xy, k=2)[0][:, 1] < _CLOSE * field.fwhm
    own = ((near, Flag.BLENDED), (measured.varying, Flag.VARIABLE), (field.wide, Flag.EXTENDED))
    return common | np.sum([np.where(rows, flag, 0) for rows, flag in own], axis=0)


def covariances(field, threshold, rows=None):
    """Covariances (n, 3, 3) of x, y and flux of stars, all or some, and mean squared residuals of their cores (n,).

    Those of the fit, times the residual where it exceeds the noise; of positions also times one plus the confusion by
    stars that are not seen (`legdistort.measurement.scene.confusion`).
    """
    chi2 = field.core_chi2(rows)
    out = field.covariance(rows) * np.maximum(chi2, 1)[:, None, None]
    known = {"sigma": field.fwhm / 2.3548, "threshold": threshold, "area": max(field.area, 1)}
    unseen = confusion(field.xy, field.flux, field.snr(), **known)
    out[:, :2, :2] *= 1 + (unseen if rows is None else unseen[rows])[:, None, None]
    return out, chi2


def map_covariances(field):
    """Covariances (n, 2, 2) of the stars by the maps of the exposures, relative and absolute, by their weights.

    The maps count as independent of each other, but for what is common to all.
    """
    weights = np.array([layer.spread(layer.scene.snr()) ** 2 for layer in field.layers])
    weights /= np.maximum(weights.sum(axis=0), 1e-30)
    relative, common = np.zeros((2, len(field.flux), 2, 2))
    for layer, weight in zip(field.layers, weights, strict=True):
        stars = layer.stars
        if not len(stars):
            continue
        pixels = layer.scene.xy + layer.scene.psf.centre(layer.scene.xy)
        own, absolute = layer.places.covariance(pixels)
        relative[stars] += (weight[stars] ** 2)[:, None, None] * own
        common[stars] += weight[stars, None, None] * (absolute - own)
    return relative, relative + common
