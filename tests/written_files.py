"""Files as this version writes them, for later versions to open: ``python tests/written_files.py``.

It makes ``tests/written/VERSION``: one file of each kind, and in ``expected.json`` what they held in memory. Once a
version is released its folder is never made again: what does not open any more is a fault of the code.
"""

import json
from pathlib import Path

import numpy as np

import legdistort
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.matching.matches import Matches
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
    found = seen(solution, prior, solution[solution.names[1]].wcs)
    (folder / "expected.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
