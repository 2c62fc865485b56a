"""The package as a whole: its face, its plan, and that its files need nothing of it."""

import inspect
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from numpy.testing import assert_allclose

import legdistort
from legdistort import paper
from legdistort.exceptions import LegdistortError, LegdistortWarning
from legdistort.geometry.basis import to_tensor
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.exposures import Exposure
from legdistort.matching.matches import Matches
from legdistort.priors.prior import Prior
from legdistort.simulation.observations import simulate_gsaoi_matches, simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.storage import write_wcs


@pytest.fixture(scope="module")
def simulation():
    return simulate_gsaoi_matches(small=True, seed=4)


@pytest.fixture(scope="module")
def solution(simulation):
    return solve(simulation.matches, prior=Prior(simulation.truth.static))


# --- the face ----------------------------------------------------------------------------------------------------


def public_members():
    for name in legdistort.__all__:
        thing = getattr(legdistort, name)
        yield name, thing
        if inspect.isclass(thing):
            for key, member in vars(thing).items():
                documented = inspect.isfunction(member) or isinstance(member, (property, classmethod, staticmethod))
                if not key.startswith("_") and documented:
                    yield f"{name}.{key}", member


@pytest.mark.parametrize(("name", "thing"), list(public_members()), ids=lambda x: x if isinstance(x, str) else "")
def test_every_public_name_is_explained(name, thing):
    assert len((inspect.getdoc(thing) or "").split()) >= 2, name


@pytest.mark.parametrize("name", legdistort.__all__)
def test_docstrings_name_all_parameters(name):
    thing = getattr(legdistort, name)
    if inspect.isclass(thing) and name != "Prior":
        return
    parameters = [p for p in inspect.signature(thing).parameters.values() if p.kind is not p.VAR_KEYWORD]
    for parameter in parameters:
        assert parameter.name in inspect.getdoc(thing), f"{name} does not explain {parameter.name}"
    positional = [p for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    allowed = 3 if name == "refine" else 2  # of which all three are always given
    assert len(positional) <= allowed, f"{name}: keyword-only after the first argument or two"


def test_names_are_sorted_and_there():
    assert list(legdistort.__all__) == sorted(legdistort.__all__)
    assert legdistort.__version__


def test_all_errors_are_caught_by_one_name():
    from legdistort import exceptions

    for name, thing in vars(exceptions).items():
        if inspect.isclass(thing) and thing.__module__ == exceptions.__name__:
            assert issubclass(thing, (LegdistortError, LegdistortWarning)), name
            assert thing.__doc__


def test_a_fit_that_nothing_tests_says_so():
    """Two stars in two exposures: chi2 is 0 by the number of unknowns."""
    xy = {"x": [10.0, 80.0, 20.0, 90.0], "y": [10.0, 70.0, 15.0, 75.5]}
    table = Table({"exposure": list("aabb"), "star": [0, 1, 0, 1]} | xy | dict.fromkeys(("x_err", "y_err"), [0.1] * 4))
    solution = solve(Matches.from_table(table, shape=(100, 100)), degree=0)
    assert repr(solution).endswith("degree 0, as many unknowns as data, which nothing tests>")


def test_nouns_explain_themselves(simulation, solution):
    shape = next(iter(simulation.matches.shapes.values()))
    n, n_stars = len(simulation.matches.table), len(simulation.matches.stars)
    assert repr(simulation.matches) == f"<Matches: {n} observations of {n_stars} stars in 6 exposures>"
    assert repr(solution) == (
        f"<Solution: 6 exposures, {n_stars} stars, degree 3, "
        f"chi2 {solution.chi2:.1f} for {solution.dof:.0f} degrees of freedom>"
    )
    assert repr(solution.gauge) == "<Gauge 'minimal': 20 constraints, 6 exposures>"
    name = solution.names[0]
    assert repr(solution[name].distortion) == f"<Distortion of {name}: degree 3, {shape[1]} x {shape[0]} px>"
    assert repr(solution[name].distortion.inverse).startswith("<Inverse: degree ")
    assert repr(Prior(np.zeros((2, 6)), sigma=1)) == "<Prior: degree 2, 6 modes an axis, sigma given>"
    assert repr(TangentPlane(10, -5, np.eye(2, 3) / 3600)) == "<TangentPlane: 10.00000 -5.00000 deg, 1.0000 arcsec/px>"
    image = Exposure(name="e1", data=np.zeros((20, 30)))
    assert repr(image).startswith("<Exposure 'e1': 30 x 20 px, ")
    for thing in (simulation, simulation.truth, solution[name].distortion.inverse, image):
        assert len(repr(thing)) < 150
        assert "array" not in repr(thing)


def test_printed_solution_is_a_table(solution):
    text = str(solution)
    lines = text.splitlines()
    assert lines[0] == repr(solution)[1:-1]
    for name in solution.names:
        assert sum(line.startswith(name) for line in lines) == 1
    header = next(line for line in lines if line.startswith("exposure"))
    columns = "exposure stars shift x shift y rotation scale rms x rms y dynamic distortion PA scale"
    assert " ".join(header.split()) == columns
    row = next(line for line in lines if line.startswith(solution.names[0]))
    assert len(row) == len(header)
    assert all(len(line) <= 120 for line in lines)


@pytest.mark.parametrize(("kind", "words"), [("minimal", "smallest dynamic part"), ("mean", "that sum to zero")])
def test_gauge_says_in_words_what_is_not_known(simulation, kind, words):
    mean = simulation.truth.static
    solver = solve if kind == "minimal" else paper.solve
    solution = solver(simulation.matches, prior=Prior(mean, static_sigma=0.1))
    text = str(solution.gauge)
    assert text.startswith(f"Gauge {kind!r}. A map of the reference plane of degree 3 that every exposure compensates")
    assert "20 modes, 6 of them exactly" in text
    rows = [line for line in text.splitlines() if line.endswith(")") or "nominal poses" in line]
    assert [line[:24].strip() for line in rows] == ["shift, rotation, scale", "shear", "degree 2", "degree 3"]
    assert sum(int(line[24:31]) for line in rows) == 20
    assert "not known" in rows[0]
    assert all(words in line for line in rows[1:])
    assert "and the uncertainty of the static distortion" in text
    assert solution.gauge.sentence in " ".join(str(solution).split())
    assert words in solution.gauge.sentence
    # the figure quoted is the dynamic rms over the detector, per axis, that was put in (similarities left out)
    put_in = np.sqrt((simulation.truth.dynamic[:, :, 3:] ** 2).sum(axis=2).mean()) / 2
    stated = float(text.split("mean by ")[1].split()[0])
    assert stated == pytest.approx(put_in, rel=0.5)
    prior = solver(simulation.matches, prior=Prior(mean, sigma=0.5))
    assert "and the prior widths" in str(prior.gauge)
    assert "uncertainty of the static" not in str(prior.gauge)


def test_results_cannot_be_assigned_to(solution):
    with pytest.raises(AttributeError):
        solution.degree = 4
    with pytest.raises(AttributeError):
        solution.gauge.kind = "mean"


def test_unknown_exposures_are_named(solution):
    with pytest.raises(LegdistortError, match=r"no exposure 'nobody' in the solution; it has .*, "):
        solution["nobody"]
    sim = simulate_matches(n_exposures=3, n_stars=20, degree=1)
    matches = Matches(sim.matches.table, sim.matches.shapes, sim.matches.poses, None, {"dark": "no stars were found"})
    with pytest.raises(LegdistortError, match=r"no exposure 'dark' in the solution: it was left out \(no stars"):
        solve(matches, degree=1)["dark"]


# --- the plan ----------------------------------------------------------------------------------------------------


def test_importing_is_quiet_and_light():
    """Of other packages nothing, no warnings, no output."""
    code = "import legdistort, sys; assert not {'numpy', 'astropy', 'matplotlib'} & set(sys.modules)"
    run = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


#: Imports each module by itself, in a process of its own that begins with what takes long and is not ours.
EACH_FIRST = """
import os, sys, traceback, warnings
import numpy, scipy.linalg, scipy.optimize, scipy.sparse, scipy.stats, scipy.ndimage, asdf, yaml, dask, tqdm

for name in sys.argv[1:]:
    if os.fork() == 0:
        warnings.simplefilter("error")
        try:
            __import__(name)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    if os.wait()[1]:
        print(name)
"""


def test_every_module_can_be_the_first():
    """astropy.modeling looks into the package for a fitter whenever its fitters are imported first."""
    names = [f"legdistort.{name}" for name in ("geometry.fitter", "geometry.models", "wcs.exposure_wcs")]
    run = subprocess.run([sys.executable, "-c", EACH_FIRST, *names], capture_output=True, text=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


# --- files without us --------------------------------------------------------------------------------------------

READER = """
import asdf, importlib.util, json, sys, warnings
warnings.simplefilter("error")
warnings.filterwarnings("ignore", "(?s).*but older package")  # what an old stack says of every newer file
assert importlib.util.find_spec("legdistort") is None, "legdistort is installed here"
out = {}
with open(sys.argv[1]) as file:
    points = json.load(file)
for path in sys.argv[2:]:
    with asdf.open(path) as file:
        wcs = file["meta"]["wcs"]
        sky = wcs.pixel_to_world(*points)
        back = wcs.get_transform("reference", "detector")(*wcs.get_transform("detector", "reference")(*points))
        inverse = wcs.get_transform("detector", "undistorted").inverse
        parts = [m.parameters.tolist() for m in inverse.traverse_postorder() if type(m).__name__ == "Legendre2D"]
        back = [list(map(float, b)) for b in back]
        out[file["meta"]["exposure"]] = [sky.ra.deg.tolist(), sky.dec.deg.tolist(), back, parts]
print(json.dumps(out))
"""


#: What ``pip install gwcs`` gave: today, and before ASDF 4.
STACKS = {
    "today": ["gwcs"],
    "December 2024": ["gwcs==0.22.1", "astropy==7.0.0", "asdf==4.1.0", "asdf-astropy==0.7.0", "numpy==2.2.0"],
}


@pytest.mark.parametrize(
    "stack", [pytest.param(name, marks=pytest.mark.slow if name == "today" else pytest.mark.sets) for name in STACKS]
)
def test_files_open_with_gwcs_alone(solution, tmp_path, stack):
    """In a fresh environment with gwcs and what it needs, nothing else: same sky to 1e-9 degrees, same coefficients."""
    python = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True, capture_output=True)
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    pip = [python, "-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--quiet", "--no-compile"]
    pip += STACKS[stack]
    got = subprocess.run(pip, capture_output=True, text=True, env=env, check=False)
    unreachable = ("Could not find a version", "Connection", "Temporary failure")  # or too old for this Python
    if got.returncode and any(words in got.stderr for words in unreachable):
        pytest.skip(f"the package index cannot be reached: {got.stderr.strip().splitlines()[-1]}")
    assert got.returncode == 0, got.stderr
    (tmp_path / "wcs").mkdir()
    paths = [write_wcs(solution[name], tmp_path / "wcs" / f"{name}.asdf") for name in solution.names]
    ny, nx = solution.estimate.shapes[solution.names[0]]
    x, y = np.random.default_rng(0).uniform([[0], [0]], [[nx - 1], [ny - 1]], (2, 200))
    (tmp_path / "points.json").write_text(json.dumps([x.tolist(), y.tolist()]))
    command = [python, "-I", "-c", READER, tmp_path / "points.json", *paths]
    read = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env, check=False)
    assert read.returncode == 0, read.stderr
    seen = json.loads(read.stdout)
    assert set(seen) == set(solution.names)
    for name, (ra, dec, back, coefficients) in seen.items():
        ours = solution[name].wcs.pixel_to_world(x, y)
        exact = solution.sky.to_sky(solution[name].correct(np.column_stack([x, y])))
        assert_allclose([ra, dec], [ours.ra.deg, ours.dec.deg], rtol=0, atol=1e-9)
        assert_allclose([ra, dec], [exact.ra.to_value(u.deg), exact.dec.to_value(u.deg)], rtol=0, atol=1e-9)
        assert_allclose(back, [x, y], rtol=0, atol=1e-6)
        tensors = to_tensor(solution.coefficients[solution.names.index(name)])
        assert coefficients == [tensor.T.ravel().tolist() for tensor in tensors]  # to the bit


# --- notebooks, and what is called the wrong way round --------------------------------------------------------------


def test_a_notebook_shows_what_print_shows(simulation, solution):
    from html import unescape

    image = Exposure(name="<b>", data=np.zeros((20, 30)))
    things = [solution.gauge, simulation, Prior(np.zeros((2, 6))), image]
    for thing in things:
        shown = thing._repr_html_()
        assert shown.startswith("<pre")
        assert unescape(shown.split(">", 1)[1].removesuffix("</pre>")) == str(thing)
        assert "<b>" not in shown
    for name in ("Camera", "Detector", "EffectivePSF", "Exposure", "Matches", "Mosaic", "Prior", "Solution"):
        assert hasattr(getattr(legdistort, name), "_repr_html_"), name


def test_objects_draw_themselves_where_they_are_told(solution):
    from matplotlib.figure import Figure

    name = solution.names[0]
    mosaic = legdistort.Mosaic(np.random.default_rng(0).normal(size=(30, 40)), *[None] * 6, exposures=())
    for draw in (
        solution.plot,
        lambda ax: solution[name].plot_residuals(ax=ax),
        lambda ax: solution[name].plot_error_map(ax=ax),
        lambda ax: solution[name].plot_error_map(absolute=True, ax=ax),
        mosaic.plot,
    ):
        ax = Figure().subplots()
        assert draw(ax=ax) is ax
        assert ax.get_title(loc="left")
    with pytest.raises(LegdistortError, match="no exposure 'x' in the solution"):
        solution["x"].plot_error_map()


def test_calls_the_wrong_way_round_are_told_the_right_one(simulation, solution):
    image = Exposure(name="e1", data=np.zeros((20, 30)))
    calls = {
        r"call coadd\(exposures, solution\)": lambda: legdistort.coadd(solution, [image]),
        "a Solution after the exposures, as solve gives it, got Matches": lambda: legdistort.coadd(
            [image], simulation.matches
        ),
        "exposures must be images as open_exposures or read_exposures give them, got Matches": lambda: legdistort.coadd(
            simulation.matches, solution
        ),
        r"call match\(measure\(exposures\)\)": lambda: legdistort.match([image]),
        "the table of detections must be a table, got Solution": lambda: legdistort.match(solution),
        "matches must be Matches .* got list": lambda: legdistort.solve([image]),
        "or a sequence of them, got Solution": lambda: legdistort.run(solution, out="never made"),
        "truth must be that of a simulation .* got str": lambda: legdistort.run([], out="never made", truth="x"),
    }
    for words, call in calls.items():
        with pytest.raises(LegdistortError, match=words):
            call()
