"""FITS headers with distortion (TAN-SIP, TPV), and how far a header is from the exact chain.

SIP is what DS9, astropy and Aladin read, TPV what SWarp and SCAMP read. Both are polynomials from pixels to the sky,
the direction in which a distortion has no closed form: they are fitted, their degree is raised until the error asked
for holds, and the error found over the whole detector is written in the header. SIP also carries the opposite
direction, which is the distortion itself.
"""

import math
import warnings

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS, FITSFixedWarning
from astropy.wcs.utils import wcs_to_celestial_frame
from numpy.polynomial.polynomial import polyval2d

from ..exceptions import ExportError, InputError
from ..geometry import basis, models, similarity
from ..geometry.tangent_plane import TangentPlane
from ..runtime.checks import check_choice, check_positive

#: Highest degree of each convention: SIP has one digit, TPV has no keywords beyond.
MAX_DEGREE = {"sip": 9, "tpv": 7}
#: The inverse polynomial of SIP is raised in degree until it is that good [pix], or has the highest degree.
INVERSE_ERROR = 1e-7

#: TPV: number of the first term of each total degree; the terms in the radius (3, 11, 23, 39) stay zero.
_TPV_FIRST = {1: 1, 2: 4, 3: 7, 4: 12, 5: 17, 6: 24, 7: 31}
_NODES = 25
_GRID = 65
_LAWSON = 12


def make_header(pose, distortion, sky, *, kind="sip", max_error=1e-3):
    """FITS header of one exposure: WCS keywords only, of the lowest degree that meets an error.

    The reference point is the tangent point of the sky if it falls on the detector, and the middle of the detector
    otherwise.

    Parameters
    ----------
    pose : ndarray, shape (2, 3)
        Reference plane -> undistorted pixels.
    distortion : Distortion
    sky : TangentPlane or None
    kind : {"sip", "tpv"}
        Convention: TAN with SIP polynomials, or TPV.
    max_error : float
        Largest error allowed over the whole detector, edges and corners included, pixels.

    Returns
    -------
    `~astropy.io.fits.Header`
        With the largest errors that `header_error` found, in pixels, rounded up: ``SIPMXERR`` (pixel to sky) and
        ``SIPIVERR`` (sky to pixel), or ``TPVMXERR`` and ``TPVIVERR``.

    Raises
    ------
    ExportError
        If no degree meets `max_error`, naming the best.
    InputError
        If the sky is not known.
    """
    check_choice(kind, tuple(MAX_DEGREE), "kind")
    check_positive(max_error, "max_error", "number of pixels")
    origin, tangent = _reference_point(pose, distortion, sky)
    nodes = _detector_points(distortion.shape, np.cos(np.pi * np.arange(_NODES) / (_NODES - 1)))
    offset = nodes - origin
    plane = tangent.from_sky(_exact_sky(pose, distortion, sky, nodes))
    top = MAX_DEGREE[kind]
    for degree in range(2, top + 1):
        polynomial, missed = _fit(offset, plane, degree)
        cd = np.stack([polynomial[:, 1, 0], polynomial[:, 0, 1]], axis=1)
        if degree < top and np.hypot(*np.linalg.solve(cd, missed.T)).max() > max_error:
            continue
        header = _linear_header(kind, origin, tangent, cd)
        header.update(_sip(polynomial, cd, offset, plane) if kind == "sip" else _tpv(degree, cd, offset, plane))
        errors = [_round_up(error) for error in header_error(header, pose, distortion, sky)]
        if max(errors) <= max_error:
            for key, error, direction in zip(("MXERR", "IVERR"), errors, ("pixel to sky", "sky to pixel"), strict=True):
                header[kind.upper() + key] = (error, f"[pix] largest error over detector, {direction}")
            return header
    raise ExportError(
        f"{distortion.name}: no {kind.upper()} header meets max_error = {max_error:g} px; the best, of degree {top}, "
        f"has {max(errors):.2g} px: allow that (--max-error), or hand on the ASDF form, which is exact"
    )


def header_error(header, pose, distortion, sky):
    """Largest errors [pix] of a FITS header against the exact chain of an exposure, as `astropy.wcs` reads it.

    Over a grid of the whole detector with its edges and corners; errors are distances in detector pixels.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Any celestial WCS: of `make_header`, or of another program.
    pose, distortion, sky
        As for `make_header`.

    Returns
    -------
    forward : float
        Pixel to sky.
    inverse : float
        Sky to pixel: by the inverse polynomials if the header has them (SIP), otherwise by iteration. Infinite if it
        fails anywhere.

    Raises
    ------
    InputError
        If the header has no celestial WCS, or the sky is not known.
    """
    points = _detector_points(distortion.shape, np.linspace(-1, 1, _GRID))
    exact = _exact_sky(pose, distortion, sky, points)
    with warnings.catch_warnings(action="ignore", category=FITSFixedWarning):
        wcs = WCS(header)
    if not wcs.has_celestial:
        raise InputError(f"the header compared with exposure {distortion.name} has no celestial WCS")
    frame = wcs_to_celestial_frame(wcs)
    stated = SkyCoord(*wcs.all_pix2world(points, 0).T, unit="deg", frame=frame)
    forward = distortion(similarity.apply(pose, sky.from_sky(stated)))
    there = exact.transform_to(frame).spherical
    inverse = _pixels(wcs, np.column_stack([there.lon.deg, there.lat.deg]))
    return tuple(_largest(found - points) for found in (forward, inverse))


def _pixels(wcs, sky):
    """Sky [deg] -> pixels (n, 2), from 0, by the inverse polynomials where there are some."""
    if wcs.sip is None:
        return wcs.wcs_world2pix(sky, 0)
    if wcs.sip.ap is None:
        return wcs.all_world2pix(sky, 0, quiet=True)
    flat = wcs.wcs_world2pix(sky, 0)
    return flat + np.stack([polyval2d(*(flat - wcs.wcs.crpix + 1).T, c) for c in (wcs.sip.ap, wcs.sip.bp)], axis=1)


def _largest(difference):
    distance = np.hypot(*difference.T)
    return float(distance.max()) if np.all(np.isfinite(distance)) else np.inf


def _exact_sky(pose, distortion, sky, points):
    """Sky (SkyCoord) of detector pixels (n, 2)."""
    if sky is None:
        raise InputError(
            f"the solution does not know the sky, so exposure {distortion.name} can have no FITS header: solve "
            "frames whose headers have a WCS, or give a reference catalogue with ra and dec (reference=, --reference)"
        )
    distortion.check_fold()
    return sky.to_sky(similarity.apply(similarity.invert(pose), distortion.invert(points)))


def _reference_point(pose, distortion, sky):
    """Pixel (2,) of the reference point of a header, and the `TangentPlane` there, in degrees."""
    ny, nx = distortion.shape
    centre = np.array([nx - 1, ny - 1]) / 2
    there = _exact_sky(pose, distortion, sky, centre[None])[0]
    tangent = similarity.apply(pose, similarity.invert(sky.matrix)[None, :, 2])
    pixel = distortion(tangent)[0]
    near = not models.outside(
        distortion.inverse.valid, *tangent[0]
    )  # elsewhere the series means nothing and may fold back
    if near and np.all(np.abs(pixel - centre) <= np.array([nx, ny]) / 2):
        return pixel, TangentPlane(sky.lon, sky.lat, similarity.identity())
    # far from the detector powers of the distance would lose digits
    return centre, TangentPlane(there.ra.deg, there.dec.deg, similarity.identity())


def _detector_points(shape, t):
    """Pixels (n * n, 2) at all pairs of the normalised coordinates `t` in [-1, 1]."""
    u, v = np.meshgrid(t, t)
    return basis.denormalize(u.ravel(), v.ravel(), shape)


def _fit(points, target, degree):
    """Polynomial without constant whose largest error is smallest, by Lawson's reweighted least squares.

    Parameters
    ----------
    points, target : ndarray, shape (n, 2)
    degree : int
        Total degree.

    Returns
    -------
    polynomial : ndarray, shape (2, degree + 1, degree + 1)
        ``[axis, i, j]`` multiplies ``x**i * y**j``.
    missed : ndarray, shape (n, 2)
        Target minus fit.
    """
    i, j = basis.orders(degree)
    i, j = i[1:], j[1:]
    scale = np.abs(points).max()
    x, y = (points / scale).T
    # orthonormal columns: the weighted normal equations below stay well conditioned
    q, r = np.linalg.qr(x[:, None] ** i * y[:, None] ** j)
    weights = np.full(len(points), 1 / len(points))
    for _ in range(_LAWSON):
        weighted = q * weights[:, None]
        solution = np.linalg.solve(weighted.T @ q, weighted.T @ target)
        missed = target - q @ solution
        distance = np.hypot(*missed.T)
        weights = weights * (distance + 1e-3 * distance.max() + np.finfo(float).tiny)
        weights /= weights.sum()
    polynomial = np.zeros((2, degree + 1, degree + 1))
    polynomial[:, i, j] = np.linalg.solve(r, solution).T / scale ** (i + j)
    return polynomial, missed


def _linear_header(kind, origin, tangent, cd):
    """The keywords of the linear part."""
    ends = {"sip": "TAN-SIP", "tpv": "TPV"}[kind]
    cards = [("WCSAXES", 2, "number of WCS axes")]
    for k, (axis, centre) in enumerate((("RA--", tangent.lon % 360), ("DEC-", tangent.lat)), start=1):
        cards += [
            (f"CTYPE{k}", f"{axis}-{ends}"),
            (f"CUNIT{k}", "deg"),
            (f"CRPIX{k}", float(origin[k - 1]) + 1, "reference pixel, from 1"),
            (f"CRVAL{k}", float(centre), "[deg] at the reference pixel"),
        ]
    cards += [(f"CD{a + 1}_{b + 1}", float(cd[a, b]), "[deg/pix]") for a, b in np.ndindex(2, 2)]
    return fits.Header([*cards, ("LONPOLE", 180.0), ("RADESYS", "ICRS")])


def _sip(polynomial, cd, offset, plane):
    """SIP keywords: A, B from the fit, AP, BP the distortion itself."""
    flat = np.linalg.solve(cd, plane.T).T
    for order in range(2, MAX_DEGREE["sip"] + 1):
        backward, missed = _fit(flat, offset - flat, order)
        if np.abs(missed).max() <= INVERSE_ERROR:
            break
    forward = np.tensordot(np.linalg.inv(cd), polynomial, axes=1)
    header = fits.Header()
    for key, tensor, lowest in zip(("A", "B", "AP", "BP"), (*forward, *backward), (2, 2, 1, 1), strict=True):
        degree = header[f"{key}_ORDER"] = len(tensor) - 1
        terms = [(i, j) for i, j in np.transpose(basis.orders(degree)) if i + j >= lowest]
        header.extend((f"{key}_{i}_{j}", float(tensor[i, j])) for i, j in terms)
    return header


def _tpv(degree, cd, offset, plane):
    """TPV keywords: the same polynomial in degrees after the CD matrix; axis 2 has x and y exchanged in its terms."""
    polynomial, _ = _fit(offset @ cd.T, plane, degree)
    return fits.Header(
        (f"PV{axis}_{_TPV_FIRST[i + j] + j}", float(tensor[i, j]))
        for axis, tensor in ((1, polynomial[0]), (2, polynomial[1].T))
        for i, j in np.transpose(basis.orders(degree))[1:]
    )


def _round_up(value):
    """To two digits, so that the figure is no smaller than what was found."""
    if value == 0 or not math.isfinite(value):
        return value
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit) * unit:.1e}")


def misleading_cards(header, stated):
    """The keywords without one of which a header has the WCS that is stated."""
    points = np.stack(np.meshgrid(*([0.0, 100.0, 300.0],) * 2), axis=-1).reshape(-1, 2)

    def on_sky(cards):
        try:
            return WCS(cards).celestial.all_pix2world(points, 0)
        except Exception:  # wcslib raises many kinds
            return np.full_like(points, np.nan)

    right, found = on_sky(stated), []
    for key in dict.fromkeys(header):
        less = header.copy()
        less.remove(key, ignore_missing=True, remove_all=True)
        if key not in stated and key and np.allclose(on_sky(less), right, rtol=0, atol=1e-9):
            found.append(key)
    return found
