"""A static distortion as it was given: one function between detector pixels and an undistorted plane.

Its direction, origin and detector shape are settled here. Outputs on a sphere (right ascension and declination, or
V2 and V3) are projected from the centre of the sphere on the plane that touches it at the centre of the detector,
since angles themselves are no plane.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import NdBSpline, make_interp_spline

from ..exceptions import InputError
from ..geometry import basis, tangent_plane
from ..runtime.provenance import checksums
from ..runtime.words import DIRECTIONS

#: A map whose cells shrink below this part of the median cell counts as folded.
FOLD = 0.1
#: What messages call the maps of shifts and of their errors.
_MAPS = "x", "y", "x error", "y error"


@dataclass(frozen=True, eq=False, repr=False)
class Source:
    """A static distortion as it was given.

    Attributes
    ----------
    name : str
        What messages call it.
    kind : str
        What it is, in words.
    function : callable
        ``function(x, y) -> (x, y)`` on arrays of plain numbers.
    direction : str or None
        One of `DIRECTIONS`; None if it does not state any.
    origin : int or None
        Coordinate of the centre of the first pixel.
    shape : tuple or None
        ``(ny, nx)`` of the detector.
    sphere : float or None
        Size in degrees of the unit of the outputs, if these are longitude and latitude.
    usual : str or None
        Direction that is taken unless another is given.
    from_middle : bool
        Whether the inputs are offsets from pixel (nx // 2, ny // 2), 0-based.
    files : tuple of paths
        Where it was read.
    details : dict
        What else was chosen (extension, frame).
    errors : ndarray, shape (2, ny, nx), or None
        Standard errors of the undistorted position of every pixel, along x and y [pix].
    is_ragged : bool
        Whether there may be more in it than a series follows, which is then kept as a table.
    """

    name: str
    kind: str
    function: object
    direction: str | None = None
    origin: int | None = None
    shape: tuple | None = None
    sphere: float | None = None
    usual: str | None = None
    from_middle: bool = False
    files: tuple = ()
    details: dict = field(default_factory=dict)
    errors: np.ndarray | None = None
    is_ragged: bool = False

    def __repr__(self):
        return f"<Source {self.name}: {self.kind}>"

    def stated(self, *, shape=None, direction=None, origin=None):
        """The same, completed by what the caller states; what contradicts the source is refused.

        Raises
        ------
        InputError
            If a statement is impossible, or something that is needed is not known.
        """
        if direction is not None and direction not in DIRECTIONS:
            raise InputError(f"direction must be {' or '.join(map(repr, DIRECTIONS))}, got {direction!r}")
        if origin not in (None, 0, 1):
            raise InputError(f"origin must be 0 or 1 (coordinate of the first pixel's centre), got {origin!r}")
        given = {"shape": None if shape is None else check_shape(shape), "direction": direction, "origin": origin}
        for key, value in given.items():
            known = getattr(self, key)
            if None not in (known, value) and value != known:
                raise InputError(
                    f"{self.name} ({self.kind}) has {key} {known!r}, not {value!r}; leave {key} (--{key}) out"
                )
            given[key] = known if value is None else value
        given["direction"] = given["direction"] or self.usual
        given["origin"] = given["origin"] or 0
        if given["direction"] is None:
            raise InputError(
                f"{self.name} ({self.kind}) does not state what it does: give direction (--direction) {DIRECTIONS[0]} "
                f"or {DIRECTIONS[1]}"
            )
        if given["shape"] is None:
            raise InputError(
                f"{self.name} ({self.kind}) does not state the size of the detector: give shape=(ny, nx) "
                "(--shape NY NX)"
            )
        return replace(self, **given)

    def record(self):
        """Where it comes from as plain numbers and strings; files with their SHA-256."""
        known = {"kind": self.kind, "name": self.name, "direction": self.direction, "origin": self.origin}
        return known | self.details | ({"files": checksums(*self.files)} if self.files else {})

    def on_plane(self):
        """The function with its outputs on a plane; of a complete source only."""
        ny, nx = self.shape
        if self.from_middle:
            return lambda x, y: self.function(x - nx // 2, y - ny // 2)
        if self.sphere is None:
            return self.function
        centre = (np.array([nx, ny]) - 1) / 2 + self.origin
        lon, lat = (float(a[0]) for a in self.function(*centre[:, None]))
        return lambda x, y: tangent_plane.gnomonic(*self.function(x, y), lon, lat, self.sphere)


def check_shape(shape):
    """Return `shape` as two ints of at least 2, or raise `InputError`."""
    try:
        ny, nx = (int(n) for n in shape if int(n) == n and n >= 2)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"shape must be (ny, nx) in pixels, at least 2 each, got {shape!r}") from None
    return ny, nx


def check_folds(plane, pixels, name):
    """Raise `InputError` naming the place where a map folds.

    Parameters
    ----------
    plane, pixels : ndarray, shape (n, m, 2)
        Images of a grid of pixels, and those pixels.
    name : str
        Of the map, for the message.
    """
    along, across = plane[:-1, 1:] - plane[:-1, :-1], plane[1:, :-1] - plane[:-1, :-1]
    area = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    middle = np.median(area)
    if not np.all(area * np.sign(middle) > FOLD * abs(middle)):
        row, column = np.unravel_index(np.argmin(area * np.sign(middle)), area.shape)
        raise InputError(
            f"{name} cannot be inverted over the detector: it folds, or has no width, near pixel "
            f"{pixels[row, column].round(1).tolist()}; check direction, shape and origin, or mend it there"
        )


def of_maps(dx, dy, *errors, name="the maps"):
    """Look-up tables of the shift [pix] that is added to the position of each pixel, as a smooth function.

    A cubic spline through all values; it continues over the outer half of the pixels at the edge.

    Parameters
    ----------
    dx, dy : array_like, shape (ny, nx)
    *errors : array_like, shape (ny, nx)
        Two more, their standard errors, or none.
    name : str, optional
        For messages.
    """
    maps = [np.asarray(a, dtype=float) for a in (dx, dy, *errors)]
    dx, dy, *errors = maps
    shapes = {a.shape for a in maps}
    if len(shapes) > 1 or dx.ndim != 2 or min(dx.shape) < 4:
        each = " and ".join(f"{a.shape} ({word})" for a, word in zip(maps, _MAPS, strict=False))
        raise InputError(f"{name}: shapes {each}; the maps must be images of one shape, at least 4 x 4")
    for word, values in zip(_MAPS, maps, strict=False):
        _check_map(f"{name}: the {word} map", values, is_error=word not in _MAPS[:2])
    ny, nx = dx.shape
    pixels = np.stack(np.meshgrid(np.arange(nx), np.arange(ny)), axis=-1).astype(float)
    check_folds(pixels + np.stack([dx, dy], axis=-1), pixels, name)
    splines = [_spline(shift) for shift in (dx, dy)]

    def function(x, y):
        at = np.stack([y, x], axis=-1)
        return x + splines[0](at), y + splines[1](at)

    known = {"errors": np.stack(errors) if errors else None, "is_ragged": True}
    return Source(name, "pixel shifts", function, usual=DIRECTIONS[0], origin=0, shape=(ny, nx), **known)


def _check_map(what, values, *, is_error):
    """Raise `InputError` for values (ny, nx) that are not finite, and negative errors."""
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        cure = "give the width itself (static_sigma, --static-sigma) in their place" if is_error else "fill them first"
        raise InputError(
            f"{what} has {len(bad)} values that are not finite, the first at pixel x {bad[0, 1]}, y {bad[0, 0]}; {cure}"
        )
    if is_error and np.any(values < 0):
        y, x = np.argwhere(values < 0)[0]
        raise InputError(
            f"{what} has negative values, the first at pixel x {x}, y {y}; it holds standard deviations in pixels"
        )


def _spline(values):
    down = make_interp_spline(np.arange(values.shape[0]), values, k=3)
    along = make_interp_spline(np.arange(values.shape[1]), down.c.T, k=3)
    return NdBSpline((down.t, along.t), np.ascontiguousarray(along.c.T), 3, extrapolate=True)


def of_powers(coefficients, name, *, centre=None):
    """Polynomial of a Drizzle coefficient file: offsets from the centre of the image, before and after.

    The coefficients multiply 1, x, y, x^2, x y, y^2, x^3, ...; x and y are the offset of a detector pixel from the
    centre, the results are the offset of its undistorted position (STSDAS ``drizzle`` with ``align="center"``).

    Parameters
    ----------
    coefficients : array_like, shape (2, n_modes)
        x then y.
    name : str
        For messages.
    centre : tuple, optional
        (x, y) of the centre, 0-based (``refpix`` less 1); default (nx // 2, ny // 2).
    """
    coefficients = np.asarray(coefficients, dtype=float)
    ix, iy = basis.orders(basis.degree_of(coefficients.shape[1]))
    x0, y0 = (0, 0) if centre is None else centre

    def function(x, y):
        powers = np.stack([(x - x0) ** i * (y - y0) ** j for i, j in zip(ix, iy, strict=True)])
        return tuple(np.tensordot(coefficients, powers, axes=1))

    known = {"direction": DIRECTIONS[0], "origin": 0, "from_middle": centre is None}
    return Source(name, "Drizzle coefficients", function, **known)
