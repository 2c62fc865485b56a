"""The command line on a small simulated night: what it leaves, and what it says of bad input."""

import inspect
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import chdir, redirect_stdout
from pathlib import Path
from types import SimpleNamespace

import asdf
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

import legdistort
from legdistort import Prior, Solution, calibrate_noise, coadd, match, measure, open_exposures, pipeline, predict, solve
from legdistort.cli import commands, options, parser, planning_options
from legdistort.cli.arguments import given, planes
from legdistort.cli.parser import main
from legdistort.cli.running import in_shell_words
from legdistort.cli.usage import COMMANDS
from legdistort.coaddition import preparation
from legdistort.demo import run_demo
from legdistort.exceptions import InputError
from legdistort.inputs.table_files import read_table
from legdistort.results import in_tables
from legdistort.runtime.parallel import map_items
from legdistort.simulation.example_files import write_examples
from legdistort.simulation.observations import simulate_exposures
from legdistort.simulation.pupil import PupilPSF
from legdistort.wcs.attachment import attach

RESULTS = {path.split("/")[0] for path in pipeline.RESULTS} - {"psf", *pipeline.CATALOGUE}


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    folder = tmp_path_factory.mktemp("night")
    return simulate_exposures(small=True, size=320, n_stars=60, seed=3).write(folder)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The small demonstration, run once: its folder and what it printed with --json."""
    out = tmp_path_factory.mktemp("demo") / "out"
    assert main(["demo", "--small", "--out", str(out), "--quiet"]) == 0
    return out


def run(frames, out, *more):
    return main(["run", *map(str, frames), "--out", str(out), "--degree", "1", "--quiet", *more])


@pytest.fixture(scope="module")
def whole(night, tmp_path_factory):
    """The night and a frame without stars run once in the place of other results: folder, what it printed, seconds."""
    folder = tmp_path_factory.mktemp("whole")
    noise = fits.PrimaryHDU(np.random.default_rng(0).normal(400, 12, (320, 320)).astype("float32"))
    noise.header["GAIN"], noise.header["RDNOISE"] = 2.0, 15.0
    noise.writeto(folder / "empty.fits")
    out = folder / "out"
    out.mkdir()
    for name in ("solution.asdf", "mosaic.fits"):
        (out / name).write_text("precious")
    begun = time.perf_counter()
    with redirect_stdout(io.StringIO()) as printed:
        assert run([*night, folder / "empty.fits"], out, "--overwrite", "--json") == 0
    return SimpleNamespace(out=out, printed=printed.getvalue(), waited=time.perf_counter() - begun)


@pytest.fixture(scope="module")
def steps(night, tmp_path_factory):
    """The folder of the same night, step by step, with relative paths."""
    folder = tmp_path_factory.mktemp("steps")
    shutil.copytree(night[0].parent, folder / "frames")
    with chdir(folder):
        for step in (
            ["measure", "frames/*.fits", "--out", "stars.ecsv"],
            ["match", "stars.ecsv", "--out", "matched.ecsv"],
            ["solve", "matched.ecsv", "--degree", "1", "--clip", "5", "--out", "out"],
        ):
            assert main([*step, "--quiet"]) == 0, step
    return folder


def failed(capsys, status, *words):
    """The command ended with status 1 and one clear line on stderr that holds the words."""
    error = capsys.readouterr().err.strip()
    assert status == 1
    assert error.count("\n") == 0, error
    assert "Traceback" not in error
    for word in words:
        assert word in error


def test_demo_leaves_everything(demo):
    assert {item.name for item in demo.iterdir()} == RESULTS | {"frames"}
    names = [path.stem for path in (demo / "frames").glob("*.fits")]
    assert {path.stem for path in (demo / "wcs").iterdir()} == set(names)
    summary = json.loads((demo / "summary.json").read_text())
    for key in ("n_exposures", "n_stars", "n_observations", "chi2", "dof", "rms_px", "sigma_px", "gauge",
                "max_inverse_error_px", "left_out", "timings", "b_px", "b_bound_px", "b_abs_px", "b_abs_err_px",
                "fwhm_ratio"):  # fmt: skip
        assert key in summary
    assert summary["n_exposures"] == 6
    assert summary["left_out"] == {}


def test_demo_is_as_good_as_it_says(demo):
    s = json.loads((demo / "summary.json").read_text())
    assert s["b_px"] < 1.5 * s["b_bound_px"]
    assert s["b_abs_px"] < 3 * s["b_abs_err_px"]
    assert s["sigma_new_px"] == pytest.approx(s["sigma_new_expected_px"], rel=0.05)
    assert s["max_inverse_error_px"] <= 1e-6
    assert s["fwhm_ratio"] < 1.15
    assert s["chi2"] / s["dof"] == pytest.approx(1, abs=0.35)


def test_the_page_shows_what_is_printed(demo):
    page = (Path(__file__).parents[2] / "docs" / "first_mosaic.md").read_text(encoding="utf-8")
    s = json.loads((demo / "summary.json").read_text())
    shown = re.findall(r"^  .*? ([\d.]+) (?:px  \(\w+ ([\d.]+)\)|x that of)", page, re.MULTILINE)
    keys = (("b_px", "b_bound_px"), ("b_abs_px", "b_abs_err_px"), ("sigma_new_px", "sigma_new_expected_px"))
    for figures, names in zip(shown, (*keys, ("fwhm_ratio",)), strict=True):
        for figure, name in zip(figures, names, strict=False):
            assert float(figure) == pytest.approx(s[name], rel=0.1), name


def test_files_agree_with_the_solution(demo):
    solution = Solution.read(demo / "solution.asdf")
    stars = Table.read(demo / "stars.ecsv")
    assert np.array_equal(stars["x"], solution.stars["x"].value)
    assert "ra" in stars.colnames
    name = solution.names[0]
    with asdf.open(demo / "wcs" / f"{name}.asdf") as file:
        ra, dec = file["meta"]["wcs"](100.0, 200.0)
    sky = solution[name].wcs(100.0, 200.0)
    assert (ra, dec) == pytest.approx(sky, abs=1e-12)
    with fits.open(demo / "mosaic.fits") as hdulist:
        assert [hdu.name for hdu in hdulist] == ["SCI", "UNCERT", "MASK", "FOOTPRINT"]


def test_json_is_alone_on_stdout(whole):
    assert json.loads(whole.printed)["n_exposures"] == 6


@pytest.mark.usefixtures("undrawn")
def test_steps_one_by_one(steps, tmp_path, capsys):
    solution = str(steps / "out" / "solution.asdf")
    for step in (
        ["coadd", str(steps / "frames" / "*.fits"), "--solution", solution, "--out", str(tmp_path / "m.fits")],
        ["show", solution],
        ["report", solution, "--out", str(tmp_path / "r.html")],
    ):
        assert main([*step, "--quiet"]) == 0, step
    out = capsys.readouterr().out
    assert "6 exposures" in out
    assert "exp05" in out
    assert (tmp_path / "m.fits").exists()
    assert (tmp_path / "r.html").exists()


def test_simulate_replaces_no_frames_of_somebody_else(tmp_path, capsys):
    (tmp_path / "exp03.fits").write_text("precious")
    failed(capsys, main(["simulate", "--small", "--out", str(tmp_path), "--quiet"]), "exp03.fits exists", "--overwrite")
    assert [path.name for path in tmp_path.iterdir()] == ["exp03.fits"]
    assert (tmp_path / "exp03.fits").read_text() == "precious"


def test_simulate_writes_frames_and_truth(tmp_path, capsys):
    assert main(["simulate", "--small", "--out", str(tmp_path / "n"), "--quiet"]) == 0
    assert len(list((tmp_path / "n").glob("*.fits"))) == 6
    assert (tmp_path / "n" / "truth.ecsv").exists()
    failed(
        capsys, main(["simulate", "--small", "--out", str(tmp_path / "n"), "--quiet"]), "already holds", "--overwrite"
    )


def test_noise_frame_is_left_out_by_name(whole):
    summary = json.loads(whole.printed)
    assert summary["n_exposures"] == 6
    assert list(summary["left_out"]) == ["empty"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["slove", "m.ecsv"], r"legdistort: .*invalid choice: slove .*; did you mean solve\?"),
        (["solve", "m.ecsv", "--degre", "3", "--out", "x"], r"legdistort solve: .* --degre 3; did you mean --degree\?"),
        (["run", "a.fits", "--over", "--out", "x"], r"legdistort run: .* --over; did you mean --overwrite\?"),
        (
            ["match", "a.lis", "--pixel-scale=0.02", "--out", "m.ecsv"],
            r"legdistort match: .* --pixel-scale=0.02; --pixel-scale is an option of run, solve, predict \(",
        ),
        (["solve"], r"legdistort solve: the following arguments are required: TABLE, --out \("),
    ],
)
def test_wrong_usage_is_told_in_a_line_with_the_nearest_option(capsys, words, message):
    with pytest.raises(SystemExit) as stopped:
        parser.main(words)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(message, line)


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(signal.SIGINT, marks=pytest.mark.slow),
        signal.SIGTERM,
        pytest.param(getattr(signal, "SIGHUP", signal.SIGTERM), marks=pytest.mark.slow),
    ],
)
def test_a_stopped_run_leaves_what_it_measured_alone(night, tmp_path, capsys, monkeypatch, number):
    """By Ctrl-C, or by a batch system, while it co-adds."""
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    monkeypatch.setattr(preparation, "measure_background", lambda *args, **options: os.kill(os.getpid(), number))
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)
    try:
        assert run(night[:4], tmp_path / "out") == 130
        assert signal.getsignal(number) == usual
    finally:
        signal.signal(number, before)
    assert capsys.readouterr().err.endswith("legdistort: interrupted\n")
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*"))
    assert left == ["out.measured", "out.measured/detections.ecsv", "out.measured/summary.json", "scratch"]


@pytest.mark.parametrize("kept", ["solution.asdf", "mosaic.fits"])
def test_existing_run_is_kept(night, tmp_path, capsys, kept):
    out = tmp_path / "out"
    out.mkdir()
    (out / kept).write_text("precious")
    failed(capsys, run(night, out), f"{out} already holds {kept}", "--overwrite")
    assert (out / kept).read_text() == "precious"


def test_existing_run_is_replaced_when_asked(whole):
    assert Solution.read(whole.out / "solution.asdf").degree == 1
    assert fits.getdata(whole.out / "mosaic.fits").ndim == 2


def test_timings_are_what_one_waits_for(whole):
    timings = json.loads((whole.out / "summary.json").read_text())["timings"]
    assert list(timings) == ["start", "read", "measure", "match", "solve", "coadd", "assess", "write", "report"]
    assert 0.7 * whole.waited < sum(timings.values()) < whole.waited  # what is missing is moving the results
    assert f"start {timings['start']:.2f} s, read" in (whole.out / "report.html").read_text()


@pytest.mark.slow
def test_two_workers_leave_the_same(whole, night, tmp_path):
    """In a process of its own, where workers are copies, one of which draws the report while files are written."""
    frames, out = [*night, whole.out.parent / "empty.fits"], tmp_path / "out"
    line = ["run", *frames, "--out", out, "--degree", "1", "--quiet", "--workers", "2"]
    subprocess.run([sys.executable, "-m", "legdistort", *line], check=True)
    own = re.compile('<th scope="row">(Command|Solved|Time)</th>')
    one, two = ((folder / "report.html").read_text().splitlines() for folder in (whole.out, out))
    assert [line for line in two if not own.search(line)] == [line for line in one if not own.search(line)]
    one, two = (json.loads((folder / "summary.json").read_text()) for folder in (whole.out, out))
    assert two["timings"].keys() == one["timings"].keys()
    assert two["files"].keys() == one["files"].keys()
    assert two["files"]["stars.ecsv"] == one["files"]["stars.ecsv"]


@pytest.mark.parametrize(("megabytes", "given", "workers"), [(5, None, 1), (40, None, 3), (40, 2, 2), (5, 2, 2)])
def test_all_cores_work_where_it_is_worth_it(tmp_path, monkeypatch, megabytes, given, workers):
    monkeypatch.setattr(commands.parallel, "n_cores", lambda: 3)
    frames = [tmp_path / "a.fits", tmp_path / "b.fits"]
    for frame in frames:
        with open(frame, "wb") as file:
            file.truncate(megabytes * 1_000_000 // 2)
    asked = SimpleNamespace(frames=frames, workers=given, quiet=True)
    assert commands._share(asked) == {"workers": workers, "progress": False}


def _not_fits(path, night):
    path.write_text("not an image")
    return [*night[1:], path]


def _truncated(path, night):
    path.write_bytes(night[0].read_bytes()[:100_000])
    return [*night[1:], path]


def _other_shape(path, night):
    fits.PrimaryHDU(np.eye(300, 512, dtype="float32")).writeto(path)
    return [*night[1:], path]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (_not_fits, ["bad.fits"]),
        (_truncated, ["bad.fits", "truncated"]),
        (_other_shape, ["bad", "shape", "(300, 512)"]),
    ],
)
def test_bad_frames_are_named_and_nothing_is_left(night, tmp_path, capsys, make, words):
    frames = make(tmp_path / "bad.fits", night)
    failed(capsys, run(frames, tmp_path / "out", "--stop-at-bad"), *words)
    assert [item.name for item in tmp_path.iterdir()] == ["bad.fits"]


def test_missing_frame(tmp_path, capsys):
    failed(capsys, run([tmp_path / "absent.fits"], tmp_path / "out"), "absent.fits")


def test_one_exposure_only(night, tmp_path, capsys):
    failed(capsys, run(night[:1], tmp_path / "out"), "only one exposure", night[0].stem)


@pytest.mark.slow
def test_fewer_stars_than_modes(night, tmp_path, capsys):
    failed(
        capsys, run(night, tmp_path / "out", "--degree", "12"), "stars, fewer than the 91 modes of degree 12", "lower"
    )


def _table(n_exposures=4, n_stars=12, groups=1):
    rng = np.random.default_rng(5)
    rows = []
    for i in range(n_exposures):
        for j in range(n_stars):
            rows.append((f"e{i}", j + 100 * (i % groups), *(rng.uniform(0, 500, 2)), 0.1, 0.1))
    return Table(rows=rows, names=["exposure", "star", "x", "y", "x_err", "y_err"])


def _nan(table):
    table["x_err"][7] = np.nan


def _negative(table):
    table["y_err"][7] = -0.1


def _twice(table):
    table.add_row(table[3])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_nan, ["x_err is not a positive finite number", "row 7", "exposure e0, star 7"]),
        (_negative, ["y_err is not a positive finite number", "row 7"]),
        (_twice, ["star 3 stands twice in exposure e0"]),
    ],
)
def test_bad_tables_are_named(tmp_path, capsys, spoil, words):
    table = _table()
    spoil(table)
    table.write(tmp_path / "t.ecsv")
    arguments = ["solve", str(tmp_path / "t.ecsv"), "--shape", "512", "512", "--out", str(tmp_path / "out")]
    failed(capsys, main(arguments), *words)
    assert not (tmp_path / "out").exists()


def test_one_exposure_without_a_reference_is_named(tmp_path, capsys):
    table = _table()
    table[table["exposure"] == "e0"].write(tmp_path / "t.ecsv")
    arguments = ["solve", str(tmp_path / "t.ecsv"), "--shape", "512", "512", "--out", str(tmp_path / "out")]
    assert main(arguments) == 1
    assert "only one exposure (e0)" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_two_groups_are_named(tmp_path, capsys):
    _table(groups=2).write(tmp_path / "t.ecsv")
    arguments = ["solve", str(tmp_path / "t.ecsv"), "--shape", "512", "512", "--out", str(tmp_path / "out")]
    assert main(arguments) == 1
    *_, last = capsys.readouterr().err.splitlines()
    assert all(words in last for words in ("2 groups with no star in common", "e0, e2", "e1, e3", "--static fit"))


def test_missing_column_tells_how_to_map_it(tmp_path, capsys):
    table = _table()
    table.rename_column("star", "id")
    table.write(tmp_path / "t.ecsv")
    arguments = ["solve", str(tmp_path / "t.ecsv"), "--shape", "512", "512", "--out", str(tmp_path / "out")]
    failed(capsys, main(arguments), "lacks the column star", "legdistort match;", "--columns star=")


def test_wrong_usage_exits_with_2(capsys):
    with pytest.raises(SystemExit) as end:
        main(["run", "a.fits"])
    assert end.value.code == 2
    with pytest.raises(SystemExit) as end:
        main(["solve", "t.ecsv", "--out", "o", "--columns", "star"])
    assert end.value.code == 2
    capsys.readouterr()


def python(*arguments):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True).stdout


def test_the_package_runs_as_the_command():
    assert python("-m", "legdistort", "--version") == f"legdistort {legdistort.__version__}\n"


def test_a_command_seeks_garbage_rarely_and_not_at_its_end():
    code = """
import gc, sys
from legdistort import cli
first, *others = gc.get_threshold()
cli.main = lambda: sys.exit(3)
try:
    cli.command()
except SystemExit as end:
    print(end.code, gc.get_threshold() == (10 * first, *others), gc.get_freeze_count() > 1000)
"""
    assert python("-c", code) == "3 True True\n"


STOPPED_AT = """
import os, signal, sys
module = sys.argv.pop(1)
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
signal.signal(signal.SIGINT, signal.default_int_handler)
from legdistort.cli import command
sys.exit(command())
"""


@pytest.mark.parametrize("name", ["argparse", "legdistort.exceptions", "numpy.linalg", "astropy.time.core"])
def test_ctrl_c_while_modules_are_imported_is_one_line(name):
    done = subprocess.run([sys.executable, "-c", STOPPED_AT, name, "show", "x"], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "legdistort: interrupted\n")


@pytest.mark.slow
def test_commands_work_without_any_stream(night, tmp_path):
    """As a daemon has it, and with ``2>&-``: nothing of theirs is written into files, which would take the numbers."""
    out = tmp_path / "d.ecsv"
    command = [sys.executable, "-m", "legdistort", "measure", *map(str, night[:2]), "--out", str(out)]
    done = subprocess.run(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *command], capture_output=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")
    assert [item.name for item in tmp_path.iterdir()] == ["d.ecsv"]
    assert len(read_table(out)) > 20


@pytest.mark.parametrize(
    "closed",
    [
        pytest.param(["stderr"], marks=pytest.mark.slow),
        pytest.param(["stdout"], marks=pytest.mark.slow),
        ["stdout", "stderr"],
    ],
)
def test_main_works_in_programs_without_streams(night, tmp_path, monkeypatch, closed):
    for name in closed:
        monkeypatch.setattr(sys, name, None)
    assert main(["measure", *map(str, night[:2]), "--out", str(tmp_path / "d.ecsv")]) == 0
    assert main(["show", str(tmp_path / "d.ecsv")]) in (0, 1)
    assert main(["show", "nowhere"]) == 1
    assert [getattr(sys, name) for name in closed] == [None] * len(closed)
    assert list(map_items(abs, [-1], progress=True)) == [1]


@pytest.mark.slow
def test_a_full_standard_error_is_no_reason_to_fail(night, tmp_path):
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "legdistort", "show", "nowhere"]
        assert subprocess.run(command, stderr=full).returncode in (1, 120)  # 120: Python could not empty it


@pytest.mark.parametrize(
    "command", ["demo", "run", "measure", "match", "solve", "coadd", "catalogue", "completeness", "simulate", "show"]
)
def test_help_has_an_example(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert f"Example: legdistort {command}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("function", "groups"),
    [
        (run_demo, [options.NIGHT]),
        (write_examples, [options.EXAMPLES]),
        (simulate_exposures, [options.NIGHT]),
        (PupilPSF, [options.OPTICS]),
        (legdistort.run, [options.RUN_FRAMES, options.WORKERS, options.LAST_STEP, options.COMPARING]),
        (measure, [options.MEASURING, options.WORKERS]),
        (calibrate_noise, [options.INJECTING, options.WORKERS]),
        (match, [options.MATCHING]),
        (solve, [options.SOLVING]),
        (coadd, [options.COADDING, options.WORKERS, options.GRID]),
        (legdistort.catalogue, [options.CATALOGUING, options.ARTIFICIAL, options.COMPLETENESS]),
        (attach, [options.FRAMES, options.ATTACHING]),
        (predict, [planning_options.PREDICTING]),
        (legdistort.Instrument.named, [planning_options.INSTRUMENT]),
        (legdistort.Instrument, [planning_options.EXPOSURES]),
        (Prior.from_model, [options.EXPANDING]),
        (Solution.read, [options.SOLUTION]),
        (legdistort.combine_nights, [options.NIGHTS, options.WORKERS]),
        (legdistort.difference, [options.MAPS, options.COMPARED]),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_options_have_the_names_of_arguments(function, groups):
    """And what is done with those that have not is said in the command."""
    own = {"prior_sigma", "static_sigma", "tpv", "head", "asdf_only", "where", "ext", "frame", "solution"}
    known = inspect.signature(function).parameters
    assert {name for group in groups for name in group if name not in known} <= own


def test_every_command_has_its_function():
    functions = [name.removeprefix("do_") for name in vars(commands) if name.startswith("do_")]
    assert sorted(functions) == sorted(COMMANDS)


@pytest.mark.parametrize("words", ["--help", "--version", "run --help", "run --degre 3"])
def test_help_loads_nothing(words):
    """So that it is there at once: numpy and astropy alone take half a second."""
    code = (
        "import sys\nfrom legdistort.cli import main\n"
        f"try:\n    main({words.split()})\nexcept SystemExit:\n    pass\n"
        "assert not {'numpy', 'astropy', 'tqdm'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "legdistort" in done.stdout + done.stderr
    assert (done.returncode, done.stderr.splitlines()[1:]) == (0, [])


def test_what_stands_for_none():
    arguments = parser._parser().parse_args(["coadd", "a.fits", "--solution", "s", "--out", "m", "--scale", "none"])
    assert given(arguments, options.COADDING) == {"match_background": True, "scale": None}
    arguments = parser._parser().parse_args(["run", "a.fits", "--out", "o", "--clip", "0", "--errors", "floor"])
    assert given(arguments, options.SOLVING) == {"clip": None, "errors": "floor"}
    assert given(arguments, options.MEASURING) == {}


def _coadd(demo, out, *more):
    frames = str(demo / "frames" / "*.fits")
    return ["coadd", frames, "--solution", str(demo / "solution.asdf"), "--out", str(out), "--quiet", *map(str, more)]


def _grid(demo):
    """Header of a part of the sky of the demonstration, turned by 30 degrees, with pixels 1.25 times as large."""
    old = WCS(fits.getheader(demo / "mosaic.fits"))
    new = WCS(naxis=2)
    new.wcs.ctype, new.wcs.crpix = ["RA---TAN", "DEC--TAN"], [121, 101]
    new.wcs.crval = old.wcs_pix2world([[320, 300]], 0)[0]
    c, s = 1.25 * np.cos(np.pi / 6), 1.25 * np.sin(np.pi / 6)
    new.wcs.cd = old.pixel_scale_matrix @ [[c, -s], [s, c]]
    return fits.Header({"NAXIS": 2, "NAXIS1": 240, "NAXIS2": 200}) + new.to_header()


@pytest.mark.parametrize(
    ("text", "names"),
    [("uncert,Weight", ("UNCERT", "WEIGHT")), ("All", ("all",)), ("None", ()), ("all,foo", ("all", "FOO"))],
)
def test_names_of_planes_may_be_in_any_case(text, names):
    assert planes(text) == names


def test_coadd_on_the_grid_of_a_file(demo, tmp_path, capsys):
    header = _grid(demo)
    header.totextfile(tmp_path / "sky.head")
    exposures = open_exposures(str(demo / "frames" / "*.fits"))
    solution = Solution.read(demo / "solution.asdf")
    settings = {"conserve": "surface_brightness", "match_background": False, "order": "bilinear", "method": "median"}
    wanted = coadd(exposures, solution, grid=header, **settings)
    (tmp_path / "scratch").mkdir()
    options = ["--grid", tmp_path / "sky.head", "--scratch", tmp_path / "scratch", "--conserve", "surface_brightness",
               "--no-match-background", "--order", "bilinear", "--combine", "median", "--planes", "all"]  # fmt: skip
    assert main(_coadd(demo, tmp_path / "m.fits", *options)) == 0
    assert "240 x 200 px, 6 exposures" in capsys.readouterr().out
    assert list((tmp_path / "scratch").iterdir()) == []
    with fits.open(tmp_path / "m.fits") as hdulist:
        np.testing.assert_array_equal(hdulist["UNCERT"].data, np.sqrt(wanted.variance))
        planes = {0: "data", "WEIGHT": "weight", "FOOTPRINT": "footprint", "FLAGS": "flags"}
        for hdu, plane in planes.items():
            np.testing.assert_array_equal(hdulist[hdu].data, getattr(wanted, plane))
        corners = [[0, 0], [239, 0], [0, 199], [239, 199]]
        sky = WCS(hdulist[0].header).wcs_pix2world(corners, 0)
        np.testing.assert_allclose(sky, WCS(header).wcs_pix2world(corners, 0), rtol=0, atol=1e-11)
        assert hdulist[0].header["CONSERVE"] == "surface_brightness"
    assert np.isfinite(wanted.data).mean() > 0.9


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda header: header.remove("CTYPE1") or header.remove("CTYPE2"), "no CTYPE1"),
        (lambda header: header.update(CTYPE1="LINEAR", CTYPE2="LINEAR"), "two axes, both celestial"),
        (lambda header: header.update(WCSAXES=3, CTYPE3="FREQ"), "two axes, both celestial"),
        (lambda header: header.remove("NAXIS1") or header.remove("NAXIS2"), "grid has no shape"),
        (lambda header: header.update(CTYPE1="RA---XXX"), "XXX"),
    ],
)
def test_grids_without_sense_are_named_before_any_work(demo, tmp_path, capsys, monkeypatch, spoil, words):
    monkeypatch.setattr("legdistort.open_exposures", lambda *_, **__: pytest.fail("the work began"))
    header = _grid(demo)
    spoil(header)
    header.totextfile(tmp_path / "bad.head")
    failed(capsys, main(_coadd(demo, tmp_path / "m.fits", "--grid", tmp_path / "bad.head")), "bad.head: ", words)
    assert [item.name for item in tmp_path.iterdir()] == ["bad.head"]


def test_options_of_coadd_reach_it(demo, tmp_path, capsys, monkeypatch):
    """And those that are not given are its own, but for the rejection of what the others do not confirm."""
    given = {}

    def stand_in(exposures, solution, **options):
        given.update(options)
        raise InputError("enough")

    monkeypatch.setattr("legdistort.coadd", stand_in)
    failed(capsys, main(_coadd(demo, tmp_path / "m.fits")), "enough")
    own = {name: p.default for name, p in inspect.signature(coadd).parameters.items() if p.kind is p.KEYWORD_ONLY}
    assert own | given == own | {"method": "clipped", "workers": 1}
    failed(capsys, main(_coadd(demo, tmp_path / "m.fits", "--order", "bicubic")), "enough")
    assert given["order"] == "bicubic"
    given.clear()
    options = "--combine mean --algorithm drizzle --pixfrac 0.5 --kernel point --conserve "
    options += "surface_brightness --no-match-background --weights equal --scale none --extrapolated mask --workers 2"
    failed(capsys, main(_coadd(demo, tmp_path / "m.fits", *options.split(), "--scratch", tmp_path)), "enough")
    assert own | given == own | {
        "method": "mean", "algorithm": "drizzle", "pixfrac": 0.5, "kernel": "point", "grid": None,
        "conserve": "surface_brightness", "match_background": False, "weights": None, "scale": None,
        "extrapolated": "mask", "workers": 2, "scratch": tmp_path, "progress": False,
    }  # fmt: skip


@pytest.mark.parametrize("order", ["6", "cubic", "1.5"])
def test_orders_that_there_are_not(order, capsys):
    with pytest.raises(SystemExit) as end:
        main(["coadd", "a.fits", "--solution", "s.asdf", "--out", "m.fits", "--order", order])
    assert end.value.code == 2
    assert "bicubic" in capsys.readouterr().err


# --- outputs are looked at before the work begins

FILES = {
    "measure": "measure IN --out OUT",
    "noise": "noise IN --out OUT",
    "noise's plot": "noise IN --out elsewhere.ecsv --plot OUT",
    "match": "match other.ecsv IN --out OUT",
    "prior": "prior IN --out OUT",
    "coadd": "coadd other.fits IN --solution s.asdf --out OUT",
    "coadd's solution": "coadd other.fits --solution IN --out OUT",
    "coadd's grid": "coadd other.fits --solution s.asdf --grid IN --out OUT",
    "predict": "predict --n-exposures 4 --stars IN --plot OUT",
    "predict's PSF": "predict --n-exposures 4 --stars other.ecsv --instrument NIRC2 --psf IN --plot-errors OUT",
    "nights": "nights IN --out OUT",
    "nights's plot": "nights IN --out elsewhere.asdf --plot OUT",
    "difference": "difference IN s.asdf --plot OUT",
    "stars": "stars IN --out OUT",
    "camera": "camera IN --out OUT",
    "report": "report IN --out OUT",
}
FOLDERS = {
    "demo": "demo --out OUT",
    "simulate": "simulate --out OUT",
    "run": "run IN --out OUT",
    "run's prior": "run other.fits --prior IN --out OUT",
    "run's reference": "run other.fits --reference IN --out OUT",
    "solve": "solve IN --out OUT",
    "attach": "attach s.asdf IN --out OUT",
}


def _ready(monkeypatch, line, *, read, out):
    """The words of a command whose work would be a failure."""
    words = [{"IN": str(read), "OUT": str(out)}.get(word, word) for word in line.split()]
    monkeypatch.setattr(commands, f"do_{words[0]}", lambda a: pytest.fail("the work began"))
    return [*words, "--quiet"]


@pytest.mark.parametrize("line", FILES.values(), ids=FILES)
def test_files_that_cannot_be_written(line, tmp_path, capsys, monkeypatch):
    command = "plot" if re.search("--plot(-errors)? OUT", line) else line.split()[0]
    endings = {
        "plot": ".png",
        "coadd": ".fits",
        "prior": ".asdf",
        "report": ".html",
        "stars": ".vot",
        "correct": ".csv",
    }
    old = f"old{endings.get(command, '.ecsv')}"
    (tmp_path / old).write_text("precious")
    monkeypatch.chdir(tmp_path)
    for name in ("in.fits", "other.fits", "other.ecsv"):
        (tmp_path / name).write_text("")
    for name, words in (
        (old, f"{old} exists already"),
        ("", "is a folder"),
        (f"{old}/m.fits", "is a file; give a folder"),
    ):
        failed(capsys, main(_ready(monkeypatch, line, read=tmp_path / "in.fits", out=tmp_path / name)), words)
    assert (tmp_path / old).read_text() == "precious"
    with pytest.raises(pytest.fail.Exception, match="the work began"):
        main([*_ready(monkeypatch, line, read="in.fits", out=tmp_path / old), "--overwrite"])


@pytest.mark.parametrize("line", FOLDERS.values(), ids=FOLDERS)
def test_folders_that_cannot_be_made(line, tmp_path, capsys, monkeypatch):
    (tmp_path / "old").write_text("precious")
    for name in ("old", "old/within"):
        words = [*_ready(monkeypatch, line, read="in.fits", out=tmp_path / name), "--overwrite"]
        failed(capsys, main(words), "old is a file; give a folder")
    with pytest.raises(pytest.fail.Exception, match="the work began"):
        main(_ready(monkeypatch, line, read="in.fits", out=tmp_path / "new" / "deep"))


@pytest.mark.parametrize("line", FILES.values(), ids=FILES)
def test_inputs_are_not_replaced(line, tmp_path, capsys, monkeypatch):
    """Under their own name, or through a link."""
    (tmp_path / "in.fits").write_text("precious")
    (tmp_path / "link").symlink_to("in.fits")
    own, link = tmp_path / "in.fits", tmp_path / "link"
    for read, out in ((own, own), (own, link), (link, own)):
        words = [*_ready(monkeypatch, line, read=read, out=out), "--overwrite"]
        failed(capsys, main(words), "is read, and would be replaced: give the output another name")


@pytest.mark.parametrize("name", ["run", "run's prior", "run's reference", "solve"])
def test_inputs_in_the_folder_of_results(name, tmp_path, capsys, monkeypatch):
    (tmp_path / "wcs").mkdir()
    for result in ("solution.asdf", "stars.ecsv", "wcs/a.asdf", "mosaic.fits"):
        (tmp_path / result).write_text("precious")
        words = [*_ready(monkeypatch, FOLDERS[name], read=tmp_path / result, out=tmp_path), "--overwrite"]
        failed(capsys, main(words), f"{result} is read, and would be replaced")
    (tmp_path / "positions.ecsv").write_text("")
    with pytest.raises(pytest.fail.Exception, match="the work began"):  # what stands under other names stays
        main([*_ready(monkeypatch, FOLDERS[name], read=tmp_path / "positions.ecsv", out=tmp_path), "--overwrite"])


def test_copies_of_frames_may_go_beside_the_solution(tmp_path, monkeypatch):
    (tmp_path / "solution.asdf").write_text("")
    with pytest.raises(pytest.fail.Exception, match="the work began"):
        main(_ready(monkeypatch, "attach IN a.fits --out OUT", read=tmp_path / "solution.asdf", out=tmp_path))


def test_the_frames_of_a_mosaic_survive_it(demo, tmp_path, capsys):
    frame = demo / "frames" / "exp00.fits"
    before = frame.read_bytes()
    failed(capsys, main(_coadd(demo, frame, "--overwrite")), "exp00.fits is read")
    assert frame.read_bytes() == before


def test_the_ending_of_a_mosaic_is_looked_at_first(demo, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("legdistort.open_exposures", lambda *_, **__: pytest.fail("the work began"))
    failed(capsys, main(_coadd(demo, tmp_path / "m.png")), "m.png: the ending selects the format of a mosaic")


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_keck_lists_by_the_command_line(shared_data, tmp_path, capsys):
    lists = [str(shared_data / "keck_nirc2_onc_bn" / f"{letter}.lis") for letter in "ABCD"]
    matched, out = str(tmp_path / "matched.ecsv"), str(tmp_path / "out")
    assert main(["match", *lists, "--columns", "x_err=xe,y_err=ye", "--shape", "1024", "1024",
                 "--min-exposures", "3", "--out", matched, "--quiet"]) == 0  # fmt: skip
    assert (
        main(["solve", matched, "--degree", "2", "--error-floor", "0.1", "--clip", "6", "--out", out, "--quiet"]) == 0
    )
    capsys.readouterr()
    solution = Solution.read(f"{out}/solution.asdf")
    rows = solution.residuals
    assert len(solution.estimate.star_names) >= 70
    assert 0.95 < np.mean(rows["used"]) <= 1
    used = rows[rows["used"]]
    for axis in "xy":
        weight = 1 / (used[f"{axis}_err"].value ** 2 + 0.1**2)
        assert np.sqrt(np.average(used[f"d{axis}"].value ** 2, weights=weight)) <= 0.22


@pytest.mark.slow
def test_microobservatory_frames(shared_data, tmp_path, capsys):
    """Four raw, undersampled frames without a WCS, with hot pixels and a drift of 250 px."""
    frames = sorted((shared_data / "microobs_hatp32" / "frames").glob("*.fits.gz"))[::3]
    how = ["--degree", "2", "--threshold", "30", "--catalogue", "none", "--json", "--quiet"]
    assert main(["run", *map(str, frames), "--out", str(tmp_path / "out"), *how]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["n_exposures"] == 4
    assert summary["n_stars"] >= 100
    assert summary["left_out"] == {}
    assert summary["fwhm_ratio"] <= 1.25
    solution = Solution.read(tmp_path / "out" / "solution.asdf")
    stars = solution.stars
    bright = stars["star"][np.argsort(stars["flux"])[::-1][:100]]
    rows = solution.residuals
    rows = rows[rows["used"] & np.isin(rows["star"], bright)]
    for axis in ("dx", "dy"):
        assert np.sqrt(np.mean(rows[axis].value ** 2)) <= 0.05


def test_steps_keep_the_sky_as_run_finds_it(whole, steps, tmp_path, capsys, monkeypatch):
    """The table of positions names its frames, whose headers know the sky; moved frames are reported."""
    at_once, by_steps = Solution.read(whole.out), Solution.read(steps / "out")
    assert in_tables.sky_sentence(by_steps) == in_tables.sky_sentence(at_once)
    np.testing.assert_array_equal(by_steps.stars["ra"], at_once.stars["ra"])
    name = at_once.names[0]
    assert by_steps[name].wcs(100.0, 200.0) == at_once[name].wcs(100.0, 200.0)
    monkeypatch.chdir(tmp_path)
    shutil.copy(steps / "stars.ecsv", tmp_path)  # away from the frames
    assert main(["match", "stars.ecsv", "--out", "blind.ecsv", "--quiet"]) == 0
    assert "matched without the headers of its frames, so without their sky: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "files"),
    [
        pytest.param("keck-lists", "*.lis", marks=pytest.mark.slow),
        ("hst-lists", "*.xymq"),
        pytest.param("gwcs", "*.asdf", marks=pytest.mark.slow),
    ],
)
def test_example_files_are_read_and_stay_the_same(kind, files, tmp_path, capsys):
    assert main(["demo", "--as", kind, "--out", str(tmp_path / "a")]) == 0
    written = sorted(map(Path, capsys.readouterr().out.split()))
    assert written == sorted((tmp_path / "a").glob(files))
    assert main(["demo", "--as", kind, "--out", str(tmp_path / "b"), "--quiet"]) == 0
    if kind == "gwcs":
        exposures = open_exposures(written)
        assert {exposure.wcs.available_frames[1] for exposure in exposures} == {"v2v3"}
    else:
        assert [p.read_bytes() for p in written] == [(tmp_path / "b" / p.name).read_bytes() for p in written]
        lists = [str(path) for path in written]
        words = ["--shape", "1024", "1024", "--error", "0.05", "--out", str(tmp_path / "m.ecsv")]
        assert main(["match", *lists, *words]) == 0
    capsys.readouterr()
    failed(capsys, main(["demo", "--as", kind, "--out", str(tmp_path / "a")]), "exists already", "--overwrite")
    failed(capsys, main(["demo", "--as", kind, "--small", "--out", str(tmp_path / "c")]), "--small", "leave it out")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("run FRAMES --pixfrac 0.5 --out o", "--pixfrac is for --algorithm drizzle"),
        ("run FRAMES --kernel turbo --out o", "--kernel is for --algorithm drizzle"),
        ("run FRAMES --algorithm exact --order 1 --out o", "--order is for --algorithm interp"),
        ("run FRAMES --epoch 2014 --out o", "--epoch is for the catalogue of --reference"),
        ("match t.ecsv --camera gsaoi --shape 9 9 --out o.ecsv", "--shape comes from --camera"),
        ("attach s.asdf FRAMES --asdf-only --max-error 0.1 --out o", "--max-error is of the header"),
        ("predict --n-exposures 9 --n-stars 80 --sigma 0.02 --origin 1", "--origin is for the table of --stars"),
    ],
)
def test_options_that_others_leave_without_effect_are_refused(words, message, night, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = [word for each in words.split() for word in (map(str, night) if each == "FRAMES" else [each])]
    failed(capsys, main(line), message, ": leave it out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("measure FRAMES --psf moffat --write-psf p --out o.ecsv", "leave write_psf out, or give --psf effective"),
        ("measure FRAMES --profile shared --write-psf p --out o.ecsv", "leave write_psf out, or give --psf effective"),
        ("run FRAMES --layout fit --out o", "--layout fit is for exposures with several detectors"),
        ("run FRAMES --static hold --out o", "is for a static distortion that is known"),
        ("run FRAMES --exposure-degree 1 --out o", "belongs to --static fit"),
        ("run FRAMES --motion-sigma 1 --out o", "belong to --motion"),
        ("prior gsaoi-2 --frame tel --out o.asdf", "leave --frame out"),
        ("prior gsaoi-2 --ext 1 --out o.asdf", "leave --ext out"),
        ("prior gsaoi-2 --origin 1 --out o.asdf", "leave origin (--origin) out"),
        ("prior gsaoi-2 --direction reference_to_detector --out o.asdf", "leave direction (--direction) out"),
    ],
)
def test_options_that_do_not_apply_are_refused_before_a_star_is_measured(
    words, message, night, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delattr("legdistort.pipeline.measure_with_psfs")
    monkeypatch.delattr("legdistort.measurement.positions.measure_with_psfs")
    line = [word for each in words.split() for word in (map(str, night) if each == "FRAMES" else [each])]
    failed(capsys, main([*line, "--quiet"]), message)
    assert list(tmp_path.iterdir()) == []


def test_widths_go_with_the_prior_of_headers(night, tmp_path, monkeypatch):
    asked = {}

    def run(**arguments):
        asked.update(arguments)
        raise InputError("far enough")

    monkeypatch.setattr(legdistort, "run", run)
    words = ["--prior", "header", "--prior-sigma", "0.3", "--static-sigma", "0.1", "--quiet", "--out"]
    assert main(["run", *map(str, night), *words, str(tmp_path / "o")]) == 1
    assert (asked["prior"].sigma, asked["prior"].static_sigma) == (0.3, 0.1)


@pytest.mark.parametrize(
    ("terminal", "more", "shown"),
    [
        (True, [], True),
        pytest.param(True, ["--quiet"], False, marks=pytest.mark.sets),
        pytest.param(False, [], False, marks=pytest.mark.sets),
    ],
)
@pytest.mark.usefixtures("undrawn")
def test_writing_shows_a_bar_on_a_terminal(terminal, more, shown, demo, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    main(["solve", str(demo / "matched.ecsv"), "--out", str(tmp_path / "o"), *more])
    assert ("writing: 100%" in capsys.readouterr().err) == shown


def test_the_camera_of_plain_images_is_none(demo, tmp_path, capsys):
    out = tmp_path / "camera.asdf"
    line = ["camera", str(demo / "solution.asdf"), "--out", str(out)]
    failed(capsys, main(line), "images without a focal plane: legdistort nights", f"--out {out}")
    assert not out.exists()


def test_another_epoch_needs_motions(demo, tmp_path, capsys):
    solution, positions = demo / "solution.asdf", demo / "detections.ecsv"
    for line in (["stars", solution], ["correct", solution, positions]):
        words = [*map(str, line), "--epoch", "2014", "--out", str(tmp_path / "o.ecsv")]
        failed(capsys, main(words), "the motions of the stars were not fitted", "--motion proper")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    ["report s.asdf --out x.pdf", "measure FRAMES --out x.fits", "prior gsaoi-2 --out x", "match t --out x.doc"],
)
def test_a_file_of_another_type_is_refused(words, night, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line = [word for each in words.split() for word in (map(str, night) if each == "FRAMES" else [each])]
    failed(capsys, main(line), "the ending selects the format, give .")


def test_outputs_are_tried_and_not_only_permitted(night, tmp_path, capsys, monkeypatch):
    """A disk that takes no renames, though permissions say that it does."""

    def refuse(*_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("legdistort.runtime.outputs.os.replace", refuse)
    monkeypatch.setattr(legdistort, "measure", None)  # that no work is begun
    words = ["measure", *map(str, night), "--out", str(tmp_path / "s.ecsv")]
    failed(capsys, main(words), "s.ecsv cannot be written: Read-only file system; write elsewhere")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("python", "shell"),
    [
        ("use overwrite=True (--overwrite)", "use --overwrite"),
        ("a catalogue (reference=, --reference)", "a catalogue (--reference)"),
        ("errors='floor' finds the error floor", "--errors floor finds the error floor"),
        ("min_exposures=4 of them", "--min-exposures 4 of them"),
        ("give min_exposures=6 (--min-exposures) or less", "give --min-exposures 6 or less"),
        ("by their name (ext='SCI', --ext SCI), or", "by their name (--ext SCI), or"),
        ("ext=('SCI', 1) (--ext SCI,1)", "--ext SCI,1"),
        ("give shape=(ny, nx) or exposures= (--shape NY NX)", "give --shape NY NX"),
        ("give one, read_table(error=...) or --error PIXELS", "give one, --error PIXELS"),
        ("call match(table) (legdistort match) first", "call legdistort match first"),
        ("lower it, measuring={'threshold': 3} (--threshold 3)", "lower it, --threshold 3"),
        ("columns={'star': ...} or --columns star=...", "--columns star=..."),
        ("must be one of 'linear', 'huber', got 'x'", "must be one of linear, huber, got x"),
        ("it's the star's own", "it's the star's own"),
    ],
)
def test_messages_in_the_shell_have_no_words_of_python(python, shell):
    assert in_shell_words(python) == shell


@pytest.mark.parametrize(
    "flags", [["match", "{}", "--shape", "9", "9"], ["match", "a.ecsv", "--wcs", "{}"], ["solve", "{}"]]
)
def test_all_files_that_are_missing_are_named_before_any_is_read(tmp_path, capsys, monkeypatch, flags):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.ecsv").write_text("not read")
    given = [each for flag in flags for each in (["a.ecsv", "b.ecsv", "c.ecsv"] if flag == "{}" else [flag])]
    assert main([*given, "--out", "out.ecsv"]) == 1
    assert capsys.readouterr().err == (
        f"legdistort: 2 of 3 files are not there (b.ecsv, c.ecsv, looked for from {tmp_path}): correct their names, or "
        "leave them out\n"
    )


def test_show_names_the_detector_of_what_it_prints(tmp_path, capsys):
    planes = [fits.ImageHDU(np.random.default_rng(k).normal(9, 1, (20, 20)), name="SCI", ver=k) for k in (1, 2)]
    for k, plane in enumerate(planes, start=1):
        plane.header["GAIN"] = float(k)
    fits.HDUList([fits.PrimaryHDU(), *planes]).writeto(tmp_path / "a.fits")
    assert main(["show", str(tmp_path / "a.fits"), "--ext", "SCI"]) == 0
    parts = capsys.readouterr().out.split("\n\n")
    assert [part.splitlines()[0] for part in parts] == ["a-1", "a-2"]
    assert ["GAIN of the image" in part for part in parts] == [True, True]
    assert main(["show", str(tmp_path / "a.fits"), "--ext", "SCI,1"]) == 0
    assert capsys.readouterr().out.startswith("quantity")


@pytest.mark.slow
def test_what_is_said_of_every_image_is_said_of_all(night, demo, tmp_path, capsys, monkeypatch):
    """Of more than a few images a line or two, unless each is asked for."""
    monkeypatch.setattr("legdistort.cli.arguments._MOST_LINES", 2)
    table = str(tmp_path / "d.ecsv")
    measure = ["measure", *map(str, night[:2]), "--psf", "moffat", "--workers", "1", "--out", table, "--overwrite"]
    assert main(measure) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "FWHM" in line]
    counts = np.unique(Table.read(table)["exposure"], return_counts=True)[1]
    assert line.startswith(f"2 images measured: {counts.min()} to {counts.max()} detections, FWHM ")
    assert main([*measure, "--verbose"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "FWHM" in line]
    assert sum(line.startswith(tuple(f"{path.stem}: " for path in night)) for line in lines) == 2
    frames = sorted((demo / "frames").glob("*.fits"))
    attach = ["attach", str(demo / "solution.asdf"), *map(str, frames), "--quiet", "--out", str(tmp_path / "with")]
    capsys.readouterr()
    assert main(attach) == 0
    first, worst = capsys.readouterr().out.splitlines()
    assert first == f"{len(frames)} images, the least exact of them (--verbose lists all):"
    assert main([*attach, "--overwrite", "--verbose"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(frames)
    errors = [float(re.search(r"SIP within (\S+) px", line)[1]) for line in lines]
    assert lines[int(np.argmax(errors))] == worst
