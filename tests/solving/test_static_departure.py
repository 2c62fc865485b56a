"""How far static distortions that were fitted depart from those that were given: print, summary and file say so."""

import four_detectors
import numpy as np
import pytest
from test_selfcalibration import camera

import legdistort as ld
from legdistort.reporting.summary import summarise

X_Y = 4  # the mode of L1(x) L1(y)


def told(solution, tmp_path):
    """What the summary has, once print and file have been seen to have it too."""
    found = summarise(solution)["static_departure"]
    assert ld.Solution.read(solution.write(tmp_path / "s.asdf")).diagnostics.static_departure == found
    return found


@pytest.mark.slow
def test_of_a_camera_by_detector_with_the_error(tmp_path):
    """A camera file is right but for 0.4 px of x y on detector 1: of four, a map of all together takes some of it."""
    matches = four_detectors.matches("static", 1, n=6, n_stars=120)
    right = ld.solve(matches, static="fit", layout="fit", degree=2)
    chips = dict(right.camera.detectors)
    bent = chips["1"].static.copy()
    bent[0, X_Y] += 0.4
    chips["1"] = ld.Detector(chips["1"].shape, layout=chips["1"].layout, static=bent)
    chips |= {k: ld.Detector(c.shape, layout=c.layout, static=c.static) for k, c in chips.items() if k != "1"}
    started = ld.Matches.from_table(
        matches.camera.on_detectors(matches.table),
        camera=ld.Camera("file", chips, right.camera.field),
        poses=right.poses,
    )
    solution = ld.solve(started, static="fit", layout="fit", degree=2)
    found = told(solution, tmp_path)
    assert list(found) == list("0123")
    assert 0.5 * 0.4 / np.sqrt(8) < found["1"][0] < 1.01 * 0.4 / np.sqrt(8)
    assert max(found[k][0] for k in "023") < 0.6 * found["1"][0]
    sigma = solution.camera["1"].static_sigma
    assert found["1"][1] == pytest.approx(np.sqrt(np.sum(sigma**2) / 8))
    assert f"static  the static distortions depart from those given by {found['1'][0]:.2g} px rms" in str(solution)
    assert right.diagnostics.static_departure is None  # nothing was given


def test_of_plain_images(tmp_path):
    sim = camera(n_exposures=6, n_stars=60)
    given = sim.truth.static.copy()
    given[1, 3:6] -= 0.2
    solution = ld.solve(sim.matches, degree=3, static="fit", exposure_degree=1, prior=ld.Prior(given))
    rms = np.sqrt(3 * 0.2**2 / 8)
    ((found,),) = told(solution, tmp_path).values()
    assert found == pytest.approx(rms, rel=0.15)
    assert f"the static distortion departs from the one given by {found:.2g} px rms per axis" in " ".join(
        str(solution).split()
    )
