"""A detector in the focal plane of a camera, as one exposure of a solution has it.

Pose, distortion of the focal plane, layout and static distortion together are again a similarity and a Legendre series
on the detector, of a degree that is raised until less than a millionth of a pixel is left out; where the distortion of
the focal plane has a table, of the fitted degree, with a table for the rest. So what serves exposures
of one detector serves those of several: resampling, headers, pictures. Its errors are those of the focal plane and of
the camera, carried to the same series.
"""

from dataclasses import dataclass

import numpy as np
from astropy import units as u

from ..exceptions import InputError
from ..geometry import basis, similarity
from ..geometry.distortion import Distortion
from ..geometry.tabulated.displacement_table import DisplacementTable
from .errors import absolute_errors

#: Largest error of the series [pix], and the degree beyond which it is not raised.
TOLERANCE, HIGHEST = 1e-6, 16


@dataclass(frozen=True, eq=False)
class OnDetector:
    """The whole map from the reference plane to the pixels of a detector.

    Attributes
    ----------
    pose : ndarray, shape (2, 3)
        Similarity from the reference plane to undistorted pixels of the detector.
    coefficients : ndarray, shape (2, n_modes)
        What is left, undistorted -> detector pixels: normalised Legendre modes, pixels.
    table : DisplacementTable or None
        What no such series has, where the distortion of the focal plane has a table.
    """

    pose: np.ndarray
    coefficients: np.ndarray
    table: DisplacementTable | None = None


def on_detector(view):
    """The `OnDetector` of a view of a detector in a focal plane.

    Raises
    ------
    InputError
        If the map is not smooth enough for a series of degree 16.
    """
    chip, common = view.chip, view.common
    t = np.linspace(-1, 1, 33)
    pixels = basis.denormalize(*(a.ravel() for a in np.meshgrid(t, t)), chip.shape)
    there = similarity.apply(similarity.invert(common.pose), common.distortion.invert(chip.to_focal_plane(pixels)))
    own = similarity.fit_similarity(there, pixels)
    back = similarity.compose(common.pose, similarity.invert(own))

    def shift(q):
        return chip.to_pixels(common.distortion(similarity.apply(back, q))) - q

    series = basis.project(lambda u, v: shift(basis.denormalize(u, v, chip.shape)).T, HIGHEST, HIGHEST + 6)
    if (ragged := common.distortion.table) is not None:
        smooth = Distortion(basis.change_degree(series, max(view.solution.degree, 1)), chip.shape)
        step = tuple(each / 2 for each in ragged.step)  # the nodes lie otherwise
        rest = DisplacementTable.of(lambda q: shift(q) - smooth(q) + q, chip.shape, step)
        return OnDetector(own, smooth.coefficients, rest)
    for degree in range(max(view.solution.degree, 1), HIGHEST + 1):
        part = basis.change_degree(series, degree)
        if np.abs(Distortion(part, chip.shape)(pixels) - pixels - shift(pixels)).max() < TOLERANCE:
            return OnDetector(own, part)
    raise InputError(
        f"exposure {view.name}, detector {view.detector}: layout and distortions together are no smooth map of the "
        "detector; lower the degree, or look at the camera"
    )


def without_departure(view, mean):
    """Series (2, n_modes) of a detector, by its own pose and degree, of a static distortion of the focal plane."""
    chip, common = view.chip, view.common
    focal_plane = Distortion(mean, common.shape)
    back = similarity.compose(common.pose, similarity.invert(view.pose))

    def shift(u, v):
        q = basis.denormalize(u, v, chip.shape)
        return (chip.to_pixels(focal_plane(similarity.apply(back, q))) - q).T

    return basis.project(shift, view.distortion.degree, HIGHEST + 6)


def own_rows(view, rows):
    """Rows of the table of residuals of an exposure that are of a detector, in its pixels, residuals and errors too."""
    camera, chip = view.solution.camera, view.chip
    rows = rows[camera.ids(rows) == view.detector]
    f = np.column_stack([rows["x"].to_value(u.pix), rows["y"].to_value(u.pix)])
    shift = np.column_stack([rows["dx"].to_value(u.pix), rows["dy"].to_value(u.pix)])
    rows = camera.on_detectors(rows)
    rows["dx"], rows["dy"] = np.einsum("nab,nb->an", chip.slope(f), shift) * u.pix
    return rows


def covariance(view, block):
    """Covariance (2 n_modes, 2 n_modes) of the coefficients of a detector, px^2.

    Parameters
    ----------
    view : View
        Of a detector in a focal plane.
    block : ndarray
        Covariance of the coefficients of the exposure, a camera taken as known.
    """
    by_modes, by_camera = _responses(view)
    return by_modes @ block @ by_modes.T + by_camera @ by_camera.T


def coefficient_variance(view):
    """Variance (2, n_modes) of the coefficients of a detector with the common map; NaN where that is not known."""
    solution, i = view.solution, view.index
    gauge, uncertainty = solution.gauge, solution.estimate.uncertainty
    own = covariance(view, absolute_errors.own_coefficients(gauge, uncertainty, i))
    by_modes, _ = _responses(view)
    if view.chip.layout_sigma is not None and np.isinf(view.chip.layout_sigma).any():
        return np.full(view.coefficients.shape, np.nan)
    if gauge.plane is not None:
        return np.diag(own).reshape(2, -1)
    return absolute_errors.coefficient_variance(gauge, own, i, by_modes)


def _responses(view):
    """How the series of a detector follows the coefficients of its exposure and the unit errors of a camera.

    Arrays (2 n_modes of the detector, 2 n_modes of the exposure) and (the same, r).
    """
    solution, chip, common = view.solution, view.chip, view.common
    degree, errors = view.distortion.degree, solution.estimate.uncertainty.camera
    back = similarity.compose(common.pose, similarity.invert(view.pose))
    x, y, weights = basis.quadrature(max(degree, HIGHEST) + 2)
    q = similarity.apply(back, basis.denormalize(x, y, chip.shape))
    f = common.distortion(q)
    slope, values = chip.slope(f), basis.values(solution.degree, *basis.normalize(q, common.shape))
    moved = np.einsum("nac,mn->nacm", slope, values).reshape(len(q), 2, -1)
    of_camera = np.zeros((len(q), 2, 0))
    if errors is not None:
        of_camera = moved @ errors.coefficients[view.index]
        of_camera = of_camera - slope @ errors.of_measured(view, q)
    modes = weights * basis.values(degree, x, y)
    return tuple(np.einsum("mn,nak->amk", modes, each).reshape(2 * len(modes), -1) for each in (moved, of_camera))
