"""A run that goes on from an earlier one has the options of that, but for those that are given."""

import argparse
import json
import shutil
from pathlib import Path

import pytest

import legdistort
from legdistort import Solution
from legdistort.cli import options, parser, repeating
from legdistort.cli.arguments import flagged
from legdistort.cli.parser import main
from legdistort.exceptions import InputError
from legdistort.simulation.observations import simulate_exposures

pytestmark = [pytest.mark.filterwarnings("ignore::legdistort.LegdistortWarning"), pytest.mark.usefixtures("undrawn")]

GROUPS = (options.MATCHING, options.SOLVING, options.COADDING, options.LAST_STEP, options.COMPARING)
FLAGS = {flag: option for _, flag, _, option in flagged(GROUPS) if flag != "--scratch"}
#: Texts of options without a list of words; a number does for all others.
TEXTS = {
    "--prior": "gsaoi-1", "--layout-sigma": "shift=1.5,rotation=1e-05", "--pose-sigma": "shift=0.0", "--planes": "none",
    "--clip": "0", "--term": "refraction,pixel_phase",
}  # fmt: skip


def earlier(folder, *words):
    """The summary that a run with some options leaves in ``first``."""
    (folder / "first").mkdir(exist_ok=True)
    parsed = parser._parsed(["run", "a.fits", "--out", str(folder / "first"), *words])
    (folder / "first" / "summary.json").write_text(json.dumps({"options": repeating.repeatable(parsed)}))


def going_on(folder, *words):
    argv = ["run", "--from", str(folder / "first"), "--out", str(folder / "second"), *words]
    parsed = parser._parsed(argv)
    parsed.begun, parsed.argv = 0.0, argv
    return repeating.with_earlier(parsed)


@pytest.mark.parametrize("flag", FLAGS)
def test_every_option_holds_again(flag, tmp_path):
    """But those of the machine; and it gives way to another value, or is left out."""
    option = FLAGS[flag]
    alone = option.settings.get("action", "extend") != "extend"
    *_, text = option.settings.get("choices", [TEXTS.get(flag, "2")])
    words = [flag] if alone else [flag, str(text)]
    plain, asked = (parser._parsed(["run", "a.fits", "--out", "o", *more]) for more in ([], words))
    (dest,) = (dest for _, each, dest, _ in flagged(GROUPS) if each == flag)
    assert getattr(asked, dest) != getattr(plain, dest)
    earlier(tmp_path, *words)
    assert getattr(going_on(tmp_path), dest) == getattr(asked, dest)
    for name in (flag.strip("-"), flag.strip("-").replace("-", "_"), "all"):
        assert getattr(going_on(tmp_path, "--forget", name), dest) == getattr(plain, dest)
    if flag == "--degree":
        assert going_on(tmp_path, flag, "3").degree == 3
        assert going_on(tmp_path, f"{flag}=3").degree == 3


def test_files_are_found_when_all_is_moved(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("night").mkdir()
    Path("night/prior.asdf").write_text("")
    earlier(tmp_path / "night", "--prior", "night/prior.asdf")
    shutil.move("night", "moved")
    assert Path(going_on(tmp_path / "moved").prior).samefile("moved/prior.asdf")


@pytest.mark.parametrize("content", ["", "[]", '{"options": 3}', '{"n_stars": 3}', "[" * 100_000])
def test_options_that_are_not_known(content, tmp_path, caplog):
    earlier(tmp_path)
    (tmp_path / "first" / "summary.json").write_text(content)
    with caplog.at_level("INFO"):
        assert going_on(tmp_path).degree is None
    assert "first are not known: what is not given here is as by default" in caplog.text


def test_other_entries_of_a_summary_are_no_options(tmp_path):
    kept = {"--degree": "2", "--out": "elsewhere", "--scratch": "elsewhere", "--overwrite": None, "--clip": [3]}
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / "summary.json").write_text(json.dumps({"options": kept}))
    assert going_on(tmp_path).repeated == ["--degree"]


@pytest.mark.parametrize(("flag", "text"), [("--reference", "gaia"), ("--prior", "siaf:NIRCAM:NRCA1_FULL")])
def test_a_file_asks_no_server(flag, text, tmp_path):
    earlier(tmp_path, flag, text)
    with pytest.raises(InputError, match=rf"{flag} {text} of \S*first asks a server: give it again, or leave it out"):
        going_on(tmp_path)
    assert getattr(going_on(tmp_path, flag, text), flag[2:]) == text
    assert getattr(going_on(tmp_path, "--forget", flag[2:]), flag[2:]) is None
    asked = parser._parsed(["run", "a.fits", "--out", "my out", flag, text, "--degree", "2", "--overwrite"])
    assert repeating.again(asked) == f"legdistort run --out 'my out' {flag} {text} --overwrite"


@pytest.mark.slow
def test_a_run_goes_on_with_what_it_was_told(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    simulate_exposures(small=True, n_exposures=4, n_stars=40, seed=1).write("frames")
    first = ["--degree", "1", "--clip", "7", "--no-mosaic", "--gain", "2", "--psf", "moffat"]
    assert main(["run", "frames/*.fits", "--out", "first", *first]) == 0
    catalogued = {}
    monkeypatch.setattr("legdistort.photometry.catalogue.catalogue", lambda *_, **told: catalogued.update(told))
    capsys.readouterr()
    assert main(["run", "--from", "first", "--clip", "0", "--catalogue", "joint", "--out", "other"]) == 0
    monkeypatch.undo()
    assert (catalogued["gain"], catalogued["psf"]) == (2, "moffat")  # what measuring was told holds for both
    monkeypatch.chdir(tmp_path)
    assert main(["run", "--from", "first", "--errors", "floor", "--out", "second"]) == 0
    told = capsys.readouterr().err
    repeated = "repeated from first: --degree 1 --clip 7.0 --no-mosaic (--forget NAME,... leaves them out)"
    assert told.count(repeated) == 1
    settings = Solution.read("second").settings
    assert (settings.degree, settings.clip, settings.errors) == (1, 7.0, "floor")
    assert not Path("second/mosaic.fits").exists()
    assert main(["run", "--from", "second", "--error-floor", "0.1", "--out", "third"]) == 1
    assert "leave error_floor out; --forget errors leaves out what is repeated from second" in capsys.readouterr().err
    assert (
        legdistort.run(earlier="second", out="third", mosaic=False).solution.settings.degree == 3
    )  # Python states all
    assert main(["run", "--from", "first", "--without", "exp9*", "--out", "fourth"]) == 1
    assert "--without exp9* is none of the exposures: exp00, exp01, exp02, exp03" in capsys.readouterr().err
    assert main(["run", "--from", "first", "--without", "exp01", "--min-exposures", "3", "--out", "fourth"]) == 0
    solution = Solution.read("fourth")
    assert solution.names == ("exp00", "exp02", "exp03")
    assert solution.left_out == {"exp01": "as asked (--without)"}
    assert main(["run", "--from", "fourth", "--out", "fifth"]) == 0  # of the frames that are left
    assert Solution.read("fifth").names == solution.names


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--from", "first", "--forget", "clip"], "--forget clip is none of the options of first, which are degree"),
        (["--from", "first", "--forget", "camera"], "frames as they were measured: run them anew without it"),
        (["a.fits", "--forget", "clip"], "--forget is for options of the run of --from: leave it out"),
        (["a.fits", "--no-mosaic", "--combine", "median"], "--combine is for a mosaic, and --no-mosaic wants none"),
    ],
)
def test_what_is_not_there_is_not_forgotten(words, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.fits").write_text("")
    earlier(tmp_path, "--degree", "2")
    assert main(["run", *words, "--out", "second"]) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("folder", "message", "hint"),
    [
        ("static", "an earlier run static has no positions", ""),
        ("static", "exposure_degree needs --static fit", "; --forget static leaves out what is repeated from static"),
        ("t", "exposure_degree needs --static fit", "; --forget static leaves out what is repeated from t"),
    ],
)
def test_a_folder_with_the_name_of_an_option_is_not_it(folder, message, hint):
    arguments = argparse.Namespace(repeated=["--static"], **{"from": folder})
    assert repeating.how_to_forget(message, arguments) == hint
