"""The refined distortion of a solution in the WCS of a pipeline, whose frames it keeps."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import gwcs
import numpy as np
from astropy import units as u
from astropy.coordinates import ICRS, SkyCoord
from astropy.modeling import models
from gwcs import coordinate_frames as cf

from ..exceptions import InputError
from .exposure_wcs import ExposureWCS

if TYPE_CHECKING:
    from gwcs import WCS as GWCS

    from ..results.view import View

log = logging.getLogger(__name__)

#: A WCS that is farther off than this part of the diagonal is compared with the other images of the solution, and is
#: that of another one which it is so many times nearer to. Pointings of headers may be wrong by as much, by chance not
#: just as another image lies.
_OFF, _NEARER = 0.05, 10


def refine(wcs: GWCS, view: View) -> GWCS:
    """A gwcs like the one given, but with the distortion and the pose that a solution found for an exposure.

    The frames stay: names, units, order, and the transforms between all but the first two (of JWST and Roman:
    ``v2v3`` -> ``world``, velocity aberration included). The transform out of the detector is replaced, so that pixels
    end where `View.wcs` puts them on the sky. Only stock models go into files.

    Parameters
    ----------
    wcs : `~gwcs.WCS`
        From the pixels of the exposure to ICRS, as ``model.meta.wcs`` of a pipeline. It is not changed.
    view : View
        Of an exposure, ``solution["exp00"]``, or of a detector of it; the solution has a sky.

    Returns
    -------
    ExposureWCS
        A `gwcs.WCS` with the name, ``pixel_shape`` and bounding box of the one given. Data models of pipelines take
        the stock class alone: ``model.meta.wcs = refined.stock()``.

    Raises
    ------
    InputError
        If `wcs` is no such gwcs, is of another detector, exposure or place on the sky, or its later transforms cannot
        be inverted; if the solution does not know the sky; if it is none of a view.

    See Also
    --------
    legdistort.results.view.View.wcs : A WCS made of the solution alone.

    Examples
    --------
    >>> import legdistort as ld
    >>> night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    >>> exposures = ld.read_exposures(list(night.hdus.values()))
    >>> solution = ld.solve(ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures))
    >>> ld.refine(solution["exp00"].wcs, solution["exp00"]).available_frames[-1]
    'icrs'
    """
    _check(wcs, view)
    frames = wcs.available_frames
    new = view.wcs
    first = new.get_transform("detector", "icrs")
    if len(frames) > 2:
        later = wcs.get_transform(frames[1], frames[-1])
        first = _unwound(first | _inverse(later, frames), wcs, new)
        first.inverse = later | new.get_transform("icrs", "detector")
    first.name = f"{frames[0]}_to_{frames[1]}"
    steps = [(step.frame, step.transform) for step in wcs.pipeline]
    made = ExposureWCS([(steps[0][0], first), *((frame, transform) for frame, transform in steps[1:])], name=wcs.name)
    made.pixel_shape = wcs.pixel_shape
    made.bounding_box = new.bounding_box if wcs.bounding_box is None else wcs.bounding_box.bounding_box(order="F")
    return made


def _check(wcs, view):
    """Raise `InputError` unless a WCS is one of an exposure."""
    if not hasattr(view, "solution"):
        raise InputError(
            "view must be that of an exposure, solution['exp00'], or of a detector, solution['exp00', '2'], got "
            f"{type(view).__name__}"
        )
    if not isinstance(wcs, gwcs.WCS):
        raise InputError(f"wcs must be a gwcs.WCS, such as model.meta.wcs of a pipeline, got {type(wcs).__name__}")
    output = wcs.output_frame
    if wcs.pixel_n_dim != 2 or not isinstance(output, cf.CelestialFrame):
        raise InputError(f"wcs must lead from two pixel coordinates to the sky, got {wcs.available_frames}")
    if not isinstance(output.reference_frame, ICRS) or tuple(output.unit) != (u.deg, u.deg):
        raise InputError(f"the sky of wcs must be ICRS in degrees, got {output.reference_frame} in {output.unit}")
    if any(step.transform is not None and step.transform.uses_quantity for step in wcs.pipeline):
        raise InputError("the transforms of wcs take quantities; give a WCS whose models are without units")
    if view.solution.sky is None:
        raise InputError(
            "the solution does not know the sky: solve frames whose headers have a WCS, or give a reference catalogue "
            "with ra and dec (reference=, --reference)"
        )
    _check_place(wcs, view)


def _check_place(wcs, view):
    """Raise `InputError` unless a WCS is of the detector and the place of an exposure."""
    (ny, nx), name = view.wcs.array_shape, view.label
    if wcs.pixel_shape is not None and tuple(wcs.pixel_shape) != (nx, ny):
        raise InputError(f"wcs is of {wcs.pixel_shape} pixels (nx, ny), exposure {name} of {(nx, ny)}")
    box = wcs.bounding_box
    if box is not None:
        (x0, x1), (y0, y1) = box.bounding_box(order="F")
        if min(x0, y0) < -0.5 or x1 > nx - 0.5 or y1 > ny - 0.5:
            raise InputError(
                f"the bounding box of wcs, x {x0} to {x1}, y {y0} to {y1}, is not within the {nx} x {ny} pixels of "
                f"exposure {name}"
            )
    apart, size = corner_move(wcs, view)
    if not apart < size:
        raise InputError(
            f"wcs and exposure {name} of the solution lie {apart:.3g} apart on the sky, more than the detector is "
            "wide: is it the WCS of another exposure?"
        )
    if apart > _OFF * size:
        others = {part.label: part for each in view.solution for part in each.parts if part.shape == view.shape}
        moves = {label: corner_move(wcs, part)[0] for label, part in others.items() if label != name}
        nearest = min(moves, key=moves.get, default=None)
        if nearest is not None and _NEARER * moves[nearest] < apart:
            raise InputError(
                f"wcs is {apart.arcsec:.3g} arcsec off exposure {name} of the solution, and "
                f"{moves[nearest].arcsec:.3g} arcsec off {nearest}: it is the WCS of that one; give its view"
            )
    log.debug("%s: corners move by up to %.3g arcsec", name, apart.arcsec)


def corner_move(wcs, view):
    """How far the corners of an image lie apart in a WCS and in that of a view, at most, and its diagonal: `Angle`."""
    ny, nx = view.wcs.array_shape
    corners = np.array([[-0.5, nx - 0.5, nx - 0.5, -0.5], [-0.5, -0.5, ny - 0.5, ny - 0.5]])
    places = [SkyCoord(*w(*corners, with_bounding_box=False), unit="deg") for w in (wcs, view.wcs)]
    return places[0].separation(places[1]).max(), places[1][0].separation(places[1][2])


def _inverse(transform, frames):
    try:
        return transform.inverse
    except NotImplementedError:
        raise InputError(
            f"the transform of wcs from {frames[1]} to {frames[-1]} has no inverse, so nothing can be put before it"
        ) from None


def _unwound(first, wcs, new):
    """The transform to the second frame with its longitudes in the turn of those that it had."""
    middle = [np.mean(side) for side in new.bounding_box.bounding_box(order="F")]
    frames = wcs.available_frames
    turn = u.deg.to(wcs.pipeline[1].frame.unit[0], 360) if wcs.pipeline[1].frame.unit[0].is_equivalent(u.deg) else 0
    old = wcs.get_transform(frames[0], frames[1])(*middle, with_bounding_box=False)
    offset = np.round((old[0] - first(*middle)[0]) / turn) * turn if turn else 0
    return first | models.Shift(offset) & models.Identity(1) if offset else first
