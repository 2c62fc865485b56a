"""What is found is subtracted, the rest searched for more, and all fitted again until nothing changes."""

import logging

import numpy as np
from scipy.spatial import cKDTree

from ..crowding import SAME
from . import splitting

_PASSES = 8
_CHANGED = 0.002  # of the stars: a pass that changes less is the last
_AGAIN = 0.5  # FWHM from what was dropped: it is not tried again
_BESIDE = 0.7  # FWHM from a star: a peak there is a matter of splitting it
_DISTURBS = 1.5  # FWHM: a change within it is a reason to look at a star anew
_ALONE = 0.8  # of the threshold, asked of a star where its neighbours are unknown too
_WHOLE = 3  # passes that look at all of a scene; in the last of them stars are split for the first time
_AROUND = 3.0  # FWHM from places: a scene is searched within

log = logging.getLogger(__name__)


def search(scene, threshold, retune, pairs=splitting.pairs, *, settled=False, around=None):
    """Search a scene for more stars, until a pass changes next to nothing.

    Parameters
    ----------
    scene : `~legdistort.measurement.scene.joint_fit.Scene`
        With the stars that are known.
    threshold : float
        Signal-to-noise ratio.
    retune : callable, optional
        ``retune(scene)`` gives it the PSF that its stars show; by default it is known.
    pairs : callable
        Fits stars of the scene as two each, as `legdistort.measurement.scene.splitting.pairs` does.
    settled : bool
        The scene has been searched before: its misfit stays, and its stars are beyond doubt.
    around : ndarray, shape (m, 2), optional
        Places near which alone it is searched, and stars are fitted.
    """
    state = _Search(scene, threshold, pairs, settled, around)
    for k in range(_PASSES):
        state.fit(4)
        if not settled and k < _WHOLE:
            scene.update_sky()
        if not settled and k < scene.starting:
            if retune is not None:
                retune(scene)
            state.active = scene.fit(state.near(scene.xy), 2)
            scene.update_sky()
        state.local = settled or (scene.by_places and k >= _WHOLE)
        if state.local:
            scene.weigh(state.near_changes(_AROUND))
        else:
            scene.update_misfit()
        changed = state.drop()
        rows = state.near_changes(_AROUND)
        places, flux = state.candidates()
        fresh = _away(places, state.dropped, _AGAIN * scene.fwhm) & _away(places, scene.xy, _BESIDE * scene.fwhm)
        if settled or k >= _WHOLE - 1:
            changed += state.split(rows, places[~fresh])
        changed += state.add(places[fresh], flux[fresh])
        log.debug("pass %d: %d stars, %d changes", k + 1, len(scene.flux), changed)
        if k >= (1 if settled else _WHOLE) and changed < max(1, 0 if settled else _CHANGED * len(scene.flux)):
            break
    scene.fit(state.near(scene.xy), 3)
    state.local = settled
    state.drop()


class _Search:
    """A scene with what has been tried: stars to be fitted again, stars that are beyond doubt, places."""

    def __init__(self, scene, threshold, pairs, settled, around):
        self.scene, self.threshold, self.pairs, self.around = scene, threshold, pairs, around
        self.active, self.sure = self.near(scene.xy), np.full(len(scene.flux), settled)
        self.dropped, self.tried = np.zeros((0, 2)), scene.xy[~self.active]
        self.local, self.changes = settled, np.zeros((0, 2)) if around is None else around

    def near(self, places):
        """Which places (n, 2) are where the scene is searched; (n,)."""
        reach = _AROUND * self.scene.fwhm
        return np.ones(len(places), dtype=bool) if self.around is None else ~_away(places, self.around, reach)

    def near_changes(self, reach):
        """Stars within so many FWHM of what has changed since the last look; all unless only these are; rows (m,)."""
        if not self.local:
            return np.arange(len(self.scene.flux))
        return np.flatnonzero(~_away(self.scene.xy, self.changes, reach * self.scene.fwhm))

    def fit(self, iterations):
        """Stars that have not come to rest fitted."""
        self.changes = np.vstack([self.changes, self.scene.xy[self.active]])
        self.active = self.scene.fit(self.active, iterations)

    def candidates(self):
        """What may be stars where the scene is searched: places (n, 2) and fluxes (n,)."""
        where = {"around": self.changes} if self.local else {}
        places, flux = self.scene.candidates(self.threshold, **where)
        self.changes = np.zeros((0, 2))
        near = self.near(places)
        return places[near], flux[near]

    def drop(self):
        """Stars that are none taken off; their number."""
        scene = self.scene
        rows, lost = self.near_changes(_AROUND), np.zeros(len(scene.flux), dtype=bool)
        lost[rows] = ~_stand(scene, self.threshold, self.sure[rows], rows)
        gone = scene.xy[lost]
        scene.remove(lost)
        self.active, self.sure = self.active[~lost], self.sure[~lost]
        self.dropped = np.vstack([self.dropped, gone])
        self._disturb(gone)
        return len(gone)

    def add(self, places, flux, *, sure=False):
        """New stars; their number."""
        self.scene.add(places, flux)
        self.active = np.append(self.active, np.ones(len(flux), dtype=bool))
        self.sure = np.append(self.sure, np.full(len(flux), sure))
        self._disturb(places)
        return len(flux)

    def split(self, rows, peaks):
        """Stars among some replaced by two where that explains more, alone and with their neighbours; their number."""
        scene = self.scene
        rows = rows[_away(scene.xy[rows], self.tried, _AGAIN * scene.fwhm)]
        rows = rows[splitting.doubtful(scene, peaks, rows)]
        self.tried = np.vstack([self.tried, scene.xy[rows]])
        params, gain = self.pairs(scene, rows)
        two = gain > splitting.GAIN
        rows, params = rows[two], params[two]
        if not len(rows):
            return 0
        before, n = (scene.xy[rows], scene.flux[rows]), len(scene.flux)
        chi2 = scene.chi2_around(before[0])
        scene.set(rows, params[:, 0, :2], params[:, 0, 2])
        scene.add(params[:, 1, :2], params[:, 1, 2])
        new = np.zeros(len(scene.flux), dtype=bool)
        new[rows] = new[n:] = True
        scene.fit(scene.around(new), 4)
        back = chi2 - scene.chi2_around(before[0]) < splitting.GAIN
        scene.set(rows[back], before[0][back], before[1][back])
        places, flux = scene.xy[n:][~back], scene.flux[n:][~back]
        scene.remove(np.arange(len(scene.flux)) >= n)
        self.sure[rows[~back]] = True
        return self.add(places, flux, sure=True)

    def _disturb(self, places):
        """What is near a change is fitted again, and may be tried again."""
        reach, self.changes = _DISTURBS * self.scene.fwhm, np.vstack([self.changes, places])
        self.active |= ~_away(self.scene.xy, places, reach)
        self.tried = self.tried[_away(self.tried, places, reach)]


def _away(places, others, distance):
    """Whether places are farther than a distance from all others; (n,)."""
    if not len(others) or not len(places):
        return np.ones(len(places), dtype=bool)
    return np.isinf(cKDTree(others).query(places, distance_upper_bound=distance)[0])


def _stand(scene, threshold, sure, rows):
    """Stars among some that stay: significant by themselves and beside their neighbours, no two in one place; (n,)."""
    if not len(rows):
        return np.ones(0, dtype=bool)
    xy, flux = scene.xy[rows], scene.flux[rows]
    ratio = flux / np.sqrt(np.maximum(scene.covariance(rows)[:, 2, 2], 1e-30))
    doubtful = ~sure & (ratio < _ALONE * threshold)
    # of stars that leave each other undetermined one goes at a time: two lights may have been fitted with three
    i, j = cKDTree(xy).query_pairs(scene.fwhm, output_type="ndarray").T
    both = doubtful[i] & doubtful[j]
    doubtful[np.where(ratio[i] < ratio[j], j, i)[both]] = False
    stay = (scene.snr(rows) > threshold) & ~doubtful
    stay &= scene.contains(xy)
    i, j = cKDTree(xy).query_pairs(SAME * scene.fwhm, output_type="ndarray").T
    stay[np.where(flux[i] < flux[j], i, j)] = False
    return stay
