"""The Fisher matrix of everything at once: stars, exposures and the detectors of GSAOI, dense and in plain powers.

What it is made of are the published numbers and the true positions of a `gsaoi_images.Night`: derivatives are
differences of its polynomials, distortions are plain powers of angles (exposures) and of pixels (detectors). Neither
the basis of the package nor its gauge, cameras or eliminations take part.
"""

import gsaoi_images
import numpy as np

#: Eigenvalues below this part of the largest are zero.
ROUNDING = 1e-11


def powers(at, degree):
    """Powers up to a total degree of (n, 2) coordinates, shape (n, n_powers)."""
    return np.stack([at[:, 0] ** i * at[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)


class Everything:
    """Jacobian of all measured positions of a table by everything unknown, in units of their errors.

    The unknowns are, in this order: stars (n, 2), exposures (i, 2, n_powers), detectors (c, 2, n_powers).

    Parameters
    ----------
    night : gsaoi_images.Night
    table : QTable
        Its `Night.table`.
    degree : int
        Of the distortions of exposures, and of those of the detectors.
    sigma : float
        Pixels.
    """

    def __init__(self, night, table, *, degree, sigma):
        self.night, self.degree, self.polynomials = night, degree, gsaoi_images.published()
        self.stars, self.star = np.unique(table["star"], return_inverse=True)
        names, self.exposure = np.unique(table["exposure"], return_inverse=True)
        self.numbers = [int(name.removeprefix("frame")) for name in names]
        self.detector = np.asarray(table["detector"]).astype(int) - 1
        self.middle = night.sky[self.stars].mean(axis=0)
        self.n_powers = (degree + 1) * (degree + 2) // 2
        n, k = len(table), self.n_powers
        self.jacobian = np.zeros((n, 2, 2 * len(self.stars) + 2 * k * (len(names) + 4)))
        stars, exposures, detectors = self.parts(self.jacobian)
        for i, c in np.unique(np.stack([self.exposure, self.detector], axis=1), axis=0):
            at = np.flatnonzero((self.exposure == i) & (self.detector == c))
            moved = self.row(i, str(c + 1), self.stars[self.star[at]])
            stars[at, :, self.star[at]], exposures[at, :, i], detectors[at, :, c] = moved
        self.jacobian = self.jacobian.reshape(2 * n, -1) / sigma
        self.fisher = self.jacobian.T @ self.jacobian

    def parts(self, vector):
        """Views (..., n_stars, 2), (..., n_exposures, 2, n_powers) and (..., 4, 2, n_powers) of vectors (..., n)."""
        k, n, first = self.n_powers, len(self.stars), vector.shape[:-1]
        last = vector.shape[-1] - 8 * k
        return (
            vector[..., : 2 * n].reshape(*first, n, 2),
            vector[..., 2 * n : last].reshape(*first, -1, 2, k),
            vector[..., last:].reshape(*first, 4, 2, k),
        )

    def row(self, i, key, stars):
        """What moves stars (n,) that exposure i sees on a detector, in pixels: derivatives (n, 2, ...) by place on the
        sky, by the powers of the exposure and by those of the detector.
        """
        c, focal, pixels = self.polynomials[int(key) - 1], self.night.focal[self.numbers[i]], self.night.pixels
        xy = pixels[self.numbers[i]][key][stars]
        to_pixels = np.linalg.inv(derivative(lambda p: gsaoi_images.to_arcsec(c, p), xy, 1.0))
        place = (focal[stars] - self.middle) / 60
        by_exposure = np.einsum("nab,nm->nabm", to_pixels, powers(place, self.degree))
        by_detector = np.einsum("ab,nm->nabm", np.eye(2), powers(xy / 1024 - 1, self.degree))
        return to_pixels @ self.slope(i, stars), by_exposure, by_detector

    def slope(self, i, stars):
        """Derivative (n, 2, 2) of places in the focal plane of exposure i by those on the sky."""
        return derivative(lambda sky: self.night.bent(self.numbers[i], sky), self.night.sky[stars], 1e-3)

    def solved(self, dynamic=None):
        """Covariance of all unknowns on what the positions determine, and the null space (n, m).

        Unknowns are compared in units of what would be told of each if all others were known. Maps that can be
        exchanged are so to first order, and seen by the product of one with the gradient of another: there must be a
        gap.

        Parameters
        ----------
        dynamic : float, optional
            Rms of every power of the distortions of exposures, arcsec, as a prior on them but for shift, rotation and
            scale; without it nothing is known beforehand.
        """
        fisher = self.fisher if dynamic is None else self.fisher + self._dynamic_prior(dynamic)
        unit = 1 / np.sqrt(np.diag(fisher))
        values, vectors = np.linalg.eigh(fisher * np.outer(unit, unit))
        gaps = np.where((values[:-1] > ROUNDING) & (values[1:] < 0.1), values[1:] / np.abs(values[:-1]), 0)
        first = 1 + int(np.argmax(gaps))
        assert gaps[first - 1] > 50, "no gap between what is determined and what is not"
        known = vectors[:, first:] * unit[:, None]
        return known / values[first:] @ known.T, vectors[:, :first] * unit[:, None]

    def _dynamic_prior(self, dynamic):
        """Its matrix."""
        low = powers(np.zeros((1, 2)), self.degree)  # the order of powers: 1, y, ..., x, ...
        one, y, x = 0, 1, self.degree + 1
        similar = np.zeros((4, 2, low.shape[1]))
        similar[0, 0, one] = similar[1, 1, one] = 1
        similar[2, 0, x] = similar[2, 1, y] = similar[3, 1, x] = np.sqrt(0.5)
        similar[3, 0, y] = -np.sqrt(0.5)
        free = np.eye(2 * self.n_powers) - similar.reshape(4, -1).T @ similar.reshape(4, -1)
        out = np.zeros(self.fisher.shape)
        for each in self.parts(np.arange(len(out)))[1]:
            out[np.ix_(each.ravel(), each.ravel())] = free / dynamic**2
        return out

    def star_bound(self, covariance):
        """Bound of the positions of the stars after a common map, rms per axis, arcsec."""
        n = 2 * len(self.stars)
        stars = covariance[:n, :n].reshape(n // 2, 2, n // 2, 2)
        centred = gsaoi_images.without_common_map(np.eye(n // 2), self.night.sky[self.stars], self.degree)
        return float(np.sqrt(sum(np.trace(centred @ stars[:, k, :, k] @ centred.T) for k in (0, 1)) / n))

    def detector_bounds(self, covariance):
        """Bounds of what `detector_parts` gives, rms per axis, arcsec."""
        at, focal = grid(), []
        moves = np.zeros((4, len(at), 2, 4, 2, self.n_powers))
        for c, polynomial in enumerate(self.polynomials):
            focal.append(gsaoi_images.to_arcsec(polynomial, at))
            slope = derivative(lambda p, polynomial=polynomial: gsaoi_images.to_arcsec(polynomial, p), at, 1.0)
            moves[c, :, :, c] = np.einsum("nab,nm->nabm", slope, powers(at / 1024 - 1, self.degree))
        k = 8 * self.n_powers
        parts = detector_parts(np.array(focal), moves.reshape(4, len(at), 2, k), self.degree)
        last = covariance[-k:, -k:]
        return tuple(float(np.sqrt(np.einsum("...k,kl,...l->...", each, last, each).mean())) for each in parts)


def grid(n=7):
    """Pixels (n^2, 2) of a detector."""
    t = np.linspace(0, gsaoi_images.SIZE - 1, n)
    return np.stack(np.meshgrid(t, t), axis=-1).reshape(-1, 2)


def detector_parts(focal, moves, degree):
    """Displacements (4, n, 2, ...) of the detectors in the focal plane: by their layouts, and by their statics.

    A map of the focal plane up to a degree, which detectors and exposures can exchange, is taken off; what is affine on
    each detector is then its layout.

    Parameters
    ----------
    focal : ndarray, shape (4, n, 2)
        Where the pixels of `grid` lie.
    """
    flat = moves.reshape(4 * moves.shape[1], -1)
    left = gsaoi_images.without_common_map(flat, focal.reshape(-1, 2), degree).reshape(4, moves.shape[1], -1)
    affine = np.column_stack([np.ones(moves.shape[1]), grid() / 1024 - 1])
    layout = affine @ (np.linalg.pinv(affine) @ left)
    return layout.reshape(moves.shape), (left - layout).reshape(moves.shape)


def camera_error(camera, degree, scale):
    """Errors (4, n, 2), arcsec, of layouts and statics of a camera: rms per axis, against the published numbers.

    `scale` is the size of a pixel of its focal plane, arcsec.
    """
    true = np.array([gsaoi_images.to_arcsec(c, grid()) for c in gsaoi_images.published()])
    found = np.array([camera[key].to_focal_plane(grid()) * scale for key in gsaoi_images.CHIPS])
    return detector_parts(true, found - true, degree)


def derivative(function, at, step):
    """Central differences (n, 2, 2) of a map of (n, 2) coordinates."""
    return np.stack([(function(at + d) - function(at - d)) / (2 * step) for d in step * np.eye(2)], axis=2)
