"""The distortions that the headers of exposures have: as a prior, as a sentence, and in the place on the sky.

A header WCS leads to the sky. Its map is taken apart as any other source is (`legdistort.priors.expansion`): a
similarity, which belongs to the pose, and a static distortion without one. So a sky that is taken from the pose is
right whether or not the distortion is used, as far as a similarity can be.
"""

from dataclasses import replace

import numpy as np

from ..exceptions import AssumptionWarning, InputError, warn
from ..geometry import basis, similarity
from ..geometry.tangent_plane import TangentPlane
from .expansion import POSE_GRID, expand
from .from_files import read_source
from .from_objects import as_source

#: Headers tell one distortion if their series differ by less than this [pix] all over the detector; the degree of a
#: series is raised until it leaves less out. A tenth of the error of the best stars that are measured.
SAME = 1e-3
#: Highest degree: that of SIP as the convention allows it.
HIGHEST = 9
#: Distortions up to this size [pix] are not worth a warning: that of the best stars that are measured.
SMALL = 0.01


def from_headers(exposures, kind, *, degree, **widths):
    """`Prior`, the `kind`, or a dict of them, from the headers of exposures (see `legdistort.Prior.from_headers`)."""
    degree = basis.check_degree(degree)
    found, lacking = {}, {}
    for exposure in exposures:
        try:
            found[exposure.name] = header_source(exposure)
        except InputError as error:
            lacking[exposure.name] = str(error)
    if not found:
        raise InputError(
            f"no header has a distortion that could be the prior: {next(iter(lacking.values()))}; leave prior='header' "
            "(--prior header) out, or give a prior of another kind"
        )
    priors = {name: _series(source, kind, degree, widths) for name, source in found.items()}
    first, *others = priors.values()
    common = all(other.shape == first.shape and _difference(first, other) < SAME for other in others)
    if lacking and not common:
        raise InputError(
            f"the headers of {', '.join(lacking)} have no distortion, and those of the others differ; leave these "
            "exposures out"
        )
    if lacking:
        warn(
            f"the headers of {', '.join(lacking)} have no distortion; they are given that of the others",
            AssumptionWarning,
        )
    return first if common else priors


def _series(source, kind, degree, widths):
    """The `Prior` of a source, of this degree or as much more as it takes."""
    while True:
        prior = kind.from_model(source, degree=degree, **widths)
        if prior.truncation < SAME or degree >= HIGHEST:
            return prior
        degree += 1


def _difference(first, other):
    """Bound of the distance [pix] between two series: the sum of the largest values of their modes."""
    degree = max(first.degree, other.degree)
    left = basis.change_degree(first.mean, degree) - basis.change_degree(other.mean, degree)
    ix, iy = basis.orders(degree)
    return np.hypot(*(np.abs(left) * np.sqrt((2 * ix + 1) * (2 * iy + 1)) / 2).sum(axis=1))


def header_source(exposure):
    """The distortion that the header of an exposure, or the gwcs beside it, has, as a `Source`.

    Raises
    ------
    InputError
        If there is none.
    """
    if exposure.has_gwcs:
        try:
            return read_source(exposure.path).stated(shape=exposure.shape)
        except InputError:  # an extension of that name with something else in it
            pass
    if exposure.wcs is None:
        raise InputError(f"{exposure.name} has no celestial WCS that is to be believed")
    return wcs_source(exposure.wcs, exposure.shape, exposure.name)


def wcs_source(wcs, shape, name="the WCS"):
    """The distortion of a celestial WCS as a complete `Source`."""
    source = replace(as_source(wcs, name=name), shape=tuple(shape), kind=_kind(wcs))
    return source.stated()


def _kind(wcs):
    kinds = ["SIP"] * (wcs.sip is not None)
    kinds += ["look-up tables"] * any(t is not None for t in (wcs.cpdis1, wcs.cpdis2, wcs.det2im1, wcs.det2im2))
    return " and ".join(kinds) or wcs.wcs.ctype[0][-3:]


def describe_headers(exposures):
    """The largest distortion in the headers in words, or None: ``SIP, up to 24.9 px over the detector``."""
    sizes = {}
    for exposure in exposures:
        try:
            source = header_source(exposure)
            sizes[exposure.name] = _placed(source)[1], source.kind
        except InputError:
            continue
    size, kind = max(sizes.values(), default=(0, ""))
    return f"{kind}, up to {size:.3g} px over the detector" if size > SMALL else None


def undistorted_plane(wcs, shape):
    """Where on the sky the undistorted pixels of a WCS with a distortion lie; None if it has none that can be followed.

    Returns
    -------
    `~legdistort.geometry.tangent_plane.TangentPlane` or None
        In the celestial frame of the WCS.
    """
    try:
        source = wcs_source(wcs, shape)
        pose, _ = _placed(source)
    except InputError:
        return None
    lon, lat = (float(a[0]) for a in source.function(*_pixels(shape, 1).T))
    return TangentPlane(lon, lat, similarity.invert(pose))


def _placed(source):
    """Pose from the plane of a source to undistorted pixels; largest distance [pix] of these to the detector's."""
    _, pose, _ = expand(source, 1)
    pixels = _pixels(source.shape, POSE_GRID)
    plane = np.stack(source.on_plane()(*(pixels + source.origin).T), axis=1)
    return pose, float(np.hypot(*(similarity.apply(pose, plane) - pixels).T).max())


def _pixels(shape, n):
    """Pixels of an n x n grid from edge to edge (the centre for n = 1), shape (n*n, 2)."""
    t = np.linspace(-1, 1, n) if n > 1 else np.zeros(1)
    u, v = (a.ravel() for a in np.meshgrid(t, t))
    return basis.denormalize(u, v, shape)
