"""Which star of a solution is which star of a reference catalogue, and where that lies in the reference plane."""

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ..exceptions import AssumptionWarning, InputError, warn
from ..geometry import similarity, star_hull
from ..geometry.tangent_plane import TangentPlane, angles, directions
from ..inputs.references.catalogue import Reference
from .registration import register
from .similarity_candidates import scale_candidates
from .star_lists import StarList

log = logging.getLogger(__name__)

#: Part of the field within which stars that are taken to be the same must agree, once a similarity is taken out.
_AGREEMENT = 0.05
#: Part of the stars for which this holds where names are given to both lists alike; numbers by brightness often agree.
_NAMED_ALIKE = 0.95
#: Times the distance of another star, and of most of one name, from which on one of the same name is not the same star.
_OTHER = 10.0
#: Part of the field that the plane of the catalogue may be off.
_MARGIN = 0.5
#: Chance that a star which is near by accident is taken for a reference star.
_CHANCE = 0.03
#: How far, as a part of it, the pixel scale may be from the one that is given.
_SCALE = 0.2
#: Sky of headers that stars of a reference bear out: to so much in the logarithm of its scale, and in degrees.
_ALIKE = 0.03, 3.0
#: Stars from which on lists have a pattern.
_FEWEST = 5
_ARCSEC = 1 / 3600


@dataclass(frozen=True, eq=False, repr=False)
class Identified:
    """Reference stars that the solution has.

    Attributes
    ----------
    rows : ndarray of int, shape (n,)
        Stars of the solution.
    xy : ndarray, shape (n, 2)
        Where the reference puts them, reference-plane pixels.
    covariance : ndarray, shape (n, 2 + k, 2 + k)
        Of these positions and of `motion`, pixels and years; NaN for what is not known.
    sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
        As it was known, or as the reference gives it.
    motion : ndarray, shape (n, k), or None
        Proper motions of the reference, pixels of the reference plane a year, and perhaps parallaxes, pixels; NaN for
        stars without one.
    maps, unknown : ndarray, shape (n, 2, m), or None
        What its positions have in common, see `legdistort.inputs.references.catalogue.Reference`; pixels.
    names : ndarray of str, shape (n,), or None
        What the reference calls them.
    missing : tuple of str
        What it calls others that lie among the stars of the solution, and are none of these.
    """

    rows: np.ndarray
    xy: np.ndarray
    covariance: np.ndarray
    sky: TangentPlane | None
    motion: np.ndarray | None = None
    maps: np.ndarray | None = None
    unknown: np.ndarray | None = None
    names: np.ndarray | None = None
    missing: tuple[str, ...] = ()

    def subset(self, these):
        """The same with some of its stars."""
        return replace(self, **{k: v[these] for k, v in vars(self).items() if isinstance(v, np.ndarray)})

    def __repr__(self):
        return f"<Identified: {len(self.rows)} reference stars>"


def identify(reference, names, positions, *, flux=None, sky=None, pixel_scale=None):
    """Find the stars that a solution and a reference have in common.

    By name if the reference names them; else on the plane, where chance must not explain what agrees; else, with
    celestial positions where no sky is known, or none of them lies where it has them, by their pattern, in any
    orientation. Of a sky that is turned, mirrored, of another scale or elsewhere a warning is given, and it is that of
    the reference then.

    Parameters
    ----------
    reference : Reference
        At the epoch of the exposures.
    names : ndarray, shape (n,)
    positions : ndarray, shape (n, 2)
        Pixels; NaN for stars that are not to be used.
    flux : ndarray, shape (n,), optional
    sky : TangentPlane, optional
        Where the reference plane lies, roughly.
    pixel_scale : float, optional
        Arcsec, to the nearest 20 per cent.

    Returns
    -------
    Identified

    Raises
    ------
    InputError
        If there are none, or they do not agree.
    """
    solved = np.isfinite(positions).all(axis=1)
    rows = np.flatnonzero(solved)
    flux = None if flux is None else flux[rows]
    mine, theirs, sky = _pairs(reference, names[rows], positions[rows], flux, sky, pixel_scale)
    rows, others = rows[mine], reference.subset(np.setdiff1d(np.arange(len(reference)), theirs))
    reference = reference.subset(theirs)
    if reference.xy is None:
        sky = _checked_sky(reference, positions[rows], sky)
    found = reference.on_plane(sky)
    _check_agreement(reference.label, positions[rows], found.xy, np.ptp(positions[solved], axis=0).max())
    missing = _missing(others.on_plane(sky), found.xy, positions[rows], positions[solved])
    common = found.motion, found.maps, found.unknown, found.names
    return Identified(rows, found.xy, found.covariance, sky, *common, missing)


def _pairs(reference, names, positions, flux, sky, pixel_scale):
    """Rows of the stars and of the reference that are the same, and the sky as far as it holds for these."""
    if reference.star is not None:
        return *_by_name(reference, names), sky
    if reference.xy is None and sky is None:
        return *_by_pattern(reference, positions, flux, pixel_scale), sky
    try:
        return *_on_plane(reference, reference.on_plane(sky).xy, positions, flux), sky
    except InputError as error:
        if reference.xy is None:
            return *_despite_sky(reference, positions, flux, sky, pixel_scale, error), sky
        # the plane of a solution of its own
        found = _turned(reference, positions, flux) if reference.maps is not None else None
        if found is None:
            raise InputError(f"{error}: another field, or the wrong columns?") from None
        return *found, None


def _despite_sky(reference, positions, flux, sky, pixel_scale, error):
    """Rows by pattern alone of stars that lie nowhere near where the sky has them; else the error."""
    few = min(len(reference), len(positions)) < _FEWEST
    found = None if few else _same_pattern(reference, positions, flux, pixel_scale, sky.pixel_scale)
    if found is None:
        searched = "" if few else ", nor is their pattern found in it, whatever the headers state"
        raise InputError(
            f"{error}{searched}: another field, the wrong columns, or a wrong sky in the headers?"
        ) from None
    return found


def same_stars(one, two, label):
    """Rows of the stars that two lists have in common: by name where these lie alike, else by their places.

    Two of one name are not the same where another star stands in the place of one, and the other far away.

    Parameters
    ----------
    one, two : (names, positions, flux)
        Arrays (n,), (n, 2) [pix, each on a plane of its own] and (n,), or None; NaN for stars without a position.
    label : str
        How messages call the second.

    Returns
    -------
    ndarray of int, ndarray of int

    Raises
    ------
    InputError
        If there are none.
    """
    (rows, own), (others, known) = _of_known_places(*one), _of_known_places(*two)
    names, xy, flux = known
    plane = {"covariance": np.zeros((len(xy), 2, 2)), "maps": np.zeros((len(xy), 2, 0))}  # which may be turned
    named = Reference(label, names, flux, None, xy, **plane)
    size = np.ptp(own[1], axis=0).max(initial=0.0)
    try:
        mine, theirs = _by_name(named, own[0])
        _check_agreement(label, own[1][mine], xy[theirs], size, _NAMED_ALIKE)
        by_name = 2 * len(mine) > min(len(own[0]), len(names))
    except InputError:
        by_name = False
    else:
        there = similarity.apply(similarity.robust_similarity(own[1][mine], xy[theirs]), own[1][mine])
        off, nearest = np.linalg.norm(there - xy[theirs], axis=1), cKDTree(xy).query(there)[0]
        same = off <= _OTHER * np.maximum(nearest, np.median(off))
        mine, theirs = mine[same], theirs[same]
    if not by_name:
        mine, theirs, _ = _pairs(replace(named, star=None), *own, None, None)
        _check_agreement(label, own[1][mine], xy[theirs], size)
    return rows[mine], others[theirs]


def _of_known_places(names, positions, flux):
    rows = np.flatnonzero(np.isfinite(positions).all(axis=1))
    return rows, (names[rows], positions[rows], None if flux is None else flux[rows])


def _by_name(reference, names):
    """Rows of the names and of the reference that are the same; a number is the same as its digits."""
    known = {str(name): row for row, name in enumerate(names)}
    pairs = [(known[str(name)], k) for k, name in enumerate(reference.star) if str(name) in known]
    if not pairs:
        raise InputError(
            f"{reference.label} names none of the stars of the exposures: it has "
            f"{', '.join(map(str, reference.star[:3]))} ..., they are {', '.join(list(known)[:3])} ...; without the "
            "column star it is matched by position"
        )
    return np.array(pairs).T


def _on_plane(reference, plane, positions, flux):
    """Rows of the stars and of the reference that stand at one place, wherever the plane may be off a little."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    size = (high - low).max()
    near = np.flatnonzero(np.all((plane > low - _MARGIN * size) & (plane < high + _MARGIN * size), axis=1))
    if len(near):
        inside = np.all((plane[near] > low) & (plane[near] < high), axis=1)
        for given in (flux, None) if flux is not None and reference.flux is not None else (None,):
            # brightest stars first is faster, and may end in a few that agree by chance
            found = _registered(positions, plane[near], given, reference.flux, near, guess=True)
            if found is None:
                found = _neighbours(positions, plane[near], high - low)
            if len(found[0]) > np.count_nonzero(inside) / 2:  # of what is another field a few are near by chance
                return found[0], near[found[1]]
    distance = np.nanmin(cKDTree(positions).query(np.nan_to_num(plane, nan=1e9))[0], initial=np.inf)
    raise InputError(
        f"none of the {len(plane)} stars of {reference.label} lies where a star of the exposures is"
        + (f"; the nearest two are {distance:.0f} px apart" if distance < 1e8 else "")
    )


def _turned(reference, positions, flux):
    """Rows of the stars and of a reference in pixels of another plane, however turned; None if it is not found."""
    return _registered(positions, reference.xy, flux, reference.flux, slice(None), guess=False)


def _registered(source, target, source_flux, target_flux, near, *, guess):
    """Rows of source and target by `registration.register`; None if nothing stands out from chance.

    The shorter list is laid on the longer one: of a part of the longer most stars may have none in the other.
    """
    if min(len(source), len(target)) < _FEWEST:
        return None
    fluxes = (None, None) if source_flux is None or target_flux is None else (source_flux, target_flux[near])
    lists = []
    for xy, flux, shift in ((source, fluxes[0], 0.0), (target, fluxes[1], 10.0)):  # so that nothing stands still
        low, span = xy.min(axis=0) - shift, np.ptp(xy, axis=0) + shift
        lists.append((low, StarList(xy - low, np.zeros(len(xy)), tuple(np.ceil(span[::-1]).astype(int) + 1), flux)))
    (low, short), (other, long) = sorted(lists, key=lambda each: len(each[1]))
    found = register(short, long, guess=np.column_stack([np.eye(2), low - other]) if guess else None)
    if found is None:
        return None
    return (found.source, found.target) if short is lists[0][1] else (found.target, found.source)


def _neighbours(positions, plane, span):
    """Mutual neighbours nearer than chance allows; for lists that are too short for a pattern."""
    limit = np.sqrt(_CHANCE * np.prod(np.maximum(span, 1)) / (np.pi * len(positions)))
    distance, row = cKDTree(positions).query(plane, distance_upper_bound=limit)
    back = cKDTree(plane).query(positions)[1]
    good = [k for k in np.flatnonzero(np.isfinite(distance)) if back[row[k]] == k]
    return row[good], np.array(good, dtype=int)


def _by_pattern(reference, positions, flux, pixel_scale):
    """Rows of the stars and of the reference, by pattern alone, on a plane around the middle of the reference."""
    if len(reference) < _FEWEST or len(positions) < _FEWEST:
        raise InputError(
            f"the exposures have no WCS, and {len(reference)} stars of {reference.label} and {len(positions)} of the "
            "exposures are too few to find one by their pattern: name them in a column star, or take more"
        )
    found = _same_pattern(reference, positions, flux, pixel_scale)
    if found is not None:
        log.info("the stars were found in %s by their pattern: %d pairs", reference.label, len(found[0]))
        return found
    raise InputError(
        f"the exposures have no WCS, and the pattern of their {len(positions)} stars is not that of the "
        f"{len(reference)} of {reference.label}"
        + (f" at {pixel_scale:g} arcsec a pixel" if pixel_scale else "")
        + ": another field, too small a part of it, or another pixel scale (pixel_scale=, --pixel-scale)? The "
        "brightest stars of it alone, as many as the exposures have, or a column star that names them help as well"
    )


def _same_pattern(reference, positions, flux, pixel_scale, stated=None):
    """Rows of the stars and of the reference that are in one pattern, at a scale that is given, or `stated`; or None.

    Both in arcsec a pixel; another one than the stated one is tried too, and none that is far from the given one.
    """
    xy = reference.on_plane(_middle(reference.sky, _ARCSEC)).xy
    scales = scale_candidates(positions, xy)
    if pixel_scale is not None:
        scales = [s for s in scales if abs(np.log(s / pixel_scale)) < _SCALE] + [pixel_scale]
    elif stated is not None:
        scales = [stated, *scales]
    for scale in scales:
        found = _registered(positions, xy / scale, flux, reference.flux, slice(None), guess=False)
        if found is not None:
            return found
    return None


def _middle(sky, scale):
    """The plane that touches the sky in the middle of positions (n, 2), in pixels of `scale` degrees."""
    lon, lat = np.degrees(angles(np.mean(directions(*np.radians(sky).T), axis=0)))
    return TangentPlane(float(lon) % 360, float(lat), scale * similarity.identity())


def _tangent_plane(reference, positions):
    """Tangent point, rotation, scale and parity from identified stars."""
    if len(positions) < 3:
        raise InputError(
            f"the exposures have no WCS, and {len(positions)} stars of {reference.label} are too few to determine "
            "rotation, scale and parity: 3 are needed"
        )
    plane = _middle(reference.sky, 1.0)
    return TangentPlane(plane.lon, plane.lat, similarity.robust_similarity(positions, reference.on_plane(plane).xy))


def _checked_sky(reference, positions, sky):
    """The sky that identified stars (n, 2) bear out, or else theirs, with a warning where they contradict it."""
    if sky is not None and len(positions) < 3:
        return sky
    by_stars = _tangent_plane(reference, positions)
    if sky is None:
        return by_stars
    middle, here = positions.mean(axis=0), reference.on_plane(sky).xy
    off = similarity.describe(similarity.robust_similarity(positions, here))
    shift = np.hypot(*(np.median(here, axis=0) - np.median(positions, axis=0)))
    near = shift < _MARGIN * np.ptp(positions, axis=0).max()
    if near and abs(np.log(off["scale"])) < _ALIKE[0] and abs(off["rotation"]) < _ALIKE[1] and off["parity"] > 0:
        return sky
    angle = f"turned by {off['rotation']:.3g} deg" if off["parity"] > 0 else "mirrored"
    warn(
        f"the header WCSs contradict {reference.label}: by {len(positions)} of its stars the field is "
        f"{by_stars.to_sky(middle).separation(sky.to_sky(middle)).arcsec:.3g} arcsec from where they have it, {angle}, "
        f"at {by_stars.pixel_scale:.4g} arcsec a pixel, not {sky.pixel_scale:.4g}; the sky is that of these stars",
        AssumptionWarning,
    )
    return by_stars


def _missing(others, xy, places, positions):
    """Names of other stars of a reference that lie among positions (n, 2), by those found at `xy` and their places."""
    if others.names is None or len(places) < 3:
        return ()
    there = similarity.apply(similarity.robust_similarity(xy, places), others.xy)
    return tuple(others.names[star_hull.supported(star_hull.around(positions), there.T)].tolist())


def _check_agreement(label, positions, xy, size, share=0.5):
    """Raise `InputError` if a similarity does not carry that share of one to the other, roughly."""
    if len(positions) < 3:
        return
    off = np.hypot(*(similarity.apply(similarity.robust_similarity(positions, xy), positions) - xy).T)
    typical = np.quantile(off, share)
    if not typical < _AGREEMENT * size:
        raise InputError(
            f"the {len(positions)} stars that {label} shares with the exposures by name do not lie as they do there "
            f"({typical:.0f} px off, whatever shift, rotation and scale): other stars under the same names? "
            "Without the column star they are matched by position"
        )
