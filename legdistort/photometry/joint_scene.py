"""The stars of all exposures together: positions on the reference plane, and one flux each."""

from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from ..measurement.detection import peaks_above
from ..measurement.scene.normal_equations import (
    JointFit,
    assembled,
    neighbour_covariance,
    normal_matrix,
    solved,
    with_neighbours,
)
from ..runtime.progress import Bar
from ..runtime.scratch import forget
from . import likelihood_sum

_BLOCK = 256  # rows and columns of the reference plane that are looked at together
_SMALL, _WORTH = 128, 2  # of blocks, where little has changed; as many of the others take as long as these do
_AROUND = 3.5  # FWHM, to either side, that are looked at around a place
#: Exposures from which a star must stand without the strongest; signal-to-noise ratio that it may lose by that.
CONFIRMED, LESS = 3, 1.0
_NOTHING = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3, 3))  # of no star
_LEAST = 1e-3  # of the information that an image has on a faint star anywhere: of what it has less, it does not see


class Layers(list):
    """Every `Layer` of a scene; what is on the disk of one leaves the memory before the next has its turn."""

    def __iter__(self):
        for layer in super().__iter__():
            yield layer
            for plane in layer.scene.planes():
                forget(plane)


@dataclass(eq=False)
class Layer:
    """One image.

    Attributes
    ----------
    name : str
    scene : `~legdistort.measurement.scene.joint_fit.Scene`
        With those of the stars whose light it has.
    places : `~legdistort.photometry.places.Places`
    grid_map : `~legdistort.coaddition.resampling.pixel_maps.ExposureMap`
        Where the grid of the sum lies on it.
    unit : float
        Factor by which its data were multiplied.
    shape : ndarray, shape (4,)
        Moffat profile of its stars.
    retuned : bool
        Whether its PSF follows from its stars.
    transmission : float
        Its light of a star relative to the flux of the star.
    rows : ndarray of int, shape (n,)
        For every star its row in the scene, -1 for those that it does not see.
    trusted : ndarray of bool, shape (n,)
        Whether it tells where a star is: not those that the solution left out in it.
    """

    name: str
    scene: object
    places: object
    grid_map: object
    unit: float
    shape: np.ndarray
    retuned: bool
    transmission: float = 1.0
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    trusted: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def local(self, xy):
        """Pixels of stars (n, 2) as its scene counts, and whether their light reaches it."""
        pixel = self.places.pixels(xy)
        pixel = pixel - (self.scene.psf.centre(np.nan_to_num(pixel)) if len(xy) else 0)
        reach, size = self.scene.half, np.array(self.scene.light.shape[::-1])
        return pixel, ((pixel > -reach) & (pixel < size - 1 + reach)).all(axis=1)

    @property
    def stars(self):
        """The stars that it sees, in the order of its scene; (m,)."""
        return np.flatnonzero(self.rows >= 0)

    def own(self, rows):
        """Which of some stars it sees, and their rows in its scene; (m,) each."""
        own = self.rows[rows]
        return np.flatnonzero(own >= 0), own[own >= 0]

    def spread(self, values, empty=0.0):
        """Values (m,) of the stars of the scene for all stars, (n,)."""
        out = np.full(len(self.rows), empty)
        out[self.stars] = values
        return out


class JointScene(JointFit):
    """What `~legdistort.measurement.scene.joint_fit.Scene` is of a frame, of all exposures.

    Parameters
    ----------
    layers : list of Layer
    grid : `~legdistort.coaddition.grids.Grid`
        Of the reference plane, on which the exposures are summed.

    Attributes
    ----------
    xy, flux : ndarray, shape (n, 2), (n,)
        Of the stars, in the reference plane; the flux is that in an exposure of transmission 1.
    spread : ndarray, shape (n, 2, 2)
        Of sources wider than stars, as of `legdistort.measurement.scene.extended.spread_light`; 0 for stars.
    rejected : int
        Peaks of the last look that did not stand without their strongest exposure.
    area : int
        Pixels of the plane that the exposures cover.
    """

    starting, by_places = 2, True  # the search begins with the stars of a solution

    def __init__(self, layers, grid, *, progress=False):
        self.layers, self.grid, self.rejected, self.area = Layers(layers), grid, 0, 0
        self.progress = progress
        self.xy, self.flux, self.spread = np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2))
        self.fwhm = float(np.median([each.scene.fwhm / _scale(each) for each in layers]))

    @property
    def wide(self):
        """Sources wider than stars, a mask (n,)."""
        return self.spread.any(axis=(1, 2))

    # -- stars come and go

    def add(self, xy, flux):
        """More stars."""
        self.xy, self.flux = np.vstack([self.xy, xy]), np.append(self.flux, flux)
        self.spread = np.concatenate([self.spread, np.zeros((len(flux), 2, 2))])
        for layer in self.layers:
            pixel, there = layer.local(xy)
            new = np.full(len(flux), -1)
            new[there] = len(layer.scene.flux) + np.arange(there.sum())
            layer.rows = np.append(layer.rows, new)
            layer.trusted = np.append(layer.trusted, np.ones(len(flux), dtype=bool))
            layer.scene.add(pixel[there], layer.transmission * flux[there])

    def remove(self, rows):
        """Stars taken off; a mask (n,)."""
        for layer in self.layers:
            layer.scene.remove(rows[layer.stars])
            layer.rows, layer.trusted = layer.rows[~rows], layer.trusted[~rows]
            layer.rows[layer.stars] = np.arange(len(layer.scene.flux))
        self.xy, self.flux, self.spread = self.xy[~rows], self.flux[~rows], self.spread[~rows]

    def set(self, rows, xy, flux, spread=None):
        """Other positions and fluxes of some stars, perhaps another spread."""
        self.xy[rows], self.flux[rows] = xy, flux
        if spread is not None:
            self.spread[rows] = spread
        for layer in self.layers:
            own = layer.rows[rows]
            pixel = layer.local(self.xy[rows])[0]
            there = (own >= 0) & np.isfinite(pixel).all(axis=1)
            its = None if spread is None else layer.places.slopes(self.xy[rows[there]]) @ spread[there]
            layer.scene.set(own[there], pixel[there], layer.transmission * self.flux[rows][there], its)

    def refresh(self):
        """All stars put once more where PSFs and transmissions have them."""
        for layer in self.layers:
            pixel = layer.local(self.xy[layer.stars])[0]
            known = np.isfinite(pixel).all(axis=1)
            layer.scene.xy[known] = pixel[known]
            layer.scene.flux = layer.transmission * self.flux[layer.stars]
            layer.scene.render()

    @contextmanager
    def restored(self):
        """Stars may come and go: they are as before afterwards."""
        own, before = (self.xy, self.flux, self.spread), []
        for each in self.layers:
            scene = each.scene
            before.append((each.rows, each.trusted, scene.xy, scene.flux, scene.spread))
            each.rows, each.trusted, scene.xy, scene.flux, scene.spread = (values.copy() for values in before[-1])
        self.xy, self.flux, self.spread = (values.copy() for values in own)
        try:
            yield
        finally:
            self.xy, self.flux, self.spread = own
            for each, values in zip(self.layers, before, strict=True):
                scene = each.scene
                each.rows, each.trusted, scene.xy, scene.flux, scene.spread = values
                scene.render()

    def contains(self, xy):
        """Whether places (n, 2) lie in any image."""
        return np.any([layer.scene.contains(np.nan_to_num(layer.local(xy)[0], nan=-99)) for layer in self.layers], 0)

    # -- the fit

    def equations(self, rows):
        """Normal matrix (3 m, 3 m) and right side of some stars' x, y and flux, sparse."""
        parts, right = [], np.zeros((len(rows), 3))
        for layer in self.layers:
            there, own = layer.own(rows)
            if len(there):
                (i, j, blocks), side = layer.scene.blocks(own)
                through = np.zeros((len(there), 3, 3))
                slopes = np.nan_to_num(layer.places.slopes(self.xy[rows[there]]))
                through[:, :2, :2] = np.where(layer.trusted[rows[there], None, None], slopes, 0)
                through[:, 2, 2] = layer.transmission
                parts.append((there[i], there[j], through[i].mT @ blocks @ through[j]))
                right[there] += (side[:, None] @ through)[:, 0]
        return assembled(parts or [_NOTHING], len(rows)), right.ravel()

    def update_sky(self):
        """The sky of every exposure made anew: most of the stars that are found last no exposure shows."""
        for layer in self.layers:
            layer.scene.update_sky(max(1, int(layer.scene.fwhm)), afresh=True)

    def update_misfit(self):
        """The misfit that bright stars show in every exposure."""
        for layer in self.layers:
            layer.scene.update_misfit()

    def weigh(self, rows):
        """Weights of all exposures made anew around some stars."""
        for layer in self.layers:
            layer.scene.weigh(layer.own(rows)[1])

    def snr(self, rows=None):
        """Signal-to-noise ratio of the stars, or some, where nothing but their flux is unknown, (n,)."""
        return np.sqrt(self._by_layer(lambda scene, own: scene.snr(own) ** 2, rows).sum(axis=0))

    def unit_snr(self, xy):
        """Ratios of signal to noise that stars of unit flux at some places would have by what is there now; (n,).

        Zero where no image sees them.
        """
        total = np.zeros(len(xy))
        for layer in self.layers:
            pixel, there = layer.local(xy)
            square = layer.scene.unit_snr(pixel[there]) ** 2
            seen = square > _LEAST * layer.scene.usual_information
            total[there] += np.where(seen, layer.transmission**2 * square, 0)
        return np.sqrt(total)

    def core_chi2(self, rows=None):
        """Mean squared residual in units of the noise in cores, of all or some, weighted with the information; (n,)."""
        weights = self._by_layer(lambda scene, own: scene.snr(own) ** 2, rows)
        chi2 = self._by_layer(lambda scene, own: scene.core_chi2(own), rows)
        return (weights * chi2).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-30)

    def sharpness(self, rows=None):
        """What is left in central pixels over what the PSF has there, of all stars or some, and its error; (n,)."""
        left = self._by_layer(lambda scene, own: scene.middles(own)[0], rows).sum(axis=0)
        norm = np.maximum(self._by_layer(lambda scene, own: scene.middles(own)[1], rows).sum(axis=0), 1e-30)
        return left / norm, norm**-0.5

    def _by_layer(self, function, rows):
        """Values of ``function(scene, rows of the scene)`` for stars, all or some, by layer, (m, n)."""
        out = np.zeros((len(self.layers), len(self.flux) if rows is None else len(rows)))
        for values, layer in zip(out, self.layers, strict=True):
            there, own = layer.own(np.arange(len(self.flux)) if rows is None else rows)
            values[there] = function(layer.scene, None if rows is None else own)
        return out

    def chi2_around(self, places):
        """Sum of the squared residuals within a core of some places of the plane, in units of the noise; (n,)."""
        total = np.zeros(len(places))
        for layer in self.layers:
            pixel, there = layer.local(places)
            total[there] += layer.scene.chi2_around(pixel[there])
        return total

    def fluxes(self, layer, rows=None):
        """Fluxes of stars of an image and their errors, positions fixed, neighbours together; (m,) each.

        Of some rows of its scene, in order, in the unit of the star's flux. The error is infinite where the image does
        not see the star.
        """
        scene = layer.scene
        rows = np.arange(len(scene.flux)) if rows is None else rows
        some = with_neighbours(scene.xy, rows, scene.fwhm)
        if not len(some):
            return np.zeros(0), np.zeros(0)
        slopes, right, centres = scene.slopes(some, flux_alone=True)
        normal, own = normal_matrix(slopes, centres, scene.half), np.searchsorted(some, rows)
        diagonal = normal.diagonal()
        flux = scene.flux[rows] + solved(normal, right[:, 0], np.sqrt(np.maximum(diagonal, 1e-30)))[own]
        error = np.sqrt(neighbour_covariance(normal, scene.xy[some], scene.fwhm, own)[:, 0, 0])
        seen = diagonal[own] > _LEAST * scene.usual_information
        return flux / layer.transmission, np.where(seen, error, np.inf) / layer.transmission

    # -- the search

    def candidates(self, threshold, around=None):
        """Peaks of the summed likelihood that stand without their strongest exposure: places (n, 2), fluxes (n,).

        Everywhere, or around some places (m, 2) of the reference plane.
        """
        parts, found = self._parts(around), []
        if around is None:
            self.area = 0
        for part in Bar(parts, desc="searching", unit="block", disable=not self.progress):
            pixels, values, area = self._peaks(part, threshold)
            found.append(np.vstack([pixels, values]))
            self.area += area if around is None else 0
        columns = np.hstack([np.zeros((6, 0)), *found])  # parts around places may overlap
        x, y, signal, norm, rest, count = columns[:, np.unique(columns[:2], axis=1, return_index=True)[1]]
        stands = (count < CONFIRMED) | (rest > threshold - LESS)
        if around is None:
            self.rejected = int(np.count_nonzero(~stands))
        return self.grid.to_reference(np.column_stack([x, y])[stands]), (signal / np.maximum(norm, 1e-30))[stands]

    def _parts(self, around):
        """Rows and columns of the plane that are looked at together: blocks of all of it, or what is around places."""
        shape = np.array(self.grid.shape)
        everything = _blocks(np.ones(-(-shape // _BLOCK), dtype=bool), _BLOCK, shape)
        if around is None:
            return everything
        reach = int(np.ceil(_AROUND * self.fwhm))
        middle = np.round(self.grid.from_reference(around))[:, ::-1].astype(int)
        middle = np.unique(middle[((middle > -reach) & (middle < shape + reach)).all(axis=1)], axis=0)
        ends = np.stack([np.maximum(middle - reach, 0), np.minimum(middle + reach + 1, shape)], axis=1)
        touched = np.zeros(-(-shape // _SMALL), dtype=bool)
        for low, high in ends.tolist():
            touched[tuple(slice(i // _SMALL, -(-k // _SMALL)) for i, k in zip(low, high, strict=True))] = True
        some = [tuple(map(slice, low, high)) for low, high in ends.tolist()]
        if touched.sum() < len(some):
            some = _blocks(touched, _SMALL, shape)
        return some if len(some) < _WORTH * len(everything) else everything

    def _peaks(self, part, threshold):
        """Peaks of a part of the plane: x, y, then signal, norm, ratio without the strongest, number of exposures; and
        the pixels that any exposure sees.
        """
        reach = max(1, int(self.fwhm / 2))
        ends = zip(part, self.grid.shape, strict=True)
        wide = tuple(slice(max(s.start - reach, 0), min(s.stop + reach, n)) for s, n in ends)
        sums, best = likelihood_sum.empty_sums([s.stop - s.start for s in wide])
        for layer in self.layers:
            likelihood_sum.add_layer(layer, wide, sums, best)
        x, y = peaks_above(sums[0] / np.sqrt(np.maximum(sums[1], 1e-30)), threshold, reach)
        pixels = np.array([x + wide[1].start, y + wide[0].start])
        low, high = (np.array([[getattr(s, end)] for s in part[::-1]]) for end in ("start", "stop"))
        own = ((pixels >= low) & (pixels < high)).all(axis=0)
        (signal, norm), (one, weight, count) = sums[:, y, x][:, own], best[1:, y, x][:, own]
        rest = (signal - one) / np.sqrt(np.maximum(norm - weight, 1e-30))
        inner = tuple(slice(p.start - w.start, p.stop - w.start) for p, w in zip(part, wide, strict=True))
        return pixels[:, own], np.array([signal, norm, rest, count]), int(np.count_nonzero(sums[1][inner]))

    def noise_peaks(self, threshold):
        """Expected number of peaks of noise above a threshold in the area covered.

        Maxima of a Gaussian field with the correlation of the PSF (Adler 1981, The Geometry of Random Fields, 6.8).
        """
        s, t = self.fwhm / 2.3548, threshold
        return float(self.area * t * np.exp(-t * t / 2) / ((2 * np.pi) ** 1.5 * 2 * s * s))


def _scale(layer):
    """Pixels of an image in one of the reference plane."""
    area = layer.grid_map.middle()[4].mean()
    return np.sqrt(area) if np.isfinite(area) and area > 0 else 1.0


def _blocks(wanted, side, shape):
    """Rows and columns of those square blocks of an image that are wanted."""
    return [
        tuple(slice(i * side, min((i + 1) * side, n)) for i, n in zip(each, shape, strict=True))
        for each in np.argwhere(wanted).tolist()
    ]
