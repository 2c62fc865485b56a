"""Where on the detector an exposure has stars: the convex hull of those used."""

import numpy as np
from astropy import units as u


def support(rows):
    """Half-planes whose intersection is the hull of the stars used in an exposure.

    Parameters
    ----------
    rows : `~astropy.table.QTable`
        Its positions, ``x``, ``y`` [pix] and ``used``, as a table of residuals has them.

    Returns
    -------
    ndarray, shape (n, 3)
        ``a x + b y + c <= 0`` inside. Where fewer than three stars support no area, no
        pixel is inside.
    """
    rows = rows[np.asarray(rows["used"], dtype=bool)]
    return around(np.column_stack([rows["x"].to_value(u.pix), rows["y"].to_value(u.pix)]))


def around(xy):
    """The half-planes of `support` for the hull of positions (n, 2)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(xy).equations
    except (QhullError, ValueError):
        return np.array([[0.0, 0.0, 1.0]])


def enclosed_area(xy):
    """Area of the convex hull of positions (n, 2), square pixels; 0 where they span none."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(xy).volume)  # which is what the area of a plane figure is called there
    except (QhullError, ValueError):
        return 0.0


def supported(planes, xy):
    """Whether detector pixels ``(2, ...)`` lie within the half-planes of `support`."""
    x, y = xy
    inside = np.ones(np.shape(x), dtype=bool)
    if inside.size == 0:
        return inside
    box = [(a, b) for a in (np.min(x), np.max(x)) for b in (np.min(y), np.max(y))]
    for a, b, c in planes:
        if not max(a * p + b * q + c for p, q in box) <= 1e-9:  # else all of the box is inside
            inside &= a * x + b * y + c <= 1e-9  # NaN is not
    return inside


def supported_pixels(planes, shape):
    """Which pixels of an image (ny, nx) lie within the half-planes of `support`, row by row."""
    (x, y), low, high = (np.arange(n) for n in shape[::-1]), np.full(shape[0], -np.inf), np.full(shape[0], np.inf)
    for a, b, c in planes:
        rest = 1e-9 - b * y - c
        if a == 0:
            high[rest < 0] = -np.inf
        elif a > 0:
            np.minimum(high, rest / a, out=high)
        else:
            np.maximum(low, rest / a, out=low)
    return (x >= low[:, None]) & (x <= high[:, None])
