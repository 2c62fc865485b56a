"""The figures of a solution, against its tables."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from importlib import resources

import four_detectors
import numpy as np
import pytest
from night_sets import Nights

from legdistort import Matches, coadd, match, measure, read_exposures, simulate_exposures, simulate_matches, solve
from legdistort.assessment.run_checks import check_run
from legdistort.exceptions import AssumptionWarning
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.pipeline import write_results
from legdistort.reporting.summary import summarise


def test_figures_are_those_of_the_tables():
    solution = solve(simulate_matches(n_stars=30, n_exposures=6, seed=3).matches, degree=1)
    found = summarise(solution, timings={"solve": 0.12345})
    used = solution.residuals[solution.residuals["used"]]
    assert json.loads(json.dumps(found)) == found
    assert (found["n_exposures"], found["n_stars"], found["n_observations"]) == (6, 30, len(used))
    left = np.concatenate([used["dx"].value, used["dy"].value])
    assert found["rms_px"] == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-6)
    assert found["timings"] == {"solve": 0.123}
    assert [check["name"] for check in found["checks"]] == [check.name for check in solution.checks]


def test_figures_in_mas_are_by_the_sky_where_no_scale_is_stated():
    plane = TangentPlane(10.0, -70.0, np.array([[-0.02, 0.0, 3.0], [0.0, 0.02, -2.0]]) / 3600)
    sim = simulate_matches(n_stars=30, n_exposures=6, seed=3)
    solution = solve(replace(sim.matches, sky=plane), degree=1)
    found, error = summarise(solution)["angles"], solution.stars["x_err", "y_err"]
    assert found["pixel_scale_arcsec"] == pytest.approx(0.02)
    assert found["rms_mas"] == pytest.approx(20 * summarise(solution)["rms_px"])
    assert found["error_mas"] == pytest.approx(20 * np.median([error["x_err"].value, error["y_err"].value]))
    assert f"angles  at 0.02 arcsec a pixel: residuals {found['rms_mas']:.3g} mas rms" in str(solution)
    assert summarise(solve(sim.matches, degree=1))["angles"] is None


def _valid(found):
    """The summary as a file has it, if it keeps the published schema."""
    jsonschema = pytest.importorskip("jsonschema")
    read = json.loads(json.dumps(found, allow_nan=False))
    schema = json.loads((resources.files("legdistort") / "data" / "schemas" / "summary-1.0.0.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(read)
    return read


def test_every_exposure_is_in_figures():
    table = Nights(2, nights=3, per=2, n_stars=60).table
    solution = solve(Matches.from_table(table, shape=(1024, 1024)), degree=3)
    found = _valid(summarise(solution))
    assert [each["name"] for each in found["exposures"]] == list(solution.names)
    for each in found["exposures"]:
        rows = table[table["exposure"] == each["name"]]
        used = solution.residuals[(solution.residuals["exposure"] == each["name"]) & solution.residuals["used"]]
        assert each["n_stars"] == len(used)
        assert each["epoch_yr"] == pytest.approx(rows["epoch"][0])
        assert each["rms_x_px"] == pytest.approx(np.sqrt(np.mean(used["dx"].value ** 2)), rel=1e-6)
        matrix = solution.poses[each["name"]]
        assert each["rotation_deg"] == pytest.approx(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0])))
        assert (each["shift_x_px"], each["shift_y_px"]) == tuple(matrix[:, 2])
        assert each["position_angle_deg"] is None
    assert sorted(night["exposures"] for night in found["nights"]) == [[f"n{i}e0", f"n{i}e1"] for i in range(3)]
    assert [night["block"] for night in found["nights"]] == solution.nights["block"].tolist()  # the worst first
    assert found["detectors"] == []


@pytest.mark.slow
def test_a_night_has_what_its_exposures_have_in_common():
    """One night is 3 px off a mode: that is its figure, and none of the others have a part of it."""
    table = Nights(2, nights=7, per=3, n_stars=120, odd=3.0, roll=0.0).table
    solution = solve(Matches.from_table(table, shape=(1024, 1024)), degree=3)
    nights = _valid(summarise(solution))["nights"]
    common = np.array([night["common_px"] for night in nights])
    odd = int(np.argmax(common))
    assert [night["odd"] for night in nights] == [True] + 6 * [False]
    assert odd == 0
    assert common[odd] > 1
    assert np.delete(common, odd).max() < 0.15
    assert all(0 < night["common_err_px"] < 0.1 for night in nights)
    sentence = next(check.sentence for check in solution.checks if check.name == "nights")
    named = f"night {nights[odd]['name']} ({', '.join(nights[odd]['exposures'])})"
    told = re.search(rf"{re.escape(named)} .* others, by ([\d.]+) px, rms length of both axes", sentence)
    assert float(told[1]) == pytest.approx(common[odd], rel=0.1)


def test_every_detector_is_in_figures():
    solution = solve(four_detectors.matches("layout", 1, n=5, n_stars=120), layout="fit", degree=1)
    found = _valid(summarise(solution))
    places = solution.camera.places
    assert {each["name"]: (each["x_px"], each["y_px"]) for each in found["detectors"]} == {
        key: (place.x, place.y) for key, place in places.items()
    }
    assert all(each["x_err_px"] > 0 for each in found["detectors"])


@pytest.mark.slow
def test_a_map_that_folds_costs_its_image_alone(tmp_path):
    """Named in summary and check; the others have their WCS, and are co-added."""
    night = simulate_exposures(small=True, n_exposures=4, seed=1)
    exposures = read_exposures(list(night.hdus.values()))
    solution = solve(match(measure(exposures, psf="moffat"), exposures=exposures), degree=2, clip=None)
    coefficients = solution.coefficients.copy()
    coefficients[2, 0, 3] += 300  # a parabola over the whole detector
    bent = replace(solution, coefficients=coefficients)
    found = _valid(summarise(bent))
    assert list(found["folded"]) == ["exp02"]
    assert "exposure exp02 folds" in found["folded"]["exp02"]
    assert 0 < found["max_inverse_error_px"] < 1e-3
    with pytest.warns(AssumptionWarning, match="no WCS of exp02: the distortion of exposure exp02 folds"):
        write_results(bent, tmp_path)
    assert sorted(path.stem for path in (tmp_path / "wcs").iterdir()) == ["exp00", "exp01", "exp03"]
    with pytest.warns(AssumptionWarning, match="left out of the mosaic: exp02: the distortion of exposure exp02 folds"):
        mosaic = coadd(exposures, bent)
    assert mosaic.exposures == ("exp00", "exp01", "exp03")
    check = next(check for check in check_run(bent) if check.name == "inverse")
    assert (check.state, check.value) == ("fail", 1.0)
    assert check.sentence.startswith("exp02 cannot be inverted: ")


def test_a_solution_is_shown_without_what_measures_and_co_adds(tmp_path):
    """Of a command that only reads a file, imports take most of the time."""
    solve(simulate_matches(n_stars=30, n_exposures=6, seed=3).matches, degree=1).write(tmp_path / "s.asdf")
    script = (
        "import sys; from legdistort.cli import main; main(['show', sys.argv[1]]);"
        "assert not {'photutils', 'reproject', 'matplotlib', 'numba'} & set(sys.modules)"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "s.asdf"], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "6 exposures, 30 stars" in run.stdout
