"""No field is lost: whatever makes one object from another keeps what it does not change, field by field.

Fields are taken from the classes themselves. A new one fails here until `whole` sets it and every road carries it.
"""

import copy
import pickle
import warnings
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass, replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from legdistort import pipeline
from legdistort.assessment import baselines
from legdistort.cameras.camera import Camera
from legdistort.cameras.detector import Detector
from legdistort.exceptions import AssumptionWarning, InputError, MatchError
from legdistort.geometry.tabulated.displacement_table import DisplacementTable
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.exposure_files import open_exposures, read_exposures
from legdistort.inputs.exposures import Exposure
from legdistort.inputs.frames.statement import read_statement
from legdistort.inputs.table_files import read_table
from legdistort.matching.matches import Matches
from legdistort.measurement.injection import MoffatStars, inject
from legdistort.measurement.options import MeasureOptions
from legdistort.priors.prior import Prior
from legdistort.results.errors.header_pointing import HeaderPointing
from legdistort.simulation.observations import simulate_matches
from legdistort.solving.camera_fit import in_camera
from legdistort.solving.choices.held_out import hold_out
from legdistort.solving.estimation import solve
from legdistort.solving.single_detectors import by_detector

SHAPE, FIELD = (400, 300), (420, 640)
RNG = np.random.default_rng(1)


# -- objects with every field set


def detector(x, seed):
    rng = np.random.default_rng(seed)
    static = np.concatenate([np.zeros((2, 3)), rng.normal(0, 0.2, (2, 7))], axis=1)
    factor = rng.normal(0, 0.1, (6, 6))
    return Detector(
        SHAPE, layout=np.array([[1.0, 0.01, -x], [-0.01, 1.0, -8.0]]), static=static,
        static_covariance=1e-4 * (8 * np.eye(20) + 1), layout_covariance=factor @ factor.T + 0.01 * np.eye(6),
        header_layout=[[0.9, 0.1, 40.0], [-0.1, 0.9, -7.0]],
    )  # fmt: skip


def camera():
    common = np.concatenate([np.zeros((2, 3)), np.full((2, 7), 0.05)], axis=1)
    known = {"common_map": 1e-3 * (common == 0), "header_map": [[1.0, -0.01, 3.0], [0.01, 1.0, -4.0]]}
    known["header_errors"] = (2e-5, 0.004)
    known["place_errors"] = [[0.1, 0.2, 0.003], [0.2, 0.1, 0.004]]
    detectors = {"a": detector(10.0, 1), "b": detector(325.0, 2)}
    widths = [np.concatenate([each.layout_sigma, each.static_sigma[:, 3:]], axis=1) for each in detectors.values()]
    correlated = 0.9 * np.eye(40) + 0.1
    known["covariance"] = correlated * np.outer(np.ravel(widths), np.ravel(widths))
    return Camera("pair", detectors, FIELD, common, **known)


def matches():
    """Six exposures of a camera with two detectors, with an epoch that is not the mean of those of the rows."""
    sim = simulate_matches(n_stars=150, n_exposures=6, shape=FIELD, dither=40, sigma=0.01, degree=1, seed=2)
    table, pair = sim.matches.table.copy(), camera()
    f = np.column_stack([table["x"].value, table["y"].value])
    on = pair.sees(f)
    table, f, on = table[on.any(axis=0)], f[on.any(axis=0)], on[:, on.any(axis=0)]
    table["detector"] = np.where(on[0], "a", "b")
    xy = np.where(on[0][:, None], pair["a"].to_pixels(f), pair["b"].to_pixels(f))
    table["x"], table["y"] = xy.T * u.pix
    table["epoch"] = (2015.0 + np.array([int(name[-2:]) for name in table["exposure"]])) * u.yr
    sky = TangentPlane(10.0, -70.0, np.array([[-1e-5, 1e-6, 2e-3], [1e-6, 1e-5, -1e-3]]))
    start = {name: RNG.normal(0, 1, (2, 6)) for name in sim.matches.names}
    return Matches.from_table(
        table, camera=pair, start=start, poses=sim.matches.poses, sky=sky, left_out={"bad": "no stars: 'none'"},
        epoch=2020.25,
        header_distortion="SIP, up to 4.48 px over the detector", pose_sigma={"shift": 20.0, "scale": 0.1},
        pointing=HeaderPointing(2, 0.5, 0.1, {"e0": (30.0, 180.0)}, (("e0", "e1"), ("e2",)), 0.01, {"2": 40.0}, 3.0),
    )  # fmt: skip


def prior():
    record = {"kind": "FITS", "name": "b.fits", "files": {"b.fits": 32 * "1f"}}
    return Prior(
        RNG.normal(0, 1, (2, 6)), sigma=RNG.uniform(0.1, 1, (2, 6)), static_covariance=np.eye(12) + 0.2,
        shape=SHAPE, truncation=0.25, plane=np.array([[2.0, 0.1, 3.0], [-0.1, 2.0, 4.0]]), source=record,
        table=DisplacementTable(RNG.normal(0, 0.1, (2, 3, 4)), (-5.0, -6.0), (20.0, 30.0)),
    )  # fmt: skip


def header():
    cards = {"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRPIX1": 10.5, "CRPIX2": 7.5, "CRVAL1": 10.0}
    cards |= {"CRVAL2": -70.0, "CD1_1": -1e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-5}
    cards |= {"A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-4, "B_1_1": 2e-5, "OBJECT": "M4"}
    return fits.Header(cards)


def exposure():
    data, mask = RNG.normal(100, 5, (40, 30)), np.zeros((40, 30), dtype=bool)
    mask[3, 4] = True
    return Exposure(
        "night1-2", data, mask=mask, uncertainty=np.full(data.shape, 5.0), wcs=WCS(header()), header=header(),
        saturation=5e4, gain=2.0, read_noise=4.0, exposure_time=30.0, path=pipeline.Path("night1.fits"), has_gwcs=True,
        exposure="night1", detector="2", stated=read_statement(header(), data, integer=False),
    )  # fmt: skip


# -- roads from one to another; `path` is that of a file that is not there yet


def kept(given, path):
    return given.keep(np.asarray(given.table["star"]) % 7 > 0)


def table_and_back(given, path):
    table = given.table.copy()
    table.meta = given.to_meta()
    return Matches.from_table(table, **Matches.read_meta(table.meta))


def file_and_back(given, path):
    pipeline.write_matched(path, given, {})
    table = read_table(path)
    return Matches.from_table(table, **Matches.read_meta(table.meta))


def compared(given, path):
    return baselines.used_matches(given, solved(given, dynamic=None))


def solved(given, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AssumptionWarning)  # of the distortion in the headers
        return solve(given, degree=1, **options)


def solved_camera(given, path):
    return solved(replace(matches(), camera=given), layout="fit").camera


def camera_file(given, path):
    given.write(path)
    return Camera.read(path)


def prior_file(given, path):
    given.write(path)
    return Prior.from_file(path)


def in_a_camera(road):
    """A road of cameras for a detector."""
    return lambda given, path: road(Camera("one", {"1": given}, FIELD), path)["1"]


def injected(given, path):
    profile = MoffatStars(np.array([-0.8, -0.8, 0.0, 2.5]))
    return inject(given, np.array([[15.0, 20.0]]), np.array([1e3]), profile, photon=0.5, rng=RNG)


#: Roads of every class.
COPIES = {
    "copy": lambda given, path: copy.copy(given),
    "deepcopy": lambda given, path: copy.deepcopy(given),
    "pickle": lambda given, path: pickle.loads(pickle.dumps(given)),
    "replace": lambda given, path: replace(given),
}
FEWER = {"table": "has fewer rows", "observations": "are those of the table"}
PARTS = dict.fromkeys(("shapes", "poses", "left_out", "start"), "have the names of single detectors, or none")
ANEW = {"table": "has other positions", "observations": "are those of the table"}
PLACES = {
    "detectors": "lie where the exposures show them",
    "common_sigma": "counts what was fitted",
    "place_errors": "are those of places found anew",
    "covariance": "is that of what was found",
    "header_map": "has the focal plane where the exposures show it",
}


@dataclass(frozen=True)
class Case:
    """A class, an object of it with every field set, and its roads.

    `changes` has, by road, fields that it changes on purpose, with the reason; `unset` fields that cannot be set.
    """

    whole: Callable
    roads: Mapping[str, Callable]
    changes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    unset: Mapping[str, str] = field(default_factory=dict)


CASES = {
    "Matches": Case(
        matches,
        {
            "keep": kept,
            "keep a slice": lambda given, path: given.keep(slice(20, None)),
            "without": lambda given, path: given.without({"exp02": "by hand"}),
            "validate": lambda given, path: hold_out(given, 0.2)[0],
            "single detectors": lambda given, path: by_detector(given, None)[0],
            "compare": compared,
            "another camera": lambda given, path: in_camera(given, replace(given.camera, name="other")),
            "table": table_and_back,
            "file": file_and_back,
        },
        {
            "keep": FEWER,
            "keep a slice": FEWER,
            "without": FEWER | dict.fromkeys(("shapes", "poses", "start"), "are of the exposures left")
            | {"left_out": "has one more"},
            "validate": FEWER,
            "single detectors": ANEW | PARTS | {"camera": "is of no use to single detectors"},
            "compare": ANEW | {"camera": "is that of the solution, for its layouts were uncertain"},
            "another camera": ANEW | {"camera": "is the other"},
        },
    ),
    "Camera": Case(
        camera,
        {"file": camera_file, "table": lambda given, path: Camera.from_meta(given.to_meta()), "solve": solved_camera},
        {"solve": PLACES},
    ),
    "Detector": Case(
        lambda: detector(10.0, 1),
        {
            "file": in_a_camera(camera_file),
            "table": in_a_camera(lambda given, path: Camera.from_meta(given.to_meta())),
            "field": lambda given, path: Camera("one", {"1": given})["1"],
        },
        {"field": {"layout": "begins at the edge of the detector"}},
    ),
    "Prior": Case(
        prior,
        {"file": prior_file, "widths": lambda given, path: given.with_sigma(0.5)},
        {"widths": {"sigma": "is what was asked for"}},
    ),
    "Prior without a mean": Case(
        lambda: replace(prior(), mean=None, sigma=None, static_sigma=0.5, static_covariance=None, table=None),
        {"file": prior_file, "widths": lambda given, path: given.with_sigma(None)},
        unset={"sigma": "is the scatter around a mean", "table": "is beside a mean"}
        | {"static_covariance": "is that of a mean"},
    ),
    "Exposure": Case(
        exposure,
        {
            "detector": lambda given, path: MeasureOptions(gain=3.0).with_detector(given),
            "injection": injected,
        },
        {
            "detector": {"gain": "is what was asked for"},
            "injection": {"data": "have stars more", "uncertainty": "has their noise"},
        },
    ),
}  # fmt: skip

ROADS = [(name, road) for name, case in CASES.items() for road in [*COPIES, *case.roads]]


# -- the law


def same(one, other):
    """Whether two values are equal to the last bit, whatever they are made of."""
    if type(one) is not type(other):
        return False
    if isinstance(one, Table):
        return one.colnames == other.colnames and all(same(one[name], other[name]) for name in one.colnames)
    if isinstance(one, np.ndarray):
        equal_nan = one.dtype.kind == "f"
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=equal_nan)
    if isinstance(one, WCS):
        return same(one.to_header(relax=True), other.to_header(relax=True))
    if isinstance(one, fits.Header):
        return one.tostring() == other.tostring()
    if is_dataclass(one):
        return not lost(one, other)
    if isinstance(one, dict):
        return set(one) == set(other) and all(same(one[key], other[key]) for key in one)
    return one == other


def lost(one, other):
    """Names of the fields that differ."""
    return {each.name for each in fields(one) if not same(getattr(one, each.name), getattr(other, each.name))}


@pytest.mark.parametrize("name", CASES)
def test_every_field_is_set(name):
    """Else the others would not see whether it is lost."""
    whole, unset = CASES[name].whole(), set()
    for each in fields(whole):
        default = each.default if each.default_factory is MISSING else each.default_factory()
        if default is not MISSING and same(getattr(whole, each.name), default):
            unset.add(each.name)
    assert unset == set(CASES[name].unset)


@pytest.mark.parametrize(("name", "road"), ROADS)
def test_every_road_keeps_every_field(name, road, tmp_path):
    case = CASES[name]
    whole = case.whole()
    made = (COPIES | case.roads)[road](whole, tmp_path / "file.asdf")
    assert lost(whole, made) == set(case.changes.get(road, {}))
    if isinstance(whole, Matches):
        assert same(made.observations, type(made.observations).of(made.table))


@pytest.mark.parametrize("name", CASES)
def test_a_changed_field_leaves_the_others(name):
    """One that is given anew: the constructor makes nothing else of the others."""
    whole = CASES[name].whole()
    for each in fields(whole):
        assert not lost(whole, replace(whole, **{each.name: copy.deepcopy(getattr(whole, each.name))}))


def test_roads_of_matches_need_no_list_of_fields():
    """A field that these do not know comes along."""
    more = make_dataclass("More", [("extra", str, "unset")], bases=(Matches,), frozen=True, eq=False)
    given = matches()
    given = more(**{each.name: getattr(given, each.name) for each in fields(given)}, extra="set")
    for road in ("keep", "without", "validate", "single detectors", "compare", "another camera"):
        assert CASES["Matches"].roads[road](given, None).extra == "set"


# -- keep


def test_what_is_kept():
    given = matches()
    mask = np.asarray(given.table["star"]) % 5 > 0
    by_mask, by_index = given.keep(mask), given.keep(np.flatnonzero(mask))
    assert not lost(by_mask, by_index)
    assert same(by_mask.table, given.table[mask])
    assert not lost(given, given.keep(slice(None)))
    fewer = given.keep(~np.isin(given.table["exposure"], ["exp00", "exp03"]))
    assert fewer.names == ("exp01", "exp02", "exp04", "exp05")
    assert list(fewer.shapes) == list(fewer.poses) == list(fewer.names)
    assert fewer.left_out == given.left_out  # only those that have a reason
    assert all(same(fewer.poses[name], given.poses[name]) for name in fewer.names)
    assert given.without({"exp00": "blurred"}).left_out == given.left_out | {"exp00": "blurred"}


def test_what_cannot_be_kept():
    given = matches()
    assert given.keep(given.table["exposure"] == "exp01").names == ("exp01",)
    with pytest.raises(MatchError, match=r"only one exposure.*exp05: blurred"):
        given.without({name: "blurred" for name in given.names if name != "exp04"})
    with pytest.raises(MatchError, match="no position is left"):
        given.keep(slice(0, 0))
    first, star = np.isin(given.table["exposure"], ["exp00", "exp01"]), np.asarray(given.table["star"])
    with pytest.raises(MatchError, match="2 groups with no star in common"):
        given.keep(first == (star % 2 > 0))
    with pytest.raises(InputError, match=r"one truth value a row .*, got shape \(3,\)"):
        given.keep([True, False, True])
    with pytest.raises(InputError, match="stands twice in exposure"):
        given.keep([*range(len(given.table)), 5])
    both = np.intersect1d(*(star[given.table["exposure"] == name] for name in given.names[:2]))[0]
    with pytest.raises(InputError, match="on one line"):
        given.keep(first & (star == both))


def test_observations_follow_the_table():
    given = matches()
    table = given.table.copy()
    table["x"] += 1 * u.pix
    moved = replace(given, table=table)
    np.testing.assert_array_equal(moved.observations.xy[:, 0], given.observations.xy[:, 0] + 1)
    np.testing.assert_allclose(moved.positions - given.positions, [[1, 0]] * len(given.stars), atol=0.2)


def test_tables_of_before_are_read():
    """Without what is known of headers, and without a camera."""
    meta = matches().to_meta()
    del meta["header_distortion"], meta["camera"]
    known = Matches.read_meta(meta)
    assert known["header_distortion"] is None
    assert known["camera"] is None
    assert known["epoch"] == 2020.25


def test_exposures_that_are_opened_are_those_that_are_read(tmp_path):
    cards = header()
    cards.update({"SATURATE": 5e4, "GAIN": 2.0, "RDNOISE": 4.0, "EXPTIME": 30.0, "EXTNAME": "SCI"})
    hdus = [fits.PrimaryHDU()]
    for chip in (1, 2):
        data = RNG.normal(100, 5, (40, 30))
        hdus.append(fits.ImageHDU(data, cards + fits.Header({"CCDCHIP": chip})))
        hdus[-1].ver = chip
        hdus.append(fits.ImageHDU(np.full(data.shape, 5.0), name="ERR", ver=chip))
        hdus.append(fits.ImageHDU((data > 110).astype(int), name="DQ", ver=chip))
    fits.HDUList(hdus).writeto(tmp_path / "night1.fits")
    pairs = zip(*(each(tmp_path / "night1.fits", ext="SCI") for each in (read_exposures, open_exposures)), strict=True)
    assert [lost(read, opened.read()) for read, opened in pairs] == [set(), set()]
