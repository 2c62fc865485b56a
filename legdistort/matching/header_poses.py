"""Poses of exposures by their headers, a WCS or else a shift: tried first in matching, and always verified."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from scipy import special
from scipy.sparse.csgraph import connected_components

from ..cameras.focal_planes import FocalPlane, agreed_similarity
from ..exceptions import AssumptionWarning, warn
from ..geometry import similarity
from ..geometry.tangent_plane import TangentPlane
from ..inputs.sky_wcs import to_icrs
from ..priors.from_headers import undistorted_plane
from ..results.errors.header_pointing import HeaderPointing

#: Headers that disagree with the others by more than this part of the field do not determine where the field lies.
TOLERANCE = 0.1
#: Nor do those in which the pixels are by more than this, and so many times the scatter of all, of another size.
_SCALE_OFF, _MANY = 3e-3, 6.0
#: The dithers by headers and by stars are compared in so many exposures or more; they contradict each other if a turn
#: and a scale explain what they differ by, by no more than this chance, and that is more than this part of the dithers.
_FEWEST, _BY_CHANCE, _DEPARTURE = 4, 1e-4, 0.05
#: Of so many headers or more, one is apart that lies off the others by this [pix] or more, by more than this part of
#: its dither (as scales and distortions displace it), and by so much more than these scatter that chance explains it in
#: no more than this part of all sets; and one at most of so many.
_SOME, _LEAST, _STRETCH, _BY_SCATTER, _ONE_OF = 4, 2.0, 8e-3, 4e-3, 4
#: Variance [pix^2] below which a pose counts as exact.
_EXACT = 1e-12


@dataclass(frozen=True, eq=False)
class HeaderPoses:
    """Nominal poses by the header WCSs.

    Attributes
    ----------
    poses : dict
        ``{exposure: (2, 3)}``, plane -> pixels, of the exposures that have a WCS.
    shapes : dict
        ``{exposure: (ny, nx)}``.
    sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
        Where the plane of these poses lies.
    starts : dict
        ``{exposure: (2, 3)}``, plane -> pixels, as `legdistort.match` is given them; and by `XSHIFT`, `YSHIFT`, of
        exposures that state these and have no WCS.
    odd : dict
        ``{detector: pixels}`` of a camera by which WCSs contradict those of others; "DETECTOR of EXPOSURE" of some
        exposures alone.
    apart : float
        Error of where the plane lies [pix, per axis], where WCSs of detectors contradict one another.
    """

    poses: dict
    shapes: dict
    sky: TangentPlane | None
    starts: dict = field(default_factory=dict)
    odd: dict = field(default_factory=dict)
    apart: float = 0.0

    @classmethod
    def of(cls, exposures, shapes, start=None):
        """Those of some exposures.

        Parameters
        ----------
        exposures : list of `legdistort.Exposure`
        shapes : dict
            ``{exposure: (ny, nx)}``.
        start : dict, optional
            ``{exposure: (xshift, yshift, rotation)}``, see `legdistort.match`; of exposures of `shapes`.
        """
        stated = {e.name: [e.header.get(key) for key in ("XSHIFT", "YSHIFT")] for e in exposures if e.wcs is None}
        starts = {
            name: np.column_stack([np.eye(2), each]) for name, each in stated.items() if all(map(_is_number, each))
        }
        starts |= {name: _turned(shapes[name], *each) for name, each in (start or {}).items()}
        found = cls.from_wcs({e.name: e.wcs for e in exposures if e.wcs is not None}, shapes)
        return replace(found, starts=starts, **_contradicting(exposures))

    @classmethod
    def from_wcs(cls, wcss, shapes):
        """From WCSs less their distortions: on the tangent plane at their median pointing, in pixels of the first one.

        Parameters
        ----------
        wcss : dict
            ``{exposure: WCS}``; it may be empty.
        shapes : dict
            ``{exposure: (ny, nx)}``.
        """
        planes = {}
        if wcss:
            to_sky = {name: _undistorted(w, shapes[name]) for name, w in wcss.items()}
            centres = [to_sky[name](_grid(shapes[name], 1)).cartesian.xyz.value[:, 0] for name in wcss]
            # the median, not the mean: one header may point anywhere
            middle = SkyCoord(*np.median(centres, axis=0), representation_type="cartesian").spherical
            on_sky = TangentPlane(middle.lon.deg, middle.lat.deg, similarity.identity())
        for name in wcss:
            grid = _grid(shapes[name], 5)
            plane = on_sky.from_sky(to_sky[name](grid))
            if np.all(np.isfinite(plane)):
                planes[name] = similarity.fit_similarity(grid, plane)
        if not planes:
            return cls({}, shapes, None)
        first, matrix = next(iter(planes.items()))
        matrix = np.column_stack([matrix[:, :2], -matrix[:, :2] @ _grid(shapes[first], 1)[0]])
        poses = {name: similarity.compose(similarity.invert(plane), matrix) for name, plane in planes.items()}
        return cls(poses, shapes, TangentPlane(on_sky.lon, on_sky.lat, matrix))

    def step(self, source, target):
        """Nominal pose from one exposure's pixels to another's, or None."""
        for known in (self.starts, self.poses):
            if {source, target} <= known.keys():
                return similarity.compose(known[target], similarity.invert(known[source]))
        return None

    def place(self, found):
        """Poses in any plane carried to the headers' plane, by the mean of the headers that agree.

        Parameters
        ----------
        found : dict
            ``{exposure: (2, 3)}``.

        Returns
        -------
        poses : dict
        sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
            Where their plane lies; None, with the poses as they were, if the headers do not determine it.
        """
        agreement = self._agreement(found)
        if agreement is None:
            if self.odd:
                warn(self.pointing(found).sentence, AssumptionWarning)
            return found, None
        names, steps, _, good = agreement
        if words := self.pointing(found).sentence:
            warn(words, AssumptionWarning)
        if 2 * np.count_nonzero(good) <= len(names):
            return found, None
        mean = steps[good].mean(axis=0)
        self._compare_dithers({name: found[name] for name, agrees in zip(names, good, strict=True) if agrees}, mean)
        return {name: similarity.compose(pose, mean) for name, pose in found.items()}, self.sky

    def pointing(self, found):
        """The `HeaderPointing` of poses ``{exposure: (2, 3)}`` in any plane; None without headers."""
        agreement = self._agreement(found)
        if agreement is None:
            return HeaderPointing(0, np.nan, np.nan, detectors=self.odd) if self.odd else None
        names, steps, corners, good = agreement
        n = np.count_nonzero(good)
        if 2 * n <= len(names):
            return HeaderPointing(0, np.nan, np.nan, groups=_groups(names, corners, TOLERANCE * self._size(names)))
        middles, turns = corners.mean(axis=1), np.array([similarity.describe(step)["rotation"] for step in steps])
        turns = (turns - turns[good][0] + 180) % 360 - 180
        turns = (turns - turns[good].mean() + 180) % 360 - 180
        errors, each = [np.nan] * 3, (middles, turns[:, None], similarity.log_scales(steps)[:, None])
        if n > 1:
            errors = [np.sqrt(np.mean(np.var(values[good], axis=0, ddof=1)) / n) for values in each]
        shift, turn, scale = map(float, errors)
        scale = max(scale, np.radians(turn))  # a header that has the one wrong does not know the other better
        if self.apart > 0:
            shift = float(np.hypot(np.nan_to_num(shift), self.apart))
        apart = np.linalg.norm(corners - np.median(corners, axis=0), axis=2).max(axis=1)
        off = {names[k]: (float(apart[k]), float(turns[k])) for k in np.flatnonzero(~good)}
        return HeaderPointing(int(n), shift, turn, off, scale=scale, detectors=self.odd, apart=self.apart)

    def _size(self, names):
        return max(max(self.shapes[n]) for n in names)

    def _agreement(self, found):
        """Names of exposures with headers, where each states that the plane lies, and which agree; None without.

        As similarities (n, 2, 3) to the plane of the headers, and the corners (n, 4, 2) there.
        """
        names = [name for name in found if name in self.poses]
        if not names:
            return None
        steps = np.array([similarity.compose(similarity.invert(found[n]), self.poses[n]) for n in names])
        corners = np.array([similarity.apply(step, _grid(self.shapes[names[0]], 2)) for step in steps])
        apart = np.linalg.norm(corners - np.median(corners, axis=0), axis=2).max(axis=1)
        good, logs = apart < TOLERANCE * self._size(names), similarity.log_scales(steps)
        if np.count_nonzero(good) > 2:
            off = np.abs(logs - np.median(logs[good]))
            good &= off < max(_SCALE_OFF, _MANY * 1.4826 * np.median(off[good]))
        centres = np.array([_grid(self.shapes[n], 1) for n in names])
        seen = similarity.apply_inverses(np.array([found[n] for n in names]), centres)[:, 0]
        moved = similarity.apply_each(steps, seen) - seen @ np.median(steps[:, :, :2], axis=0).T
        good[np.flatnonzero(good)[_apart(moved[good], seen[good])]] = False
        return names, steps, corners, good

    def _compare_dithers(self, found, mean):
        """Warn where the stars move between exposures as no WCS of that scale and orientation lets them move.

        Parameters
        ----------
        found : dict
            ``{exposure: (2, 3)}`` by the stars.
        mean : ndarray, shape (2, 3)
                From the plane of the headers to theirs.
        """
        if len(found) < _FEWEST:
            return
        centres = {name: _grid(self.shapes[name], 1) for name in found}
        seen = np.concatenate([similarity.apply(similarity.invert(found[n]), centres[n]) for n in found])
        stated = np.concatenate([similarity.apply(similarity.invert(self.poses[n]), centres[n]) for n in found])
        seen = similarity.apply(similarity.invert(mean), seen)
        z, w = (plane[:, 0] + 1j * plane[:, 1] for plane in (seen, stated))
        z, w = z - z.mean(), w - w.mean()
        off, spread = np.sum(np.abs(w - z) ** 2), np.sum(np.abs(z) ** 2)
        if not spread > 0:
            return
        factors = {mirrored: np.sum(w * np.conj(a)) / spread for mirrored, a in ((False, z), (True, z.conj()))}
        mirrored = abs(factors[True]) > abs(factors[False])
        factor = factors[mirrored]
        left = max(off * 1e-12, np.sum(np.abs(w - factor * (z.conj() if mirrored else z)) ** 2))
        dof = 2 * len(z) - 4
        if special.fdtrc(2, dof, (off - left) / 2 / (left / dof)) < _BY_CHANCE and off > _DEPARTURE**2 * spread:
            turned = "mirrored" if mirrored else f"turned by {np.degrees(np.angle(factor)):.1f} deg"
            warn(
                "the header WCSs contradict the stars: from exposure to exposure these move as if the WCS were "
                f"{turned}, and its pixels {abs(factor):.3f} times as large; give reference= (--reference), or mend "
                "the headers",
                AssumptionWarning,
            )


def _apart(moved, places):
    """Which headers have their exposures apart from where the others have theirs, by how these scatter.

    One at a time, the worst first, against those that are left: the generalised extreme Studentized deviate of Rosner
    (1983), here of displacements in two axes. Several that are alike are a visit or a night, with a pointing of its
    own: none of them is a wrong header.

    Parameters
    ----------
    moved : ndarray, shape (n, 2)
        By how much each header has its exposure elsewhere than the stars [pix], but for a common shift.
    places : ndarray, shape (n, 2)
        Where the exposures lie [pix].

    Returns
    -------
    list of int
    """
    left, tried, n_apart = list(range(len(moved))), [], 0
    if len(moved) < _SOME:
        return []
    for _ in range(len(moved) // _ONE_OF):
        n = len(left)
        square = np.sum((moved[left] - moved[left].mean(axis=0)) ** 2, axis=1)
        k = int(np.argmax(square))
        others = max((square.sum() - square[k] * n / (n - 1)) / (2 * (n - 2)), _EXACT)  # their variance per axis
        chance = n * special.fdtrc(2, 2 * (n - 2), square[k] * n / (n - 1) / 2 / others)
        tried.append(left.pop(k))
        off, dither = (np.linalg.norm(each[tried[-1]] - each[left].mean(axis=0)) for each in (moved, places))
        if chance < _BY_SCATTER and off > max(_LEAST, _STRETCH * dither):
            n_apart = len(tried)
    apart = tried[:n_apart]
    between = np.linalg.norm(moved[apart, None] - moved[apart], axis=-1)
    return [] if np.any(between[np.triu_indices(n_apart, 1)] < _LEAST) else apart


def _contradicting(exposures):
    """What headers of detectors contradict in each other, ``odd`` and ``apart`` of `HeaderPoses`."""
    planes = [each for each in exposures if isinstance(each, FocalPlane) and (each.wcs is not None or each.odd)]
    far = {}
    for plane in planes:
        for detector, pixels in plane.odd.items():
            far.setdefault(detector, {})[plane.name] = pixels
    odd = {}
    for detector, each in far.items():
        if len(each) == len(planes):
            odd[detector] = max(each.values())
        else:
            odd |= {f"{detector} of {name}": pixels for name, pixels in each.items() if np.isfinite(pixels)}
    apart = [plane.apart for plane in planes if np.isfinite(plane.apart)]
    return {"odd": odd, "apart": float(np.median(apart)) if apart else 0.0}


def _groups(names, corners, tolerance):
    """Names whose corners (n, 4, 2) lie within a tolerance of each other, directly or through others; largest first."""
    apart = np.linalg.norm(corners[:, None] - corners, axis=3).max(axis=2)
    _, group = connected_components(apart < tolerance, directed=False)
    found = [tuple(np.array(names)[group == g].tolist()) for g in range(group.max() + 1)]
    return tuple(sorted(found, key=len, reverse=True))


def _turned(shape, x, y, rotation):
    """Pose that turns about the centre of a detector, by degrees from x to y, and shifts."""
    angle, centre = np.deg2rad(rotation), _grid(shape, 1)[0]
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([matrix, centre + [x, y] - matrix @ centre])


def _is_number(value):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def sky_by_layout(matches, found, poses):
    """Where the reference plane lies on the sky, with detectors where they were found.

    The plane is put on the sky by headers, which have the detectors elsewhere: those that agree on where count, one
    that contradicts them does not. It stays where a reference told how the focal plane lies in that of the headers.

    Parameters
    ----------
    matches : Matches
        With a sky, by headers.
    found : `~legdistort.cameras.header_layout.HeaderLayout` or None
        Of the camera as it was found.
    poses : ndarray, shape (n_exposures, 2, 3)

    Returns
    -------
    `~legdistort.geometry.tangent_plane.TangentPlane`
    """
    before = matches.camera.headers
    if before is None or found is None or matches.camera.states_scale:
        return matches.sky
    back = similarity.compose(similarity_of(before)[0], similarity.invert(similarity_of(found)[0]))
    moves = [similarity.compose(similarity.invert(pose), similarity.compose(back, pose)) for pose in poses]
    return replace(matches.sky, matrix=similarity.compose(matches.sky.matrix, np.mean(moves, axis=0)))


def similarity_of(layout):
    """From the plane of headers to the focal plane (2, 3), and the error of its place [pix] where headers disagree.

    Where these show which of them are right, that of the layout, else what agrees of them.

    Parameters
    ----------
    layout : `~legdistort.cameras.header_layout.HeaderLayout`
    """
    if layout.is_undecided:
        agreed = agreed_similarity(layout.found, layout.stated)
        if agreed.pose is not None:
            return similarity.invert(agreed.pose), agreed.apart
    return layout.similarity, 0.0


def pointing_by_layout(pointing, found):
    """A `HeaderPointing` with what headers disagree by of a found layout, if nothing shows which of them are wrong.

    And with an error of the scale by how sizes of pixels differ from theirs, those of most alike.
    """
    if found is None or pointing is None:
        return pointing
    pointing = replace(pointing, scale=float(np.fmax(pointing.scale, found.scale_error)))
    apart = similarity_of(found)[1]
    if not apart > 0 or pointing.apart > 0 or pointing.detectors:
        return pointing
    return replace(pointing, apart=apart, shift=float(np.hypot(np.nan_to_num(pointing.shift), apart)))


def header_map_by(matches, poses, sky, variances):
    """The `Camera.header_map` with the focal plane where a solution has it on the sky.

    The mean of the exposures by their errors: one whose pose is known badly, as it overlaps the others in a strip,
    counts by as much.

    Parameters
    ----------
    matches : Matches
        As headers have them: with a sky, poses and a `header_map` by these.
    poses : dict
        ``{exposure: (2, 3)}``, from the reference plane of the solution to its focal plane.
    sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
        Where that reference plane lies.
    variances : sequence of float
        Of these poses, of rotation and scale [pix^2, per axis at the corners of the focal plane].

    Returns
    -------
    header_map : ndarray, shape (2, 3), or None
        None without the headers' one, or without a sky.
    weights : ndarray, shape (n_exposures,)
        With the sum 1.
    scatter : ndarray, shape (2,)
        Standard deviations of scale and rotation [rad] of the mean, by how the exposures differ; zeros of a single one.
    """
    camera = matches.camera
    if camera.header_map is None or matches.sky is None or sky is None:
        return None, None, np.zeros(2)
    back, corners, by_header = similarity.invert(camera.header_map), _grid(camera.field, 2), []
    for name, pose in poses.items():
        places = sky.to_sky(similarity.apply(similarity.invert(pose), corners))
        there = similarity.apply(matches.poses[name], matches.sky.from_sky(places))
        by_header.append(similarity.apply(back, there))
    turned = np.array(by_header) - np.mean(by_header, axis=1, keepdims=True)
    weights = _weights(turned.reshape(len(poses), -1), np.asarray(variances))
    found = similarity.fit_similarity(np.average(by_header, axis=0, weights=weights), corners)
    z, w = (offsets @ [1, 1j] for offsets in (turned, corners - corners.mean(axis=0)))
    moved = z @ w.conj() / np.vdot(w, w)  # of every exposure, scale and rotation as one number
    off = np.stack([np.abs(moved), np.angle(moved / moved.mean())], axis=1)
    share = 1 - np.sum(weights**2)
    return found, weights, np.sqrt(weights**2 @ (off - weights @ off) ** 2 / share) if share > 1e-9 else np.zeros(2)


def _weights(values, variances):
    """Weights (n,) of values (n, k) with variances (n,), each, and a scatter beyond these that all have in common.

    The scatter is found by the method of moments (DerSimonian & Laird 1986).
    """
    variances = np.maximum(variances, _EXACT)
    weights = 1 / variances / np.sum(1 / variances)
    share = 1 - np.sum(weights**2)
    if not share > 0:
        return weights
    seen = np.mean(weights @ (values - weights @ values) ** 2)
    scatter = max(seen - np.sum(weights * (1 - weights) * variances), 0.0) / share
    weights = 1 / (variances + scatter)
    return weights / weights.sum()


def _grid(shape, n):
    """Pixels of an n x n grid from edge to edge (the centre for n = 1), shape (n*n, 2)."""
    x, y = (np.linspace(0, size - 1, n) if n > 1 else np.array([(size - 1) / 2]) for size in shape[::-1])
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _undistorted(wcs, shape):
    """The function from undistorted pixels (n, 2) to the sky, as the poses lead to these.

    A distortion has a similarity in it (the linear part of a header holds at its reference pixel alone): the pixels are
    those that a static distortion without one leads to, as in a prior.
    """
    plane = undistorted_plane(wcs, shape)

    def to_sky(xy):
        lon, lat = to_icrs(wcs, xy, distortion=False) if plane is None else plane.model()(*xy.T)
        return SkyCoord(lon * u.deg, lat * u.deg, frame="icrs")

    return to_sky
