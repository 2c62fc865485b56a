"""The command line on a small simulated night: what it leaves, and what it says of bad input."""

import json
import os
import signal
import tempfile

import asdf
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from legdistort import Solution, coaddition
from legdistort.cli import main
from legdistort.simulation import simulate_exposures

RESULTS = {"solution.asdf", "stars.ecsv", "wcs", "mosaic.fits", "report.html", "summary.json"}


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    folder = tmp_path_factory.mktemp("night")
    return simulate_exposures(small=True, seed=3).write(folder)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The small demonstration, run once: its folder and what it printed with --json."""
    out = tmp_path_factory.mktemp("demo") / "out"
    assert main(["demo", "--small", "--out", str(out), "--quiet"]) == 0
    return out


def run(frames, out, *more):
    return main(["run", *map(str, frames), "--out", str(out), "--degree", "1", "--quiet", *more])


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


def test_files_agree_with_the_solution(demo):
    solution = Solution.read(demo / "solution.asdf")
    stars = Table.read(demo / "stars.ecsv")
    assert np.array_equal(stars["x"], solution.stars["x"].value)
    assert "ra" in stars.colnames
    name = solution.names[0]
    with asdf.open(demo / "wcs" / f"{name}.asdf") as file:
        ra, dec = file["meta"]["wcs"](100.0, 200.0)
    sky = solution.wcs(name)(100.0, 200.0)
    assert (ra, dec) == pytest.approx(sky, abs=1e-12)
    with fits.open(demo / "mosaic.fits") as hdulist:
        assert [hdu.name for hdu in hdulist] == ["SCI", "VAR", "WEIGHT", "FOOTPRINT", "FLAGS", "CONTEXT"]


def test_json_is_alone_on_stdout(night, tmp_path, capsys):
    assert run(night, tmp_path / "out", "--json") == 0
    assert json.loads(capsys.readouterr().out)["n_exposures"] == 6


def test_steps_one_by_one(night, tmp_path, capsys):
    frames = [str(path) for path in night]
    steps = (
        ["measure", *frames, "--out", str(tmp_path / "stars.ecsv")],
        ["match", str(tmp_path / "stars.ecsv"), "--out", str(tmp_path / "matched.ecsv")],
        ["solve", str(tmp_path / "matched.ecsv"), "--degree", "1", "--clip", "5", "--out", str(tmp_path / "out")],
        ["coadd", *frames, "--solution", str(tmp_path / "out/solution.asdf"), "--out", str(tmp_path / "m.fits")],
        ["show", str(tmp_path / "out" / "solution.asdf")],
        ["report", str(tmp_path / "out" / "solution.asdf"), "--out", str(tmp_path / "r.html")],
    )
    for step in steps:
        assert main([*step, "--quiet"]) == 0, step
    out = capsys.readouterr().out
    assert "6 exposures" in out
    assert "exp05" in out
    assert (tmp_path / "m.fits").exists()
    assert (tmp_path / "r.html").exists()


def test_simulate_writes_frames_and_truth(tmp_path, capsys):
    assert main(["simulate", "--small", "--out", str(tmp_path / "n"), "--quiet"]) == 0
    assert len(list((tmp_path / "n").glob("*.fits"))) == 6
    assert (tmp_path / "n" / "truth.ecsv").exists()
    failed(
        capsys, main(["simulate", "--small", "--out", str(tmp_path / "n"), "--quiet"]), "already holds", "--overwrite"
    )


def test_noise_frame_is_left_out_by_name(night, tmp_path, capsys):
    noise = fits.PrimaryHDU(np.random.default_rng(0).normal(400, 12, (512, 512)).astype("float32"))
    noise.header["GAIN"], noise.header["RDNOISE"] = 2.0, 15.0
    noise.writeto(tmp_path / "empty.fits")
    assert run([*night, tmp_path / "empty.fits"], tmp_path / "out", "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["n_exposures"] == 6
    assert list(summary["left_out"]) == ["empty"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_leaves_nothing(night, tmp_path, capsys, monkeypatch, number):
    """By Ctrl-C, or by a batch system."""
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "scratch"))
    monkeypatch.setattr(coaddition, "survey", lambda *args, **options: os.kill(os.getpid(), number))
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.getsignal(signal.SIGTERM)
    try:
        assert run(night, tmp_path / "out") == 1
    finally:
        signal.signal(signal.SIGINT, before[0])
    assert signal.getsignal(signal.SIGTERM) == before[1]
    assert "interrupted; nothing was left half-written" in capsys.readouterr().err
    assert [p.name for p in tmp_path.rglob("*")] == ["scratch"]


def test_existing_run_is_kept(night, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "solution.asdf").write_text("precious")
    failed(capsys, run(night, out), str(out), "--overwrite")
    assert (out / "solution.asdf").read_text() == "precious"
    assert run(night, out, "--overwrite") == 0
    assert Solution.read(out / "solution.asdf").degree == 1


def _not_fits(path, night):
    path.write_text("not an image")
    return [*night[1:], path]


def _truncated(path, night):
    path.write_bytes(night[0].read_bytes()[:100_000])
    return [*night[1:], path]


def _other_shape(path, night):
    fits.PrimaryHDU(np.zeros((300, 512), dtype="float32")).writeto(path)
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
    failed(capsys, run(frames, tmp_path / "out"), *words)
    assert [item.name for item in tmp_path.iterdir()] == ["bad.fits"]


def test_missing_frame(tmp_path, capsys):
    failed(capsys, run([tmp_path / "absent.fits"], tmp_path / "out"), "absent.fits")


def test_one_exposure_only(night, tmp_path, capsys):
    failed(capsys, run(night[:1], tmp_path / "out"), "only one exposure", night[0].stem)


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


def _alone(table):
    table.remove_rows(table["exposure"] != "e0")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (_nan, ["x_err is not a positive finite number", "row 7", "exposure e0, star 7"]),
        (_negative, ["y_err is not a positive finite number", "row 7"]),
        (_twice, ["star 3 stands twice in exposure e0"]),
        (_alone, ["only one exposure (e0)"]),
    ],
)
def test_bad_tables_are_named(tmp_path, capsys, spoil, words):
    table = _table()
    spoil(table)
    table.write(tmp_path / "t.ecsv")
    arguments = ["solve", str(tmp_path / "t.ecsv"), "--shape", "512", "512", "--out", str(tmp_path / "out")]
    failed(capsys, main(arguments), *words)
    assert not (tmp_path / "out").exists()


def test_two_groups_are_named(tmp_path, capsys):
    _table(groups=2).write(tmp_path / "t.ecsv")
    arguments = ["solve", str(tmp_path / "t.ecsv"), "--shape", "512", "512", "--out", str(tmp_path / "out")]
    failed(capsys, main(arguments), "2 groups with no star in common", "e0, e2", "e1, e3")


def test_missing_column_tells_how_to_map_it(tmp_path, capsys):
    table = _table()
    table.rename_column("star", "id")
    table.write(tmp_path / "t.ecsv")
    arguments = ["solve", str(tmp_path / "t.ecsv"), "--shape", "512", "512", "--out", str(tmp_path / "out")]
    failed(capsys, main(arguments), "lacks the column star", "--columns star=")


def test_wrong_usage_exits_with_2(capsys):
    with pytest.raises(SystemExit) as end:
        main(["run", "a.fits"])
    assert end.value.code == 2
    with pytest.raises(SystemExit) as end:
        main(["solve", "t.ecsv", "--out", "o", "--columns", "star"])
    assert end.value.code == 2
    capsys.readouterr()


@pytest.mark.parametrize("command", ["demo", "run", "measure", "match", "solve", "coadd", "simulate", "show", "report"])
def test_help_has_an_example(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"])
    assert end.value.code == 0
    assert f"Example: legdistort {command}" in capsys.readouterr().out


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
    assert len(solution.star_names) >= 70
    assert 0.95 < np.mean(rows["used"]) < 1
    used = rows[rows["used"]]
    for axis in "xy":
        weight = 1 / (used[f"{axis}_err"].value ** 2 + 0.1**2)
        assert np.sqrt(np.average(used[f"d{axis}"].value ** 2, weights=weight)) <= 0.22


def test_microobservatory_frames(shared_data, tmp_path, capsys):
    """Twelve raw, undersampled frames without a WCS, with hot pixels and a drift of 273 px."""
    frames = sorted((shared_data / "microobs_hatp32" / "frames").glob("*.fits.gz"))
    assert main(["run", *map(str, frames), "--out", str(tmp_path / "out"), "--degree", "2", "--json", "--quiet"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["n_exposures"] == 12
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
