"""Moffat profiles that all stars of a frame share, of a shape that may vary over the field."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..profiles import moffat
from ..profiles.shape_field import shape_field

_PLACES = 9  # along x and along y at which the shape is kept: it is a polynomial of degree 2 at most


@dataclass(frozen=True, eq=False)
class MoffatField:
    """A shared PSF: Moffat profiles with shapes that are bilinear between places.

    It has what an `~legdistort.measurement.effective.model.EffectivePSF` has for the fit of a scene: `light`, `centre`,
    `fwhm` and `source`.

    Attributes
    ----------
    shapes : ndarray, shape (k, k, 4)
        By y and x; parameters of `legdistort.measurement.profiles.moffat`.
    size : tuple of int
        ``(ny, nx)`` of the frame.
    """

    shapes: np.ndarray
    size: tuple

    source = "moffat"

    @classmethod
    def of_stars(cls, shapes, covariance, xy, use, *, size, degree, fallback):
        """The field of the shapes of some stars (`legdistort.measurement.profiles.shape_field.shape_field`)."""
        places = _places(size)
        n = len(places)
        shapes, covariance = np.vstack([shapes, np.tile(fallback, (n, 1))]), np.concatenate([covariance, _units(n)])
        use = np.append(use, np.zeros(n, dtype=bool))
        field, _ = shape_field(shapes, covariance, np.vstack([xy, places]), use, degree=degree, fallback=fallback)
        return cls(field[-n:].reshape(_PLACES, _PLACES, 4), size)

    @classmethod
    def constant(cls, shape, size):
        """One shape (4,) everywhere."""
        return cls(np.broadcast_to(shape, (_PLACES, _PLACES, 4)), size)

    @cached_property
    def fwhm(self):
        """Full width at half maximum in the middle of the field [pix]."""
        return float(moffat.fwhm(self.shapes[_PLACES // 2, _PLACES // 2]))

    @cached_property
    def _nodes(self):
        return moffat.quadrature(self.fwhm)

    def at(self, xy):
        """Shapes (n, 4) at some places (n, 2)."""
        t = np.clip(xy[:, ::-1] / (np.array(self.size) - 1) * (_PLACES - 1), 0, _PLACES - 1)
        low = np.minimum(t.astype(int), _PLACES - 2)
        (i, j), (f, g) = low.T, (t - low).T[:, :, None]
        below, above = ((1 - g) * self.shapes[k, j] + g * self.shapes[k, j + 1] for k in (i, i + 1))
        return (1 - f) * below + f * above

    def centre(self, xy):
        """Where the centre lies, from where positions count; (n, 2), zeros."""
        return np.zeros((len(xy), 2))

    def light(self, params, centres, half, *, slopes=False):
        """Light of stars on square stamps.

        Parameters
        ----------
        params : ndarray, shape (n, 3)
            x, y from the central pixels, flux. Their precision (float32 or float64) is that of the results.
        centres : ndarray of int, shape (n, 2)
            Central pixels (x, y).
        half : int
            Stamps reach from -half to half.
        slopes : bool
            Whether to give the derivatives by x, y and flux too.

        Returns
        -------
        light : ndarray, shape (n, npix)
        slopes : ndarray, shape (n, 3, npix)
            Only if asked for.
        """
        profile = moffat.parameters(np.ones(len(params)), self.at(centres + params[:, :2]), params[:, :2])
        unit = 1 / moffat.flux(profile)
        profile[:, 2] = params[:, 2] * unit
        profile, unit = profile.astype(params.dtype), unit.astype(params.dtype)
        if not slopes:
            return moffat.evaluate(profile, half, self._nodes if half < 4 * self.fwhm else moffat.CENTRES)
        light, by = moffat.evaluate_placed(profile, half, self._nodes)
        by[:, 2] *= unit[:, None]
        return light, by


def _places(size):
    y, x = (np.linspace(0, n - 1, _PLACES) for n in size)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _units(n):
    return np.tile(np.eye(4), (n, 1, 1))
