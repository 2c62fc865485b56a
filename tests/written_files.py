"""Files as this version writes them, for later versions to open: ``python tests/written_files.py``.

It makes ``tests/written/VERSION``: one file of each kind, and in ``expected.json`` what they held in memory. Once a
version is released its folder is never made again: what does not open any more is a fault of the code.
"""

import json
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

import legdistort
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.table_files import read_table
from legdistort.matching.matches import Matches
from legdistort.pipeline import write_matched
from legdistort.priors.prior import Prior
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.storage import write_wcs

FOLDER = Path(__file__).parent / "written"
PIXELS = np.array([[10.0, 20.0], [200.5, 100.0], [399.0, 299.0]])


def seen(solution, prior, wcs):
    """What is compared, as plain lists."""
    name = solution.names[1]
    return {
        "names": list(solution.names),
        "coefficients": solution.coefficients.tolist(),
        "x_err_abs": solution.stars["x_err_abs"].value.tolist(),
        "corrected": solution[name].correct(PIXELS).tolist(),
        "chi2": solution.chi2,
        "prior": prior.mean.tolist(),
        "prior_sigma": prior.sigma.tolist(),
        "sky": np.transpose(wcs(*PIXELS.T)).tolist(),
        "pixels": np.transpose(wcs.invert(*wcs(*PIXELS.T))).tolist(),
    }


def seen_camera(camera):
    """What is compared of a camera, as plain lists."""
    return {
        "camera": camera.name,
        "field": list(camera.field),
        "centres": {key: each.to_focal_plane([[9.0, 4.0]]).tolist() for key, each in camera.detectors.items()},
        "place_errors": {key: each.place.errors for key, each in camera.detectors.items()},
        "static_sigma": {key: each.static_sigma.tolist() for key, each in camera.detectors.items()},
        "common_sigma": camera.common_sigma[0, :3].tolist(),
    }


def seen_matches(path):
    """What is compared of matches, as `legdistort solve` reads them."""
    table = read_table(path)
    matches = Matches.from_table(table, **Matches.read_meta(table.meta))
    return {
        "matched": [str(matches), list(matches.names), dict(matches.left_out)],
        "matched_x": matches.table["x"].value.tolist(),
        "matched_poses": [matches.poses[name].tolist() for name in matches.names],
        "matched_sky": [matches.sky.lon, matches.sky.lat, *matches.sky.matrix.ravel().tolist()],
    }


def seen_mosaic(path):
    """What is compared of a mosaic, read by astropy alone."""
    with fits.open(path) as hdulist:
        image = hdulist["SCI" if "SCI" in hdulist else 0]
        return {
            "mosaic": [hdu.name for hdu in hdulist],
            "mosaic_shape": list(image.data.shape),
            "mosaic_sum": [
                float(np.nansum(image.data, dtype=float)),
                float(np.nansum(hdulist["UNCERT"].data, dtype=float)),
            ],
            "mosaic_sky": np.transpose(WCS(image.header).pixel_to_world_values(*PIXELS[:2].T)).tolist(),
        }


def make_others(folder, solution, matches):
    """Files beside those of the solution: camera, matches, mosaic; returns what is compared of them."""
    layouts = {"1": 0.0, "2": 24.0}
    camera = legdistort.Camera("pair", {
        key: legdistort.Detector((10, 20), layout=np.array([[1.0, 0.01, -x], [0.0, 1.0, 0.5]]), layout_sigma=0.1,
                                 static=np.array([[0, 0, 0, 0.3, 0, 0.1]] * 2), static_sigma=0.02)
        for key, x in layouts.items()
    }, common_sigma=np.array([[np.inf, 0.1, 0.2, 0.3, 0.4, 0.5]] * 2))  # fmt: skip
    camera.write(folder / "camera.asdf", overwrite=True)
    write_matched(folder / "matched.ecsv", matches, {})
    rng = np.random.default_rng(1)
    frames = [Exposure(name=view.name, data=rng.normal(10, 1, view.shape).astype("f4")) for view in solution]
    grid = WCS(naxis=2)
    grid.wcs.ctype, grid.wcs.crval, grid.wcs.crpix = ("RA---TAN", "DEC--TAN"), (10.0, -70.0), (20.0, 15.0)
    grid.wcs.cdelt, grid.array_shape = (-1e-5, 1e-5), (30, 40)
    settings = {"weights": None, "scale": None, "match_background": False, "planes": "all"}
    legdistort.coadd(frames, solution, grid=grid, **settings).write(folder / "mosaic.fits", overwrite=True)
    return seen_camera(camera) | seen_matches(folder / "matched.ecsv") | seen_mosaic(folder / "mosaic.fits")


def main():
    """Make the folder of this version."""
    sim = simulate_matches(n_stars=25, n_exposures=3, shape=(300, 400), dither=30, degree=2, seed=3)
    matrix = np.array([[-1e-5, 1e-6, 2e-3], [1e-6, 1e-5, -1e-3]])
    matches = Matches(sim.matches.table, sim.matches.shapes, sim.matches.poses, TangentPlane(10.0, -70.0, matrix))
    prior = Prior(sim.truth.static, sigma=np.full((2, 6), 0.5), shape=(300, 400))
    solution = solve(matches, prior=prior, degree=2, clip=5, errors="scale")
    folder = FOLDER / legdistort.__version__
    folder.mkdir(parents=True, exist_ok=True)
    solution.write(folder / "solution.asdf", overwrite=True)
    prior.write(folder / "prior.asdf", overwrite=True)
    write_wcs(solution[solution.names[1]], folder / "wcs.asdf", overwrite=True)
    found = seen(solution, prior, solution[solution.names[1]].wcs) | make_others(folder, solution, matches)
    (folder / "expected.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
