"""Every option of the verbs in every setting: it runs, and what comes out is of use, or it is refused in words.

Options are taken from the signatures. A new one fails here until it has a sample. Refusals are stated beside the
sample; all else must run.
"""

import inspect
import itertools
import pickle
import warnings
from dataclasses import dataclass, field
from functools import cache, partial

import four_detectors
import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.modeling.models import Identity, Legendre2D, Mapping
from astropy.table import QTable, Table
from astropy.time import Time
from astropy.wcs import WCS

from legdistort.cameras.camera import Camera
from legdistort.cameras.detector import Detector
from legdistort.coaddition.mosaicking import coadd
from legdistort.exceptions import LegdistortError, LegdistortWarning
from legdistort.geometry.tangent_plane import TangentPlane
from legdistort.inputs.exposures import Exposure
from legdistort.matching.matcher import match
from legdistort.matching.matches import Matches
from legdistort.measurement.effective.model import EffectivePSF
from legdistort.measurement.positions import measure
from legdistort.priors.prior import Prior
from legdistort.reporting.page import write_report
from legdistort.results.accuracy import known_offsets
from legdistort.results.solution import Solution
from legdistort.results.view import View
from legdistort.simulation.instruments.instrument import Instrument
from legdistort.simulation.observations import simulate_matches
from legdistort.simulation.prediction import predict
from legdistort.solving.estimation import solve
from legdistort.solving.terms.term import Term
from legdistort.wcs.attachment import attach
from legdistort.wcs.refinement import refine

SHAPE, FIELD = (80, 120), (84, 250)
SKY = TangentPlane(10.0, -70.0, np.array([[-1e-5, 1e-6, 2e-3], [1e-6, 1e-5, -1e-3]]))
STATIC = np.array([[0, 0, 0, 0.1, 0.05, 0.02], [0, 0, 0, 0.02, -0.1, 0.03]])
SIGMA = 0.02


# -- settings


def simulated(shape, n_stars):
    """Matched positions of four exposures, a year apart, with fluxes; nominal poses."""
    sim = simulate_matches(
        n_stars=n_stars, n_exposures=4, shape=shape, degree=1, dither=8, rotations=[0, 10, 20, 90], static=0.3,
        dynamic=0.1, sigma=SIGMA, seed=2, sky=SKY,
    )  # fmt: skip
    table = sim.matches.table.copy()
    table["epoch"] = (2015.0 + np.array([int(name[-2:]) for name in table["exposure"]])) * u.yr
    table["flux"] = 1e3 + 10.0 * np.unique(np.asarray(table["star"]), return_inverse=True)[1]
    return table, sim.matches.poses


def chip(x=0.0):
    if not x:
        return Detector(SHAPE, static=STATIC)
    layout = np.array([[1.0, 0.01, -x], [-0.01, 1.0, -2.0]])
    widths = {"static_sigma": np.full((2, 6), 0.03), "layout_sigma": np.full((2, 3), 0.3)}
    return Detector(SHAPE, layout=layout, static=STATIC, **widths)


@cache
def matches(setting):
    """Matches of plain images; with a camera of one detector, which has a static distortion; with one of two."""
    if setting == "pair":
        camera = Camera("pair", {"a": chip(2.0), "b": chip(126.0)}, FIELD)
        table, poses = simulated(FIELD, 60)
        f = np.column_stack([table["x"].value, table["y"].value])
        on = camera.sees(f)
        table, f, on = table[on.any(axis=0)], f[on.any(axis=0)], on[:, on.any(axis=0)]
        table["detector"] = np.where(on[0], "a", "b")
        xy = np.where(on[0][:, None], camera["a"].to_pixels(f), camera["b"].to_pixels(f))
        table["x"], table["y"] = xy.T * u.pix
        return Matches.from_table(table, camera=camera, poses=poses, sky=SKY)
    table, poses = simulated(SHAPE, 30)
    if setting == "plain":
        return Matches.from_table(table, shape=SHAPE, poses=poses, sky=SKY)
    if setting == "no sky":
        return Matches.from_table(table, shape=SHAPE, poses=poses)
    table["detector"] = "1"
    return Matches.from_table(table, camera=Camera("one", {"1": chip()}), poses=poses, sky=SKY)


def catalogue(setting):
    """The stars of a solution as a reference on the sky."""
    stars = quiet(solve, matches(setting), degree=1).stars
    made = Table({name: stars[name].to_value(u.deg) for name in ("ra", "dec")}, units=["deg", "deg"])
    made["ra_error"], made["dec_error"] = np.full((2, len(made)), 1.0) * u.mas
    made["pmra"], made["pmdec"] = np.zeros((2, len(made))) * u.mas / u.yr
    made["pmra_error"], made["pmdec_error"] = np.full((2, len(made)), 0.5) * u.mas / u.yr
    made["ref_epoch"] = 2016.0
    return made


def earlier(setting):
    """A solution of the same stars in other exposures."""
    seen = matches(setting)
    table, camera = seen.camera.on_detectors(seen.table.copy()), seen.camera if seen.camera.is_known else None
    table["x"] += np.random.default_rng(3).normal(0, SIGMA, len(table)) * u.pix
    table["exposure"] = [f"before_{name}" for name in table["exposure"]]
    known = {f"before_{name}": pose for name, pose in seen.poses.items()}
    shape = None if seen.camera.has_focal_plane else SHAPE
    return quiet(solve, Matches.from_table(table, shape=shape, camera=camera, poses=known, sky=seen.sky), degree=1)


def form(degree):
    """A model for the whole of what has this degree."""

    def of_setting(setting):
        ny, nx = FIELD if setting == "pair" else SHAPE
        above = {f"c{i}_{j}": True for i in range(degree + 1) for j in range(degree + 1) if i + j > degree}
        box = {"x_domain": (-0.5, nx - 0.5), "y_domain": (-0.5, ny - 0.5)}
        x, y = (Legendre2D(degree, degree, **box, fixed=above) for _ in "xy")
        return Identity(2) + (Mapping((0, 1, 0, 1)) | x & y)

    return of_setting


def quiet(function, *args, **options):
    """The result, without our warnings, which tell of what is assumed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LegdistortWarning)
        return function(*args, **options)


SOLVED = {
    "plain": partial(solve, degree=1),
    "one": partial(solve, degree=1),
    "pair": partial(solve, degree=1),
    "layout held": partial(solve, degree=1, layout="hold", static="hold"),
    "single detectors": partial(solve, degree=1, dynamic="detector"),
    "motions": partial(solve, degree=1, motion="proper"),
    "prior": partial(solve, degree=2, prior=Prior(STATIC, sigma=0.1, static_sigma=0.05)),
    "law": partial(solve, degree=1, errors="by-brightness"),
    "no sky": partial(solve, degree=1),
}


@pytest.fixture(scope="module")
def solution(tmp_path_factory):
    """A solution by its setting, made once."""
    folder = tmp_path_factory.mktemp("solutions")

    @cache
    def made(setting):
        if setting.startswith("read "):
            return Solution.read(made(setting[5:]).write(folder / f"{setting}.asdf"))
        if setting == "pickled":
            return pickle.loads(pickle.dumps(made("pair")))
        if setting == "reference":
            return quiet(solve, matches("plain"), degree=1, reference=catalogue("plain"))
        if setting == "left out":
            return quiet(solve, matches("plain").without({"exp03": "blurred"}), degree=1)
        given = {"layout held": "pair", "single detectors": "pair"}.get(setting, setting)
        return quiet(SOLVED[setting], matches(given if given in ("one", "pair", "no sky") else "plain"))

    return made


# -- tables


@dataclass(frozen=True, eq=False)
class Row:
    """Options given together, and in which settings they are refused, with words of the message.

    A function among the values makes them from the setting.
    """

    options: dict
    refused: dict = field(default_factory=dict)

    def __str__(self):
        return ", ".join(f"{name}={_short(value)}" for name, value in self.options.items()) or "nothing"


def _short(value):
    return repr(value) if isinstance(value, str | int | float | None | bool) else type(value).__name__


def row(refused=None, **options):
    return Row(options, refused or {})


def single(words):
    return dict.fromkeys(("plain", "one"), words)


SEVERAL = single("is for exposures with several detectors")
OWN = {"one": "camera one has a static distortion of its own: leave prior and model out"}

SOLVE = [
    row(base=earlier),
    row(degree=0),
    row(degree=2),
    row(degree="auto"),
    row(prior=Prior(STATIC), refused=OWN),
    row(prior=Prior(STATIC, sigma=0.1, static_sigma=0.05), refused=OWN),
    row(prior=Prior(STATIC, sigma="evidence"), refused=OWN),
    row(
        prior=lambda setting: dict.fromkeys(matches(setting).names, Prior(STATIC)),
        refused=OWN | {"pair": "give what is known of its detectors to the camera"},
    ),
    row(model=form(1), degree=None, refused=OWN),
    row(model=form(2), degree=None, refused=OWN),
    row(model=form(2), degree=3, refused=OWN | dict.fromkeys(("plain", "pair"), "leave degree=3 out")),
    row(static="fit", degree=2),
    row(static="hold", refused={"plain": "is for a static distortion that is known"}),
    row(static="prior", prior=Prior(STATIC, static_sigma=0.05), refused=OWN),
    row(layout="fit", refused=SEVERAL),
    row(layout="prior", refused=SEVERAL),
    row(layout_sigma={"shift": 1.0, "rotation": 0.01}, refused=SEVERAL),
    row(layout_sigma={"shift": 1.0}, layout="hold", refused=SEVERAL | {"pair": "layout_sigma is for layout='prior'"}),
    row(dynamic="focal_plane", refused=SEVERAL),
    row(dynamic="detector", refused=SEVERAL),
    row(exposure_degree=0, static="fit", degree=2, refused={"pair": "exposure_degree is for single detectors"}),
    row(gauge="minimal"),
    row(method="joint"),
    row(loss="cauchy"),
    row(clip=None),
    row(error_floor=0.01),
    row(errors="scale"),
    row(errors="floor"),
    row(errors="by-brightness"),
    row(errors="correlated"),
    row(max_iterations=20),
    row(validate=0.2),
    row(motion="proper"),
    row(motion="parallax"),
    row(motion="acceleration"),
    row(motion="auto"),
    row(motion="proper", motion_sigma="evidence"),
    row(motion="proper", motion_epoch=Time("2016-07-01")),
    row(night_sigma=0.1),
    row(pose_sigma={"shift": 1.0, "rotation": 0.1 * u.deg}),
    row(motion_sigma=0.01, refused=dict.fromkeys(("plain", "one", "pair"), "belong to motion='proper'")),
    row(reference=catalogue, epoch=2016.5, pixel_scale=0.036),
    row(pixel_scale=0.02),
    row(reference=catalogue, motion="proper"),
    row(reference=catalogue, reference_error="found"),
    row(reference=catalogue, reference_degree=1),
    row(reference_degree=2, refused=dict.fromkeys(("plain", "one", "pair"), "is for the catalogue of reference")),
    row(reference_error=0.1, refused=dict.fromkeys(("plain", "one", "pair"), "is for the catalogue of reference")),
    row(terms="pixel_phase"),
    row(terms=["refraction"], refused=dict.fromkeys(("plain", "one", "pair"), "lacks the columns colour, tan_z")),
    row(
        terms="differential_refraction",
        refused=dict.fromkeys(("plain", "one", "pair"), "lacks the columns tan_z, parallactic_angle"),
    ),
    row(progress=True),
]

ALONE = "exposure exp00 has detectors, a, b, with their own pixels: say which"
IN_PIXELS = dict.fromkeys(("pair", "layout held", "read pair", "pickled"), ALONE)
UNMOVED = "motions of the stars were not fitted: call solve with motion='proper'"
SKYLESS = {"no sky": "does not know the sky"}
XY = np.array([[30.0, 40.0], [70.0, 50.0]])


def of_stars(solution):
    return solution.stars["star"][:2]


def still(*moving):
    """Where no motions were fitted."""
    return {each: UNMOVED for each in VIEWS if each not in ("motions", "read motions")}


VIEWS = (
    "plain", "one", "pair", "layout held", "single detectors", "motions", "prior", "law", "reference", "no sky",
    "left out", "read pair", "read motions", "read law", "pickled",
)  # fmt: skip

VIEW = {
    "correct": [
        row(x=XY),
        row(x=30.0, y=40.0),
        row(x=XY, errors=np.full((2, 2), SIGMA)),
        row(x=XY[:0], errors=np.zeros((0, 2))),
        row(x=XY, errors=np.full((2, 2), SIGMA), flux=[1e3, 2e3]),
        row(x=XY, epoch=2016.5, stars=of_stars, errors=np.full((2, 2), SIGMA), refused=still()),
        row(x=XY, flux=[1e3, 2e3], refused=dict.fromkeys(VIEWS, "give errors too")),
        row(x=[1.0, 2.0, 3.0], y=[1.0, 2.0], refused=dict.fromkeys(VIEWS, r"one shape, got \(3,\) and \(2,\)")),
    ],
    "distort": [
        row(x=XY),
        row(x=30.0, y=40.0),
        row(x=[1.0, 2.0, 3.0], y=[1.0, 2.0], refused=dict.fromkeys(VIEWS, r"one shape, got \(3,\) and \(2,\)")),
    ],
    "fits_wcs": [
        row(max_error=0.01, refused=SKYLESS),
        row(max_error="a", refused=dict.fromkeys(VIEWS, "max_error must be a positive number of pixels, got 'a'")),
    ],
    "header": [row(kind="tpv", max_error=0.01, refused=SKYLESS)],
    "sigma_map": [
        row(n=5),
        row(n=5, support=False, absolute=True),
        row(n=0, refused=dict.fromkeys(VIEWS, "n must be a positive integer, got 0")),
    ],
    "check_pixels": [row()],
    "supported": [row(xy=XY)],
    "to_reference": [row(xy=XY)],
    "plot_residuals": [
        row(scale=100.0, ax=lambda _: plt.figure().add_subplot()),
        row(scale="a", refused=dict.fromkeys(VIEWS, "scale must be a positive number, got 'a'")),
    ],
    "plot_error_map": [row(absolute=True, ax=lambda _: plt.figure().add_subplot())],
}
#: Methods that several detectors have in common.
COMMON = "supported", "to_reference", "plot_residuals"


def new_table(*, stars):
    """Of positions that took no part."""

    def of_solution(solution):
        made = QTable({"exposure": list(solution.names[:2])})
        for axis in "xy":
            made[axis], made[f"{axis}_err"] = [30.0, 40.0] * u.pix, np.full(2, SIGMA) * u.pix
        if stars:
            made["star"] = of_stars(solution)
        if solution.camera.has_focal_plane:
            made["detector"] = ["a", "b"]
        made["flux"] = [1e3, 2e3]
        return made

    return of_solution


SOLUTION = {
    "absolute_covariance": [row(), row(without_unknown=True)],
    "correct_table": [
        row(table=new_table(stars=False)),
        row(table=new_table(stars=True), epoch=2016.5, refused=still()),
    ],
    "plot": [row(ax=lambda _: plt.figure().add_subplot())],
    "stars_at": [row(epoch=2016.5, refused=still())],
    "write": [row(path="file.asdf", overwrite=True)],
    "read": [row(path="file.asdf", max_bytes=10**8)],
}


def frames(setting):
    """Images of a solution with its stars on them."""
    rng, made = np.random.default_rng(1), []
    for part in (part for view in setting for part in view.parts):
        y, x = np.mgrid[: part.shape[0], : part.shape[1]]
        data = rng.normal(100.0, 5.0, part.shape)
        for star in part.residuals:
            data += 3e3 * np.exp(-((x - star["x"].value) ** 2 + (y - star["y"].value) ** 2) / 4.5)
        header = part.header(max_error=1.0) if setting.sky is not None else fits.Header()
        several = {"exposure": part.name, "detector": part.detector} if part.detector else {}
        wcs = WCS(header) if setting.sky is not None else None
        made.append(Exposure(part.label, data, wcs=wcs, header=header, gain=2.0, exposure_time=30.0, **several))
    return tuple(made)


def grid(solution):
    return solution[solution.names[0]].parts[0].fits_wcs(max_error=1.0)


def by_image(solution):
    return {part.label: 1.0 for view in solution for part in view.parts}


MOSAICS = "plain", "read pair", "left out"
COADD = [
    row(method="clipped"),
    row(order="bilinear"),
    row(algorithm="drizzle", pixfrac=0.7, kernel="turbo"),
    row(grid=grid),
    row(conserve="surface_brightness"),
    row(match_background=False),
    row(weights="sigma_map"),
    row(weights=by_image),
    row(scale=by_image),
    row(extrapolated="mask"),
    row(workers=1, scratch=".", progress=True),
    row(planes=["WEIGHT"]),
    row(planes="all"),
    row(weights="seeing", refused=dict.fromkeys(MOSAICS, "has no FWHM of stars in every exposure; give a dict")),
]
ATTACH = [
    row(out="out", overwrite=True, progress=True),
    row(out="out", kind="tpv", max_error=0.1),
    row(in_place=True, kind=None),
    row(out="out", ext="SCI", refused=dict.fromkeys(MOSAICS, "no exposure 'exp00(-a)?_SCI' in the solution")),
    row(refused=dict.fromkeys(MOSAICS, "give either out=")),
]
REPORT = [
    row(mosaic=None, psfs=None, summary=None, comparison=None, stacks=None, joint=None, files=(), overwrite=True),
    row(exposures=frames),
]
STARS = np.random.default_rng(3).uniform([0, 0], [120, 80], (40, 2))
BRIGHT = Table({"x": STARS[:, 0], "y": STARS[:, 1], "mag": np.linspace(12, 18, 40)})
ROUND = EffectivePSF.from_array(np.exp(-np.sum(np.mgrid[-20:21, -20:21] ** 2, axis=0) / 50), oversampling=4)
INSTRUMENT = Instrument(
    camera=Camera("one", {"1": Detector(SHAPE)}), pixel_scale=0.02, psf=ROUND, exposure_time=10, zero_point=26.0,
    sky_brightness=14.0, read_noise=10.0,
)  # fmt: skip
COLOURED = Table({"x": STARS[:, 0], "y": STARS[:, 1], "colour": np.linspace(-1, 2, 40)})
PREDICT = [
    row(stars=STARS),
    row(n_stars=40, min_exposures=3, seed=2),
    row(density=40),
    row(sigma=0.05),
    row(degree=2),
    row(camera=lambda _: matches("pair").camera, shape=None),
    row(dithers=10.0),
    row(pixel_scale=0.02),
    row(instrument=INSTRUMENT, stars=BRIGHT, sigma=None, shape=None),
    row(instrument=INSTRUMENT, refused={"": "sigma and instrument both state the errors"}),
    row(poses=lambda _: matches("plain").poses),
    row(prior=Prior(STATIC, sigma=0.1)),
    row(dynamic=0.1),
    row(spectrum={2: 0.1}, static_spectrum={2: 0.1}),
    row(epochs=[2015.0, 2016.0, 2017.0, 2018.0]),
    row(epochs=[2015.0, 2016.0, 2017.0, 2018.0], field=SkyCoord(10.0, -70.0, unit="deg")),
    row(n_exposures=3, n_grid=8),
    row(terms=Term.named("turbulence", size=0.1, length=40)),
    row(terms=[Term.named("pixel_phase", sigma=0.03)]),
    row(terms="turbulence", refused={"": "a forecast finds no sizes: give turbulence its own"}),
    row(
        terms=Term.named("refraction", sigma=0.02),
        stars=COLOURED,
        tan_z=[0.3, 0.4, 0.5, 0.6],
        parallactic_angle=[0, 20, 40, 60] * u.deg,
    ),
]
MATCH = [
    row(exposures=frames, camera=None),
    row(shape=SHAPE),
    row(min_exposures=3),
    row(columns={"x": "x"}),
    row(tolerance=2.0),
    row(reject_flags=0),
    row(isolation=None),
    row(start={"exp00": (0.0, 0.0), "exp01": (3.0, -2.0, 10.0)}),
    row(keywords=["ROTPPOSN"], refused={"": "no header states ROTPPOSN as a number|to be read from headers"}),
    row(progress=True),
]
MEASURE = [
    row(fwhm=3.5),
    row(threshold=10.0, max_stars=20),
    row(box=9),
    row(profile="linear", psf="moffat"),
    row(blends="alone"),
    row(gain=2.0, read_noise=5.0, saturation=5e4),
    row(errors="fit"),
    row(psf="moffat", write_psf=None),
    row(workers=1, progress=True),
]


# -- the law


def attempt(call, words):
    """The result of a call that is to run, or None for one that is to be refused with such words."""
    if words is None:
        return quiet(call)
    with pytest.raises(LegdistortError, match=words) as caught:
        quiet(call)
    assert len(str(caught.value).split()) > 6
    return None


def resolved(options, setting):
    """Options with what is made from the setting."""
    return {name: value(setting) if inspect.isfunction(value) else value for name, value in options.items()}


def assert_of_use(made, path):
    """It prints; positions and residuals are there; the file has all of it, or without a path the pickle."""
    assert str(made)
    assert repr(made)
    assert str(made.gauge)
    used = np.asarray(made.residuals["used"], dtype=bool)
    assert np.count_nonzero(used) > 0.7 * len(used)
    for axis in "xy":
        assert np.isfinite(made.residuals[f"d{axis}"][used].value).all()
    assert np.count_nonzero(np.isfinite(made.stars["x"].value)) > 20
    back = pickle.loads(pickle.dumps(made)) if path is None else Solution.read(made.write(path))
    assert str(back) == str(made)
    assert [check.state for check in back.checks] == [check.state for check in made.checks]
    for name in set(made.stars.colnames) - {"star", "sky"}:
        np.testing.assert_allclose(back.stars[name], made.stars[name], rtol=1e-9, err_msg=name)
    for view, again in zip(made, back, strict=True):
        np.testing.assert_allclose(again.errors, view.errors, rtol=1e-9)
    for part in made["exp00" if "exp00" in made else made.names[0]].parts:
        np.testing.assert_allclose(part.distort(part.correct(XY)), XY, atol=1e-5)


def options_of(function, subjects):
    return {p.name for p in inspect.signature(function).parameters.values()} - set(subjects) - {"self"}


def methods(kind):
    """Public methods of a class, by name."""
    return {name for name, each in vars(kind).items() if not name.startswith("_") and _is_method(each)}


def _is_method(each):
    return inspect.isfunction(each) or isinstance(each, classmethod | staticmethod)


def assert_complete(function, rows, *subjects):
    assert {name for each in rows for name in each.options} >= options_of(function, subjects), function.__name__


def crossed(pairs, every):
    """Pairs of options and settings; most of each option, each time others, are sets, and some of these slow."""
    return [
        pytest.param(
            *pair,
            marks=[] if k % every == 0 else pytest.mark.slow if k % (3 * every) == 1 else pytest.mark.sets,
            id="-".join(map(str, pair)),
        )
        for k, pair in enumerate(pairs)
    ]


#: A camera of one detector is a plain image but for its static distortion.
OF_ONE = {"degree", "static", "gauge", "errors", "reference"}
SOLVED_ROWS = [
    (given, setting)
    for given in SOLVE
    for setting in ("plain", "one", "pair")
    if setting != "one" or "one" in given.refused or given.options.keys() & OF_ONE
]


@pytest.mark.parametrize(("given", "setting"), crossed(SOLVED_ROWS, 6))
def test_solve(given, setting, tmp_path):
    options = {"degree": 1} | resolved(given.options, setting)
    if options["degree"] is None:
        del options["degree"]
    made = attempt(lambda: solve(matches(setting), **options), given.refused.get(setting))
    if made is not None:  # files take most of the time: one of every row
        in_file = SOLVE.index(given) % 3 == ("plain", "one", "pair").index(setting)
        quiet(assert_of_use, made, tmp_path / "solution.asdf" if in_file else None)


@pytest.mark.parametrize(
    ("method", "given", "setting"),
    crossed([(name, given, setting) for name, rows in VIEW.items() for given in rows for setting in VIEWS], 7),
)
def test_views(solution, method, given, setting):
    solved = solution(setting)
    views, options = [solved[solved.names[0]]], resolved(given.options, solved)
    if solved.camera.has_focal_plane:
        views += [views[0].parts[1]]
    for view in views:
        words = given.refused.get(setting)
        if len(view.parts) > 1 and method not in COMMON:
            words = IN_PIXELS[setting]
        made = attempt(lambda view=view: getattr(view, method)(**options), words)
        if made is not None and method in ("correct", "to_reference"):
            assert np.isfinite(made[0]).all()
    plt.close("all")


@pytest.mark.parametrize(
    ("method", "given", "setting"),
    crossed([(name, given, setting) for name, rows in SOLUTION.items() for given in rows for setting in VIEWS], 7),
)
def test_solutions(solution, method, given, setting, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    solved = solution(setting)
    if method == "read":
        solved.write("file.asdf")
    options = resolved(given.options, solved)
    attempt(lambda: getattr(solved, method)(**options), given.refused.get(setting))
    plt.close("all")


@pytest.fixture(scope="module")
def images(solution):
    return cache(lambda setting: frames(solution(setting)))


@pytest.mark.parametrize(("given", "setting"), crossed(itertools.product(COADD, MOSAICS), 4))
def test_coadd(solution, images, given, setting, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    solved = solution(setting)
    options = resolved(given.options, solved)
    made = attempt(lambda: coadd(images(setting), solved, **options), given.refused.get(setting))
    if made is not None:
        assert repr(made)
        assert np.isfinite(made.data).mean() > 0.05
        assert made.write("mosaic.fits").exists()


@pytest.mark.parametrize(("given", "setting"), crossed(itertools.product(ATTACH, MOSAICS), 4))
def test_attach(solution, images, given, setting, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for each in images(setting):
        fits.writeto(f"{each.name}.fits", each.data, each.header)
    made = attempt(lambda: attach(solution(setting), "*.fits", **given.options), given.refused.get(setting))
    assert made is None or [each.exposure for each in made]


@pytest.mark.parametrize("setting", VIEWS)
def test_refine(solution, setting):
    solved = solution(setting)
    view = solved[solved.names[0]].parts[-1]
    words = "must lead from two pixel coordinates to the sky" if setting == "no sky" else None
    made = attempt(lambda: refine(wcs=view.wcs, view=view), words)
    assert made is None or np.isfinite(made(30.0, 40.0)).all()


@pytest.mark.parametrize(
    ("given", "setting"), crossed(itertools.product(REPORT, ["plain", "pair", "motions", "read pair", "no sky"]), 4)
)
def test_report(solution, given, setting, tmp_path, undrawn):
    solved = solution(setting)
    options = resolved(given.options, solved)
    assert quiet(write_report, tmp_path / "report.html", solved, **options) or (tmp_path / "report.html").exists()


@pytest.mark.parametrize("given", PREDICT, ids=str)
def test_predict(given):
    options = {"n_exposures": 4, "stars": STARS, "sigma": SIGMA, "degree": 1, "shape": SHAPE, "n_grid": 5}
    if given.options.keys() & {"n_stars", "density"}:
        del options["stars"]
    made = attempt(lambda: predict(**options | resolved(given.options, None)), given.refused.get(""))
    if made is not None:
        assert str(made)
        assert np.isfinite(made.b)


@pytest.mark.parametrize(("given", "setting"), crossed(itertools.product(MATCH, ["plain", "pair"]), 3))
def test_match(solution, images, given, setting):
    solved = solution(setting)
    positions = solved.camera.on_detectors(solved.residuals) if setting == "pair" else solved.residuals
    table = positions["exposure", "x", "y", "x_err", "y_err", "flux"]
    if setting == "pair":
        table["detector"] = positions["detector"]
    options = {"camera": solved.camera} if setting == "pair" else {"shape": SHAPE}
    made = attempt(lambda: match(table, **options | resolved(given.options, solved)), given.refused.get(setting))
    if made is not None:
        assert repr(made)
        assert len(made.table) > 50


@pytest.mark.parametrize("given", MEASURE, ids=str)
def test_measure(images, given):
    made = attempt(lambda: measure(images("plain")[:2], **given.options), given.refused.get(""))
    assert np.isfinite(made["x"].value).all()
    assert len(made) > 10


def test_no_option_is_forgotten():
    assert_complete(solve, SOLVE, "matches")
    assert_complete(coadd, COADD, "exposures", "solution")
    assert_complete(attach, ATTACH, "solution", "paths")
    assert_complete(predict, PREDICT)
    assert_complete(match, MATCH, "detections")
    assert_complete(measure, MEASURE, "exposures")
    assert_complete(write_report, REPORT, "path", "solution")
    assert_complete(refine, [row(wcs=None, view=None)])
    for kind, rows in ((View, VIEW), (Solution, SOLUTION)):
        assert methods(kind) == set(rows)
        for name, each in rows.items():
            assert_complete(getattr(kind, name), each)


# -- faults that the table has shown


def test_a_check_says_that_no_absolute_position_is_known():
    """Where nothing determines how detectors lie, no dither over the gaps and no roll: it was a mean of nothing."""
    made = quiet(solve, four_detectors.matches(None, 0, n=4, dither=2.0), degree=1, layout="fit")
    assert not np.isfinite(made.stars["x_err_abs"].value).any()
    (check,) = (check for check in made.checks if check.name == "absolute")
    assert check.state == "unknown"
    assert "do not determine how the detectors lie" in check.sentence


def test_offsets_need_a_star(solution):
    solved = solution("plain")
    with pytest.raises(LegdistortError, match="xy has a position of none of the stars"):
        known_offsets(solved, np.full(solved.estimate.positions.shape, np.nan))


def test_errors_that_are_no_numbers(solution):
    with pytest.raises(LegdistortError, match="errors must be numbers, in pixels"):
        solution("plain")["exp00"].correct(XY, errors="small")
