"""What a camera that was fitted adds to the errors of coefficients and new positions, against a dense solution."""

import pickle

import gsaoi_images
import numpy as np
import pytest

import legdistort
from legdistort.geometry import basis, similarity
from legdistort.results.errors.absolute_errors import own_coefficients, relative_coefficients
from legdistort.results.view import error_map

SIGMA = 0.01


@pytest.fixture(scope="module")
def night():
    return gsaoi_images.Night(n_exposures=6, n_stars=200, dither=8.0, turn=0.3)


@pytest.fixture(scope="module")
def solution(night):
    matches = legdistort.Matches.from_table(night.table(sigma=SIGMA), camera=legdistort.Camera.gsaoi())
    return legdistort.solve(matches, layout="fit", clip=None)


class Dense:
    """Normal equations of stars, coefficients and layouts together, and covariances on given constraints."""

    def __init__(self, solution):
        self.solution, camera, table = solution, solution.camera, solution.residuals
        keys, names, self.n_stars = list(camera.detectors), list(solution.names), len(solution.estimate.star_names)
        self.size = 2 * basis.n_modes(solution.degree)
        self.n_first = 2 * self.n_stars + len(names) * self.size
        n = self.n_first + 6 * len(keys)
        self.normal = np.zeros((n, n))
        for row in table:
            i, c = names.index(row["exposure"]), keys.index(row["detector"])
            j = int(np.searchsorted(solution.estimate.star_names, row["star"]))
            design = np.zeros((2, n))
            q = similarity.apply(solution.poses[row["exposure"]], solution.estimate.positions[[j]])
            by_star, by_exposure, by_layout, f = self.slopes(row["exposure"], camera[row["detector"]], q)
            design[:, 2 * j : 2 * j + 2] = by_star
            design[:, 2 * self.n_stars + i * self.size :][:, : self.size] = by_exposure
            design[:, self.n_first + 6 * c :][:, :6] = by_layout
            to_pixels = camera[row["detector"]].slope(f)[0] / SIGMA
            self.normal += (to_pixels @ design).T @ (to_pixels @ design)

    def slopes(self, name, chip, q):
        """Derivatives of residuals at an undistorted position by star, coefficients and layout; where it falls."""
        distortion, pose = self.solution[name].distortion, self.solution.poses[name]
        values = basis.values(self.solution.degree, *basis.normalize(q, distortion.shape))[:, 0]
        f = distortion(q)
        low = basis.values(1, *basis.normalize(similarity.apply(chip.layout, f), chip.shape))[:, 0]
        back = np.linalg.inv(chip.layout[:, :2])
        return distortion.jacobian(q)[0] @ pose[:, :2], np.kron(np.eye(2), values), np.kron(back, low), f

    def covariance(self, rows):
        """On rows (m, n) that are held at zero."""
        free = np.linalg.svd(rows)[2][np.linalg.matrix_rank(rows) :].T
        return free @ np.linalg.inv(free.T @ self.normal @ free) @ free.T

    def by_layouts(self):
        """Covariance of everything by the errors of the layouts, in the gauge of the solution, with a common map."""
        gauge, n = self.solution.gauge, len(self.normal)
        rows = np.zeros((gauge.n_constraints, n))
        rows[:, 2 * self.n_stars : self.n_first] = gauge.orthonormal
        held = np.zeros((n - self.n_first, n))
        held[:, self.n_first :] = np.eye(n - self.n_first)
        known = self.covariance(np.concatenate([rows, held]))
        first = slice(None, self.n_first)
        cross = self.normal[self.n_first :, first]
        left = self.normal[self.n_first :, self.n_first :] - cross @ known[first, first] @ cross.T
        unit = 1 / np.sqrt(np.diag(self.normal)[self.n_first :])
        values, vectors = np.linalg.eigh(left * np.outer(unit, unit))
        assert np.count_nonzero(values < 1e-5) == 6  # an affine map of the focal plane
        exchanged = np.zeros((6, n))
        counts = np.tile([0.01, 1.0, 1.0], (n - self.n_first) // 3)  # changes are small, shifts in tenths of their size
        exchanged[:, self.n_first :] = (vectors[:, :6] * unit[:, None]).T * counts
        return self.covariance(np.concatenate([rows, exchanged])) - known


@pytest.fixture(scope="module")
def dense(solution):
    return Dense(solution)


@pytest.fixture(scope="module")
def relative(dense, solution):
    """Covariance by the layouts of stars, coefficients and layouts, a common map of the stars taken off."""
    gauge, n = solution.gauge, 2 * dense.n_stars
    modes = gauge.modes_at(solution.estimate.positions)
    fit = np.zeros((gauge.n_modes * 2, len(dense.normal)))
    for k in range(2):
        fit[k * gauge.n_modes : (k + 1) * gauge.n_modes, k:n:2] = np.linalg.pinv(modes.T)
    undo = np.zeros((len(dense.normal), gauge.n_modes * 2))
    for k in range(2):
        undo[k:n:2, k * gauge.n_modes : (k + 1) * gauge.n_modes] = -modes.T
    undo[n : dense.n_first] = gauge.motion.reshape(-1, 2 * gauge.n_modes)
    take_off = np.eye(len(dense.normal)) + undo @ fit
    return take_off @ dense.by_layouts() @ take_off.T


@pytest.mark.slow
def test_coefficients(solution, dense, relative):
    """The covariance of every exposure is that of a known camera, and what the layouts add."""
    for i, name in enumerate(solution.names):
        mine = slice(2 * dense.n_stars + i * dense.size, 2 * dense.n_stars + (i + 1) * dense.size)
        known = own_coefficients(solution.gauge, solution.estimate.uncertainty, i)
        added = solution[name].covariance - known
        expected = relative[mine, mine]
        assert np.abs(added - expected).max() < 0.02 * np.abs(expected).max()
        assert np.trace(expected) > np.trace(known)  # it is not little


@pytest.mark.slow
def test_stars(solution, dense, relative):
    n = 2 * dense.n_stars
    matrix = solution.estimate.uncertainty.star_matrix.reshape(2, dense.n_stars, 2, dense.n_stars)
    own = solution.estimate.uncertainty.star_unknowns
    expected = relative[:n, :n].reshape(dense.n_stars, 2, dense.n_stars, 2)
    camera = solution.estimate.uncertainty.camera.stars
    for k in range(2):
        assert np.allclose(np.diag(matrix[k, :, k]), own[k], rtol=1e-9)
        added = np.sum(camera[:, k] ** 2, axis=1)
        assert np.abs(added - np.einsum("jj->j", expected[:, k, :, k])).max() < 0.02 * np.abs(added).max()
    between = np.delete(expected[0, 0, :, 0], 0)
    assert np.allclose(np.delete(camera[0, 0] @ camera[:, 0].T, 0), between, atol=0.02 * np.abs(between).max())


@pytest.mark.parametrize("key", ["1", "2", "3", "4"])
def test_new_positions(solution, dense, relative, night, key):
    """Errors of the layout of the detector itself, those of the coefficients, and what they have in common."""
    chip, name = solution.camera[key], solution.names[1]
    xy = night.pixels[1][key]
    xy = xy[np.isfinite(xy[:, 0])][::5]
    found = solution[name, key].correct(xy, errors=np.zeros((len(xy), 2))).relative
    q = solution[name].distortion.invert(chip.to_focal_plane(xy))
    c, block = int(key) - 1, relative_coefficients(solution.gauge, solution.estimate.uncertainty, 1)
    for at, covariance in zip(q, found, strict=True):
        by_star, by_exposure, by_layout, _ = dense.slopes(name, chip, at[None])
        through = np.zeros((2, len(relative)))
        through[:, 2 * dense.n_stars + dense.size :][:, : dense.size] = by_exposure
        through[:, dense.n_first + 6 * c :][:, :6] = by_layout
        through = -np.linalg.inv(by_star) @ through
        coefficients = through[:, 2 * dense.n_stars + dense.size :][:, : dense.size]
        own = coefficients @ block @ coefficients.T
        assert np.allclose(covariance - own, through @ relative @ through.T, atol=0.03 * np.trace(covariance))


@pytest.mark.parametrize(("name", "key"), [("frame00", "4"), ("frame03", "2")])
def test_coefficients_of_a_detector(solution, dense, relative, name, key):
    """Those of its series follow coefficients and layout together, by quadrature over the detector."""
    view, common, chip = solution[name, key], solution[name], solution.camera[key]
    i, c, size = common.index, list(solution.camera.detectors).index(key), dense.size
    degree = view.distortion.degree
    t, w = np.polynomial.legendre.leggauss(2 * degree)
    (x, y), weights = (each.ravel() for each in np.meshgrid(t, t)), np.outer(w, w).ravel()
    q = np.stack([(x + 1) * chip.shape[1] / 2 - 0.5, (y + 1) * chip.shape[0] / 2 - 0.5], axis=1)
    modes = weights * basis.values(degree, x, y)
    through = np.zeros((len(q), 2, len(relative)))
    there = similarity.apply(common.pose, similarity.apply(similarity.invert(view.pose), q))
    for k, at in enumerate(there):
        _, by_exposure, by_layout, f = dense.slopes(name, chip, at[None])
        to_pixels = chip.slope(f)[0]
        through[k, :, 2 * dense.n_stars + i * size :][:, :size] = to_pixels @ by_exposure
        through[k, :, dense.n_first + 6 * c :][:, :6] = to_pixels @ by_layout
    through = np.einsum("mn,nak->amk", modes, through).reshape(-1, len(relative))
    coefficients = through[:, 2 * dense.n_stars + i * size :][:, :size]
    for found, block in (
        (view.covariance, own_coefficients(solution.gauge, solution.estimate.uncertainty, i)),
        (view.relative_covariance, relative_coefficients(solution.gauge, solution.estimate.uncertainty, i)),
    ):
        expected = coefficients @ block @ coefficients.T + through @ relative @ through.T
        assert np.abs(found - expected).max() < 0.02 * np.abs(expected).max()
    assert np.allclose(view.relative_errors.ravel() ** 2, np.diag(view.relative_covariance))


def test_kept_in_pickles(solution):
    again = pickle.loads(pickle.dumps(solution))
    for part in solution[solution.names[2]].parts[:2]:
        other = again[part.name, part.detector]
        for key in ("covariance", "relative_errors", "errors", "coefficients", "pose"):
            assert np.array_equal(getattr(other, key), getattr(part, key), equal_nan=True), key
    assert np.array_equal(again.stars["x_err"], solution.stars["x_err"])
    assert list(again.camera.detectors) == list(solution.camera.detectors)


def test_kept_in_files(solution, night, tmp_path):
    again = legdistort.Solution.read(solution.write(tmp_path / "solution.asdf"))
    name = solution.names[2]
    assert np.array_equal(again[name].covariance, solution[name].covariance)
    assert np.array_equal(error_map(again[name], n=8)[2], error_map(solution[name], n=8)[2], equal_nan=True)
    found, expected = (each[name, "2"].sigma_map(n=8)[2] for each in (again, solution))
    assert np.array_equal(found, expected, equal_nan=True)


def test_errors_that_are_scaled(night, solution):
    """Stated errors of half the size, scaled by the residuals: the errors of the camera are scaled with the others."""
    table = night.table(sigma=SIGMA)
    table["x_err"] /= 2
    table["y_err"] /= 2
    matches = legdistort.Matches.from_table(table, camera=legdistort.Camera.gsaoi())
    scaled = legdistort.solve(matches, layout="fit", clip=None, errors="scale")
    factor = scaled.diagnostics.error_scale / 2
    assert np.allclose(scaled.stars["x_err"], factor * solution.stars["x_err"], rtol=1e-3)
    assert np.allclose(scaled["frame01"].relative_errors,
                       factor * solution["frame01"].relative_errors, rtol=1e-3)  # fmt: skip
    for key, detector in solution.camera.detectors.items():
        again = scaled.camera[key]
        assert np.allclose(again.layout_sigma, factor * detector.layout_sigma, rtol=1e-3)
        assert np.allclose(again.static_sigma, factor * detector.static_sigma, rtol=1e-3)
