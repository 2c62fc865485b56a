"""A solution over the focal plane of a camera, seen from its detectors.

Pose, distortion of the focal plane, layout and static distortion together are again a similarity and a Legendre series
on the detector, of a degree that is raised until less than a millionth of a pixel is left out. So what serves exposures
of one detector serves those of several: resampling, headers, pictures.
"""

from dataclasses import replace

import numpy as np

from ..exceptions import InputError
from ..geometry import basis, similarity
from ..geometry.distortion import Distortion
from ..inputs.exposure_names import detector_name

#: Largest error of the series [pix], and the degree beyond which it is not raised.
TOLERANCE, HIGHEST = 1e-6, 16


def by_detector(solution):
    """The solution of a camera with every detector of every exposure as an exposure of its own.

    Its errors are not those of single detectors: it is for positions alone.

    Parameters
    ----------
    solution : `legdistort.Solution`
        With a camera.

    Returns
    -------
    Solution
        Names are those of `detector_name`.
    """
    camera, made = solution.camera, {}
    for name in solution.names:
        for key, detector in camera.detectors.items():
            made[detector_name(name, key)] = (detector.shape, *_together(solution, name, key))
    degree = max(basis.degree_of(series.shape[1]) for _, _, series in made.values())
    coefficients = np.stack([basis.change_degree(series, degree) for _, _, series in made.values()])
    table = solution.observations.copy(copy_data=False)
    table["exposure"] = [detector_name(*pair) for pair in zip(table["exposure"], table["detector"], strict=True)]
    table["x"], table["y"] = table["x_detector"], table["y_detector"]
    lost = {detector_name(name, key): why for name, why in solution.left_out.items() for key in camera.detectors}
    return replace(
        solution,
        names=tuple(made),
        degree=degree,
        shapes={name: shape for name, (shape, _, _) in made.items()},
        poses={name: pose for name, (_, pose, _) in made.items()},
        coefficients=coefficients,
        prior_mean=np.zeros_like(coefficients),
        observations=table,
        left_out=lost,
        camera=None,
        form=None,
        checked=solution.checks,
        inverses={},
        file_checksum=solution.checksum,
    )


def _together(solution, name, key):
    """Pose (2, 3) from the reference plane to a detector, and what is left of the map as a Legendre series."""
    detector, distortion, pose = solution.camera[key], solution.distortion(name), solution.poses[name]
    t = np.linspace(-1, 1, 33)
    pixels = basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), detector.shape)
    there = similarity.apply(similarity.invert(pose), distortion.invert(detector.to_focal_plane(pixels)))
    own = similarity.fit_similarity(there, pixels)
    back = similarity.invert(own)

    def shift(q):
        return detector.to_pixels(distortion(similarity.apply(pose, similarity.apply(back, q)))) - q

    series = basis.project(lambda u, v: shift(basis.denormalize(u, v, detector.shape)).T, HIGHEST, HIGHEST + 6)
    for degree in range(max(solution.degree, 1), HIGHEST + 1):
        part = basis.change_degree(series, degree)
        if np.abs(Distortion(part, detector.shape)(pixels) - pixels - shift(pixels)).max() < TOLERANCE:
            return own, part
    raise InputError(
        f"exposure {name}, detector {key}: layout and distortions together are no smooth map of the detector; lower "
        "the degree, or look at the camera"
    )
