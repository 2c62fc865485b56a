"""The gwcs of an exposure, made of stock parts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gwcs
import numpy as np
from astropy import units as u
from astropy.coordinates import ICRS
from gwcs import coordinate_frames as cf

from ..geometry import models, similarity
from ..geometry.tangent_plane import PlaneToSky

if TYPE_CHECKING:
    from gwcs import WCS as GWCS

#: Positions that are evaluated at once: some 150 MB for what is worked out on the way. With an eighth of them, which
#: would stay in the cache of a processor, what astropy does for every call takes a third of the time.
_PIECE = 1 << 18


class ExposureWCS(gwcs.WCS):
    """`gwcs.WCS` that loses no position of the detector on the way from the sky to pixels.

    The stock class takes a box in right ascension and declination around the four corners for the footprint: where
    distortion bends an edge outwards, and around a pole, positions on the detector become NaN (docs/upstream.md). Here
    they become NaN outside the bounding box and outside the region for which the distortion is meant, and nowhere else.
    Files hold the stock class.
    """

    def outside_footprint(self, world_arrays: Any) -> Any:
        """World coordinates as they are: the bounding box of the pixels, and the models, determine what is outside."""
        return world_arrays

    def pixel_to_world_values(self, *pixel_arrays: Any) -> Any:
        """As the stock class; many positions piece by piece, which need less memory and time."""
        return _piecewise(super().pixel_to_world_values, pixel_arrays)

    def world_to_pixel_values(self, *world_arrays: Any) -> Any:
        """As the stock class; many positions piece by piece, which need less memory and time."""
        return _piecewise(super().world_to_pixel_values, world_arrays)

    def stock(self) -> GWCS:
        """The same WCS as a plain `gwcs.WCS`."""
        return rebuilt(gwcs.WCS, self)


def _piecewise(function, arrays):
    """The values of a function of coordinates for arrays, `_PIECE` positions at a time."""
    if any(isinstance(array, u.Quantity) for array in arrays):
        return function(*arrays)
    if len({np.shape(array) for array in arrays}) > 1:  # which the stock class does not take
        arrays = np.broadcast_arrays(*arrays)
    if np.size(arrays[0]) <= _PIECE:
        return function(*arrays)
    arrays = [np.asarray(array) for array in arrays]
    flat = [array.reshape(-1) for array in arrays]
    out = np.empty((len(arrays), flat[0].size))
    for begin in range(0, flat[0].size, _PIECE):
        part = slice(begin, begin + _PIECE)
        out[:, part] = function(*(array[part] for array in flat))
    return tuple(out.reshape(-1, *arrays[0].shape))


def rebuilt(kind, wcs):
    """A gwcs as another class, with the same steps, name, shape and bounding box."""
    made = kind(wcs.pipeline, name=wcs.name)
    made.pixel_shape = wcs.pixel_shape
    return made


def exposure_wcs(name, pose, distortion, sky=None, detector=None, *, shared=False):
    """The gwcs of one exposure: detector -> undistorted -> reference (-> icrs).

    That of a detector of a camera: detector -> undistorted -> focal_plane -> reference (-> icrs). Forward (pixel to
    sky) uses the certified inverse, backward is exact; NaN outside the detector forward and outside its image backward.

    Parameters
    ----------
    name : str
    pose : ndarray, shape (2, 3)
    distortion : Distortion
        Undistorted -> detector pixels; with a detector of a camera, to the pixels of the focal plane.
    sky : TangentPlane, optional
    detector : `~legdistort.Detector`, optional
    shared : bool
        Whether distortions may be the same objects in all WCSs that have them, as for files.

    Returns
    -------
    ExposureWCS
    """
    ny, nx = (distortion if detector is None else detector).shape

    def correction(of):
        return of.shared_correction if shared else of.correction_model()

    def plane(frame):
        return cf.Frame2D(name=frame, axes_order=(0, 1), unit=(u.pix, u.pix))

    back = models.pose_model(similarity.invert(pose), "pose_inverse")
    if detector is None:
        steps = [(plane("detector"), correction(distortion)), (plane("undistorted"), back)]
    else:
        layout = models.pose_model(similarity.invert(detector.layout), "layout_inverse")
        steps = [
            (plane("detector"), correction(detector.distortion)),
            (plane("undistorted"), layout),
            (plane("focal_plane"), from_focal_plane(correction(distortion), back)),
        ]
    steps.append((plane("reference"), None if sky is None else PlaneToSky.of(sky)))
    if sky is not None:
        sky_frame = cf.CelestialFrame(
            name="icrs", reference_frame=ICRS(), unit=(u.deg, u.deg), axes_names=("ra", "dec")
        )
        steps.append((sky_frame, None))
    wcs = ExposureWCS(steps, name=name)
    wcs.bounding_box = ((-0.5, nx - 0.5), (-0.5, ny - 0.5))
    wcs.pixel_shape = (nx, ny)
    return wcs


def from_focal_plane(correction, back):
    """Focal plane -> reference plane, ``correction | back``, with the exact opposite attached."""
    model = correction | back
    model.inverse = back.inverse | correction.inverse
    return model
