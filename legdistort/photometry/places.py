"""Where the reference plane lies on an image, and how well that is known: all that measuring sees of a solution."""

import numpy as np

from ..geometry import star_hull

_STEP = 0.5  # pixels to either side for slopes: maps are smooth over the width of a star


class Places:
    """The map of one image.

    Parameters
    ----------
    view : `~legdistort.results.view.View`
        Of an exposure, or of a detector of it.
    """

    def __init__(self, view):
        self.view = view

    def pixels(self, xy):
        """Where positions (n, 2) of the reference plane lie on the image, (n, 2); NaN where it does not reach."""
        return self.view.distort(xy)

    def slopes(self, xy):
        """Derivatives of the pixels x and y (rows) of positions (n, 2) by those of the plane, (n, 2, 2)."""
        axes = _STEP * np.eye(2)
        columns = [(self.view.distort(xy + step) - self.view.distort(xy - step)) / (2 * _STEP) for step in axes]
        return np.stack(columns, axis=-1)

    def supported(self, shape, margin):
        """Pixels of the image (ny, nx) within the stars that determined the map, or so many pixels beyond them.

        Of a detector in a focal plane, the stars of all detectors of the exposure.
        """
        planes = star_hull.support(self.view.common.residuals)
        if len(planes) >= 3:  # fewer stand for no area
            planes = planes - [0, 0, margin]
        if self.view.chip is None:
            return star_hull.supported_pixels(planes, shape)
        pixels = self.view.chip.to_focal_plane(np.indices(shape)[::-1].reshape(2, -1).T.astype(float)).T
        return star_hull.supported(planes, pixels).reshape(shape)

    def covariance(self, pixels):
        """Covariances (n, 2, 2) [pix^2] of corrected pixels (n, 2) by the map: relative ones, and absolute ones."""
        return self.view.correct(pixels, errors=np.zeros((len(pixels), 2)))[1:]

    def left_out(self, stars):
        """Which of some stars, by name (n,), the solution left out in this image, as far from where they are."""
        rows = self.view.residuals
        return np.isin(stars, np.asarray(rows["star"])[~np.asarray(rows["used"], dtype=bool)])
