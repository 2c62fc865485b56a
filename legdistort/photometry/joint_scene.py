"""The stars of all exposures together: positions on the reference plane, and one flux each."""

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import bsr_array, csc_array

from ..coaddition.resampling import engines
from ..coaddition.resampling.engines import Resampling, resample
from ..measurement.detection import peaks_above
from ..measurement.scene.normal_equations import JointFit, neighbour_covariance, normal_matrix, solved
from ..runtime.progress import Bar

_STRIP = 256  # rows of the reference plane that are carried at a time
_MARGIN = 12  # pixels around what is interpolated: splines have forgotten its edge by then
#: Exposures from which a star must stand without the strongest; signal-to-noise ratio that it may lose by that.
CONFIRMED, LESS = 3, 1.0
_UNSEEN = -1e30
_LEAST = 1e-3  # of the weight of the best seen star of an image: what has less is not seen


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

    Attributes
    ----------
    xy, flux : ndarray, shape (n, 2), (n,)
        Of the stars, in the reference plane; the flux is that in an exposure of transmission 1.
    rejected : int
        Peaks of the last look that did not stand without their strongest exposure.
    area : int
        Pixels of the plane that the exposures cover.
    """

    def __init__(self, layers, grid, *, progress=False):
        self.layers, self.grid, self.rejected, self.area = layers, grid, 0, 0
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

    def contains(self, xy):
        """Whether places (n, 2) lie in any image."""
        return np.any(
            [layer.scene.contains(np.nan_to_num(layer.local(xy)[0].pixel, nan=-99)) for layer in self.layers], 0
        )

    # -- the fit

    def equations(self, rows):
        """Normal matrix (3 m, 3 m) and right side of some stars' x, y and flux, sparse."""
        normal, right = csc_array((3 * len(rows),) * 2), np.zeros(3 * len(rows))
        for layer in self.layers:
            there = np.flatnonzero(layer.rows[rows] >= 0)
            if len(there):
                own, side = layer.scene.equations(layer.rows[rows[there]])
                blocks = np.zeros((len(there), 3, 3))
                slopes = np.nan_to_num(layer.places.place(self.xy[rows[there]]).slopes)
                blocks[:, :2, :2] = np.where(layer.trusted[rows[there], None, None], slopes, 0)
                blocks[:, 2, 2] = layer.transmission
                through = bsr_array((blocks, there, np.arange(len(there) + 1)), shape=(own.shape[0], len(right)))
                normal += (through.T @ own @ through).tocsc()
                right += through.T @ side
        return normal, right

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

    def fluxes(self, layer):
        """Fluxes of the stars of an image and their errors, positions fixed, neighbours together; (m,) each.

        In the unit of the star's flux. The error is infinite where the image does not see the star.
        """
        scene, m = layer.scene, len(layer.scene.flux)
        if not m:
            return np.zeros(0), np.zeros(0)
        slopes, pixels, centres = scene.slopes(np.arange(m))
        slopes = slopes[:, 2:]
        normal = normal_matrix(slopes, centres, scene.half)
        left = np.sqrt(scene.weights, dtype=float) * scene.residual
        right = np.einsum("np,np->n", slopes[:, 0], left.ravel()[pixels])
        diagonal = normal.diagonal()
        flux = scene.flux + solved(normal, right, np.sqrt(np.maximum(diagonal, 1e-30)))
        error = np.sqrt(neighbour_covariance(normal, scene.xy, scene.fwhm)[:, 0, 0])
        seen = scene.snr() ** 2 > _LEAST * scene.flux**2 * diagonal.max()
        return flux / layer.transmission, np.where(seen, error, np.inf) / layer.transmission

    # -- the search

    def candidates(self, threshold):
        """Peaks of the summed likelihood that stand without their strongest exposure: places (n, 2), fluxes (n,)."""
        signal, norm, strongest = self.summed_likelihood()
        ratio = signal / np.sqrt(np.maximum(norm, 1e-30))
        x, y = peaks_above(ratio, threshold, max(1, int(self.fwhm / 2)))
        one, weight, count = (each[y, x] for each in strongest[1:])
        rest = (signal[y, x] - one) / np.sqrt(np.maximum(norm[y, x] - weight, 1e-30))
        stands = (count < CONFIRMED) | (rest > threshold - LESS)
        self.rejected = int(np.count_nonzero(~stands))
        self.area = int(np.count_nonzero(norm))
        x, y = x[stands], y[stands]
        return self.grid.to_reference(np.column_stack([x, y]).astype(float)), (signal / np.maximum(norm, 1e-30))[y, x]

    def noise_peaks(self, threshold):
        """Expected number of peaks of noise above a threshold in the area covered.

        Maxima of a Gaussian field with the correlation of the PSF (Adler 1981, The Geometry of Random Fields, 6.8).
        """
        s, t = self.fwhm / 2.3548, threshold
        return float(self.area * t * np.exp(-t * t / 2) / ((2 * np.pi) ** 1.5 * 2 * s * s))

    def summed_likelihood(self):
        """Likelihood of one more star at every pixel of the grid: signal, norm (ny, nx) as those of a scene, and the
        ratio, signal and norm of the exposure with the greatest ratio and the number of exposures, (4, ny, nx).
        """
        ny, nx = self.grid.shape
        compiled = engines.uses_compiled_splines("interp", 3, ny * nx * len(self.layers))
        linear, cubic = (Resampling(order=order, compiled=compiled) for order in (1, 3))
        signal, norm, best = (np.zeros((*k, ny, nx), np.float32) for k in ((), (), (4,)))
        best[0] = -np.inf
        for layer in Bar(self.layers, desc="searching", unit="frame", disable=not self.progress):
            own, weight = layer.scene.likelihood()
            weight = np.where(weight > 0, weight, _UNSEEN)
            for start in range(0, ny, _STRIP):
                found = layer.grid_map.piece((slice(start, start + _STRIP), slice(0, nx)), margin=_MARGIN)
                if found is not None:
                    piece, part = found
                    n, s = resample([weight[part]], piece, linear)[0], resample([own[part]], piece, cubic)[0]
                    s, n = layer.transmission * s, layer.transmission**2 * n
                    there = n > 0  # NaN is not: it lies outside
                    r = np.where(there, s / np.sqrt(np.where(there, n, 1)), -np.inf)
                    signal[piece.window] += np.where(there, s, 0)
                    norm[piece.window] += np.where(there, n, 0)
                    window = best[:, *piece.window]
                    higher = r > window[0]
                    for plane, values in zip(window, (r, s, n), strict=False):
                        plane[higher] = values[higher]
                    window[3] += there
        return signal, norm, best


def _scale(layer):
    """Pixels of an image in one of the reference plane."""
    area = layer.grid_map.middle()[4].mean()
    return np.sqrt(area) if np.isfinite(area) and area > 0 else 1.0
