"""`run`: what it is given is looked at before a frame is read."""

import pytest

from legdistort import pipeline
from legdistort.cli.parser import main
from legdistort.exceptions import InputError

KINDS = {
    "measuring": ({"threshold": 1}, "threshold must be a number of at least 2"),
    "matching": ({"tolerance": -1}, "tolerance must be a positive number of pixels"),
    "solving": ({"gauge": "maximal"}, "gauge must be one of 'minimal', got 'maximal'"),
    "coadding": ({"order": 9}, "order must be an integer from 0 to 5"),
}


@pytest.fixture(autouse=True)
def _unread(monkeypatch):
    for place in ("legdistort", "legdistort.inputs.exposure_files"):
        monkeypatch.setattr(f"{place}.open_exposures", lambda *_, **__: pytest.fail("a frame was read"))


@pytest.mark.parametrize("argument", KINDS)
def test_options_are_refused_before_a_frame_is_read(argument, tmp_path):
    bad, words = KINDS[argument]
    with pytest.raises(InputError, match=f"^{argument}: {words}"):
        pipeline.run("a.fits", out=tmp_path / "out", **{argument: bad})
    with pytest.raises(InputError, match=f"^{argument} has no option 'typo'; it takes .*{next(iter(bad))}"):
        pipeline.run("a.fits", out=tmp_path / "out", **{argument: {"typo": 1}})
    with pytest.raises(InputError, match=f"^{argument} must be a dict of options, got list"):
        pipeline.run("a.fits", out=tmp_path / "out", **{argument: []})
    with pytest.raises(pytest.fail.Exception, match="a frame was read"):
        pipeline.run("a.fits", out=tmp_path / "out", **{argument: {}})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("argument", "name"),
    [("matching", "min_exposures"), ("solving", "degree"), ("solving", "prior"), ("solving", "clip")],
)
def test_what_run_takes_itself_does_not_stand_in_a_dict(argument, name, tmp_path):
    with pytest.raises(InputError, match=f"{argument} has the option '{name}': give it as the argument {name} of run"):
        pipeline.run("a.fits", out=tmp_path, **{argument: {name: 3}})


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"degree": -1}, "^degree must be"),
        ({"min_exposures": 1}, "^min_exposures must be"),
        ({"clip": 0.5}, "^clip must be"),
        ({"workers": 0}, "^workers must be"),
        ({"epoch": "soon"}, "epoch"),
        (
            {"clip": 5.0, "solving": {"method": "alternating"}},
            "^solving: method='alternating' is that of the published method",
        ),
        ({"solving": {"static": "fit"}, "degree": 1}, "^solving: static='fit' shares the modes"),
    ],
)
def test_other_arguments_are_refused_before_a_frame_is_read(bad, words, tmp_path):
    with pytest.raises(InputError, match=words):
        pipeline.run("a.fits", out=tmp_path, **bad)


@pytest.mark.parametrize("out", [None, 3])
def test_a_folder_for_the_results_is_needed(out):
    with pytest.raises(InputError, match=f"out must be a path, that of the folder for the results, got {out}"):
        pipeline.run("a.fits", out=out)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("run --threshold 1", "measuring: threshold must be a number of at least 2"),
        ("run --isolation -1", "matching: isolation must be"),
        ("run --error-floor -1", "solving: error_floor must"),
        ("run --pixfrac 2 --algorithm drizzle", "coadding: pixfrac must"),
        ("run --degree 99", "degree must be"),
        ("run --no-mosaic --order 1", "--order is for a mosaic, and --no-mosaic wants none: leave it out"),
        ("run --min-exposures 1", "min_exposures must be"),
        ("run --pixel-scale -1", "pixel_scale must be a positive number"),
        ("run --workers 0", "workers must be"),
        ("measure --fwhm 0", "fwhm must be a number between"),
        ("measure --workers 0", "workers must be"),
        ("noise --gain -1", "gain must be a positive number"),
        ("noise --fluxes -1", "fluxes must be positive numbers"),
        ("noise --n-positions 1", "n_positions must be an integer"),
    ],
)
def test_the_command_line_refuses_options_before_a_frame_is_read(line, words, tmp_path, capsys):
    command, *more = line.split()
    out = tmp_path / ("out" if command == "run" else "out.ecsv")
    assert main([command, "a.fits", "--out", str(out), *more]) == 1
    assert f"legdistort: {words}" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
