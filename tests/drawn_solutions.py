"""Small solutions and mosaics to be drawn."""

from types import SimpleNamespace

import numpy as np
from astropy import units as u
from astropy.table import QTable

from legdistort.geometry import basis
from legdistort.results.diagnostics import Diagnostics
from legdistort.results.estimate import Estimate
from legdistort.results.settings import Settings
from legdistort.results.solution import Solution


def make_solution(
    n_exposures=11, n_stars=80, degree=3, *, shape=(2048, 2048), names=None, flux=True, prior=True, seed=1
):
    """A solution with numbers of our own: GSAOI-like static part, dynamic parts of about 0.4 px."""
    rng = np.random.default_rng(seed)
    names = tuple(names or [f"rgS20130201S{i:04d}" for i in range(n_exposures)])
    size = (len(names), 2, basis.n_modes(degree))
    mean = np.zeros(size)
    if degree >= 2:
        mean[:, 0, [3, 5]] = -4.1, -3.8
        mean[:, 1, 3:6] = 0.3, -0.7, 0.5
    coefficients = mean + rng.normal(0, 0.4 / np.sqrt(size[2] / 2), size)
    brightness = 10 ** rng.uniform(2, 5, n_stars)
    error = np.tile(np.hypot(0.8 / np.sqrt(brightness), 0.003), len(names))
    positions = rng.uniform(0, 1, (n_stars, 2)) * (shape[1], shape[0]) - 0.5
    rows = QTable({"exposure": np.repeat(names, n_stars), "star": np.tile(np.arange(n_stars), len(names))})
    rows["x"], rows["y"] = np.tile(positions, (len(names), 1)).T * u.pix
    for axis in "xy":
        rows[f"{axis}_err"] = error * u.pix
        rows[f"d{axis}"] = error * rng.normal(size=len(rows)) * u.pix
    if flux:
        rows["flux"] = np.tile(brightness, len(names))
    rows["used"] = rng.uniform(size=len(rows)) > 0.01
    solution = Solution(
        names=names,
        degree=degree,
        poses={name: np.column_stack([np.eye(2), rng.normal(0, 99, 2)]) for name in names},
        coefficients=coefficients,
        residuals=rows,
        chi2=1432.1,
        dof=1380,
        status="converged after 4 iterations",
        gauge=SimpleNamespace(
            sentence="minimal: by convention", warning="", motion=coefficients, tie=None, plane="one of our own"
        ),
        settings=Settings(degree),
        diagnostics=Diagnostics(),
        estimate=Estimate(
            star_names=np.arange(n_stars),
            positions=positions,
            shapes=dict.fromkeys(names, shape),
            prior_mean=mean if prior else np.zeros(size),
            uncertainty=SimpleNamespace(
                coefficients=1e-4 * np.eye(coefficients.size),
                of_exposure=lambda i, n_exposures: 1e-4 * np.eye(coefficients.size // n_exposures),
                common=None,
                camera=None,
            ),
        ),
        left_out={"bad <one>": "only 2 stars matched, <i>10</i> & more are needed"},
    )
    stars = {"star": solution.estimate.star_names, "x": positions[:, 0] * u.pix, "y": positions[:, 1] * u.pix}
    stars |= {f"{axis}_{kind}": np.full(n_stars, 0.01) * u.pix for kind in ("err", "err_abs") for axis in "xy"}
    vars(solution)["stars"] = QTable(stars | {"n": np.full(n_stars, len(names))})  # without covariances
    return solution


def make_mosaic(size=900, seed=2):
    """Stars on noise, with a strip that no exposure covers."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((size, size))
    image = rng.normal(10, 2, (size, size))
    for flux, x0, y0 in zip(10 ** rng.uniform(2, 5, 60), *rng.uniform(0, size, (2, 60)), strict=True):
        image += flux / 50 * (1 + ((x - x0) ** 2 + (y - y0) ** 2) / 9) ** -2.5
    image[:, : size // 30] = np.nan
    return SimpleNamespace(data=image.astype(np.float32))
