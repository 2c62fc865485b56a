"""The algebra of similarities, and the tangent plane against astropy."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from legdistort.exceptions import InputError
from legdistort.geometry import similarity
from legdistort.geometry.tangent_plane import TangentPlane, angles, compass, directions, gnomonic


@st.composite
def similarities(draw):
    angle = draw(st.floats(-np.pi, np.pi))
    scale = draw(st.floats(0.01, 100))
    flip = draw(st.sampled_from([1.0, -1.0]))
    shift = [draw(st.floats(-3000, 3000)) for _ in range(2)]
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([scale * np.array([[c, -s], [s, c]]) @ np.diag([1.0, flip]), shift])


XY = np.random.default_rng(0).uniform(-1000, 1000, (20, 2))


@given(similarities())
def test_apply_is_mx_plus_t(a):
    assert_allclose(similarity.apply(a, XY)[3], a[:, :2] @ XY[3] + a[:, 2])


@pytest.mark.parametrize("xy", [[[1.0, 2.0, 3.0]], [1.0], 2.0])
def test_what_is_no_position_is_refused(xy):
    with pytest.raises(InputError, match=r"positions must be x and y in pixels, an array of shape \(n, 2\), got"):
        similarity.apply(similarity.identity(), xy)


@given(similarities())
def test_inverse_undoes(a):
    assert_allclose(similarity.apply(similarity.invert(a), similarity.apply(a, XY)), XY, atol=1e-8)
    assert_allclose(similarity.compose(a, similarity.invert(a))[:, :2], np.eye(2), atol=1e-12)


@given(similarities(), similarities(), similarities())
def test_composition(a, b, c):
    assert_allclose(
        similarity.apply(similarity.compose(a, b), XY),
        similarity.apply(a, similarity.apply(b, XY)),
        rtol=1e-10,
        atol=1e-6,
    )
    left, right = similarity.compose(similarity.compose(a, b), c), similarity.compose(a, similarity.compose(b, c))
    assert_allclose(left, right, rtol=1e-9, atol=1e-6 * np.abs(left).max())
    assert_allclose(similarity.compose(a, similarity.identity()), a)
    assert_allclose(similarity.compose(similarity.identity(), a), a)


@given(similarities())
def test_similarities_pass_the_check_and_are_described(a):
    assert_allclose(similarity.check(a), a)
    d = similarity.describe(a)
    turn = np.radians(d["rotation"])
    m = d["scale"] * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag([1, d["parity"]])
    assert_allclose(np.column_stack([m, [d["dx"], d["dy"]]]), a, rtol=1e-9, atol=1e-9 * d["scale"])


@given(similarities())
def test_fit_recovers_a_similarity(a):
    assert_allclose(similarity.fit_similarity(XY, similarity.apply(a, XY)), a, rtol=1e-7, atol=1e-7)


@given(similarities(), st.integers(0, 99))
def test_fit_is_the_least_squares_solution(a, seed):
    """Against a plain design matrix, weighted, with noise."""
    rng = np.random.default_rng(seed)
    scale = similarity.describe(a)["scale"]
    target = similarity.apply(a, XY) + scale * rng.normal(size=XY.shape)
    w = rng.uniform(0, 1, len(XY))
    pose = similarity.fit_similarity(XY, target, weights=w)
    x, y = XY.T
    one, zero = np.ones(len(XY)), np.zeros(len(XY))
    parity = similarity.describe(a)["parity"]
    # M = [[p, -q], [q, p]], or [[p, q], [q, -p]] in a mirror
    design = np.concatenate([np.column_stack([x, -parity * y, one, zero]), np.column_stack([parity * y, x, zero, one])])
    root = np.sqrt(np.tile(w, 2))
    p, q, tx, ty = np.linalg.lstsq(design * root[:, None], target.T.ravel() * root, rcond=None)[0]
    assert_allclose(pose, [[p, -parity * q, tx], [q, parity * p, ty]], rtol=1e-7, atol=1e-7 * scale)


def test_parity_can_be_held():
    mirrored = XY * [-1, 1]
    assert similarity.describe(similarity.fit_similarity(XY, mirrored))["parity"] == -1
    assert similarity.describe(similarity.fit_similarity(XY, mirrored, parity=1))["parity"] == 1
    assert similarity.describe(similarity.fit_similarity(XY, XY, parity=-1))["parity"] == -1


def test_robust_fit_ignores_outliers_and_keeps_given_weights():
    xy = np.random.default_rng(0).uniform(0, 1000, (30, 2))
    target = xy + np.where(np.arange(30) < 20, 0.0, 8.0)[:, None]
    assert_allclose(similarity.apply(similarity.robust_similarity(xy, target), xy), xy, atol=0.1)
    pose = similarity.robust_similarity(xy, target, weights=(np.arange(30) >= 20).astype(float))
    assert_allclose(similarity.apply(pose, xy), xy + 8, atol=1e-6)


@pytest.mark.parametrize(
    ("source", "weights", "message"),
    [
        (XY[:1], None, "needs at least two points, got 1"),
        (XY[:3], [0, 1, 0], "needs at least two points, got 1"),
        (np.ones((5, 2)), None, "two distinct points, all are at the same place"),
    ],
)
def test_too_few_points(source, weights, message):
    with pytest.raises(InputError, match=message):
        similarity.fit_similarity(source, source, weights=weights)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.eye(3), r"pose of exp1 must be a finite \(2, 3\) array \[M \| t\], got shape \(3, 3\)"),
        ([[1, 0, np.nan], [0, 1, 0]], "must be a finite"),
        ([[1, 0.1, 0], [0, 1, 0]], "is not a similarity .*leave shear to the distortion"),
        ([[1, 0, 0], [0, 1.01, 0]], "is not a similarity"),
        (np.zeros((2, 3)), "is not a similarity"),
    ],
)
def test_bad_poses(pose, message):
    with pytest.raises(InputError, match=message):
        similarity.check(pose, "pose of exp1")


def plane(lon=201.3, lat=-47.5, scale=0.02 / 3600, angle=12.0):
    t = np.radians(angle)
    m = scale * np.array([[-np.cos(t), np.sin(t)], [np.sin(t), np.cos(t)]])
    return TangentPlane(lon, lat, np.column_stack([m, -m @ [511.5, 383.5]]))


@pytest.mark.parametrize(("lon", "lat"), [(201.3, -47.5), (0.0, 0.0), (359.9999, 60.0), (30.0, 89.999), (30.0, -90.0)])
def test_tangent_plane_is_a_fits_tan(lon, lat):
    tp = plane(lon, lat)
    header = WCS(naxis=2)
    header.wcs.ctype = "RA---TAN", "DEC--TAN"
    header.wcs.crval = lon, lat
    header.wcs.cd = tp.matrix[:, :2]
    header.wcs.crpix = 512.5, 384.5
    header.wcs.radesys = "ICRS"
    expected = SkyCoord(*header.wcs_pix2world(XY, 0).T * u.deg)
    sky = tp.to_sky(XY)
    assert sky.separation(expected).max() < 1e-9 * u.arcsec
    assert sky.frame.name == "icrs"
    assert_allclose(tp.from_sky(sky), XY, atol=1e-5)
    assert_allclose(tp.pixel_scale, 0.02)


def test_tangent_plane_takes_any_frame():
    tp = plane()
    assert_allclose(tp.from_sky(tp.to_sky(XY).galactic), XY, atol=1e-5)


@pytest.mark.parametrize(("lon", "lat"), [(201.3, -47.5), (0.0, 0.0), (359.9999, 60.0), (30.0, 89.999)])
@pytest.mark.parametrize("degrees", [1.0, 1 / 3600])
def test_gnomonic_projection_is_that_of_the_tangent_plane(lon, lat, degrees):
    plane = TangentPlane(lon, lat, np.eye(2, 3))
    offsets = np.random.default_rng(2).uniform(-2, 2, (30, 2))
    sky = plane.to_sky(offsets)
    ra = np.where(np.arange(30) % 2, sky.ra.deg, sky.ra.deg - 360)  # the same place
    found = gnomonic(ra / degrees, sky.dec.deg / degrees, lon / degrees, lat / degrees, degrees)
    assert_allclose(degrees * np.stack(found, axis=1), offsets, rtol=0, atol=1e-10)
    assert np.isnan(gnomonic(lon + 180, -lat, lon, lat)).all()


@given(st.floats(-3.1, 3.1), st.floats(-1.57, 1.57))
def test_directions_and_compass_are_a_frame(lon, lat):
    place = directions(lon, lat)
    frame = np.stack([place, *compass(lon, lat)])
    assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) > 0
    assert_allclose(angles(3 * place), (lon, lat), atol=1e-9)


# --- errors on the sky ---------------------------------------------------------------------------------------------

PLACES = [(0.0, 0.0), (359.9999, -30.0), (83.6, 89.9), (200.0, -90.0), (120.0, 60.0)]


@pytest.mark.parametrize(("lon", "lat"), PLACES)
@pytest.mark.parametrize("flip", [1, -1])
def test_sky_jacobian_is_the_finite_difference(lon, lat, flip):
    """Offsets on the sky that a small step in x or y makes, east and north at the place itself."""
    angle = np.radians(25)
    m = 2e-3 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([flip, 1.1])
    plane = TangentPlane(lon, lat, np.column_stack([m, [0.3, -0.2]]))
    xy = np.random.default_rng(0).uniform(-1500, 1500, (30, 2))  # up to 3 degrees off: far from flat
    found = plane.jacobian(xy)
    for k, step in enumerate(np.eye(2) * 0.5):
        centre, ahead, behind = (plane.to_sky(p) for p in (xy, xy + step, xy - step))
        east, north = (np.subtract(a.deg, b.deg) for a, b in zip(
            centre.spherical_offsets_to(ahead), centre.spherical_offsets_to(behind), strict=True))  # fmt: skip
        assert_allclose(found[:, :, k], np.stack([east, north], axis=1), rtol=0, atol=3e-9)


def test_sky_errors_are_those_of_a_cloud_of_points():
    plane = TangentPlane(30.0, 70.0, np.array([[-1e-3, 5e-4, 0.1], [5e-4, 1e-3, 0.5]]))
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    cloud = np.random.default_rng(1).multivariate_normal([800, -300], covariance, 200_000)
    sky, centre = plane.to_sky(cloud), plane.to_sky(np.array([[800.0, -300.0]]))
    east, north = (a.to_value(u.mas) for a in centre.spherical_offsets_to(sky))
    ra_error, dec_error, corr = plane.to_sky_errors(np.array([[800.0, -300.0]]), np.array([[0.04], [0.09], [0.01]]))
    assert_allclose(ra_error.to_value(u.mas), east.std(), rtol=5e-3)
    assert_allclose(dec_error.to_value(u.mas), north.std(), rtol=5e-3)
    assert_allclose(corr, np.corrcoef(east, north)[0, 1], atol=5e-3)


@pytest.mark.parametrize(("lon", "lat", "flip"), [(10.0, -40.0, 1), (359.9999, 89.2, -1), (200.0, 0.0, -1)])
def test_position_angle_and_scale_are_those_of_the_sky(lon, lat, flip):
    """Of a rotated exposure off the tangent point, by the separations and angles of astropy."""
    turn, scale, pose_turn = np.radians(33.0), 0.02 / 3600, np.radians(-50.0)
    matrix = scale * np.array([[-flip * np.cos(turn), np.sin(turn)], [flip * np.sin(turn), np.cos(turn)]])
    plane = TangentPlane(lon, lat, np.column_stack([matrix, [0.0, 0.0]]))
    c, s = 1.1 * np.cos(pose_turn), 1.1 * np.sin(pose_turn)
    pose = np.array([[c, -s, 4000.0], [s, c, -9000.0]])
    centre = np.array([511.5, 1023.5])
    ends = similarity.apply(similarity.invert(pose), [centre, centre + [0, 1], centre + [1, 0]])
    middle, up, along = plane.to_sky(ends)
    angle, size = plane.orientation(pose, (2048, 1024))
    assert angle == pytest.approx((middle.position_angle(up).deg + 180) % 360 - 180, abs=1e-4)
    assert size == pytest.approx(np.sqrt(middle.separation(up).arcsec * middle.separation(along).arcsec), rel=1e-5)
    assert size == pytest.approx(0.02 / 1.1, rel=1e-3)
