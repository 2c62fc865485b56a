"""Distortions, poses and both together as astropy models."""

from functools import cache

import numpy as np
from astropy import units as u
from astropy.modeling import models
from astropy.modeling.core import FittableModel, Model  # astropy.modeling is half imported when it looks for our fitter
from astropy.modeling.parameters import Parameter

from ..exceptions import InputError
from . import basis, similarity

CHUNK = 8192  # points per block: the work arrays stay in the cache


class FastLegendre2D(models.Legendre2D):
    """`~astropy.modeling.models.Legendre2D` that is thread-safe, keeps no work arrays and knows where it is valid.

    The stock model stores its recurrence in attributes: two threads that evaluate one instance corrupt each
    other, and full-size arrays stay behind. Its derivatives forget the domain, so that astropy's non-linear fitters
    end at wrong coefficients; here they are right. (docs/upstream.md shows all three faults.) Positions may be
    quantities in pixels, and so is then the value.
    Parameters and serialisation are those of `Legendre2D`, and ASDF files hold the stock model.

    Attributes
    ----------
    valid : tuple or None
        ``(x_min, x_max, y_min, y_max)``: NaN is returned outside, where the polynomial would be extrapolated
        and could fold back onto the detector.
    """

    valid = None

    def evaluate(self, x, y, *coeffs):
        """Value at (x, y); coefficients in the order of ``param_names``."""
        shape = (self.y_degree + 1, self.x_degree + 1)
        c = np.array([np.asarray(c, dtype=float).reshape(-1)[0] for c in coeffs]).reshape(shape)
        c /= np.outer(basis.norm(np.arange(shape[0])), basis.norm(np.arange(shape[1])))
        given = x if isinstance(x, u.Quantity) else y
        x, y = np.broadcast_arrays(to_pixels(x), to_pixels(y))
        out = np.empty(x.shape)
        flat_x, flat_y, flat = x.reshape(-1), y.reshape(-1), out.reshape(-1)
        for start in range(0, flat.size, CHUNK):
            part = slice(start, start + CHUNK)
            px = basis.legendre(self.x_degree, _to_window(flat_x[part], self.x_domain, self.x_window))
            py = basis.legendre(self.y_degree, _to_window(flat_y[part], self.y_domain, self.y_window))
            np.einsum("jn,jn->n", c @ px, py, out=flat[part])
            if self.valid is not None:
                flat[part][outside(self.valid, flat_x[part], flat_y[part])] = np.nan
        return like(given, out)

    def fit_deriv(self, x, y, *params):
        """Derivatives with respect to the coefficients, shape (n, n_coefficients).

        astropy's linear fitter hands over positions in the window, as the stock model takes them; its non-linear
        fitters and sums of models hand over plain positions, which the stock model takes for those, too. Here they are
        recognised by their size: what goes beyond twice the window, as pixels do on more than four of them, is
        mapped.
        """
        if not (_near(self.x_window, x) and _near(self.y_window, y)):
            x = _to_window(x, self.x_domain, self.x_window)
            y = _to_window(y, self.y_domain, self.y_window)
        return super().fit_deriv(x, y, *params)

    def stock(self):
        """The same function as a plain `~astropy.modeling.models.Legendre2D`."""
        return rebuilt(models.Legendre2D, self)

    def stock_view(self) -> models.Legendre2D:
        """The same as `stock`, with the parameters of this one: for reading alone, and 50 times as fast to make."""
        view = models.Legendre2D.__new__(models.Legendre2D)
        vars(view).update(vars(self))
        return view


@cache
def _zeros(degree):
    model = FastLegendre2D(degree, degree)
    for name in [name for name, value in vars(model).items() if isinstance(value, Parameter)]:
        if name not in model.param_names:  # left by series of higher degree that were made before
            del vars(model)[name]
    return model


def legendre_series(tensor, shape, *, fixed=(), valid=None, name=None):
    """One Legendre series on a detector.

    It is a copy of one that is made once: astropy's constructor copies the parameters of all series that the process
    ever made, which takes thirty times as long after one of degree 25 (docs/upstream.md).

    Parameters
    ----------
    tensor : ndarray, shape (n, n)
        Coefficients ``[i, j]`` of the un-normalised ``P_i(u) P_j(v)``.
    shape : tuple
        ``(ny, nx)`` of the detector.
    fixed : sequence of tuple
        Indices ``(i, j)`` of the coefficients that are marked as fixed for fitters.
    valid : tuple, optional
        See `FastLegendre2D`.
    """
    ny, nx = shape
    series = _zeros(len(tensor) - 1).copy()
    series.name, series.valid = name, valid
    series.x_domain, series.y_domain = (-0.5, nx - 0.5), (-0.5, ny - 0.5)
    series.parameters = np.ravel(np.transpose(tensor))
    for i, j in fixed:
        getattr(series, f"c{i}_{j}").fixed = True
    return series


def rebuilt(kind, series, **changed):
    """A Legendre series as another class of model, all else the same but for the keywords given."""
    known = {name: getattr(series, name) for name in ("x_domain", "y_domain", "x_window", "y_window", "name", "fixed")}
    values = dict(zip(series.param_names, series.parameters, strict=True))
    return kind(series.x_degree, series.y_degree, **known | values | changed)


def nodes(model):
    """All models that a model is made of, itself the last."""
    return [n for n in model.traverse_postorder() if isinstance(n, Model)] if model.n_submodels > 1 else [model]


def leaves(model):
    """The simple models that a model is made of, from left to right."""
    return [node for node in nodes(model) if node.n_submodels == 1]


def to_pixels(x):
    """Plain float array of positions given as numbers, or as a quantity in pixels; `InputError` for anything else."""
    try:
        return np.asarray(x.to_value(u.pix) if isinstance(x, u.Quantity) else x, dtype=float)
    except u.UnitConversionError:
        raise InputError(f"positions must be in pixels, got {x.unit}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"positions must be numbers, in pixels: {error}") from None


def like(given, pixels):
    """Pixels as a quantity if what was given is one."""
    return pixels * u.pix if isinstance(given, u.Quantity) else pixels


def _to_window(x, domain, window):
    if domain is None:
        return x
    (d0, d1), (w0, w1) = domain, window
    return w0 + (x - d0) * ((w1 - w0) / (d1 - d0))


def _near(window, x):
    """Whether all positions lie within twice a window: stars beyond the domain come out a little beyond it."""
    return np.abs(x - np.mean(window)).max(initial=0) <= np.ptp(window)


def outside(box, x, y):
    """Whether points lie outside a box ``(x_min, x_max, y_min, y_max)``; NaN counts as outside."""
    x_min, x_max, y_min, y_max = box
    return ~((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max))


def displacement_model(tensors, shape, *, valid=None, name=None, table=None):
    """Model (x, y) -> (x, y) + two Legendre series on the detector, and perhaps a table.

    Parameters
    ----------
    tensors : array_like, shape (2, n, n)
        Coefficients ``[axis, i, j]`` of the un-normalised ``P_i(u) P_j(v)``, pixels. Where none of total degree n and
        more is there, these are marked as fixed for fitters.
    shape : tuple
        ``(ny, nx)`` of the detector.
    valid : tuple, optional
        See `FastLegendre2D`.
    table : DisplacementTable, optional
    """
    tensors = np.asarray(tensors, dtype=float)
    order = np.arange(tensors.shape[1])
    above = np.argwhere(np.add.outer(order, order) > order[-1])
    fixed = () if np.any(tensors[:, above[:, 0], above[:, 1]]) else above
    parts = [
        legendre_series(tensor, shape, fixed=fixed, valid=valid, name=f"d{axis}")
        for axis, tensor in zip("xy", tensors, strict=True)
    ]
    model = with_table(models.Identity(2) + (models.Mapping((0, 1, 0, 1)) | (parts[0] & parts[1])), table)
    model.name = name
    return model


def with_table(model, table):
    """A model of positions plus the displacements of a `DisplacementTable`; the model itself without one."""
    if table is None:
        return model
    along_x, along_y = table.models()
    return model + (models.Mapping((0, 1, 0, 1)) | (along_x & along_y))


def correction_model(tensors, inverse, shape, table=None):
    """Detector -> undistorted pixels: the certified inverse forwards, the exact distortion attached backwards.

    Parameters
    ----------
    tensors : ndarray, shape (2, n, n)
        Of the distortion, as for `displacement_model`.
    inverse : Inverse
    shape : tuple
        ``(ny, nx)`` of the detector.
    table : DisplacementTable, optional
        Of the distortion, beside the tensors.
    """
    correction = displacement_model(inverse.tensors, shape, name="correction", table=inverse.table)
    correction.inverse = displacement_model(tensors, shape, valid=inverse.valid, name="distortion", table=table)
    return correction


class Similarity2D(FittableModel):
    """A pose as a model: `~astropy.modeling.models.AffineTransformation2D` with one number a parameter.

    astropy's fitters refuse the stock model, whose parameters are matrices. The parameters are fixed, since a pose is
    not fitted together with the linear modes of a distortion. Positions may be quantities in pixels.
    """

    n_inputs = n_outputs = 2
    _separable = False
    xx, xy, dx = (Parameter(default=d, fixed=True) for d in (1.0, 0.0, 0.0))
    yx, yy, dy = (Parameter(default=d, fixed=True) for d in (0.0, 1.0, 0.0))

    @staticmethod
    def evaluate(x, y, *pose):
        """Positions (x, y) through the pose ``[[xx, xy, dx], [yx, yy, dy]]``."""
        given = x if isinstance(x, u.Quantity) else y
        x, y = to_pixels(x), to_pixels(y)
        xx, xy, dx, yx, yy, dy = pose
        return like(given, xx * x + xy * y + dx), like(given, yx * x + yy * y + dy)

    @property
    def inverse(self):
        """The opposite direction."""
        return pose_model(similarity.invert(np.reshape(self.parameters, (2, 3))))

    def stock(self):
        """The same function as a plain `~astropy.modeling.models.AffineTransformation2D`."""
        pose = np.reshape(self.parameters, (2, 3))
        return models.AffineTransformation2D(matrix=pose[:, :2], translation=pose[:, 2], name=self.name)


def pose_model(pose, name=None):
    """A pose (2, 3) as a `Similarity2D`."""
    return Similarity2D(*np.ravel(pose), name=name)


def exposure_model(pose, distortion, form=None):
    """Reference plane -> detector pixels, ``T | D``, as an astropy compound model with its inverse attached.

    Parameters
    ----------
    pose : ndarray, shape (2, 3)
    distortion : Distortion
    form : Form, optional
        What D looks like (``form.fill(distortion)`` is the model), if not
        ``Identity(2) + (Mapping((0, 1, 0, 1)) | Legendre2D & Legendre2D)`` on the detector.
    """
    there, back = pose_model(pose, "pose"), pose_model(similarity.invert(pose), "pose_inverse")
    model = there | (distortion.model() if form is None else form.fill(distortion))
    model.inverse = distortion.correction_model() | back
    model.name = "reference_to_detector"
    return model
