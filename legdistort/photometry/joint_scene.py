"""The stars of all exposures together: positions on the reference plane, and one flux each."""

from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from ..measurement.detection import peaks_above
from ..measurement.scene.normal_equations import JointFit, assembled, neighbour_covariance, normal_matrix, solved
from ..runtime.progress import Bar
from ..runtime.scratch import forget, moved
from . import likelihood_sum

_ROWS = 256  # of the reference plane that are looked at together
#: Exposures from which a star must stand without the strongest; signal-to-noise ratio that it may lose by that.
CONFIRMED, LESS = 3, 1.0
_NOTHING = np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3, 3))  # of no star
_LEAST = 1e-3  # of the weight of the best seen star of an image: what has less is not seen


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
        """`Place` of stars (n, 2) as its scene counts, and whether their light reaches it."""
        place = self.places.place(xy)
        pixel = place.pixel - (self.scene.psf.centre(np.nan_to_num(place.pixel)) if len(xy) else 0)
        reach, size = self.scene.half, np.array(self.scene.light.shape[::-1])
        return place._replace(pixel=pixel), ((pixel > -reach) & (pixel < size - 1 + reach)).all(axis=1)

    @property
    def stars(self):
        """The stars that it sees, in the order of its scene; (m,)."""
        return np.flatnonzero(self.rows >= 0)

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
    folder : path, optional
        On the disk of which the sums are; by default in the memory.

    Attributes
    ----------
    xy, flux : ndarray, shape (n, 2), (n,)
        Of the stars, in the reference plane; the flux is that in an exposure of transmission 1.
    rejected : int
        Peaks of the last look that did not stand without their strongest exposure.
    area : int
        Pixels of the plane that the exposures cover.
    """

    def __init__(self, layers, grid, *, folder=None, progress=False):
        self.layers, self.grid, self.folder, self.rejected, self.area = Layers(layers), grid, folder, 0, 0
        self.progress = progress
        self.xy, self.flux = np.zeros((0, 2)), np.zeros(0)
        self.fwhm = float(np.median([each.scene.fwhm / _scale(each) for each in layers]))

    # -- stars come and go

    def add(self, xy, flux):
        """More stars."""
        self.xy, self.flux = np.vstack([self.xy, xy]), np.append(self.flux, flux)
        for layer in self.layers:
            place, there = layer.local(xy)
            new = np.full(len(flux), -1)
            new[there] = len(layer.scene.flux) + np.arange(there.sum())
            layer.rows = np.append(layer.rows, new)
            layer.trusted = np.append(layer.trusted, np.ones(len(flux), dtype=bool))
            layer.scene.add(place.pixel[there], layer.transmission * flux[there])

    def remove(self, rows):
        """Stars taken off; a mask (n,)."""
        for layer in self.layers:
            layer.scene.remove(rows[layer.stars])
            layer.rows, layer.trusted = layer.rows[~rows], layer.trusted[~rows]
            layer.rows[layer.stars] = np.arange(len(layer.scene.flux))
        self.xy, self.flux = self.xy[~rows], self.flux[~rows]

    def set(self, rows, xy, flux):
        """Other positions and fluxes of some stars."""
        self.xy[rows], self.flux[rows] = xy, flux
        for layer in self.layers:
            own = layer.rows[rows]
            place, there = layer.local(self.xy[rows])
            there = (own >= 0) & np.isfinite(place.pixel).all(axis=1)
            layer.scene.set(own[there], place.pixel[there], layer.transmission * self.flux[rows][there])

    def refresh(self):
        """All stars put once more where PSFs and transmissions have them."""
        for layer in self.layers:
            pixel = layer.local(self.xy[layer.stars])[0].pixel
            known = np.isfinite(pixel).all(axis=1)
            layer.scene.xy[known] = pixel[known]
            layer.scene.flux = layer.transmission * self.flux[layer.stars]
            layer.scene.render()

    @contextmanager
    def restored(self):
        """Stars may come and go, and the sky change: they are as before afterwards."""
        own, before = (self.xy, self.flux), []
        for each in self.layers:
            scene = each.scene
            before.append((each.rows, each.trusted, scene.xy, scene.flux, scene.sky))
            each.rows, each.trusted, scene.xy, scene.flux = (values.copy() for values in before[-1][:-1])
            scene.sky = scene.sky.copy() if self.folder is None else moved(scene.sky, self.folder)
        self.xy, self.flux = (values.copy() for values in own)
        try:
            yield
        finally:
            self.xy, self.flux = own
            for each, values in zip(self.layers, before, strict=True):
                each.rows, each.trusted, each.scene.xy, each.scene.flux, each.scene.sky = values
                each.scene.render()

    def contains(self, xy):
        """Whether places (n, 2) lie in any image."""
        return np.any(
            [layer.scene.contains(np.nan_to_num(layer.local(xy)[0].pixel, nan=-99)) for layer in self.layers], 0
        )

    # -- the fit

    def equations(self, rows):
        """Normal matrix (3 m, 3 m) and right side of some stars' x, y and flux, sparse."""
        parts, right = [], np.zeros((len(rows), 3))
        for layer in self.layers:
            there = np.flatnonzero(layer.rows[rows] >= 0)
            if len(there):
                (i, j, blocks), side = layer.scene.blocks(layer.rows[rows[there]])
                through = np.zeros((len(there), 3, 3))
                slopes = np.nan_to_num(layer.places.place(self.xy[rows[there]]).slopes)
                through[:, :2, :2] = np.where(layer.trusted[rows[there], None, None], slopes, 0)
                through[:, 2, 2] = layer.transmission
                parts.append((there[i], there[j], through[i].mT @ blocks @ through[j]))
                right[there] += (side[:, None] @ through)[:, 0]
        return assembled(parts or [_NOTHING], len(rows)), right.ravel()

    def update_sky(self):
        """The sky of every exposure changed by what is left."""
        for layer in self.layers:
            layer.scene.update_sky(max(1, int(layer.scene.fwhm)))

    def update_misfit(self):
        """The misfit that bright stars show in every exposure."""
        for layer in self.layers:
            layer.scene.update_misfit()

    def snr(self):
        """Signal-to-noise ratio of the stars where nothing but their flux is unknown, (n,)."""
        return np.sqrt(np.sum([layer.spread(layer.scene.snr()) ** 2 for layer in self.layers], axis=0))

    def core_chi2(self):
        """Mean squared residual in units of the noise in the cores, weighted with the information; (n,)."""
        weights = np.array([layer.spread(layer.scene.snr()) ** 2 for layer in self.layers])
        chi2 = np.array([layer.spread(layer.scene.core_chi2()) for layer in self.layers])
        return (weights * chi2).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-30)

    def chi2_around(self, places):
        """Sum of the squared residuals within a core of some places of the plane, in units of the noise; (n,)."""
        total = np.zeros(len(places))
        for layer in self.layers:
            place, there = layer.local(places)
            total[there] += layer.scene.chi2_around(place.pixel[there])
        return total

    def fluxes(self, layer, rows=None):
        """Fluxes of the stars of an image and their errors, positions fixed, neighbours together; (m,) each.

        In the unit of the star's flux. The error is infinite where the image does not see the star, and of stars that
        are not among some rows of its scene.
        """
        scene, m = layer.scene, len(layer.scene.flux)
        if not m:
            return np.zeros(0), np.zeros(0)
        slopes, right, centres = scene.slopes(np.arange(m), flux_alone=True)
        normal = normal_matrix(slopes, centres, scene.half)
        diagonal = normal.diagonal()
        flux = scene.flux + solved(normal, right[:, 0], np.sqrt(np.maximum(diagonal, 1e-30)))
        rows, error = np.arange(m) if rows is None else rows, np.full(m, np.inf)
        error[rows] = np.sqrt(neighbour_covariance(normal, scene.xy, scene.fwhm, rows)[:, 0, 0])
        seen = scene.snr() ** 2 > _LEAST * scene.flux**2 * diagonal.max()
        return flux / layer.transmission, np.where(seen, error, np.inf) / layer.transmission

    # -- the search

    def candidates(self, threshold):
        """Peaks of the summed likelihood that stand without their strongest exposure: places (n, 2), fluxes (n,)."""
        (signal, norm), strongest = self.summed_likelihood()
        reach, ny, found, self.area = max(1, int(self.fwhm / 2)), self.grid.shape[0], [], 0
        for start in range(0, ny, _ROWS):
            low, stop = max(0, start - reach), min(start + _ROWS, ny)
            rows = slice(low, stop + reach)
            x, y = peaks_above(signal[rows] / np.sqrt(np.maximum(norm[rows], 1e-30)), threshold, reach)
            own = (y + low >= start) & (y + low < stop)
            found.append(np.column_stack([x, y + low])[own])
            self.area += int(np.count_nonzero(norm[start:stop]))
        x, y = np.concatenate(found).T
        one, weight, count = strongest[1:, y, x]
        rest = (signal[y, x] - one) / np.sqrt(np.maximum(norm[y, x] - weight, 1e-30))
        stands = (count < CONFIRMED) | (rest > threshold - LESS)
        self.rejected = int(np.count_nonzero(~stands))
        x, y = x[stands], y[stands]
        flux = signal[y, x] / np.maximum(norm[y, x], 1e-30)
        return self.grid.to_reference(np.column_stack([x, y]).astype(float)), flux

    def noise_peaks(self, threshold):
        """Expected number of peaks of noise above a threshold in the area covered.

        Maxima of a Gaussian field with the correlation of the PSF (Adler 1981, The Geometry of Random Fields, 6.8).
        """
        s, t = self.fwhm / 2.3548, threshold
        return float(self.area * t * np.exp(-t * t / 2) / ((2 * np.pi) ** 1.5 * 2 * s * s))

    def summed_likelihood(self):
        """Likelihood of one more star at every pixel of the grid: signal and norm as those of a scene, (2, ny, nx), and
        the ratio, signal and norm of the exposure with the greatest ratio and the number of exposures, (4, ny, nx).
        """
        sums, best = likelihood_sum.empty_sums(self.grid.shape, self.folder)
        for layer in Bar(self.layers, desc="searching", unit="frame", disable=not self.progress):
            likelihood_sum.add_layer(layer, sums, best)
        return sums, best


def _scale(layer):
    """Pixels of an image in one of the reference plane."""
    area = layer.grid_map.middle()[4].mean()
    return np.sqrt(area) if np.isfinite(area) and area > 0 else 1.0
