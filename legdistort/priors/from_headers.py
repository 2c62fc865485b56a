"""The distortions that the headers of exposures have: as a prior, as a sentence, and in the place on the sky.

A header WCS leads to the sky. Its map is taken apart as any other source is (`legdistort.cameras.expansion`): a
similarity, which belongs to the pose, and a static distortion without one. So a sky that is taken from the pose is
right whether or not the distortion is used, as far as a similarity can be.
"""

import contextlib
from dataclasses import dataclass, replace
from functools import partial

import gwcs
import numpy as np
from astropy.wcs import WCS

from ..cameras.expansion import POSE_GRID, expand
from ..cameras.source import Source
from ..exceptions import AssumptionWarning, InputError, warn
from ..geometry import basis, similarity
from ..geometry.tangent_plane import TangentPlane
from ..inputs.sky_wcs import to_icrs
from .from_files import read_source
from .from_objects import as_source, of_sky

#: Headers state one distortion if their series differ by less than this [pix] all over the detector; the degree of a
#: series is raised until it leaves less out. It is what `legdistort attach` allows a header by default.
SAME = 1e-3
#: Highest degree: that of SIP as the convention allows it.
HIGHEST = 9
#: Distortions up to this size [pix] are not worth a warning: half the error of a star of the paper (0.02 px). A linear
#: header departs by 1e-6 px (`legdistort.priors.from_objects.NOTHING`) at most, so that it never gives a false alarm.
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
        raise InputError(f"{exposure.name} has no celestial WCS, or none that is plausible")
    return wcs_source(exposure.wcs, exposure.shape, exposure.name)


def wcs_source(wcs, shape, name="the WCS"):
    """The distortion of a believable WCS as a complete `Source` that leads to the sky (ICRS)."""
    if isinstance(wcs, WCS):
        as_source(wcs, name=name)  # refuses one without a distortion
    return replace(of_sky(partial(to_icrs, wcs), shape, name), kind=_kind(wcs)).stated()


def _kind(wcs):
    if not isinstance(wcs, WCS):
        return "gwcs" if isinstance(wcs, gwcs.WCS) else "WCS"
    kinds = ["SIP"] * (wcs.sip is not None)
    kinds += ["look-up tables"] * any(t is not None for t in (wcs.cpdis1, wcs.cpdis2, wcs.det2im1, wcs.det2im2))
    return " and ".join(kinds) or wcs.to_header()[f"CTYPE{wcs.wcs.lng + 1}"][-3:]  # once set, WCSLIB calls TPV a TAN


@dataclass(frozen=True, eq=False)
class HeaderDistortion:
    """A distortion by its header, with the pose from its plane to undistorted pixels.

    `size` is the largest distance [pix] of undistorted pixels to those of the detector.
    """

    source: Source
    pose: np.ndarray
    size: float

    @classmethod
    def of(cls, source):
        """That of a complete source."""
        _, pose, _ = expand(source, 1)
        bare = cls(source, pose, 0.0)
        pixels = _pixels(source.shape, POSE_GRID)
        return replace(bare, size=float(np.hypot(*(bare.undistort(pixels) - pixels).T).max()))

    def undistort(self, xy):
        """Undistorted pixels of detector pixels (n, 2)."""
        plane = self.source.on_plane()(*(xy + self.source.origin).T)
        return similarity.apply(self.pose, np.stack(plane, axis=1))


def header_distortions(exposures):
    """``{name: HeaderDistortion}`` of the exposures that have one of more than `SMALL` pixels."""
    found = {}
    for exposure in exposures:
        with contextlib.suppress(InputError):
            found[exposure.name] = HeaderDistortion.of(header_source(exposure))
    return {name: distortion for name, distortion in found.items() if distortion.size > SMALL}


def describe(distortions):
    """The largest of `header_distortions` in words, or None: ``SIP, up to 24.9 px over the detector``."""
    if not distortions:
        return None
    largest = max(distortions.values(), key=lambda distortion: distortion.size)
    return f"{largest.source.kind}, up to {largest.size:.3g} px over the detector"


def undistorted_plane(wcs, shape):
    """Where on the sky the undistorted pixels of a WCS with a distortion lie; None if it has none that can be followed.

    Returns
    -------
    `~legdistort.geometry.tangent_plane.TangentPlane` or None
        ICRS.
    """
    try:
        source = wcs_source(wcs, shape)
        pose = HeaderDistortion.of(source).pose
    except InputError:
        return None
    lon, lat = (float(a[0]) for a in source.function(*_pixels(shape, 1).T))
    return TangentPlane(lon, lat, similarity.invert(pose))


def _pixels(shape, n):
    """Pixels of an n x n grid from edge to edge (the centre for n = 1), shape (n*n, 2)."""
    t = np.linspace(-1, 1, n) if n > 1 else np.zeros(1)
    u, v = (a.ravel() for a in np.meshgrid(t, t))
    return basis.denormalize(u, v, shape)
