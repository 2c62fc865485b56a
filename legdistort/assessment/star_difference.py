"""What becomes of the stars from one solution to another: their places and motions, with what the errors let expect."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import QTable
from scipy import special
from scipy.spatial import cKDTree

from ..exceptions import InputError
from ..geometry import basis
from ..geometry.similarity import apply, fit_similarity
from ..inputs import column_contract
from ..inputs.repetitions import fingerprints
from ..inputs.table_files import records
from ..matching.cross_identification import same_stars
from ..results import in_tables

#: Stars that are named, those that differ most.
NAMED = 5
_FEWEST = 5  # stars in both
_SAME_SEASON = 0.1  # years, in which a star of 5 mas/yr moves by 0.5 mas
_SAME_PLACE, _SAME_TIME = 0.5, 1e-5  # of the stars of an exposure that was measured twice [pix], [yr]


@dataclass(frozen=True)
class Offsets:
    """Differences of stars, rms per axis, and the same over their errors: NaN where these are not known.

    Attributes
    ----------
    rms_similarity, ratio_similarity : float
        After a common shift, rotation and scale; over absolute errors.
    rms, ratio : float
        After a common map of the degree; over relative errors.
    p : float
        Probability of so large a ratio by chance; NaN where exposures are shared, or stars moved unknown.
    """

    rms_similarity: float
    ratio_similarity: float
    rms: float
    ratio: float
    p: float

    def in_words(self, unit: str, degree: int) -> str:
        """The figures in a sentence."""
        over = f" ({self.ratio_similarity:.2g} times the absolute errors)" * bool(np.isfinite(self.ratio_similarity))
        chance = f", p = {self.p:.2g}" * bool(np.isfinite(self.p))
        return (
            f"{self.rms_similarity:.2g} {unit} rms per axis after a common shift, rotation and scale{over}, "
            f"{self.rms:.2g} {unit} after a common map of degree {degree} ({self.ratio:.2g} times the errors{chance})"
        )


@dataclass(frozen=True, eq=False)
class StarDifference:
    """Differences of the stars that two solutions have in common, second minus first, at one epoch.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        One row a star, that which differs most first: ``star`` (its name in the first), ``x``, ``y`` [pix] there,
        ``dx``, ``dy`` [pix] after a common map, ``error`` [pix] of these per axis, ``ratio``; with motions in both
        ``dvx``, ``dvy``, ``v_error`` [pix/yr], ``v_ratio``. Errors are those of both, or, where exposures are shared,
        the larger of the two.
    places : Offsets
        Pixels.
    motions : Offsets or None
        Pixels a year; None unless both have motions.
    n_stars : tuple of int
        In the first and in the second.
    degree : int
        Of the common map.
    epoch : float or None
        Julian year of the places.
    pixel_scale : float or None
        Arcsec, as stated of the first.
    years : float
        Between the two where motions do not carry the stars from one to the other, else 0: they moved by these years of
        their motions, which no error has.
    """

    table: QTable
    places: Offsets
    motions: Offsets | None
    n_stars: tuple[int, int]
    degree: int
    epoch: float | None
    pixel_scale: float | None = None
    years: float = 0.0

    def lines(self) -> list[str]:
        """What `print` shows of them."""
        at = "" if self.epoch is None else f" at {self.epoch:.4f}"
        both = f"{len(self.table)} stars in both, of {self.n_stars[0]} and {self.n_stars[1]}"
        out = [f"{both}: places{at} differ by {self.places.in_words('px', self.degree)}."]
        if self.motions is not None:
            out.append(f"Motions differ by {self.motions.in_words('px/yr', self.degree)}.")
        if self.angles is not None:
            figures = [f"{self.angles[f'places_{kind}']:.2g}" for kind in ("similarity_mas", "mas")]
            out.append(f"At {self.pixel_scale:.6g} arcsec a pixel: places {' and '.join(figures)} mas")
            if self.motions is not None:
                figures = [f"{self.angles[f'motions_{kind}']:.2g}" for kind in ("similarity_mas_yr", "mas_yr")]
                out[-1] += f", motions {' and '.join(figures)} mas/yr"
            out[-1] += "."
        if self.years:
            when = "later" if self.years > 0 else "earlier"
            out.append(
                f"The second is {abs(self.years):.2f} years {when}, and neither has motions: the stars moved by these "
                "years of them, which no error has, and chances are not known; solve both together, motion='proper' "
                "(--motion proper), for what they are."
            )
        elif np.isnan(self.places.p):
            out.append("Exposures are in both: errors are the larger of the two, and chances are not known.")
        worst = self.table[:NAMED].copy()
        for name in worst.colnames[1:]:
            worst[name].info.format = ".2f" if name in ("x", "y", "ratio", "v_ratio") else ".4f"
        return [*out, "The largest differences over their errors:", *worst.pformat(max_lines=-1, max_width=-1)]

    @property
    def angles(self) -> dict[str, float] | None:
        """Differences in mas where a pixel scale is stated, rms per axis, else None.

        ``places_similarity_mas`` after a common shift, rotation and scale, ``places_mas`` after a common map; with
        motions ``motions_similarity_mas_yr``, ``motions_mas_yr``.
        """
        if self.pixel_scale is None:
            return None
        found = {}
        for name, unit, each in (("places", "mas", self.places), ("motions", "mas_yr", self.motions)):
            if each is not None:
                found[f"{name}_similarity_{unit}"] = 1000 * self.pixel_scale * each.rms_similarity
                found[f"{name}_{unit}"] = 1000 * self.pixel_scale * each.rms
        return found

    def to_dict(self) -> dict[str, Any]:
        """Everything as numbers and texts for JSON; of the stars those that are named."""
        kinds = {"places_px": self.places, "motions_px_yr": self.motions}
        figures = {
            kind: each and {name: value if value == value else None for name, value in vars(each).items()}
            for kind, each in kinds.items()
        }
        counts = {"n_stars": len(self.table), "n_first": self.n_stars[0], "n_second": self.n_stars[1]}
        more = {
            "degree": self.degree,
            "epoch_yr": self.epoch,
            "unmoved_yr": self.years,
            "angles": self.angles,
            "largest": records(self.table[:NAMED]),
        }
        return counts | figures | more


def shared_exposures(first, second):
    """Names, in the second of two solutions, of exposures that both have: measured alike, or anew in the same frame."""
    known = {mark for marks in fingerprints(first.residuals).values() for mark in marks}
    same = {name for name, marks in fingerprints(second.residuals).items() if known & set(marks)}
    one, two = _seen(first), _seen(second)
    for name in (one.keys() & two.keys()) - same:
        (xy, year), (again, other) = one[name], two[name]
        if not abs(year - other) > _SAME_TIME and np.median(cKDTree(xy).query(again)[0]) < _SAME_PLACE:
            same.add(name)
    return tuple(name for name in second.names if name in same)


def _seen(solution):
    """Measured positions (n, 2) and year, NaN if unknown, of every exposure."""
    table = solution.residuals
    name, xy = column_contract.labels(table, "exposure"), np.column_stack([table["x"].value, table["y"].value])
    years = column_contract.values(table, "epoch", u.yr) if "epoch" in table.colnames else np.full(len(table), np.nan)
    parts = {each: name == each for each in np.unique(name)}
    return {each: (xy[mine], years[mine][0]) for each, mine in parts.items()}


def compare_stars(first, second, *, shared):
    """The `StarDifference` of two solutions; None where no stars are found to be the same.

    Parameters
    ----------
    first, second : Solution
    shared : bool
        Whether they have exposures in common, so that their errors are not independent.
    """
    one, two, year, years = _at_one_time(first, second)
    counts = len(one), len(two)
    try:
        rows = same_stars(_places(one), _places(two), "the second solution")
    except InputError:
        return None
    one, two = one[rows[0]], two[rows[1]]
    good = np.all([np.isfinite(_error(each, "{}_err")) & _placed(each) for each in (one, two)], axis=0)
    one, two = one[good], two[good]
    degree = min(first.degree, second.degree)
    if len(one) < max(_FEWEST, 2 * basis.n_modes(degree)):
        return None
    xy, field = _xy(one), np.asarray(one["field"]) if "field" in one.colnames else np.ones(len(one))
    places, motions = np.empty_like(xy), np.full_like(xy, np.nan)
    moving = "vx" in one.colnames and "vx" in two.colnames
    for each in np.unique(field):
        mine = field == each
        pose = fit_similarity(xy[mine], _xy(two[mine]), weights=_error(one[mine], "{}_err") ** -2.0)
        places[mine] = _xy(two[mine]) - apply(pose, xy[mine])
        if moving:
            motions[mine] = _xy(two[mine], "v{}") - _xy(one[mine], "v{}") @ pose[:, :2].T
    table = QTable({"star": one["star"], "x": one["x"], "y": one["y"]})
    found = []
    for values, name in ((places, "{}"), (motions, "v{}")) if moving else ((places, "{}"),):
        errors = [_together(one, two, f"{name}_{kind}", shared) for kind in ("err", "err_abs")]
        left, offsets = _offsets(values, xy, field, errors, degree, by_chance=not (shared or years))
        found.append(offsets)
        prefix, unit = name.format("")[:1], one[name.format("x")].unit
        for axis in range(2):
            table[f"d{name.format('xy'[axis])}"] = left[:, axis] * unit
        table[f"{prefix}_error".lstrip("_")] = errors[0] * unit
        table[f"{prefix}_ratio".lstrip("_")] = np.sqrt(np.mean(left**2, axis=1)) / errors[0]
    table = table[np.argsort(-table["ratio"])]
    scale = in_tables.pixel_scale(first)
    return StarDifference(table, found[0], found[1] if moving else None, counts, degree, year, scale, years)


def _at_one_time(first, second):
    """The stars of both at the epoch of the first, as far as motions are known, that epoch, and the years beyond."""
    one, two, years = first.stars, second.stars, 0.0
    year, other = in_tables.epoch(first), in_tables.epoch(second)
    if year is not None and second.estimate.motions is not None:
        two = second.stars_at(year)
    elif other is not None and first.estimate.motions is not None:
        one, year = first.stars_at(other), other
    elif None not in (year, other) and first.estimate.motions is None and abs(other - year) > _SAME_SEASON:
        years = other - year
    return one, two, year, years


def _placed(stars):
    """Which stars (n,) are known at the epoch of the table: one without a motion is where it was seen."""
    return np.isfinite(stars["vx"].value) if "vx" in stars.colnames else np.ones(len(stars), bool)


def _places(stars):
    """Names, positions and fluxes of a table of stars, as `same_stars` takes them."""
    return np.asarray(stars["star"]), _xy(stars), np.asarray(stars["flux"]) if "flux" in stars.colnames else None


def _offsets(values, xy, field, errors, degree, *, by_chance):
    """Values (n, 2) without a common map of every field, and their `Offsets`; errors (n,) relative and absolute."""
    alike, left = np.empty_like(values), np.empty_like(values)
    for each in np.unique(field):
        mine = np.flatnonzero((field == each) & np.isfinite(values).all(axis=1))
        alike[mine], left[mine] = _without_maps(values[mine], xy[mine], errors[0][mine], degree)
    known = np.isfinite(values).all(axis=1)
    ratio = _rms(left[known] / errors[0][known, None])  # errors are those after a map is taken off
    dof = 2 * (np.count_nonzero(known) - len(np.unique(field)) * basis.n_modes(degree))
    left[~known] = np.nan
    return left, Offsets(
        rms_similarity=_rms(alike[known]),
        ratio_similarity=_rms(alike[known] / errors[1][known, None]),
        rms=_rms(left[known]),
        ratio=ratio,
        p=float(special.chdtrc(dof, dof * ratio**2)) if dof > 0 and by_chance else np.nan,
    )


def _without_maps(values, xy, error, degree):
    """Values (n, 2) without a shift, rotation and scale, and without a map of a degree, by weighted least squares."""
    span = np.ptp(xy, axis=0).max() or 1.0
    t = 2 * (xy - (xy.min(axis=0) + xy.max(axis=0)) / 2) / span
    (x, y), one, zero = t.T, np.ones(len(t)), np.zeros(len(t))
    similar = np.array([[one, zero], [zero, one], [x, y], [-y, x]]).transpose(2, 1, 0)  # (n, 2, 4)
    design, weight = similar.reshape(-1, 4), np.repeat(1 / error, 2)
    found = np.linalg.lstsq(design * weight[:, None], values.ravel() * weight, rcond=None)[0]
    modes = basis.values(degree, x, y).T
    whole = np.linalg.lstsq(modes / error[:, None], values / error[:, None], rcond=None)[0]
    return values - similar @ found, values - modes @ whole


def _xy(table, name="{}"):
    return np.column_stack([np.asarray(getattr(table[name.format(c)], "value", table[name.format(c)])) for c in "xy"])


def _error(table, name):
    """Errors (n,) per axis."""
    return np.sqrt(np.mean(_xy(table, name) ** 2, axis=1))


def _together(one, two, name, shared):
    """Errors (n,) of differences: of both, or the larger of the two where they are not independent."""
    first, second = _error(one, name), _error(two, name)
    return np.maximum(first, second) if shared else np.hypot(first, second)


def _rms(values):
    return float(np.sqrt(np.mean(values**2)))
