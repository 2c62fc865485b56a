"""Cameras whose detectors have files of their own, with frames as JWST and others write them, and gwcs alone."""

import io
import shutil
from dataclasses import replace

import asdf
import gwcs
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling import models
from astropy.table import QTable, Table
from gwcs import coordinate_frames as cf
from scamp_heads import write_head

import legdistort
from legdistort import Exposure, Solution
from legdistort.cli.parser import main
from legdistort.exceptions import InputError
from legdistort.inputs.detector_files import label_of, of_files, with_detectors
from legdistort.inputs.wcs_files import open_wcs

pytestmark = [pytest.mark.filterwarnings("ignore::legdistort.LegdistortWarning"), pytest.mark.usefixtures("undrawn")]

# -- which files are of one exposure


def exposure(name, **cards):
    return Exposure(
        name, np.arange(16.0).reshape(4, 4), header=fits.Header({k.replace("_", "-"): v for k, v in cards.items()})
    )


def parts(*exposures):
    return [(each.exposure, each.detector) for each in with_detectors(list(exposures))]


def test_files_named_alike_but_for_the_detector():
    visit = [
        exposure(f"jw01_0000{i}_nrc{key.lower()}_cal", DETECTOR=f"NRC{key}", EXPSTART=59776.4 + i / 100)
        for i in (1, 2)
        for key in ("A1", "BLONG")
    ]
    assert parts(*visit) == [(f"jw01_0000{i}_cal", f"NRC{key}") for i in (1, 2) for key in ("A1", "BLONG")]
    assert parts(*visit[::3]) == [(None, None)] * 2  # none has two
    assert [each.name for each in with_detectors(visit)] == [each.name for each in visit]


def test_files_that_were_begun_together():
    night = [
        exposure(f"SUPA0012{i}{key}", DET_ID=key, MJD_OBS=55000 + i / 1440 + key * 1e-6)
        for i in (345, 346)
        for key in (0, 9)
    ]
    assert parts(*night) == [(f"SUPA0012{i}", str(key)) for i in (345, 346) for key in (0, 9)]


def frame_of(detectors, cards=None):
    """Extensions of two files, with the cards of each."""
    each = [(f"e{i}", key, card) for i in (0, 1) for key, card in zip(detectors, cards or [{}] * 9, strict=False)]
    return [replace(exposure(f"{e}-{key}", **card), exposure=e, detector=key) for e, key, card in each]


@pytest.mark.parametrize(("theirs", "ours"), [("IM{}", "{}"), ("{}", "IM{}"), ("CCD0{}", "chip-{}")])
def test_detectors_of_the_same_numbers_are_the_same(theirs, ours, caplog):
    caplog.set_level("INFO", logger="legdistort")
    ids = [ours.format(k) for k in (3, 1, 4, 2)]
    found = of_files(frame_of([theirs.format(k) for k in (1, 2, 3, 4)]), ids)
    wanted = [(f"e{i}-{ours.format(k)}", f"e{i}", ours.format(k)) for i in (0, 1) for k in (1, 2, 3, 4)]
    assert [(each.name, each.exposure, each.detector) for each in found] == wanted
    told = [text for text in caplog.messages if "by their numbers" in text]
    assert len(told) == 1
    assert f"detectors {theirs.format(1)}, {theirs.format(2)}" in told[0]


@pytest.mark.parametrize(
    ("detectors", "ids"),
    [
        (["IM1", "IM2", "IM3"], "1234"),
        (["IM1", "IM2", "IM3", "IM4"], "123"),
        (["IM0", "IM1", "IM2", "IM3"], "1234"),
        (["A1", "B1", "A2", "B2"], "1234"),
        (["IM1", "IM2", "IM3", "4"], "1234"),
        (["A", "B"], "12"),
    ],
)
def test_detectors_are_not_guessed(detectors, ids):
    """One is missing, counted from another number, or has its number twice; or it has a name that is known."""
    frames = frame_of(detectors)
    assert [each.detector for each in of_files(frames, ids)] == detectors * 2
    camera = legdistort.Camera(
        "c", {k: legdistort.Detector((4, 4), layout=[[1, 0, 9 * int(k)], [0, 1, 0]]) for k in ids}
    )
    with pytest.raises(
        InputError, match=r"is of detector .*, and camera c has .* give a camera whose ids are those of"
    ):
        camera.of_detectors(frames)


def test_headers_that_name_detectors_go_before_numbers():
    """Chips that are counted otherwise than extensions, as those of WFC3; and a version that all have alike."""
    swapped = of_files(frame_of(["IM1", "IM2"], [{"CCDCHIP": 2}, {"CCDCHIP": 1}]), "12")
    assert [each.detector for each in swapped] == ["2", "1"] * 2
    alike = of_files(frame_of(["IM1", "IM2"], [{"EXTVER": 1}] * 2), "12")
    assert [each.detector for each in alike] == ["1", "2"] * 2


@pytest.mark.parametrize(
    "frames",
    [
        [("a1", {"DETECTOR": "X"}), ("a2", {"DETECTOR": "X"})],
        [("n_X", {"DETECTOR": "X"}), ("n_Y", {})],
        [("n_X", {"DETECTOR": "X", "MJD_OBS": 55000.0}), ("n_Y", {"DETECTOR": "Y", "MJD_OBS": 55000.1})],
        [(f"n{i}", {"DETECTOR": "XY"[i % 2], "DATE_OBS": "2014-12-09"}) for i in range(4)],
        [(f"n{i}", {"DETECTOR": "XY"[i % 2]}) for i in range(4)],
        [("X", {"DETECTOR": "X"}), ("Y", {"DETECTOR": "Y"})],
    ],
    ids=["one detector", "not named", "other times", "dates alone", "no times", "no names"],
)
def test_other_files_are_exposures_each(frames):
    assert parts(*(exposure(name, **cards) for name, cards in frames)) == [(None, None)] * len(frames)


@pytest.mark.parametrize(
    ("name", "exact", "label"),
    [
        ("jw_1_nrca1_cal", True, "jw_1_cal-NRCA1"),
        ("jw_2_nrca1_cal", True, None),
        ("obs_NRCA1", True, None),
        ("obs17_3", False, "obs17-NRCA1"),
        ("obs17_3", True, None),
    ],
)
def test_the_part_that_a_file_is(name, exact, label):
    known = ["jw_1_cal-NRCA1", "jw_1_cal-NRCA2", "obs1-NRCA1", "obs17-NRCA1"]
    assert label_of(name, fits.Header({"DETECTOR": "NRCA1"}), known, exact=exact) == label


# -- a visit of two detectors, whose headers are some tenths of a pixel wrong

N, SCALE = 128, 0.1
PLACES = {"NRCA1": np.array([-8.0, 0.3]), "NRCA2": np.array([8.2, 0.1])}  # v2, v3 [arcsec]
OFF = {"NRCA1": np.array([0.03, 0.05]), "NRCA2": np.array([-0.04, 0.02])}
DITHERS = np.array([[0, 0], [5, 1], [-5, 2], [2, -4], [-3, -5], [4, 5.0]])


def nominal_wcs(key, dither):
    """As a pipeline has it: detector -> v2v3 -> worlegdistort."""
    middle = models.Shift(-(N - 1) / 2) & models.Shift(-(N - 1) / 2)
    first = middle | models.AffineTransformation2D(SCALE * np.eye(2), translation=PLACES[key] + dither)
    sky = (
        models.Scale(-1 / 3600) & models.Scale(1 / 3600)
        | models.Pix2Sky_TAN()
        | models.RotateNative2Celestial(80, -69, 180)
    )
    frames = [cf.Frame2D(name=name, unit=(unit, unit)) for name, unit in (("detector", u.pix), ("v2v3", u.arcsec))]
    world = cf.CelestialFrame(name="world", reference_frame=ICRS(), unit=(u.deg, u.deg))
    wcs = gwcs.WCS([(frames[0], first), (frames[1], sky), (world, None)])
    wcs.bounding_box = ((-0.5, N - 0.5), (-0.5, N - 0.5))
    return wcs


@pytest.fixture(scope="module")
def visit(tmp_path_factory):
    """Frames without stars, catalogues as photutils writes them, and bare gwcs, in a folder."""
    rng, folder = np.random.default_rng(3), tmp_path_factory.mktemp("visit")
    stars = rng.uniform(-22, 22, (1200, 2))
    for i, dither in enumerate(DITHERS):
        for key in PLACES:
            name, wcs = f"jw01_02105_0000{i + 1}_{key.lower()}", nominal_wcs(key, dither)
            q = (stars - dither - PLACES[key] - OFF[key]) / SCALE
            xy = q + (N - 1) / 2
            seen = np.all((xy > 2) & (xy < N - 3), axis=1)
            xy = xy[seen] + rng.normal(0, 0.01, (seen.sum(), 2))
            table = QTable({"xcentroid": xy[:, 0], "ycentroid": xy[:, 1], "flux": 1e3 + np.flatnonzero(seen)})
            table.write(folder / f"{name}_cat.ecsv")
            tree, content = (
                {"meta": {"wcs": wcs, "instrument": {"name": "NIRCAM", "detector": key}, "extra": [1, "two"]}},
                io.BytesIO(),
            )
            asdf.AsdfFile(tree).write_to(content)
            asdf.AsdfFile(tree).write_to(folder / f"{name}_model.asdf")
            asdf.AsdfFile({"wcs": wcs}).write_to(folder / f"{name}_wcs.asdf")
            raw = np.frombuffer(content.getvalue(), "u1")[None]
            primary = fits.PrimaryHDU(
                header=fits.Header(
                    {"TELESCOP": "JWST", "INSTRUME": "NIRCAM", "DETECTOR": key, "EXPSTART": 59776 + i / 100}
                )
            )
            image = fits.ImageHDU(rng.normal(0, 1, (N, N)).astype("f4"), name="SCI")
            extra = fits.BinTableHDU.from_columns(
                [fits.Column("ASDF_METADATA", f"{raw.size}B", array=raw)], name="ASDF"
            )
            fits.HDUList([primary, image, extra]).writeto(folder / f"{name}_cal.fits")
    return folder


def stars_on_sky(lists, folder, pattern, read):
    """Of each star in every frame: number (its flux) and place by the refined WCS of the file [arcsec]."""
    number, places = [], []
    for path in sorted(folder.glob(pattern)):
        table = QTable.read(lists / f"{path.name.rpartition('_')[0]}_cat.ecsv")
        ra, dec = read(path)(table["xcentroid"].value, table["ycentroid"].value)
        number.append((table["flux"].value - 1e3).astype(int))
        places.append(np.stack([(ra - 80) * np.cos(np.radians(69)), dec + 69], axis=1) * 3600)
    return np.concatenate(number), np.concatenate(places)


def scatter(number, places):
    """Rms deviation of places from the mean of their star, per axis [pix]."""
    means = np.stack([np.bincount(number, xy) for xy in places.T], axis=1) / np.maximum(np.bincount(number), 1)[:, None]
    n_free = len(number) - len(np.unique(number))
    return np.sqrt(np.sum((places - means[number]) ** 2) / 2 / n_free) / SCALE


def gwcs_of_fits(path):
    return legdistort.read_exposures(path)[0].wcs


def gwcs_of_asdf(*keys):
    def read(path):
        with asdf.open(path, lazy_load=False, memmap=False) as file:
            node = file.tree
            for key in keys:
                node = node[key]
            return node

    return read


@pytest.mark.parametrize(
    ("ending", "read"),
    [
        pytest.param("cal.fits", gwcs_of_fits, marks=pytest.mark.slow),
        pytest.param("model.asdf", gwcs_of_asdf("meta", "wcs"), marks=pytest.mark.sets),
        pytest.param("wcs.asdf", gwcs_of_asdf("wcs"), marks=pytest.mark.sets),
    ],
    ids=["frames", "models", "bare gwcs"],
)
def test_a_visit_by_its_catalogues(ending, read, visit, tmp_path, monkeypatch):
    """Solved as a camera, with its layout found; stars agree to their noise in the files that come out."""
    monkeypatch.chdir(tmp_path)
    before = scatter(*stars_on_sky(visit, visit, f"*{ending}", read))
    lists = [str(path) for path in sorted(visit.glob("*_cat.ecsv"))]
    files = [str(path) for path in sorted(visit.glob(f"*{ending}"))]
    assert main(["match", *lists, "--wcs", *files, "--error", "0.01", "--out", "m.ecsv", "--quiet"]) == 0
    assert main(["solve", "m.ecsv", "--degree", "1", "--out", "sol", "--quiet"]) == 0
    solution = Solution.read("sol")
    assert list(solution.camera.detectors) == ["NRCA1", "NRCA2"]
    assert len(solution.names) == len(DITHERS)
    assert solution.chi2 / solution.dof == pytest.approx(1, abs=0.15)
    assert main(["attach", "sol", *files, "--out", "out", "--quiet"]) == 0
    after = scatter(*stars_on_sky(visit, tmp_path / "out", f"*{ending}", read))
    assert before > 0.1
    assert after == pytest.approx(0.01, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["*nrca2_", "jw01_02105_00002_nrca2_"], ids=["one detector", "one list"])
def test_lists_of_one_detector_of_a_known_camera(which, visit, tmp_path, monkeypatch):
    """The frame beside a list says which detector that is of, where the camera has more than these lists show."""
    monkeypatch.chdir(tmp_path)
    legdistort.Camera.of_frames(open_wcs(sorted(visit.glob("*_cal.fits")))).write("camera.asdf")
    lists, files = ([str(path) for path in sorted(visit.glob(f"{which}{end}"))] for end in ("cat.ecsv", "cal.fits"))
    words = ["--wcs", *files, "--camera", "camera.asdf", "--error", "0.01"]
    assert main(["match", *lists, *words, "--out", "m.ecsv", "--quiet"]) == 0
    assert set(QTable.read("m.ecsv")["detector"]) == {"NRCA2"}


@pytest.mark.slow
def test_catalogues_beside_bare_gwcs(visit, tmp_path, monkeypatch):
    """Files of a gwcs and nothing else: sky and shape of lists, and places to put the refined gwcs into."""
    monkeypatch.chdir(tmp_path)
    read = gwcs_of_asdf("wcs")
    lists, files = (sorted(str(path) for path in visit.glob(f"*nrca1_{end}")) for end in ("cat.ecsv", "wcs.asdf"))
    assert main(["match", *lists, "--wcs", *files, "--error", "0.01", "--out", "m.ecsv", "--quiet"]) == 0
    assert main(["solve", "m.ecsv", "--degree", "1", "--out", "sol", "--quiet"]) == 0
    solution = Solution.read("sol")
    assert solution.camera.field == (N, N)
    assert solution.sky.lon == pytest.approx(80, abs=0.05)
    assert main(["attach", "sol", *files, "--out", "out", "--quiet"]) == 0
    assert scatter(*stars_on_sky(visit, tmp_path / "out", "*", read)) == pytest.approx(0.01, rel=0.2)


def test_bare_gwcs_are_of_the_detectors_that_their_names_say(visit):
    """As the catalogues beside them: exposures of two detectors; names without a detector say nothing."""
    opened = open_wcs([str(path) for path in sorted(visit.glob("*_wcs.asdf"))])
    assert {each.detector for each in opened} == {"NRCA1", "NRCA2"}
    assert len({each.exposure for each in opened}) == len(DITHERS)
    assert all(each.detector.lower() in each.name for each in opened)
    plain = [replace(each, name=f"e{k}", exposure=None, detector=None) for k, each in enumerate(opened)]
    assert all(each.detector is None for each in with_detectors(plain))


def test_foreign_files_with_a_gwcs_alone(shared_data):
    """Of MIRI and NIRCam by the end of their bounding boxes, of Roman by its shape."""
    folder = shared_data / "gwcs_interop"
    opened = open_wcs(str(folder / "*wcs.asdf"))
    shapes = {each.name: each.shape for each in opened}
    assert shapes == {"miriwcs": (1024, 1028), "nircamwcs": (2048, 2048), "roman_wcs": (5000, 5000)}
    assert all(each.wcs is not None for each in opened)
    (miri,) = open_wcs(folder / "miriwcs.asdf", shape=(1024, 1032))
    assert miri.shape == (1024, 1032)


@pytest.mark.parametrize(
    ("make", "shape", "words"),
    [
        (
            lambda path: path,
            None,
            r"a_wcs.asdf: its gwcs states neither pixel_shape nor a bounding box: give the shape, --shape",
        ),
        (
            lambda path: _written(path, {"wcs": 3}),
            None,
            r"a_wcs.asdf has no gwcs at meta.wcs or roman.meta.wcs or wcs, nor an",
        ),
        (lambda path: _frame(path), (N, N), r"--shape comes from the frames of --wcs: leave it out"),
        (lambda path: _twice(path), (N, N), "two exposures are named 'a_wcs' .*; rename a file, or give one of them"),
        (
            lambda path: write_head(path.with_suffix(".head")),
            None,
            r"a_wcs.head is the text of a header, without the size and time of its image: give the frame",
        ),
    ],
    ids=["no shape", "no gwcs", "no gwcs file", "twice", "text of a header"],
)
def test_files_of_no_use_are_named(make, shape, words, tmp_path):
    wcs = nominal_wcs("NRCA1", [0, 0])
    wcs.bounding_box = None
    with pytest.raises(InputError, match=words):
        open_wcs(make(_written(tmp_path / "a_wcs.asdf", {"wcs": wcs})), shape=shape)


def _written(path, tree):
    asdf.AsdfFile(tree).write_to(path)
    return path


def _frame(path):
    fits.PrimaryHDU(np.arange(64.0).reshape(8, 8)).writeto(path.with_suffix(".fits"))
    return path.with_suffix(".fits")


def _twice(path):
    return [path, _frame(path)]


def test_lists_are_named_after_their_frames_whatever_they_end_with(visit, tmp_path, monkeypatch, capsys):
    """The name of the frame with more behind it, or with another last word; else a message that says what to do."""
    monkeypatch.chdir(tmp_path)
    files = [str(path) for path in sorted(visit.glob("*_wcs.asdf"))]
    first = sorted(visit.glob("*_cat.ecsv"))[0]
    shutil.copy(first, "other.ecsv")
    assert main(["match", "other.ecsv", "--wcs", *files, "--error", "0.01", "--out", "m.ecsv"]) == 1
    assert "other.ecsv: exposure other is none of the frames" in capsys.readouterr().err


@pytest.mark.parametrize(("theirs", "ours"), [("IM{}", "{}"), ("{}", "IM{}"), ("{}", "H2RG-{}")])
def test_lists_of_detectors_of_the_same_numbers_are_of_the_camera(theirs, ours, caplog):
    """As frames are; whether the same stars are numbered or not, or a camera corrects them."""
    caplog.set_level("INFO", logger="legdistort")
    rng, keys = np.random.default_rng(1), (1, 2)
    seen = [(f"e{i}", k, s) for k in keys for i in (0, 1) for s in range(4)]
    rows = [(name, theirs.format(k), *rng.uniform(10, 90, 2), 0.1, 0.1, 4 * k + s) for name, k, s in seen]
    table = Table(rows=rows, names=["exposure", "detector", "x", "y", "x_err", "y_err", "star"])
    layouts = {k: np.array([[1.0, 0, -110 * (k - 1)], [0, 1, 0]]) for k in (2, 1)}
    detectors = {ours.format(k): legdistort.Detector((100, 100), layout=each) for k, each in layouts.items()}
    camera = legdistort.Camera("two", detectors)
    matches = legdistort.Matches.from_table(table, camera=camera)
    assert set(matches.table["detector"]) == {ours.format(k) for k in keys}
    is_2 = np.asarray(table["detector"]) == theirs.format(2)
    right = np.asarray(table["x"]) + np.where(is_2, 110, 0)
    np.testing.assert_allclose(np.sort(matches.table["x"].value), np.sort(right), atol=1e-9)
    np.testing.assert_allclose(camera.correct_table(table["detector", "x", "y"])["x"].value, right, atol=1e-9)
    assert any("are taken for" in text for text in caplog.messages)


@pytest.mark.parametrize("keys", ["13", "AB", "123"])
def test_lists_of_other_detectors_are_refused_in_words(keys):
    """Both sets, and the column to rename."""
    table = Table({"exposure": ["e0"] * len(keys), "detector": list(keys)} | dict.fromkeys("xy", [5.0] * len(keys)))
    table["x_err"] = table["y_err"] = 0.1
    detector = {k: legdistort.Detector((100, 100), layout=np.array([[1.0, 0, -110 * k], [0, 1, 0]])) for k in (0, 1)}
    camera = legdistort.Camera("two", {f"IM{k + 1}": each for k, each in detector.items()})
    words = f"it has IM1, IM2, and the column detector has {', '.join(keys)}, .* rename these in the column"
    with pytest.raises(InputError, match=words):
        legdistort.match(table, camera=camera, min_exposures=2)
