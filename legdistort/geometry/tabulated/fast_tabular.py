"""Linear interpolation on a regular grid as an astropy model, a stock `Tabular2D` in files."""

import numpy as np
from astropy import units as u
from astropy.modeling import models

from ..models import like, to_pixels
from .linear import interpolated


class FastTabular2D(models.Tabular2D):
    """`~astropy.modeling.models.Tabular2D` of regular nodes that takes quantities in pixels, and has no box of its own.

    Beyond the nodes the outermost cells go on, as of the stock model with ``fill_value=None``. ASDF files hold the
    stock model.
    """

    _is_dynamic = False

    def evaluate(self, x, y):
        """Value at (x, y)."""
        given = x if isinstance(x, u.Quantity) else y
        x, y = np.broadcast_arrays(to_pixels(x), to_pixels(y))
        first, step = zip(*((p[0], (p[-1] - p[0]) / (len(p) - 1)) for p in self.points), strict=True)
        made = interpolated(
            np.asarray(self.lookup_table).T[None], first, step, np.stack([x.ravel(), y.ravel()], axis=1)
        )
        return like(given, made[:, 0].reshape(x.shape))

    @property
    def bounding_box(self):
        """None: what the table is part of has one."""
        raise NotImplementedError("a table of displacements has no bounding box of its own")

    def __repr__(self):
        nx, ny = np.shape(self.lookup_table)
        return f"<FastTabular2D({nx} x {ny} nodes, name={self.name!r})>"

    def stock(self):
        """The same function as a plain `~astropy.modeling.models.Tabular2D`."""
        known = {"method": "linear", "bounds_error": False, "fill_value": None, "name": self.name}
        return models.Tabular2D(self.points, self.lookup_table, **known)
