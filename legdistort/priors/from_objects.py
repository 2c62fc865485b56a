"""Models, WCSs and SIAF apertures as sources of a static distortion."""

from dataclasses import replace

import gwcs
import numpy as np
from astropy import units as u
from astropy import wcs as fits_wcs
from astropy.modeling import Model, models
from gwcs import coordinate_frames as cf

from ..cameras.source import Source, check_shape
from ..exceptions import InputError
from ..geometry.tangent_plane import PlaneToSky, gnomonic
from ..runtime.words import DIRECTIONS

#: Frames of a gwcs where the distortion ends and pointing has not begun, in order of preference.
PLANES = ("undistorted", "v2v3")
#: Name by which the last frame of a gwcs, where it is one of the sky, may be asked for whatever it is called.
SKY = "sky"
#: Departure [pix] from a linear map below which a FITS WCS has no distortion.
NOTHING = 1e-6


def as_source(model, *, frame=None, name="the model"):
    """What is known of a model, WCS, aperture or function, as a `Source`.

    Parameters
    ----------
    model : callable, `~astropy.modeling.Model`, `~gwcs.wcs.WCS`, `~astropy.wcs.WCS`, SIAF aperture, or `Source`
    frame : str, optional
        Of a gwcs, the frame that serves as undistorted plane (default: the first of `PLANES`, or else the last;
        "sky" is the last, if it is one of the sky and none has that name);
        of a SIAF aperture, ``"idl"`` (default) or ``"tel"``.
    name : str, optional
        For messages.
    """
    if isinstance(model, Source):
        return model
    if isinstance(model, gwcs.WCS):
        return _of_gwcs(model, frame, name)
    if hasattr(model, "Sci2IdlDeg"):
        return _of_aperture(model, frame, name)
    if frame is not None:
        raise InputError(f"frame (--frame) is for gwcs objects and SIAF apertures; {name} is neither, leave it out")
    if isinstance(model, fits_wcs.WCS):
        return _of_fits_wcs(model, name)
    if not callable(model):
        raise InputError(f"{name} must be a model, a WCS, an aperture or a function, got {type(model).__name__}")
    return of_model(model, name)


def of_model(model, name, **known):
    """An astropy model, or any function of x and y, with units or without."""
    inputs, outputs = getattr(model, "n_inputs", 2), getattr(model, "n_outputs", 2)
    if (inputs, outputs) != (2, 2):
        raise InputError(f"{name} has {inputs} inputs and {outputs} outputs; a distortion has two of each")
    is_model = isinstance(model, Model)
    last = model[-1] if is_model and model.n_submodels > 1 else model
    if isinstance(last, (models.RotateNative2Celestial, PlaneToSky)):  # between models | is no union of types
        known = {"direction": DIRECTIONS[0], "sphere": 1.0} | known
    kind = "astropy model" if is_model else "function"
    return Source(name, kind, _plain(model, known.get("sphere")), **known)


def _plain(model, sphere=None):
    """A model as a function of plain numbers: its own unit goes in, that of its first output comes out."""
    for unit in (1, u.pix, u.arcsec, u.deg):
        try:
            probe = model(np.array([1.0]) * unit, np.array([1.0]) * unit)
        except u.UnitsError:
            continue
        except ValueError:  # this place is not its own; what it is worth will show where it is used
            return model
        break
    else:
        raise InputError(f"{type(model).__name__}: takes neither plain numbers nor pixels, arcsec or degrees")
    out = getattr(probe[0], "unit", None)
    if out is not None and sphere is not None:
        out = u.Unit(sphere * u.deg)
    if out is None and unit == 1:
        return model

    def function(x, y):
        found = model(x * unit, y * unit)
        return tuple(a if out is None else a.to_value(out) for a in found)

    return function


def _of_gwcs(wcs, frame, name):
    frames = {getattr(step.frame, "name", step.frame): step.frame for step in wcs.pipeline}
    names = list(frames)
    if frame is None:
        frame = next((plane for plane in PLANES if plane in names[1:]), names[-1])
    if frame == SKY and SKY not in names and isinstance(frames[names[-1]], cf.CelestialFrame):
        frame = names[-1]
    if frame not in names[1:]:
        raise InputError(f"{name}: no frame {frame!r} after {names[0]!r}; it has {', '.join(map(repr, names[1:]))}")
    transform, end = wcs.get_transform(names[0], frame), frames[frame]
    if transform is None:
        raise InputError(f"{name}: the gwcs has no transform from {names[0]!r} to {frame!r}")
    known = {"direction": DIRECTIONS[0], "origin": 0, "shape": _shape_of(wcs), "details": {"frame": frame}}
    if isinstance(end, cf.CelestialFrame) or str(frame).startswith("v2v3"):
        known["sphere"] = float(end.unit[0].to(u.deg)) if hasattr(end, "unit") else 1.0
        if getattr(end, "axes_order", None) == (1, 0):
            transform = transform | models.Mapping((1, 0))
    return replace(of_model(transform, name, **known), kind="gwcs")


def _shape_of(wcs):
    """Detector of a gwcs: its ``pixel_shape``, or else a bounding box that begins at the first pixel's corner."""
    if wcs.pixel_shape is not None:
        return check_shape(wcs.pixel_shape[::-1])
    try:
        (x0, x1), (y0, y1) = wcs.bounding_box.bounding_box(order="F")
    except (AttributeError, TypeError, ValueError):
        return None
    whole = float(x0) == float(y0) == -0.5
    return check_shape((float(y1) + 0.5, float(x1) + 0.5)) if whole else None


def _of_fits_wcs(wcs, name):
    if not wcs.has_celestial:
        raise InputError(f"{name} has no celestial WCS (CTYPE RA---TAN-SIP, RA---TPV or the like); give one that has")
    shape = None if wcs.pixel_shape is None else wcs.pixel_shape[::-1]
    if wcs.naxis != 2:
        wcs, shape = wcs.celestial, None if shape is None else shape[-2:]

    def function(x, y):
        sky = wcs.all_pix2world(x, y, 0)
        return sky[wcs.wcs.lng], sky[wcs.wcs.lat]

    _check_distorted(function, wcs.wcs.crpix - 1, wcs.wcs.crval[[wcs.wcs.lng, wcs.wcs.lat]], (1001, 1001), name)
    known = {"direction": DIRECTIONS[0], "origin": 0, "sphere": 1.0}
    return Source(name, "FITS WCS", function, shape=None if shape is None else check_shape(shape), **known)


def of_sky(function, shape, name):
    """A function from pixels (n, 2) of a detector to places on the sky (2, n), degrees.

    Raises
    ------
    InputError
        If it has no distortion.
    """
    centre = (np.array(shape[::-1]) - 1) / 2

    def by_axes(x, y):
        x, y = np.broadcast_arrays(x, y)
        return function(np.stack([x.ravel(), y.ravel()], axis=1)).reshape(2, *x.shape)

    _check_distorted(by_axes, centre, function(centre[None])[:, 0], shape, name)
    known = {"direction": DIRECTIONS[0], "origin": 0, "sphere": 1.0, "shape": check_shape(shape)}
    return Source(name, "WCS", by_axes, **known)


def _check_distorted(function, centre, place, shape, name):
    """Raise `InputError` if a function from pixels to the sky is linear about a pixel that leads to a place there."""
    t = [np.linspace(-0.5, 0.5, 5) * (n - 1) for n in shape[::-1]]
    grid = np.stack(np.meshgrid(*t), axis=-1).reshape(-1, 2) + centre
    linear = np.column_stack([grid, np.ones(len(grid))])
    if not np.isfinite(linear).all():  # LAPACK would never end
        raise InputError(f"{name}: the reference pixel of its WCS (CRPIX1, CRPIX2) must be finite numbers")
    with np.errstate(all="ignore"):
        sky = np.column_stack(gnomonic(*function(*grid.T), *place))
        matrix = np.linalg.lstsq(linear, np.nan_to_num(sky), rcond=None)[0]
        left = np.abs(linear @ matrix - sky).max() / np.sqrt(abs(np.linalg.det(matrix[:2])))
    if left < NOTHING:  # not if it is NaN
        raise InputError(f"{name} has no distortion (SIP, TPV or other), only a linear matrix and a projection")


def _of_aperture(aperture, frame, name):
    """Science pixels, as in the images, to the ideal plane; ``tel`` is V2 and V3, on the sphere."""
    if frame not in (None, "idl", "tel"):
        raise InputError(f"{name}: frame of a SIAF aperture must be 'idl' or 'tel', got {frame!r}")
    frame = frame or "idl"
    shape = aperture.YSciSize, aperture.XSciSize
    if aperture.Sci2IdlDeg is None or None in shape:
        raise InputError(
            f"{name}: aperture {aperture.AperName} has no distortion polynomial; take the one of a detector"
        )
    return Source(
        name,
        "SIAF aperture",
        lambda x, y: aperture.convert(np.asarray(x, float), np.asarray(y, float), "sci", frame),
        direction=DIRECTIONS[0],
        origin=1,
        shape=check_shape(shape),
        sphere=1 / 3600 if frame == "tel" else None,
        details={"frame": frame},
    )
