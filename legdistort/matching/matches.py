"""Matched positions: which detection of which exposure is which star, and roughly where everything lies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy.sparse.csgraph import connected_components

from ..cameras.camera import Camera, check_camera
from ..exceptions import AssumptionWarning, InputError, MatchError, reasons_of, warn
from ..geometry import similarity
from ..geometry.epochs import exposure_years
from ..geometry.tangent_plane import TangentPlane
from ..inputs import column_contract, exposure_names, repetitions, start_poses
from ..inputs.detector_files import with_ids_of
from ..results.errors.header_pointing import HeaderPointing
from ..runtime.checks import check_choice
from ..runtime.guards.units import plain_numbers
from ..runtime.notebook import Column, Fact, Grid, Heading, ShownAsPrinted
from .fields import apart, estimated, joined, side_by_side

if TYPE_CHECKING:
    from astropy.table import Table
    from numpy.typing import ArrayLike

    from ..runtime.annotations import Shape

#: Columns of a table that solve gives it: what terms were found to displace positions by, which is taken off these.
DISPLACED = "x_terms", "y_terms"
#: Positions belong on their detector, give or take this part of its size: distortions move stars over its edge.
MARGIN = 0.1
#: Where more than this part of the positions of an exposure does not, its shape is taken for wrong.
STRAY = 0.1
#: About so many rows of a long table, those of some of its stars, are looked at before all are.
_SOME = 50_000
#: Rows that a message names.
_MOST_NAMED = 6

#: Metadata of fields of `Matches`: a dict with an entry for every exposure; what makes a value of that in a table file.
BY_EXPOSURE, READ = "by_exposure", "read"

#: Days: exposures whose headers have no more than the date of one night may have two.
_NIGHT = 1.5
_SAME_EPOCH = 1e-4  # years: a mean that was written and read


@dataclass(frozen=True, eq=False)
class Observations:
    """The plain arrays behind `Matches`, one row an observation.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        What they come from.
    names : tuple of str
        Exposures, in the order in which they first appear.
    stars : ndarray, shape (n_stars,)
        Star identifiers, sorted.
    exposure, star : ndarray of int, shape (n,)
        Indices into `names` and `stars`.
    xy : ndarray, shape (n, 2)
        Pixels; what terms displace them by (`DISPLACED`) is taken off.
    covariance : ndarray, shape (n, 3)
        ``var_x, var_y, cov_xy`` [pix^2].
    """

    table: QTable
    names: tuple[str, ...]
    stars: np.ndarray
    exposure: np.ndarray
    star: np.ndarray
    xy: np.ndarray
    covariance: np.ndarray

    @cached_property
    def first(self) -> np.ndarray:
        """First row of every exposure, (n_exposures,)."""
        return np.unique(self.exposure, return_index=True)[1]

    @property
    def key(self) -> np.ndarray:
        """A number (n,) of every pair of exposure and star, which ascends with exposure, then star."""
        return self.exposure.astype(np.int64, copy=False) * len(self.stars) + self.star

    @cached_property
    def is_sorted(self) -> bool:
        """Whether rows come by exposure, then star, and no star twice in an exposure."""
        key = self.key
        return bool(np.all(key[1:] > key[:-1]))

    @cached_property
    def flux(self) -> np.ndarray | None:
        """Mean flux of every star, (n_stars,); None without the column."""
        if "flux" not in self.table.colnames:
            return None
        flux = np.nan_to_num(column_contract.values(self.table, "flux"))
        return np.bincount(self.star, flux, len(self.stars)) / np.bincount(self.star, minlength=len(self.stars))

    @cached_property
    def fields(self) -> np.ndarray:
        """Number of the group of every exposure that has common stars, directly or through others, (n_exposures,)."""
        n = len(self.names)
        for rows in _some_then_all(self):
            # tie every exposure to the first one of each of its stars: the same groups as all pairs, in a small graph
            star, exposure, first = self.star[rows], self.exposure[rows], np.full(len(self.stars), n)
            np.minimum.at(first, star, exposure)
            tied = np.zeros((n, n), dtype=bool)
            tied[exposure, first[star]] = True
            if tied[:, 0].all():  # as nearly always
                return np.zeros(n, dtype=int)
        return connected_components(tied, directed=False)[1]

    def check(self, *, n_fields: float = 1) -> None:
        """Raise what `Matches.from_table` does where these do not determine distortions.

        Parameters
        ----------
        n_fields : int
            Groups of exposures without a common star that there may be.

        Raises
        ------
        InputError
            For a star that stands twice in an exposure, or positions that all lie on one line.
        MatchError
            For exposures in more groups.
        """
        _check_duplicates(self)
        if len(self.groups) > n_fields:
            raise apart(self.groups, "solve each group by itself")
        _check_spread(self)

    @property
    def groups(self) -> list[list[str]]:
        """The exposures of every group that has common stars."""
        return [[str(self.names[i]) for i in np.flatnonzero(self.fields == g)] for g in range(self.fields.max() + 1)]

    @classmethod
    def of(cls, table: Table) -> Observations:
        """Those of a table that keeps the contract of matched positions."""
        names, exposure = _first_seen(table["exposure"])
        stars, star = _ranked(table["star"])
        x_err, y_err = table["x_err"].to_value(u.pix), table["y_err"].to_value(u.pix)
        xy, covariance = np.empty((2, len(table))), np.zeros((3, len(table)))  # columns that lie in one piece
        xy[0], xy[1] = table["x"].to_value(u.pix), table["y"].to_value(u.pix)
        for column, name in zip(xy, DISPLACED, strict=True):
            if name in table.colnames:
                column -= table[name].to_value(u.pix)
        np.square(x_err, out=covariance[0])
        np.square(y_err, out=covariance[1])
        if "xy_corr" in table.colnames:
            covariance[2] = np.asarray(table["xy_corr"]) * x_err * y_err
        return cls(table, names, stars, exposure, star, xy.T, covariance.T)


def _read_arrays(meta):
    return {name: np.array(each) for name, each in meta.items()}


def _read_sky(meta):
    return TangentPlane(meta["lon"], meta["lat"], np.array(meta["matrix"]))


@dataclass(frozen=True, eq=False)
class Matches(ShownAsPrinted):
    """Positions of the same stars in several exposures.

    `keep` makes matches of some of the rows, `dataclasses.replace` others with changed fields; both keep what is not
    changed, and `observations` follow the table.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        One row an observation: ``exposure``, ``star``, ``x``, ``y``, ``x_err``, ``y_err`` [pix]
        and what else came with it. Rows are never reordered.
    shapes : dict
        ``{exposure: (ny, nx)}``.
    poses : dict
        ``{exposure: (2, 3) array}``, reference plane -> undistorted pixels (see `legdistort.geometry.similarity`).
    sky : `~legdistort.geometry.tangent_plane.TangentPlane` or None
        Where the reference plane lies on the sky, if that is known.
    left_out : dict
        ``{exposure: reason}`` of exposures that could not be used.
    epoch : float or None
        Mean of the exposures, a Julian year, if their headers state it.
    header_distortion : str or None
        The largest distortion of the headers, in words, if they have one; it is not in the poses.
    observations : Observations
        The table as plain arrays; made of it, need not be given.
    camera : `legdistort.Camera`
        Where it has a focal plane (`Camera.has_focal_plane`), positions are those in that, and those on the detectors
        stand in ``x_detector``, ``y_detector``. That of plain images need not be given.
    pose_sigma : dict or None
        Errors of all poses, ``shift`` [pix], ``rotation`` [deg], ``scale``, those that are known; None: poses are where
        a solution starts.
    pointing : HeaderPointing or None
        How well headers tell where the plane lies on the sky, where they put it there.
    start : dict or None
        ``{exposure: (2, n_modes)}``: distortions with which a solution begins, pixels, normalised Legendre modes, in
        the place of those of a prior.

    See Also
    --------
    legdistort.match : Matches from positions of stars that are not identified.
    legdistort.solve : Positions and distortions from matches.

    Examples
    --------
    >>> import legdistort as ld
    >>> table = ld.simulate_matches(n_stars=20, n_exposures=4, seed=1).matches.table
    >>> table["exposure", "star", "x", "y", "x_err", "y_err"].colnames
    ['exposure', 'star', 'x', 'y', 'x_err', 'y_err']
    >>> ld.Matches.from_table(table, shape=(2048, 2048))
    <Matches: 80 observations of 20 stars in 4 exposures>
    """

    table: QTable
    shapes: dict[str, tuple[int, int]] = field(metadata={BY_EXPOSURE: True})
    poses: dict[str, np.ndarray] = field(metadata={BY_EXPOSURE: True, READ: _read_arrays})
    sky: TangentPlane | None = field(default=None, metadata={READ: _read_sky})
    left_out: dict[str, str] = field(default_factory=dict)
    epoch: float | None = None
    header_distortion: str | None = None
    observations: Observations | None = None
    camera: Camera = field(default=None, metadata={READ: Camera.from_meta})
    pose_sigma: dict[str, float] | None = None
    pointing: HeaderPointing | None = field(default=None, metadata={READ: HeaderPointing.of_meta})
    start: dict[str, np.ndarray] | None = field(default=None, metadata={BY_EXPOSURE: True, READ: _read_arrays})

    def __post_init__(self) -> None:
        if self.camera is None:
            object.__setattr__(self, "camera", Camera.of_images(self.shapes.values()))
        if self.observations is None or self.observations.table is not self.table:
            object.__setattr__(self, "observations", Observations.of(self.table))

    @property
    def names(self) -> tuple[str, ...]:
        """Exposure names, in the order in which they first appear."""
        return self.observations.names

    @property
    def stars(self) -> np.ndarray:
        """Star identifiers, sorted."""
        return self.observations.stars

    @cached_property
    def positions(self) -> np.ndarray:
        """Rough reference positions (n_stars, 2): mean of the measured ones carried back by the poses."""
        obs = self.observations
        back = np.empty_like(obs.xy)
        for i, name in enumerate(self.names):
            rows = obs.exposure == i
            back[rows] = similarity.apply(similarity.invert(self.poses[name]), obs.xy[rows])
        return start_poses.star_means(back, obs.star, len(self.stars))

    @cached_property
    def times(self) -> tuple[np.ndarray, str]:
        """Times (n_exposures,) from the first exposure on, and their unit, by the column ``epoch``.

        In "days"; in "exposures", their order, where it is of one night and distinguishes no more than half of them.
        """
        n = len(self.names)
        if "epoch" in self.table.colnames:
            years = column_contract.values(self.table, "epoch", u.yr)[self.observations.first]
            days = u.yr.to(u.day) * (years - years.min())
            if np.isfinite(years).all() and (2 * len(np.unique(years)) > n or np.ptp(days) > _NIGHT):
                return days, "days"
        return np.arange(n, dtype=float), "exposures"

    @cached_property
    def epochs(self) -> np.ndarray | None:
        """Years (n_exposures,) of the exposures, by the column ``epoch``.

        Raises
        ------
        InputError
            If it is missing, for some of the exposures too, or cannot be the time of an exposure.
        """
        if "epoch" not in self.table.colnames:
            raise InputError(
                "when the exposures were taken is not known: give the column epoch (decimal years, MJD or Time), "
                "frames with DATE-OBS, MJD-OBS or EXPSTART in their headers, or legdistort match --dates TABLE, which "
                "has names of lists and their dates"
            )
        return exposure_years(self.names, self.observations.exposure, column_contract.values(self.table, "epoch", u.yr))

    @cached_property
    def blocks(self) -> np.ndarray:
        """Night, or other block of exposures that may share a departure from the static distortion, of every exposure.

        Integers (n_exposures,): by the column ``block``, else by gaps of more than half a day in ``epoch``, else one.

        Raises
        ------
        InputError
            For an exposure with several values in ``block``.
        """
        obs = self.observations
        if "block" in self.table.colnames:
            label = np.asarray(self.table["block"])
            if np.any(several := label != label[obs.first][obs.exposure]):
                name = self.names[obs.exposure[int(np.argmax(several))]]
                raise InputError(f"column 'block' has several values for exposure {name}: give one night for each")
        return column_contract.blocks(self.table, obs.first)

    @cached_property
    def nights(self) -> dict[str, list[str]]:
        """Names of the exposures of every night, or other block (`blocks`), as `Solution.nights` calls them."""
        number, names, _ = column_contract.nights_of(self.table, self.observations.first)
        return {night: [self.names[i] for i in np.flatnonzero(number == n)] for n, night in enumerate(names)}

    @property
    def fields(self) -> np.ndarray:
        """Number of the field of every exposure (n_exposures,): groups of exposures without a common star.

        They lie side by side on the reference plane, and are solved together for what they have in common.
        """
        return self.observations.fields

    @plain_numbers
    def keep(self, rows: ArrayLike | slice) -> Matches:
        """The same matches with some rows of the table; exposures without any go.

        Parameters
        ----------
        rows : array_like of bool, shape (n,), slice, or array_like of int
            As an index of the table.

        Raises
        ------
        InputError
            For another number of them, a row that comes twice, or positions on one line.
        MatchError
            If nothing is left, or what is left falls apart.
        """
        rows = rows if isinstance(rows, slice) else np.asarray(rows)
        if not isinstance(rows, slice) and rows.dtype == bool and rows.shape != (len(self.table),):
            raise InputError(f"rows must be one truth value a row ({len(self.table)}), got shape {rows.shape}")
        table = self.table[rows]
        if len(table) == 0:
            raise MatchError("no position is left: keep those of an exposure at least")
        seen = Observations.of(table)
        kept = np.isin(self.names, seen.names)
        seen.check(n_fields=len(np.unique(self.fields[kept])))
        return replace(self, table=table, observations=seen, **self._by_exposure(seen.names))

    def without(self, reasons: Mapping[str, str]) -> Matches:
        """The same matches without some exposures or `nights`, ``{name: reason}``; the exposures join `left_out`.

        The `epoch` is the mean of those that are left if it was that of all.

        Raises
        ------
        MatchError
            If what is left is one exposure, or falls apart.
        """
        if unknown := reasons.keys() - {*self.names}:
            of = {name: self.nights.get(name, [name]) if name in unknown else [name] for name in reasons}
            reasons = {exposure: reasons[name] for name, exposures in of.items() for exposure in exposures}
        rows = ~np.isin(self.table["exposure"], list(reasons))
        if not rows.any():
            raise MatchError(f"no exposure agrees with the others: {reasons_of(reasons)}")
        kept = self.keep(rows)
        if len(kept.names) == 1 < len(self.names):
            raise alone(kept.names[0], f"; left out: {reasons_of(reasons)}")
        mean = _mean_epoch(self.table)
        own = self.epoch is not None and mean is not None and abs(self.epoch - mean) < _SAME_EPOCH
        epoch = _mean_epoch(kept.table) if own else self.epoch
        return replace(kept, left_out=self.left_out | dict(reasons), epoch=epoch)

    def _by_exposure(self, names):
        """Fields that have an entry for every exposure, with those of these only."""
        found = {each.name: getattr(self, each.name) for each in fields(self) if each.metadata.get(BY_EXPOSURE)}
        return {key: value and {name: value[name] for name in names} for key, value in found.items()}

    def to_meta(self) -> dict[str, Any]:
        """All that is known beside the table as plain lists, for the header of a table file; see `read_meta`."""
        known = {each.name: getattr(self, each.name) for each in _beside_the_table()}
        known["camera"] = self.camera if self.camera.is_known else None
        return {key: _plain(value) for key, value in (known | self._by_exposure(self.names)).items()}

    @staticmethod
    def read_meta(meta: Mapping[str, Any]) -> dict[str, Any]:
        """What `to_meta` wrote, as arguments of `from_table`; None for what `meta` does not have.

        Parameters
        ----------
        meta : dict
            Header of a table, ours or another one.
        """
        found = {}
        for each in _beside_the_table():
            value, read = meta.get(each.name), each.metadata.get(READ)
            found[each.name] = value if value is None or read is None else read(value)
        return {"shape": found.pop("shapes"), **found}

    def __repr__(self) -> str:
        n_fields = int(self.fields.max(initial=0)) + 1
        of_fields = f" of {n_fields} fields" if n_fields > 1 else ""
        exposures = f"{len(self.names)} exposure{'s' * (len(self.names) != 1)}"
        counts = f"{len(self.table)} observations of {len(self.stars)} stars in {exposures}"
        return f"<Matches: {counts}{of_fields}>"

    def _parts(self):
        poses = [similarity.describe(self.poses[name]) for name in self.names]
        shown = {"dx [px]": ("dx", 2), "dy [px]": ("dy", 2), "rotation [deg]": ("rotation", 4), "scale": ("scale", 6)}
        columns = [Column(head, [f"{each[key]:.{n}f}" for each in poses]) for head, (key, n) in shown.items()]
        stars = Column("stars", list(map(str, np.bincount(self.observations.exposure))))
        table = Grid([Column("exposure", self.names, words=True), stars, *columns])
        return [Heading(repr(self)[1:-1]), table, Fact("left out", reasons_of(self.left_out))]

    @classmethod
    def of_fields(cls, fields: Mapping[str, Matches]) -> Matches:
        """Matches of several fields that one camera has taken, to solve them together for what they have in common.

        Fields lie side by side on the reference plane. The sky is known where all have the same tangent plane.

        Parameters
        ----------
        fields : dict
            ``{name: Matches}``; the name stands in front of those of exposures, or of stars, if some stand in several
            fields.

        Raises
        ------
        InputError
            For anything else, fewer than two, or fields of different cameras or errors of poses.
        """
        if not isinstance(fields, Mapping) or len(fields) < 2 or not all(isinstance(p, cls) for p in fields.values()):
            raise InputError(f"fields must be a dict of Matches, two at least, got {fields!r}")
        table, known = joined({str(label): part for label, part in fields.items()})
        return cls.from_table(table, **known, allow_copies=True)

    @classmethod
    @plain_numbers
    def from_table(
        cls,
        table: Table,
        *,
        shape: Shape | Mapping[str, Shape] | None = None,
        poses: Mapping[str, ArrayLike] | None = None,
        columns: Mapping[str, str] | None = None,
        sky: TangentPlane | None = None,
        left_out: Mapping[str, str] | None = None,
        epoch: float | None = None,
        header_distortion: str | None = None,
        allow_copies: bool = False,
        camera: Camera | None = None,
        pose_sigma: Mapping[str, float | u.Quantity] | None = None,
        **passed_on: HeaderPointing | Mapping[str, np.ndarray] | None,
    ) -> Matches:
        """Matches from a table of positions whose stars are identified.

        Parameters
        ----------
        table : `~astropy.table.Table`
            Columns ``exposure``, ``star`` (int or str), ``x``, ``y``, ``x_err``, ``y_err`` (pixels,
            0-based, standard deviations), optional ``xy_corr``, ``detector``, ``flux`` or ``mag``, and
            ``epoch``, when the exposure was taken: decimal years, MJD, or `~astropy.time.Time`, and ``block``, the
            night or other block of exposures that it is of: a name or an integer (see `blocks`).
        shape : tuple or dict
            ``(ny, nx)``, or that by exposure; not needed with a camera.
        poses : dict, optional
            ``{exposure: (2, 3)}``, reference -> undistorted pixels; estimated from the positions if not given.
        columns : dict, optional
            ``{our name: name in the table}``, for example ``{"star": "name", "x_err": "xe"}``.
        sky : `~legdistort.geometry.tangent_plane.TangentPlane`, optional
        left_out : dict, optional
            Passed on.
        epoch : float, optional
            Mean of the exposures, a Julian year; by default that of a column ``epoch``, if there is one.
        header_distortion : str, optional
            The largest distortion of the headers, in words; `legdistort.solve` warns of it if no prior takes it.
        allow_copies : bool
            Keep exposures whose positions are those of another one to the last bit, as in simulations without noise;
            else they are left out with a warning: five stars or more, and over half of those of the shorter list.
        camera : `legdistort.Camera`, optional
            Where exposures have several detectors, distinguished by the column ``detector``: they become one, the focal
            plane of the camera, whose layout and static distortion count as known. What an exposure adds is then a
            distortion of the focal plane as a whole.
        **passed_on
            ``pointing`` and ``start``, as `read_meta` has them.
        pose_sigma : dict, optional
            Standard errors of the poses given, which are then more than start values: of ``shift``, that of the middle
            of the detector [pix, both axes], ``rotation`` [deg] about it, and ``scale`` (relative); 0 is exact, and
            rotation or scale may be left out where they are not known.

        Raises
        ------
        InputError
            For missing columns, bad values, duplicate (exposure, star) rows, a missing shape or pose.
        MatchError
            For exposures that overlap on the `sky` and have no common star. Other groups without a common star lie side
            by side on the reference plane (`Matches.fields`).

        Warns
        -----
        AssumptionWarning
            Naming positions outside their detector, which are left out; more than a tenth of those of an exposure are
            an `InputError`.
        """
        for name, given in (("poses", poses), ("columns", columns), ("left_out", left_out)):
            if not isinstance(given, dict | None):
                raise InputError(f"{name} must be a dict, got {type(given).__name__}")
        if columns:
            table = column_contract.rename(table, columns)
        former = (getattr(table, "meta", None) or {}).get("camera")  # of a file
        table = column_contract.check(table, column_contract.MATCHED, "the table of matched positions")
        table.remove_columns([name for name in DISPLACED if name in table.colnames])  # of an earlier solution
        if table["exposure"].dtype.kind != "U":
            table["exposure"] = table["exposure"].astype(str)
        if camera is not None:
            table, shape = in_focal_plane(table, camera, former=former), camera.field
        seen, left_out = Observations.of(table), dict(left_out or {})
        check_choice(allow_copies, (True, False), "allow_copies")
        if not allow_copies and (copies := repetitions.reasons(seen.names, seen.exposure, seen.xy)):
            table, left_out = table[~np.isin(table["exposure"], list(copies))], left_out | copies
            seen = Observations.of(table)
        for name in seen.names:
            exposure_names.check_exposure_name(name)
        shapes = shapes_by_exposure(shape, seen.names)
        inside = _inside(seen, shapes)
        if not inside.all():
            table = table[inside]
            seen = Observations.of(table)
        seen.check(n_fields=np.inf)
        if (pose_sigma := start_poses.check_pose_sigma(pose_sigma)) and poses is None:
            raise InputError("pose_sigma states how well poses are known: give these (poses=), or leave pose_sigma out")
        poses = estimated(seen) if poses is None else _check_poses(poses, seen.names)
        if seen.fields.any():
            poses = side_by_side(seen, poses, shapes, sky)
        epoch = _mean_epoch(table) if epoch is None else epoch
        known = {"observations": seen, "camera": camera, "pose_sigma": pose_sigma, **passed_on}
        return cls(table, shapes, poses, sky, left_out, epoch, header_distortion, **known)


def _beside_the_table():
    """Fields of `Matches` that a file has in the header of its table."""
    return [each for each in fields(Matches) if each.name not in ("table", "observations")]


def _plain(value):
    """Plain lists, dicts, numbers and strings of what `Matches` hold."""
    if hasattr(value, "to_meta"):
        return value.to_meta()
    if is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(each) for each in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def _mean_epoch(table):
    """Mean Julian year of the positions of a table, None if nothing states any."""
    if "epoch" not in table.colnames:
        return None
    epochs = column_contract.values(table, "epoch", u.yr)
    return float(np.nanmean(epochs)) if np.isfinite(epochs).any() else None


def shapes_by_exposure(shape, names):
    """Shapes (ny, nx), checked, of the exposures named: from a dict of them, or from one shape for all."""
    if not isinstance(shape, dict):
        shape = dict.fromkeys(names, shape)
    missing = [name for name in names if name not in shape]
    if missing:
        raise InputError(f"shape has no entry for exposure {missing[0]!r}; give (ny, nx) for every exposure")
    out = {}
    for name in names:
        try:
            ny, nx = (int(n) for n in shape[name])
        except (TypeError, ValueError):
            ny = nx = 0
        if ny < 1 or nx < 1:
            raise InputError(f"shape of exposure {name!r} must be (ny, nx) in pixels, got {shape[name]!r}")
        out[name] = (ny, nx)
    return out


def _check_spread(seen):
    """Positions on one line do not constrain anything across it."""
    for rows in _some_then_all(seen):
        x, y = (column - column.mean() for column in seen.xy[rows].T)
        # not by the linear algebra library, whose threads would be in the way of what comes next
        xx, xy, yy = (np.einsum("n,n", *pair) for pair in ((x, x), (x, y), (y, y)))
        smaller, larger = np.linalg.eigvalsh([[xx, xy], [xy, yy]])
        if smaller >= 1e-12 * larger or np.linalg.matrix_rank([x, y]) == 2:
            return
    raise InputError("all positions lie on one line: give stars all over the field, or look at the columns x, y")


def _some_then_all(seen):
    """Rows to look at: of very many those of some stars, which nearly always tell that all is well, then all."""
    if len(seen.star) > 2 * _SOME:
        yield np.flatnonzero(seen.star < len(seen.stars) * _SOME // len(seen.star))
    yield slice(None)


def _check_poses(given, names):
    missing = [name for name in names if name not in given]
    if missing:
        raise InputError(f"poses has no entry for exposure {missing[0]!r}; give a (2, 3) array for every exposure")
    return {name: similarity.check(given[name], f"pose of exposure {name!r}") for name in names}


def _first_seen(column):
    """Distinct names in the order in which they first appear, and the number of each row's name."""
    column = np.asarray(column)
    heads = np.flatnonzero(np.concatenate([[True], column[1:] != column[:-1]]))  # tables come in runs of one exposure
    numbers = {}
    run = [numbers.setdefault(str(name), len(numbers)) for name in column[heads]]
    return tuple(numbers), np.repeat(run, np.diff(np.append(heads, len(column))))


def _ranked(column):
    """Distinct stars, sorted, and the rank of each row's star; a table look-up where stars are small integers."""
    column = np.asarray(column)
    if column.dtype.kind in "iu" and len(column) and column.min() >= 0 and column.max() < 4 * len(column) + 1000:
        present = np.bincount(column.astype(np.int64, copy=False)) > 0
        return np.flatnonzero(present).astype(column.dtype), (np.cumsum(present) - 1)[column]
    return np.unique(column, return_inverse=True)


def _check_duplicates(seen):
    if seen.is_sorted:
        return
    table, key = seen.table, seen.key
    order = np.argsort(key, kind="stable")
    same = np.flatnonzero(np.diff(key[order]) == 0)
    if len(same):
        rows = order[same[0] : same[0] + 2]
        raise InputError(
            f"star {table['star'][rows[0]]} stands {'twice' if len(same) == 1 else 'more than once'} in exposure "
            f"{table['exposure'][rows[0]]} (rows {rows[0]} and {rows[1]}; {len(same)} such rows in all); "
            "keep one position of a star in an exposure"
        )


def _inside(seen, shapes):
    """Which positions lie on their detector, give or take a tenth of its size; a few others are warned of.

    Raises
    ------
    InputError
        If so many of an exposure lie outside that its shape is to be doubted.
    """
    xy, sizes = seen.xy, np.array([shapes[name][::-1] for name in seen.names])
    smallest = sizes.min(axis=0)
    low, high = ([end(column) for column in xy.T] for end in (np.min, np.max))
    if np.all(low >= -MARGIN * smallest) and np.all(high <= (1 + MARGIN) * smallest):
        return np.ones(len(xy), dtype=bool)
    size = sizes[seen.exposure]
    out = ((xy < -MARGIN * size) | (xy > (1 + MARGIN) * size)).any(axis=1)
    if not out.any():
        return ~out
    rows = np.flatnonzero(out)
    named = [
        f"star {seen.stars[seen.star[row]]} of exposure {seen.names[seen.exposure[row]]} at ({xy[row, 0]:.0f}, "
        f"{xy[row, 1]:.0f})"
        for row in rows[:_MOST_NAMED]
    ]
    share = np.bincount(seen.exposure[rows], minlength=len(sizes)) / np.bincount(seen.exposure)
    if share.max() > STRAY:
        name = seen.names[int(np.argmax(share))]
        raise InputError(
            f"{len(rows)} positions lie outside their detector, {100 * share.max():.0f} % of those of exposure {name}, "
            f"whose shape is {shapes[name]} (ny, nx); the first are {'; '.join(named)} px: correct the shape or the "
            "positions"
        )
    more = f" and {len(rows) - len(named)} more" * (len(rows) > len(named))
    warn(
        f"{len(rows)} positions lie outside their detector and are left out: {'; '.join(named)} px{more}",
        AssumptionWarning,
    )
    return ~out


def in_focal_plane(table, camera, *, former=None):
    """The table with positions in the focal plane of a camera, without those outside of their detector (`_inside`).

    Positions in the focal plane of a `former` camera, as in the header of a file, are taken to their detectors first.
    """
    check_camera(camera)
    if not camera.has_focal_plane:
        return table
    if "x_detector" in table.colnames and former not in (None, camera.to_meta()):
        return camera.in_focal_plane(Camera.from_meta(former).on_detectors(table))
    if "x_detector" not in table.colnames:
        table = with_ids_of(table, camera.detectors)
        detector, part = camera.ids(table), QTable(table, copy=False)
        if "star" not in table.colnames:
            part["star"] = np.arange(len(table))
        part["exposure"] = [f"{name}[{key}]" for name, key in zip(table["exposure"], detector, strict=True)]
        seen, of_part = Observations.of(part), dict(zip(part["exposure"], detector, strict=True))
        table = table[_inside(seen, {name: camera[of_part[name]].shape for name in seen.names})]
    return camera.in_focal_plane(table)


def alone(name, more=""):
    """The `MatchError` that there is one exposure, and nothing to compare it with."""
    return MatchError(
        f"only one exposure ({name}): the distortion is found from the differences between exposures, or from a "
        "catalogue; give two of the same field at least, or reference= (--reference), or the solution that it is to "
        f"come into: base= (--base){more}"
    )
