"""What a command line names: exposures to leave out, files that hold no solution."""

import json
import re

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from night_sets import SIZE, Nights
from scamp_heads import barrel, matrix, write_head

import legdistort as ld
from legdistort.cli import main
from legdistort.cli.given_files import given_camera


@pytest.fixture
def table(tmp_path):
    sim = ld.simulate_matches(n_exposures=6, n_stars=40, degree=2, sigma=0.02, dither=100.0)
    sim.matches.table.write(tmp_path / "m.ecsv")
    return tmp_path / "m.ecsv"


def test_exposures_may_be_left_out_by_name(table, tmp_path, capsys):
    line = ["solve", str(table), "--shape", "2048", "2048", "--degree", "2", "--quiet", "--json", "--out"]
    assert main([*line, str(tmp_path / "r"), "--without", "exp00", "exp*4"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert set(summary["left_out"]) == {"exp00", "exp04"}
    check = next(each for each in summary["checks"] if each["name"] == "rejection")
    assert check["state"] == "pass"  # nothing is odd about what was asked for
    assert "2 exposures were left out: exp00, exp04: as asked (--without)" in check["sentence"]
    assert main([*line, str(tmp_path / "s"), "--without", "night*"]) == 1
    assert "--without night* is none of the exposures: exp00, exp01" in capsys.readouterr().err


@pytest.mark.slow
def test_an_odd_night_is_a_failure_which_its_name_cures(tmp_path, capsys):
    table = Nights(5, per=2, odd=0.5, roll=0.7, n_stars=120).table
    del table["block"]
    table.write(tmp_path / "m.ecsv")
    line = ["solve", str(tmp_path / "m.ecsv"), "--shape", str(SIZE), str(SIZE), "--quiet", "--strict", "--out"]
    assert main([*line, str(tmp_path / "all")]) == 3
    cure = re.search(r"solve\s+(--without\s+\S+)\s+leaves it out", capsys.readouterr().out)[1]
    named = "Night 2017-12-11 (n4e0, n4e1) departs"
    methods = [
        re.search('<p class="methods">(.*?)</p>', (tmp_path / name / "report.html").read_text(), re.DOTALL)[1]
        for name in ("all", "without")
        if name == "all" or main([*line, str(tmp_path / name), *cure.split()]) == 0
    ]
    assert named in methods[0]
    assert json.loads((tmp_path / "all" / "summary.json").read_text())["angles"] is None
    assert named not in methods[1]
    assert "Left out: n4e0, n4e1: as asked (--without)." in methods[1]
    assert main([*line, str(tmp_path / "more"), "--without", "2017-12-12"]) == 1
    assert "none of the nights: 2014-05-27, " in capsys.readouterr().err


@pytest.mark.slow
def test_a_stated_pixel_scale_gives_figures_in_mas(tmp_path, capsys):
    table = Nights(5, nights=3, per=2, roll=0.7, n_stars=100, motion=0.05).table
    table.write(tmp_path / "m.ecsv")
    line = [
        "solve",
        str(tmp_path / "m.ecsv"),
        "--shape",
        str(SIZE),
        str(SIZE),
        "--motion",
        "proper",
        "--quiet",
        "--out",
    ]
    assert main([*line, str(tmp_path / "angles"), "--pixel-scale", "0.01"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "angles" / "summary.json").read_text())["angles"]
    solution = ld.Solution.read(tmp_path / "angles")
    used = solution.residuals[solution.residuals["used"]]
    stars, offsets = solution.stars, np.concatenate([used["dx"].value, used["dy"].value])
    median = {name: 10 * np.nanmedian([stars[c].value for c in columns]) for name, columns in {
        "error_mas": ("x_err", "y_err"), "error_abs_mas": ("x_err_abs", "y_err_abs"),
        "motion_error_mas_yr": ("vx_err", "vy_err"), "motion_error_abs_mas_yr": ("vx_err_abs", "vy_err_abs"),
    }.items()}  # fmt: skip
    expected = median | {"pixel_scale_arcsec": 0.01, "rms_mas": 10 * np.sqrt(np.mean(offsets**2))}
    assert found == {name: pytest.approx(value) for name, value in expected.items()}
    words = f"at 0.01 arcsec a pixel: residuals {found['rms_mas']:.3g} mas rms per axis"
    assert f"angles {words}" in printed
    assert words in (tmp_path / "angles" / "report.html").read_text()


def test_a_solution_is_the_camera_that_it_found(tmp_path):
    """In its folder, or by its file; the next solution begins with it."""
    sim = ld.simulate_matches(n_exposures=4, n_stars=40, degree=2, sigma=0.02, dither=100.0)
    solution = ld.solve(sim.matches, degree=2)
    (tmp_path / "results").mkdir()
    solution.write(tmp_path / "results" / "solution.asdf")
    for given in ("results", "results/solution.asdf"):
        camera = given_camera(str(tmp_path / given))
        assert camera.detectors.keys() == solution.camera.detectors.keys()
        for key, each in camera.detectors.items():
            np.testing.assert_array_equal(each.static, solution.camera[key].static)
            np.testing.assert_array_equal(each.layout, solution.camera[key].layout)
    assert given_camera(None) is None
    assert given_camera("gsaoi").name == "GSAOI"


def test_cameras_and_priors_are_shown(tmp_path, capsys):
    prior = ld.Prior(np.full((2, 3), 0.25), static_sigma=[0.1, 0.1, np.inf], shape=(512, 512))
    prior.write(tmp_path / "prior.asdf")
    ld.Camera.gsaoi().write(tmp_path / "camera.asdf")
    for name, words in (
        ("prior", "coefficient static_sigma"),
        ("camera", "Camera GSAOI: 4 detectors in a focal plane"),
    ):
        assert main(["show", str(tmp_path / f"{name}.asdf")]) == 0
        assert words in capsys.readouterr().out
    assert main(["show", "--json", str(tmp_path / "prior.asdf")]) == 0
    modes = json.loads(capsys.readouterr().out)["modes"]
    assert [row["static_sigma"] for row in modes] == [0.1, None, 0.1, None]
    assert main(["show", "--json", str(tmp_path / "camera.asdf")]) == 0
    assert [each["id"] for each in json.loads(capsys.readouterr().out)["detectors"]] == ["1", "2", "3", "4"]
    assert main(["show", str(tmp_path / "camera.asdf"), "--strict"]) == 1
    assert "--strict is for a solution: leave it out" in capsys.readouterr().err


@pytest.mark.slow
def test_the_shape_of_a_header_comes_from_what_it_is_used_with(table, tmp_path, capsys):
    """A text states none: the table of matches does, and the solution that it is compared with."""
    head = write_head(tmp_path / "a.head", barrel(120), cd=matrix(scale=0.01 / 3600), crpix=(1024.5, 1024.5))
    matched = QTable.read(table)
    matched.meta["shapes"] = {name: [2048, 2048] for name in set(matched["exposure"].tolist())}
    matched.write(tmp_path / "stated.ecsv")
    out = str(tmp_path / "out")
    line = ["solve", str(tmp_path / "stated.ecsv"), "--degree", "2", "--quiet", "--prior", str(head), "--out"]
    assert main([*line, out]) == 0
    prior = ld.Solution.read(out).settings.prior
    assert prior["shape"] == [2048, 2048]
    assert prior["truncation_px"] == ld.Prior.from_file(head, shape=(2048, 2048)).truncation
    assert main(["difference", str(head), out]) in (0, 3)
    capsys.readouterr()
    for words in (["difference", str(head), str(head)], ["run", str(table), "--prior", str(head)]):
        assert main([*words, *["--out", str(tmp_path / "r")] * (words[0] == "run")]) == 1
        told = capsys.readouterr().err
        assert "give --shape NY NX; legdistort prior has that option, and what it writes can be given here" in told
    assert main(["predict", "--prior", str(head), "--n-exposures", "4", "--n-stars", "30", "--sigma", "0.02"]) == 1
    assert capsys.readouterr().err.endswith("give --shape NY NX\n")


@pytest.fixture
def mosaic(tmp_path):
    """A frame of two detectors of 60 x 50 pixels, and the text of other headers, as SCAMP writes it."""
    frame, blocks = [fits.PrimaryHDU()], []
    for k in (1, 2):
        cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 150.0, "CRVAL2": 2.0, "CRPIX1": 130.0 - 65 * k,
                 "CRPIX2": 25.0, "CD1_1": -1e-4, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-4}  # fmt: skip
        frame.append(fits.ImageHDU(np.random.default_rng(k).normal(size=(50, 60)), name=f"CCD{k}"))
        frame[-1].header.update(cards | {"CCDNAME": f"ccd-{k}"})
        scaled = fits.Header((cards | {"CD1_1": -1.01e-4, "CD2_2": 1.01e-4, "CRPIX1": 130.0 - 75 * k}).items())
        blocks.append("\n".join([*map(str, scaled.cards), "END     "]))
    fits.HDUList(frame).writeto(tmp_path / "m.fits")
    (tmp_path / "m.head").write_text("\n".join(blocks) + "\n")
    return tmp_path / "m.fits", tmp_path / "m.head"


def test_a_camera_by_the_headers_of_a_frame(mosaic, tmp_path, capsys):
    frame, text = map(str, mosaic)
    far = {}
    for out, more in (("own", []), ("scamp", ["--headers", text])):
        assert main(["camera", frame, *more, "--out", str(tmp_path / f"{out}.asdf")]) == 0
        camera = ld.Camera.read(tmp_path / f"{out}.asdf")
        assert list(camera.detectors) == ["CCD1", "CCD2"]
        far[out] = abs(np.diff([camera[key].layout[0, 2] for key in camera.detectors])[0])
    assert far == pytest.approx({"own": 65.0, "scamp": 75.0}, abs=1e-3)
    assert main(["prior", text, "--shape", "50", "60", "--out", str(tmp_path / "p.asdf")]) == 1
    assert f"legdistort camera FRAME --headers {text} --out camera.asdf takes all" in capsys.readouterr().err
    assert main(["camera", frame, "--ext", "CCD1", "--headers", text, "--out", str(tmp_path / "o.asdf")]) == 1
    assert "m.head has 2 headers" in capsys.readouterr().err
    assert main(["camera", frame, "--ext", "CCD1", "--out", str(tmp_path / "o.asdf")]) == 1
    assert "has one image: legdistort prior" in capsys.readouterr().err
