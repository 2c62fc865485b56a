"""Solution -> astropy models and gwcs objects made of stock parts."""

import gwcs
import numpy as np
from astropy import units as u
from astropy.coordinates import ICRS
from astropy.modeling import FittableModel, Parameter, models
from gwcs import coordinate_frames as cf

from . import poses
from .distortion import like, to_pixels


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
        return pose_model(poses.invert(np.reshape(self.parameters, (2, 3))))

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
    form : `legdistort.forms.Form`, optional
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
