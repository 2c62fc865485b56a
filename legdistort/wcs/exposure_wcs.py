"""The gwcs of an exposure, made of stock parts."""

import gwcs
from astropy import units as u
from astropy.coordinates import ICRS
from gwcs import coordinate_frames as cf

from ..geometry import similarity
from ..geometry.models import pose_model


def exposure_wcs(name, pose, distortion, sky=None):
    """The gwcs of one exposure: detector -> undistorted -> reference (-> icrs).

    Forward (pixel to sky) uses the certified inverse, backward is exact; NaN outside the detector forward and
    outside its image backward.

    Parameters
    ----------
    name : str
    pose : ndarray, shape (2, 3)
    distortion : Distortion
    sky : TangentPlane, optional
    """
    ny, nx = distortion.shape

    def plane(frame):
        return cf.Frame2D(name=frame, axes_order=(0, 1), unit=(u.pix, u.pix))

    steps = [
        (plane("detector"), distortion.correction_model()),
        (plane("undistorted"), pose_model(similarity.invert(pose), "pose_inverse")),
        (plane("reference"), None if sky is None else sky.model()),
    ]
    if sky is not None:
        steps.append((cf.CelestialFrame(name="icrs", reference_frame=ICRS(), unit=(u.deg, u.deg)), None))
    wcs = gwcs.WCS(steps, name=name)
    wcs.bounding_box = ((-0.5, nx - 0.5), (-0.5, ny - 0.5))
    wcs.pixel_shape = (nx, ny)
    return wcs
