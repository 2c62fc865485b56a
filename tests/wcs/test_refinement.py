"""A solution in the WCS of a pipeline: frames stay, the sky is that of the solution, its tools take the result."""

import io
from dataclasses import replace

import asdf
import gwcs
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import FK5, ICRS
from astropy.modeling import models
from gwcs import coordinate_frames as cf
from gwcs.geometry import CartesianToSpherical, SphericalToCartesian
from numpy.testing import assert_allclose, assert_array_equal
from sky_chains import detector, geometries, solution_at

import legdistort
from legdistort.exceptions import InputError

SHAPE = (400, 560)
SCALE = 0.06  # arcsec per pixel


def plane(name, unit):
    return cf.Frame2D(name=name, axes_names=("x", "y"), unit=(unit, unit))


def pipeline(lon=10.0, lat=-30.0, v2=80.0, *, reference=None, shape=SHAPE):
    """Detector -> v2v3 (arcsec) -> v2v3vacorr -> world, as the pipeline of JWST makes it, with a linear distortion."""
    ny, nx = shape
    shift = models.Shift(-(nx - 1) / 2) & models.Shift(-(ny - 1) / 2)
    to_v23 = shift | models.Scale(SCALE) & models.Scale(SCALE) | models.Shift(v2) & models.Shift(-490.0)
    aberration = models.Scale(1 + 1e-5) & models.Scale(1 + 1e-5)
    turn = models.RotationSequence3D([v2 / 3600, 490 / 3600, 30.0, lat, -lon], "zyxyz")
    degrees = models.Scale(1 / 3600) & models.Scale(1 / 3600)
    to_sky = degrees | SphericalToCartesian(wrap_lon_at=180) | turn | CartesianToSpherical(wrap_lon_at=360)
    sky = cf.CelestialFrame(
        name="world", reference_frame=ICRS() if reference is None else reference, unit=(u.deg, u.deg)
    )
    steps = [
        (plane("detector", u.pix), to_v23), (plane("v2v3", u.arcsec), aberration),
        (plane("v2v3vacorr", u.arcsec), to_sky), (sky, None),
    ]  # fmt: skip
    wcs = gwcs.WCS(steps, name="f200w")
    wcs.bounding_box = ((3.5, nx - 0.5), (-0.5, ny - 0.5))
    return wcs


def check_sky(made, solution, within):
    """On the sky the solution stands, by the textbook formula, both ways."""
    p, ra, dec = detector(solution, "a")
    (x0, x1), (y0, y1) = within
    inside = (p > [x0 + 1e-6, y0 + 1e-6]).all(axis=1) & (p < [x1 - 1e-6, y1 - 1e-6]).all(axis=1)
    sky = made.pixel_to_world(*p[inside].T)
    off = [(sky.ra.deg - ra[inside] + 180) % 360 - 180, sky.dec.deg - dec[inside]]
    assert np.hypot(off[0] * np.cos(np.radians(dec[inside])), off[1]).max() < 2e-6 * solution.sky.pixel_scale / 3600
    assert_allclose(np.column_stack(made.invert(ra[inside], dec[inside])), p[inside], rtol=0, atol=2e-6)
    beyond = (p < [x0 - 1e-6, y0 - 1e-6]).any(axis=1)
    assert np.isnan(made(*p[beyond].T)).all()


@pytest.mark.parametrize(("lon", "lat"), [(10.0, -30.0), (0.0, 60.0), (0.0, 90.0)])
def test_frames_stay_and_the_sky_is_that_of_the_solution(lon, lat):
    wcs = pipeline(lon, lat)
    before = np.array(wcs(100.0, 200.0))
    solution = solution_at(wcs, SHAPE)
    made = legdistort.refine(wcs, solution["a"])
    assert isinstance(made, gwcs.WCS)
    assert made.available_frames == ["detector", "v2v3", "v2v3vacorr", "world"]
    assert [step.frame for step in made.pipeline] == [step.frame for step in wcs.pipeline]
    assert (made.name, made.pixel_shape) == ("f200w", None)
    assert made.bounding_box == wcs.bounding_box
    box = wcs.bounding_box.bounding_box(order="F")
    check_sky(made, solution, box)
    assert_array_equal(wcs(100.0, 200.0), before)
    v23 = np.array(made.get_transform("detector", "v2v3")(100.0, 200.0))
    assert np.hypot(*(v23 - wcs.get_transform("detector", "v2v3")(100.0, 200.0))) < 12 * SCALE
    for start, end in (("v2v3", "world"), ("world", "v2v3vacorr"), ("v2v3", "v2v3vacorr")):
        ours, theirs = (w.get_transform(start, end)(*(v23 if start == "v2v3" else before)) for w in (made, wcs))
        assert_array_equal(ours, theirs)
    assert_allclose(made.get_transform("v2v3", "detector")(*v23), [100.0, 200.0], rtol=0, atol=2e-6)


def test_read_without_legdistort(tmp_path):
    wcs = pipeline()
    made = legdistort.refine(wcs, solution_at(wcs, SHAPE)["a"])
    content = io.BytesIO()
    asdf.AsdfFile({"meta": {"wcs": made}}).write_to(content)
    assert b"legdistort" not in content.getvalue()
    content.seek(0)
    with asdf.open(content, lazy_load=False) as file:
        back = file["meta"]["wcs"]
    assert type(back) is gwcs.WCS
    assert_allclose(back([100.0, 300.0], [200.0, 10.0]), made([100.0, 300.0], [200.0, 10.0]), rtol=0, atol=1e-12)
    assert_allclose(back.invert(*made(100.0, 200.0), with_bounding_box=False), [100.0, 200.0], rtol=0, atol=2e-6)


def test_longitudes_stay_in_their_turn():
    """An inverse that counts from 0 to 360 degrees does not move negative V2 by a turn."""
    wcs = pipeline(v2=-80.0)
    to_sky = wcs.pipeline[2].transform
    wrapped = to_sky.copy()
    wrapped.inverse = to_sky.inverse | models.Shift(1296000.0) & models.Identity(1)
    wcs = gwcs.WCS([*((s.frame, s.transform) for s in wcs.pipeline[:2]), (wcs.pipeline[2].frame, wrapped),
                    (wcs.output_frame, None)])  # fmt: skip
    made = legdistort.refine(wcs, solution_at(wcs, SHAPE)["a"])
    assert -100 < made.get_transform("detector", "v2v3")(280.0, 200.0)[0] < -60
    assert_allclose(made.get_transform("detector", "world")(280.0, 200.0), made(280.0, 200.0), rtol=1e-12)


def test_without_a_frame_between():
    wcs = pipeline()
    short = gwcs.WCS([(wcs.input_frame, wcs.forward_transform), (wcs.output_frame, None)])
    short.bounding_box = None  # that of the whole detector then
    short.pixel_shape = SHAPE[::-1]
    solution = solution_at(wcs, SHAPE)
    made = legdistort.refine(short, solution["a"])
    assert made.available_frames == ["detector", "world"]
    assert made.pixel_shape == SHAPE[::-1]
    check_sky(made, solution, ((-0.5, SHAPE[1] - 0.5), (-0.5, SHAPE[0] - 0.5)))


@pytest.mark.parametrize(
    ("name", "shape"), [("nircamwcs", (2048, 2048)), ("miriwcs", (1024, 1032)), ("roman_wcs", (5000, 5000))]
)
def test_real_pipelines(shared_data, name, shape):
    with asdf.open(shared_data / "gwcs_interop" / f"{name}.asdf", lazy_load=False, memmap=False) as file:
        wcs = file["roman"]["wcs"] if "roman" in file.tree else file["wcs"]
    solution = solution_at(wcs, shape, peak=5.0)
    made = legdistort.refine(wcs, solution["a"])
    assert made.available_frames == wcs.available_frames
    check_sky(made, solution, wcs.bounding_box.bounding_box(order="F"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w, s: ("wcs", s), r"wcs must be a gwcs.WCS, such as model.meta.wcs of a pipeline, got str"),
        (lambda w, s: (w, replace(s, sky=None)), r"does not know the sky.*\(reference=, --reference\)"),
        (lambda w, s: (pipeline(reference=FK5()), s), "the sky of wcs must be ICRS in degrees, got <FK5"),
        (lambda w, s: (pipeline(lon=11.0), s), r"exposure a of the solution lie .* apart.*WCS of another exposure\?"),
        (lambda w, s: (pipeline(shape=(500, 500)), s), "y -0.5 to 499.5, is not within the 560 x 400 pixels of"),
        (lambda w, s: (_of(w, pixel_shape=(10, 20)), s), r"wcs is of \(10, 20\) pixels \(nx, ny\), exposure"),
        (lambda w, s: (_one_way(w), s), "the transform of wcs from v2v3 to world has no inverse"),
        (lambda w, s: (_with_units(), s), "take quantities; give a WCS whose models are without units"),
        (lambda w, s: (s["a"].wcs.__class__(w.pipeline[:1] + [(plane("v2v3", u.arcsec), None)]), s), "to the sky, got"),
    ],
)  # fmt: skip
def test_what_cannot_be_refined(change, words):
    wcs = pipeline()
    wcs, solution = change(wcs, solution_at(wcs, SHAPE))
    with pytest.raises(InputError, match=words):
        legdistort.refine(wcs, solution["a"])


@pytest.mark.parametrize("dither", [60.0, -60.0, 20.0])
def test_the_wcs_of_another_exposure(dither):
    """As long as the two are farther apart than headers may be wrong: 5 % of the diagonal, 34 px here."""
    wcs = pipeline()
    made = geometries()(3, 1.0, shape=SHAPE, turn=0.0, names=("a", "b"))
    poses = {"a": np.eye(2, 3), "b": np.array([[1.0, 0.0, dither], [0.0, 1.0, 0.0]])}
    solution = replace(made, sky=solution_at(wcs, SHAPE).sky, poses=poses)
    legdistort.refine(wcs, solution["a"])
    if dither == 20.0:
        legdistort.refine(wcs, solution["b"])
        return
    with pytest.raises(InputError, match=r"wcs is 3\.\d+ arcsec off exposure b .* off a: it is the WCS of that one"):
        legdistort.refine(wcs, solution["b"])
    wrong = pipeline(lon=10.0 + 3.0 / 3600)  # a pointing, and no other exposure there
    legdistort.refine(wrong, solution["a"])


def test_an_exposure_that_is_not_there():
    wcs = pipeline()
    with pytest.raises(InputError, match="no exposure 'b' in the solution"):
        legdistort.refine(wcs, solution_at(wcs, SHAPE)["b"])


def _of(wcs, **attributes):
    for key, value in attributes.items():
        setattr(wcs, key, value)
    return wcs


def _one_way(wcs):
    steps = [(step.frame, step.transform) for step in wcs.pipeline]
    bent = models.Mapping((0, 1, 0, 1)) | models.Polynomial2D(1, c1_0=1) & models.Polynomial2D(1, c0_1=1)
    return gwcs.WCS([steps[0], (steps[1][0], bent | steps[1][1]), *steps[2:]])


def _with_units():
    to_sky = models.Shift(1 * u.pix) & models.Shift(1 * u.pix) | models.Scale(1 * u.deg / u.pix) & models.Scale(
        1 * u.deg / u.pix
    )
    sky = cf.CelestialFrame(name="world", reference_frame=ICRS(), unit=(u.deg, u.deg))
    return gwcs.WCS([(plane("detector", u.pix), to_sky), (sky, None)])


# --- in the tools of the pipelines -------------------------------------------------------------------------------


def test_tweakwcs():
    """A shift by one arcsecond in the tangent plane moves the refined sky by that."""
    correctors = pytest.importorskip("tweakwcs.correctors", reason="tweakwcs is no extra of the tests")
    wcs = pipeline()
    solution = solution_at(wcs, SHAPE)
    info = {"v2_ref": 80.0, "v3_ref": -490.0, "roll_ref": 0.0}
    corrector = correctors.JWSTWCSCorrector(legdistort.refine(wcs, solution["a"]), info)
    p, ra, _ = (a[404:] for a in detector(solution, "a"))
    p, ra = p[p[:, 0] > 3.5], ra[p[:, 0] > 3.5]
    assert_allclose(np.mod(corrector.det_to_world(*p.T)[0], 360), ra, rtol=0, atol=1e-9)
    corrector.set_correction(shift=(1.0, 0.0))
    assert corrector.wcs.available_frames == ["detector", "v2v3", "v2v3vacorr", "v2v3corr", "world"]
    moved = corrector.wcs.pixel_to_world(*p.T)
    apart = moved.separation(solution["a"].wcs.pixel_to_world(*p.T)).arcsec
    assert_allclose(apart, 1.0, rtol=1e-4)


def test_stcal():
    """The pixel map with which jwst and romancal resample: both ways by the exact chain."""
    utils = pytest.importorskip("stcal.resample.utils", reason="stcal is no extra of the tests")
    wcs = pipeline()
    solution = solution_at(wcs, SHAPE)
    made = legdistort.refine(wcs, solution["a"])
    ny, nx = SHAPE
    grid = solution["a"].fits_wcs()  # as a target of another kind
    pixmap = utils.calc_pixmap(made, made, shape=SHAPE)
    y, x = np.mgrid[:ny, :nx]
    inside = x > 3.5
    assert np.abs(pixmap - np.stack([x, y], axis=-1))[inside].max() < 2e-6
    pixmap = utils.calc_pixmap(made, grid, shape=SHAPE)
    assert np.abs(pixmap - np.stack([x, y], axis=-1))[inside].max() < 2e-3  # max_error of the FITS WCS
