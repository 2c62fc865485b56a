"""Files and folders may have any name: what is written lies there and nowhere else, and is read from there."""

from io import BytesIO
from pathlib import Path

import asdf
import matplotlib.font_manager  # noqa: F401  (its list of fonts is kept at home)
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS

import legdistort as ld
from legdistort import pipeline
from legdistort.cli.parser import main
from legdistort.coaddition.grids import read_grid
from legdistort.coaddition.mosaic import Mosaic
from legdistort.exceptions import InputError
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.references.catalogue import read_reference
from legdistort.inputs.table_files import read_table, write_stars
from legdistort.measurement.noise_curves import NoiseCurves
from legdistort.priors.prior import Prior
from legdistort.reporting.page import write_report
from legdistort.results.solution import Solution
from legdistort.runtime import asdf_files, outputs
from legdistort.simulation.observations import SimulatedExposures, simulate_exposures, simulate_matches
from legdistort.solving.estimation import solve
from legdistort.wcs.attachment import attach
from legdistort.wcs.storage import read_wcs, write_wcs

#: Parts of URLs, of patterns, of home folders, of options, of formulae.
FOLDERS = ["A#1", "A?x=1", "A;b", "D%41", "a Ä", "-x", "new\nline", "~x", "~", "http:", "file:", "A[1]*", "$A&b"]
#: Those that each other program has its own trouble with; by default these alone, and two more with the slow tests.
WORST = {"A#1", "D%41", "new\nline", "~", "http:", "A[1]*"}
SLOW = {"A?x=1", "-x"}
#: Exposures named after files; and so their WCS files and copies.
NAMES = ("A#1", "A?x=1;b", "D%41", "-ä ~b", "~$_$", "http:")
SHAPE = (40, 50)
COLUMNS = ("exposure", "flux", "n", "found", "fwhm", *(f"{axis}_{what}" for axis in "xy" for what in ("rms", "sigma",
           "bias", "err", "ratio")))  # fmt: skip


@pytest.fixture(scope="module")
def solution():
    """A solved set whose exposures have these names."""
    found = simulate_matches(
        n_stars=12, n_exposures=len(NAMES), degree=1, sigma=0.01, shape=SHAPE, static=0.1, dynamic=0.1
    )
    matches, truth = found.matches, found.truth
    named = dict(zip(truth.names, NAMES, strict=True))
    table = matches.table.copy()
    table["exposure"] = [named[name] for name in table["exposure"]]
    poses = {named[name]: pose for name, pose in matches.poses.items()}
    sky = TangentPlane(10.0, 20.0, np.array([[-1e-5, 0.0, 2e-4], [0.0, 1e-5, -2e-4]]))
    prior = Prior(np.zeros((2, 3)))  # a reference needs absolute errors
    return solve(ld.Matches.from_table(table, shape=SHAPE, poses=poses, sky=sky), degree=1, prior=prior)


def folder(name):
    return pytest.param(name, marks=[] if name in WORST else pytest.mark.slow if name in SLOW else pytest.mark.sets)


@pytest.fixture(params=map(folder, FOLDERS))
def place(request, tmp_path, monkeypatch):
    """A folder of such a name, relative to where one works; its neighbours are what is taken for it at the worst."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "DA"))
    for neighbour in ("A", "new"):
        Path(neighbour).write_text("precious")
    Path("DA").mkdir()
    for neighbour in ("http:", "file:"):
        Path(neighbour).mkdir()
    Path(request.param).mkdir(exist_ok=True)
    return Path(request.param)


@pytest.fixture
def alone(place):
    """A check that nothing has changed but the files named, below the place."""

    def everything():
        return {path: path.read_bytes() if path.is_file() else None for path in Path().rglob("*")}

    before = everything()

    def check(*names):
        wanted = {place / name for name in names}
        folders = {
            parent for path in wanted for parent in path.parents if parent not in (Path(), *place.parents, place)
        }
        now = everything()
        assert now.keys() - before.keys() == wanted | folders
        assert {path: now[path] for path in before} == before

    return check


def mosaic():
    plane = np.arange(np.prod(SHAPE), dtype="f4").reshape(SHAPE)
    wcs = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CDELT1": 1e-5, "CDELT2": 1e-5})
    return Mosaic(
        plane, plane, plane, plane.astype("i4"), plane.astype("u1"), plane[None].astype("u4"), WCS(wcs), NAMES
    )


@pytest.mark.parametrize("stem", [pytest.param("s", marks=pytest.mark.sets), "A#1?x;y%41"])
def test_solutions_priors_and_wcs(solution, place, alone, stem):
    solution.write(place / f"{stem}.asdf")
    again = Solution.read(place / f"{stem}.asdf")
    assert again.names == NAMES
    np.testing.assert_array_equal(again.coefficients, solution.coefficients)
    prior = Prior(np.ones((2, 6)), shape=SHAPE)
    prior.write(str(place / f"{stem}.prior.asdf"))
    np.testing.assert_array_equal(Prior.from_file(str(place / f"{stem}.prior.asdf")).mean, prior.mean)
    assert Prior.from_file(place / f"{stem}.asdf").shape == SHAPE
    write_wcs(solution[NAMES[0]], place / f"{stem}.wcs.asdf")
    np.testing.assert_allclose(
        read_wcs(str(place / f"{stem}.wcs.asdf"))(3.0, 4.0), solution[NAMES[0]].wcs(3.0, 4.0), rtol=0, atol=1e-12
    )
    assert Prior.from_file(place / f"{stem}.wcs.asdf").shape == SHAPE
    alone(f"{stem}.asdf", f"{stem}.prior.asdf", f"{stem}.wcs.asdf")


@pytest.mark.parametrize("stem", [pytest.param("m", marks=pytest.mark.sets), "A#1?x;y%41"])
def test_mosaics(place, alone, stem):
    endings = (".fits", ".fits.gz", ".fits.bz2", ".asdf")
    for ending in endings:
        mosaic().write(place / (stem + ending))
    for ending in endings[:3]:
        assert read_grid(str(place / (stem + ending))).array_shape == SHAPE
        (image,) = ld.read_exposures(place / (stem + ending))
        np.testing.assert_array_equal(image.data, mosaic().data)
    with asdf.open(BytesIO((place / (stem + ".asdf")).read_bytes())) as found:
        assert found["mosaic"]["exposures"] == list(NAMES)
    alone(*(stem + ending for ending in endings))


@pytest.mark.parametrize("stem", [pytest.param("t", marks=pytest.mark.sets), "A#1?x;y%41"])
def test_tables(solution, place, alone, stem):
    endings = (".ecsv", ".fits", ".vot", ".xml", ".csv")
    for ending in endings:
        write_stars(solution, place / (stem + ending))
        table = read_table(str(place / (stem + ending)))
        assert set(table["exposure"]) == {stem}
        np.testing.assert_allclose(table["x"], solution.stars["x"].value, rtol=1e-12)
        assert len(read_reference(place / (stem + ending)).sky) == 12
    curves = NoiseCurves(QTable({name: [1.0] for name in COLUMNS}))
    curves.write(place / "noise.ecsv")
    assert NoiseCurves.read(str(place / "noise.ecsv")).table["flux"] == 1
    (place / "list.txt").write_text("# x y x_err y_err\n1 2 0.1 0.1\n")
    assert len(read_table(str(place / "list.txt"))) == 1
    alone(*(stem + ending for ending in endings), "noise.ecsv", "list.txt")


def test_report_and_summary(solution, place, alone, monkeypatch):
    monkeypatch.setattr("legdistort.reporting.page.render", lambda *_, **__: "Ä")  # its pictures take their time
    write_report(place / "r#.html", solution)
    assert (place / "r#.html").read_text(encoding="utf-8") == "Ä"
    outputs.write_summary(place / "s#.json", {"a": 1})
    outputs.write_summary(place / "s#.json", {"a": 2})
    assert (place / "s#.json").read_text() == '{\n "a": 2\n}\n'
    alone("r#.html", "s#.json")


def frames(folder, names=NAMES):
    folder.mkdir(exist_ok=True)
    for name in names:
        fits.HDUList([fits.PrimaryHDU(np.ones(SHAPE, "u1"))]).writeto(file := BytesIO())
        (folder / f"{name}.fits").write_bytes(file.getvalue())
    return [str(folder / f"{name}.fits") for name in names]


def test_attaching(solution, place, alone):
    names = NAMES if place.name == "A#1" else NAMES[:1]
    paths = frames(place / "in", names)
    attach(solution, paths, out=place / "out#1", max_error=1)
    attach(solution, paths, in_place=True, max_error=1)
    for name, path in zip(names, paths, strict=True):
        copy = place / "out#1" / f"{name}.fits"
        assert copy.read_bytes()[: 2880 * 3] == Path(path).read_bytes()[: 2880 * 3]
        assert Prior.from_file(copy).shape == Prior.from_file(path).shape == SHAPE
    alone(*(f"{folder}/{name}.fits" for folder in ("in", "out#1") for name in names))


def test_simulated_images_and_maps(solution, place, alone):
    truth = simulate_exposures(small=True, n_exposures=2, size=256, n_stars=3).truth
    pixels = np.zeros(SHAPE, "f4")
    images = {name: fits.HDUList([fits.PrimaryHDU(pixels)]) for name in NAMES}
    paths = SimulatedExposures(images, truth).write(place)
    assert [exposure.name for exposure in ld.read_exposures(map(str, paths))] == list(NAMES)
    assert [exposure.read().name for exposure in ld.open_exposures(paths)] == list(NAMES)
    assert Prior.from_file([str(path) for path in paths[:2]], direction="detector_to_reference").shape == SHAPE
    alone(*(f"{name}.fits" for name in NAMES), "truth.ecsv")


@pytest.mark.usefixtures("undrawn")
def test_a_run(place_with_frames, capsys):
    """Frames of such names in a folder of such a name: everything lies in the folder asked for."""
    folder, paths = place_with_frames
    before = sorted(Path().rglob("*"))
    assert (
        main(["run", *paths, "--out", str(folder / "out;b"), "--degree", "1", "--quiet", "--min-exposures", "2"]) == 0
    )
    out = folder / "out;b"
    results = {path.split("/")[0] for path in pipeline.RESULTS} - {"psf", *pipeline.CATALOGUE}
    assert {path.name for path in out.iterdir()} == results
    names = {Path(path).stem for path in paths}
    assert {path.name for path in (out / "wcs").iterdir()} == {f"{name}.asdf" for name in names}
    assert sorted(path for path in Path().rglob("*") if out not in (path, *path.parents)) == before
    assert set(Solution.read(out / "solution.asdf").names) == names
    assert fits.getheader(BytesIO((out / "mosaic.fits").read_bytes()))["IMCMB003"] == r"-\xe4 ~b"
    assert main(["report", str(out / "solution.asdf"), "--out", str(folder / "r#.html")]) == 0


@pytest.fixture
def place_with_frames(tmp_path, monkeypatch):
    """A night whose frames have such names, in a folder of such a name beside one that must not change."""
    monkeypatch.chdir(tmp_path)
    Path("A").write_text("precious")
    night = simulate_exposures(small=True, n_exposures=3, n_stars=40, size=320, seed=1)
    names = ("A#1?x;b", "D%41~$_$", "-ä ~b")
    images = dict(zip(names, night.hdus.values(), strict=True))
    paths = SimulatedExposures(images, night.truth).write("A#1/in[1]*")
    return Path("A#1"), [str(path) for path in paths]


UNFIT = ["new\nline", "a\tb", "a\\b", "a\x7f", "\udcff", "  .", "é" * 125 + "a"]


@pytest.mark.parametrize("name", UNFIT)
def test_exposures_that_no_file_can_be_named_after_are_refused_at_the_door(tmp_path, name):
    """Before any work, and naming the file."""
    path = tmp_path / f"{name}.fit"
    hdulist = fits.HDUList([fits.PrimaryHDU(np.ones(SHAPE))])
    hdulist.writeto(file := BytesIO())
    path.write_bytes(file.getvalue())
    before = sorted(tmp_path.iterdir())
    words = "cannot be the name of a file; rename it"
    for read in (ld.read_exposures, ld.open_exposures):
        with pytest.raises(InputError, match=words) as caught:
            read([path])
        assert str(caught.value).startswith(repr(str(path)))
    with pytest.raises(InputError, match=words):
        Exposure(name, np.ones(SHAPE))
    with pytest.raises(InputError, match=words):
        ld.run([path, path], out=tmp_path / "out")
    assert sorted(tmp_path.iterdir()) == before
    path = tmp_path / f"{name}.txt"
    path.write_text("# x y x_err y_err\n1 2 0.1 0.1\n")
    with pytest.raises(InputError, match=words) as caught:
        read_table(path)
    assert str(caught.value).startswith(repr(str(path)))


@pytest.mark.parametrize("name", [*UNFIT, "a/b", "", "a\0b"])
def test_so_are_those_of_tables(solution, name):
    table = solution.residuals.copy()
    table["exposure"] = [name if other == NAMES[0] else other for other in table["exposure"]]
    words = "cannot be the name of a file; rename it" if name else "column 'exposure' has no value in 12 of 72 rows"
    with pytest.raises(InputError, match=words):
        ld.Matches.from_table(table, shape=SHAPE)


def test_long_names(solution, tmp_path):
    """As long as file systems allow."""
    for path in (tmp_path / f"{'é' * 125}.asdf", tmp_path / f"{'x' * 250}.asdf"):
        solution.write(path)
        assert Solution.read(path).names == NAMES
    fits.HDUList([fits.PrimaryHDU(np.ones(SHAPE))]).writeto(file := BytesIO())
    (tmp_path / f"{'x' * 250}.fits").write_bytes(file.getvalue())
    assert ld.read_exposures(tmp_path / f"{'x' * 250}.fits")[0].name == "x" * 250


def test_patterns_in_folders_with_brackets(tmp_path):
    (tmp_path / "A[1]").mkdir()
    paths = frames(tmp_path / "A[1]")
    assert {exposure.name for exposure in ld.read_exposures(str(tmp_path / "A[1]" / "*.fits"))} == set(NAMES)
    assert len(paths) == len(NAMES)


def test_the_package_itself_in_such_a_folder(tmp_path, monkeypatch):
    """Schemas are found wherever the package is installed."""
    folder = tmp_path / "A#1" / "legdistort" / "data" / "schemas"
    folder.mkdir(parents=True)
    (folder / "moved-1.0.0.yaml").write_text("%YAML 1.1\n---\ntype: object\nrequired: [a]\n")
    monkeypatch.setattr(asdf_files.resources, "files", lambda package: tmp_path / "A#1" / package)
    asdf_files.check_tree({"a": 1}, "moved-1.0.0", "f.asdf")
    with pytest.raises(InputError, match="'a' is a required property"):
        asdf_files.check_tree({"b": 1}, "moved-1.0.0", "f.asdf")
