"""Sources wider than stars, found among the stars of all exposures, and fitted as one each."""

import numpy as np
from scipy.spatial import cKDTree

from ..measurement.profiles.levenberg_marquardt import Limits, minimise
from ..measurement.scene.extended import spread_light
from ..measurement.scene.splitting import GAIN
from ..measurement.scene.stamps import stamp_pixels

_REACH = 2.0  # FWHM: fainter rows so near may be parts of a source
_SNR = 10.0  # of a star by itself that may be one
_FEWEST, _PAIR = 3, 1.0  # rows side by side that may be one, whatever their chi2; two so many FWHM apart
_BETTER = 10.0  # by which chi2 is less than that of two stars
_PEERS, _LEAST_PEERS = 25, 5  # stars of about its flux
_DEVIATES = 3.0, 1.0  # standard deviations of their chi2 and sharpness, the error of that included
_SCATTER = 0.05, 0.01  # of chi2, and of sharpness, at least
_START, _LEAST, _MOST = 0.6, 0.35, 2.0  # standard deviations of the PSF: spread at first, and within which it is one
_NARROWEST = 0.2  # of the same unit, the other axis, roughly
_EXPLAINED = 2.5  # chi2 of the core with a spread PSF, at most
_MISFIT = 0.02  # part of its light by which a source may deviate from a spread PSF
_CENTRE = 1.0  # FWHM that its middle may lie from the brightest row
_LIMITS, _FIXED = Limits(20, 1e-2), 1e9
_ROOT = np.array([0, 1, 1]), np.array([0, 0, 1])  # what is not 0 of the root of the covariance of the spread


class _Groups:
    """Pixels around rows that may be one source each, n of them, in all exposures; see `minimise`.

    Parameters of a source are x, y [pix, from the brightest row, in the plane], flux, and the root of the covariance of
    its spread, a lower triangle.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
    rows : ndarray of int, shape (n,)
        The brightest.
    members : list of ndarray of int
        The others of each.
    """

    kind = np.dtype(np.float64)

    def __init__(self, field, rows, members):
        self.xy, self.half, self.images, n = field.xy[rows], np.inf, [], len(rows)
        self.chi2, square, self.dof = np.zeros(n), np.zeros(n), np.full(n, -6)
        for layer in field.layers:
            scene, (there, own) = layer.scene, layer.own(rows)
            if not len(own):
                continue
            centres = np.round(scene.xy[own]).astype(int)
            pixels, inside = stamp_pixels(centres, scene.half, scene.light.shape)
            weights = np.where(inside, scene.weights.ravel()[pixels], 0).astype(float)
            left, light = scene.residual_at(pixels), np.zeros(pixels.shape)
            for k, (i, star) in enumerate(zip(there, own, strict=True)):
                group = np.append(star, layer.own(members[i])[1])
                params = np.column_stack([scene.xy[group] - centres[k], scene.flux[group]])
                light[k] = scene.star_light(group, params, np.tile(centres[k], (len(group), 1)), scene.half).sum(axis=0)
            weak = weights / (1 + weights * (_MISFIT * light) ** 2)
            self.images.append((layer, there, centres, left + light, weights, weak))
            self.chi2[there] += (weak * left**2).sum(axis=1)
            square[there] += (weak * (left + light) ** 2).sum(axis=1)
            self.dof[there] += np.count_nonzero(weak, axis=1)
        self.target, self.dof = np.sqrt(square)[:, None], np.maximum(self.dof, 1)

    def light(self, layer, centres, params, xy):
        """Light of sources (m, 6) on stamps of an image, and its derivatives (m, 6, npix)."""
        xy = xy + params[:, :2]
        root = np.zeros((len(params), 2, 2))
        root[:, *_ROOT] = params[:, 3:]
        own = np.column_stack([layer.local(xy)[0] - centres, layer.transmission * params[:, 2]])
        scene, slopes = layer.scene, layer.places.slopes(xy)
        if root.any():
            light, by, by_spread = spread_light(scene.psf, own, slopes @ root, centres, scene.half, slopes=True)
        else:
            light, by = scene.psf.light(own, centres, scene.half, slopes=True)
            by_spread = np.zeros((len(params), 2, 2, light.shape[1]))
        out = np.empty((len(params), 6, light.shape[1]))
        out[:, :2] = np.einsum("nca,ncp->nap", slopes, by[:, :2])
        out[:, 2] = layer.transmission * by[:, 2]
        out[:, 3:] = np.einsum("nca,ncbp->nabp", slopes, by_spread)[:, *_ROOT]
        return light, out

    def linearise(self, params, rows):
        """Chi2, negative half gradient and half Hessian of some groups."""
        n, place = len(rows), np.full(len(self.xy), -1)
        place[rows] = np.arange(n)
        chi2, gradient, hessian = np.zeros(n), np.zeros((n, 6)), np.zeros((n, 6, 6))
        for layer, there, centres, data, _, weak in self.images:
            own, at = place[there] >= 0, place[there]
            at = at[own]
            light, by = self.light(layer, centres[own], params[at], self.xy[rows[at]])
            left, weights = data[own] - light, weak[own]
            chi2[at] += (weights * left**2).sum(axis=1)
            gradient[at] += np.einsum("nap,np->na", by, weights * left)
            hessian[at] += (by * weights[:, None]) @ by.mT
        return chi2, gradient, hessian

    def like_stars(self, params):
        """What `JointScene.core_chi2` and `JointScene.sharpness` of stars (n, 6) in their places would be."""
        chi2, information, sharp, norm = np.zeros((4, len(self.xy)))
        for layer, there, centres, data, weights, _ in self.images:
            light = self.light(layer, centres, params[there], self.xy[there])[0]
            left, middle = data - light, light.shape[1] // 2
            near = layer.scene.near(layer.local(self.xy[there] + params[there, :2])[0] - centres) & (weights > 0)
            core = (near * light * weights * left**2).sum(axis=1) / np.maximum((near * light).sum(axis=1), 1e-30)
            own = (weights * light**2).sum(axis=1)
            chi2[there], information[there] = chi2[there] + own * core, information[there] + own
            its = weights[:, middle] * light[:, middle]
            sharp[there] += its * left[:, middle]
            norm[there] += its * light[:, middle]
        norm = np.maximum(norm, 1e-30)
        return chi2 / np.maximum(information, 1e-30), (sharp / norm, norm**-0.5)


def merge_extended(field):
    """Rows that are one source wider than a star replaced by it; where such are, (k, 2).

    The brightest of some rows, or a star whose core no star explains, is a candidate. As a single star it must have a
    larger chi2 than the stars of its flux, and where it is one row less light in the central pixel. With a spread PSF
    it must explain the pixels better than two stars do, and no worse than more stars but for what each must explain.

    Parameters
    ----------
    field : `~legdistort.photometry.joint_scene.JointScene`
        With the stars that were found.
    """
    if not len(field.flux):
        return np.zeros((0, 2))
    rows, members = _unlike_stars(field)
    if not len(rows):
        return np.zeros((0, 2))
    groups, sigma = _Groups(field, rows, members), field.fwhm / 2.3548
    start = _start(field, rows, members)
    one = _fitted(groups, start, np.zeros(3), fixed=True)[1]
    wide, chi2 = _fitted(groups, start + [0, 0, 0, *_START * sigma * np.array([1, 0, 1])], np.full(3, _MOST * sigma))
    more = np.array([len(others) - 1 for others in members])  # than one beside the brightest
    size = np.sqrt((wide[:, 3:] ** 2).sum(axis=1) / 2) / sigma
    narrow = np.abs(wide[:, 3] * wide[:, 5]) / np.maximum(size * sigma, 1e-30) / sigma  # that of two stars is 0
    yes = (one - chi2 > GAIN) & (chi2 < groups.chi2 + np.where(more > 0, GAIN * more, -_BETTER)) & (wide[:, 2] > 0)
    yes &= (size > _LEAST) & (size < _MOST) & (narrow > _NARROWEST) & (np.hypot(*wide[:, :2].T) < _CENTRE * field.fwhm)
    yes &= groups.like_stars(wide)[0] < _EXPLAINED
    gone, root = np.zeros(len(field.flux), dtype=bool), np.zeros((np.count_nonzero(yes), 2, 2))
    root[:, *_ROOT] = wide[yes, 3:]
    field.set(rows[yes], groups.xy[yes] + wide[yes, :2], wide[yes, 2], root)
    for k in np.flatnonzero(yes):
        gone[members[k]] = True
    places = field.xy[rows[yes]]
    field.remove(gone)
    return places


def _unlike_stars(field):
    """Candidates (`_candidates`) that stars of their flux are not like."""
    usual = _Usual(field)
    rows, members = _candidates(field, usual)
    if not len(rows):
        return rows, members
    groups = _Groups(field, rows, members)
    single = _fitted(groups, _start(field, rows, members), np.zeros(3), fixed=True)[0]
    larger, duller = usual.unlike(*groups.like_stars(single), single[:, 2])
    yes = np.flatnonzero(larger & (duller | [len(others) > 0 for others in members]))
    return rows[yes], [members[k] for k in yes]


def _start(field, rows, members):
    """Parameters (n, 6) of stars of all the light, in the places of the brightest."""
    out = np.zeros((len(rows), 6))
    out[:, 2] = [field.flux[[k, *others]].sum() for k, others in zip(rows, members, strict=True)]
    return out


def _fitted(groups, start, most, *, fixed=False):
    """Parameters (n, 6) and chi2 (n,) of sources, their spread up to some values."""
    precision = np.array([0, 0, 0, 1, 1, 1]) * (_FIXED if fixed else 0)
    bounds = np.array([0, -1, 0]) * most, most
    params, _, chi2, _ = minimise(groups, start, prior=(np.zeros_like(start), precision), bounds=bounds, limits=_LIMITS)
    return params, chi2


def _candidates(field, usual):
    """Rows that may be the middle of a source (n,), brightest first, and the others that may be parts of each."""
    near = cKDTree(field.xy).query_ball_point(field.xy, _REACH * field.fwhm)
    snr, alone = field.snr(), np.all(usual.unlike(field.core_chi2(), field.sharpness(), field.flux), axis=0)
    free, rows, members = ~field.wide, [], []
    for k in np.argsort(-field.flux, kind="stable"):
        own = np.array([i for i in near[k] if free[i] and i != k], dtype=int)
        close = len(own) and np.hypot(*(field.xy[own] - field.xy[k]).T).min() < _PAIR * field.fwhm
        if free[k] and snr[k] > _SNR and (alone[k] or close or len(own) + 1 >= _FEWEST):
            rows.append(k)
            members.append(own)
            free[own] = False
        free[k] = False
    return np.array(rows, dtype=int), members


class _Usual:
    """What cores of stars that stand by themselves are like: median and scatter of chi2 and sharpness, by flux."""

    def __init__(self, field):
        apart = cKDTree(field.xy).query(field.xy, k=2)[0][:, 1] > _REACH * field.fwhm
        stars = np.flatnonzero(~field.wide & apart)
        self.flux, self.values = np.zeros(1), [(1.0, _SCATTER[0]), (0.0, _SCATTER[1])]
        if len(stars) < _LEAST_PEERS:
            return
        order = stars[np.argsort(field.flux[stars], kind="stable")]
        window = min(_PEERS, len(order))
        self.flux = np.median(_windows(field.flux[order], window), axis=1)
        self.values = []
        for values, least in zip((field.core_chi2(), field.sharpness()[0]), _SCATTER, strict=True):
            own = _windows(values[order], window)
            middle = np.median(own, axis=1)
            scatter = 1.4826 * np.median(np.abs(own - middle[:, None]), axis=1)
            self.values.append((middle, np.maximum(scatter, least)))

    def unlike(self, chi2, sharpness, flux):
        """Whether sources (n,) of some flux have a larger chi2 than stars, and less light in the middle; (n,) each."""
        out, (own, error) = [], sharpness
        for sign, values, noise, limit, known in zip(
            (1, -1), (chi2, own), (0, error), _DEVIATES, self.values, strict=True
        ):
            middle, scatter = (np.interp(flux, self.flux, np.broadcast_to(each, self.flux.shape)) for each in known)
            out.append(sign * (values - middle) > limit * np.maximum(scatter, noise))
        return out


def _windows(values, width):
    return np.lib.stride_tricks.sliding_window_view(values, width)
