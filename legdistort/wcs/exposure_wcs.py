"""Solution -> astropy models and gwcs objects made of stock parts."""

import gwcs
from astropy import units as u
from astropy.coordinates import ICRS
from gwcs import coordinate_frames as cf

from ..geometry import similarity as poses
from ..geometry.models import pose_model


def exposure_model(pose, distortion, form=None):
    """Reference plane -> detector pixels, ``T | D``, as an astropy compound model with its inverse attached.

    Parameters
    ----------
    pose : ndarray, shape (2, 3)
    distortion : Distortion
    form : `legdistort.solving.model_forms.Form`, optional
        What D looks like, if not ``Identity(2) + (Mapping((0, 1, 0, 1)) | Legendre2D & Legendre2D)`` on the detector.
    """
    similarity = pose_model(pose, "pose")
    forward = similarity | (distortion.model() if form is None else form.fill(distortion))
    forward.inverse = correction_model(distortion) | pose_model(poses.invert(pose), "pose_inverse")
    forward.name = "reference_to_detector"
    return forward


def correction_model(distortion):
    """Detector -> undistorted pixels: the certified inverse forwards, the exact distortion attached backwards."""
    exact = distortion.model()
    correction = exact.inverse
    plain = exact.copy()
    plain.inverse = None  # no circle of inverses: files would never end
    correction.inverse = plain
    return correction


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
        (plane("detector"), correction_model(distortion)),
        (plane("undistorted"), pose_model(poses.invert(pose), "pose_inverse")),
        (plane("reference"), None if sky is None else sky.model()),
    ]
    if sky is not None:
        steps.append((cf.CelestialFrame(name="icrs", reference_frame=ICRS(), unit=(u.deg, u.deg)), None))
    wcs = gwcs.WCS(steps, name=name)
    wcs.bounding_box = ((-0.5, nx - 0.5), (-0.5, ny - 0.5))
    wcs.pixel_shape = (nx, ny)
    return wcs
