"""Cameras calibrated by their own dithers and rolls, against the dense Fisher matrix of everything."""

import gsaoi_bounds
import gsaoi_calibration
import gsaoi_images
import numpy as np
import pytest

import legdistort


def angles(first, second):
    """Cosines of the principal angles between the spans of two sets of columns (n, k)."""
    return np.linalg.svd(np.linalg.qr(first)[0].T @ np.linalg.qr(second)[0], compute_uv=False)


def span(columns, k):
    """The k directions (n, k) that columns (n, m) span, the rest being rounding and of second order."""
    directions, size, _ = np.linalg.svd(columns, full_matrices=False)
    assert size[k - 1] > 5 * size[k]
    return directions[:, :k]


@pytest.mark.parametrize(("turn", "unknown"), [pytest.param(0.0, 4, marks=pytest.mark.slow), (0.8, 0)])
def test_what_is_unknown(turn, unknown):
    """The null space of the dense matrix: a map of the sky, one of the focal plane, and what `gauge.unknown` lists."""
    field, degree = gsaoi_calibration.night(turn), gsaoi_calibration.DEGREE
    table = field.table(sigma=0.01)
    matches = legdistort.Matches.from_table(table, camera=gsaoi_calibration.wrong(legdistort.Camera.gsaoi()))
    solution = legdistort.solve(matches, degree=degree, layout="fit", static="fit")
    everything = gsaoi_bounds.Everything(field, table, degree=degree, sigma=0.01)

    null = everything.solved()[1]
    assert null.shape[1] == 40
    assert solution.gauge.n_maps == 20
    n = 2 * len(everything.stars)
    assert angles(span(null[:n], 20), solution.gauge.directions.reshape(n, -1)).min() > 0.999

    null = everything.solved(dynamic=0.003)[1]  # the dynamic parts are small: what is common to all is told by the rest
    similar = similarities(field.sky[everything.stars])
    assert null.shape[1] == 4 + 4 + unknown  # shift, rotation, scale of the sky, and of all detectors together
    named = solution.gauge.unknown
    assert len(named) == unknown
    assert [each.name for each in named] == ["shear", "shear", "z^2", "i z^2"][:unknown]
    if unknown:
        patterns = np.stack([each.stars.ravel() for each in named], axis=1)
        assert angles(span(null[:n], 4 + unknown), np.hstack([similar, patterns])).min() > 0.999


def similarities(sky):
    """Displacements (2 n, 4) of stars by shift, rotation and scale."""
    x, y = (sky - sky.mean(axis=0)).T / 50
    one, no = np.ones(len(x)), np.zeros(len(x))
    return np.stack([np.stack(d, axis=1).ravel() for d in ((one, no), (no, one), (x, y), (-y, x))], axis=1)


@pytest.mark.slow
def test_layouts_to_begin_with_do_not_matter():
    """Detectors that lie wrong by pixels, or right: the same stars and detectors."""
    field, found = gsaoi_calibration.night(0.0), []
    for shift in (0.0, 3.0):
        camera = gsaoi_calibration.wrong(legdistort.Camera.gsaoi(), shift=shift, bend=0.0)
        matches = legdistort.Matches.from_table(field.table(sigma=0.01), camera=camera)
        solution = legdistort.solve(matches, layout="fit", static="fit")
        parts = gsaoi_bounds.camera_error(solution.camera, 3, 1.0)
        stars = gsaoi_images.without_common_map(solution.estimate.positions, field.sky[solution.estimate.star_names], 3)
        found.append(np.concatenate([stars.ravel(), *(part.ravel() for part in parts)]))
    assert np.sqrt(np.mean((found[0] - found[1]) ** 2)) < 1e-4


@pytest.mark.parametrize(
    ("turn", "n_draws"),
    [
        pytest.param(0.0, 16, marks=pytest.mark.sets),
        pytest.param(0.8, 16, marks=pytest.mark.sets),
        pytest.param(0.8, 7, marks=pytest.mark.slow),
    ],
)
def test_at_the_bound(turn, n_draws):
    """Stars, layouts and statics at the bound of the dense matrix, with true errors."""
    found, wide = gsaoi_calibration.calibrate(turn, n_draws), np.sqrt(16 / n_draws)
    assert np.all(found.errors < (1 + 0.15 * wide) * found.bounds)
    assert found.pulls[0] == pytest.approx(1, abs=0.2 * wide)
    assert found.pulls[1:] == pytest.approx(np.ones(2), abs=0.6 * wide)  # a few directions make most of them
