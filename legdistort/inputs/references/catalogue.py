"""A reference catalogue: positions with errors that the star positions are to be tied to.

Columns are those of Gaia (also as VizieR writes them), or ``x``, ``y`` in the reference plane, named as in the tables
of stars of solutions. Where a table has both, the sky is taken.
"""

import logging
import re
import warnings
from dataclasses import dataclass, replace
from itertools import combinations
from numbers import Real
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.coordinates import Angle, SkyCoord
from astropy.table import Column, Table
from astropy.time import Time

from ...exceptions import AssumptionWarning, InputError, warn
from ...geometry import basis
from ...geometry.epochs import year
from ...geometry.tangent_plane import angles, compass, directions
from ...runtime import checks
from .. import column_contract
from ..plain_columns import is_text, numbers, text
from ..table_files import read_table
from .scamp import of_scamp

log = logging.getLogger(__name__)

#: How VizieR calls the columns of Gaia, and places in the tables of others, in small letters.
VIZIER = {
    "ra_icrs": "ra", "de_icrs": "dec", "e_ra_icrs": "ra_error", "e_de_icrs": "dec_error", "pmde": "pmdec",
    "e_pmra": "pmra_error", "e_pmde": "pmdec_error", "radecor": "ra_dec_corr", "rapmracor": "ra_pmra_corr",
    "rapmdecor": "ra_pmdec_corr", "depmracor": "dec_pmra_corr", "depmdecor": "dec_pmdec_corr",
    "pmrapmdecor": "pmra_pmdec_corr", "gmag": "phot_g_mean_mag", "plx": "parallax", "e_plx": "parallax_error",
    "raplxcor": "ra_parallax_corr", "deplxcor": "dec_parallax_corr", "plxpmracor": "parallax_pmra_corr",
    "plxpmdecor": "parallax_pmdec_corr", "raj2000": "ra", "dej2000": "dec", "radeg": "ra", "dedeg": "dec",
    "e_raj2000": "ra_error", "e_dej2000": "dec_error", "e_radeg": "ra_error", "e_dedeg": "dec_error",
    "_raj2000": "ra", "_dej2000": "dec", "_ra": "ra", "_de": "dec",
}  # fmt: skip
#: Errors as other tables call them.
VIZIER |= {
    given.format(name): f"{name}_error"
    for name in ("ra", "dec", "pmra", "pmdec", "parallax") for given in ("{}_err", "e_{}", "{}_unc")
}  # fmt: skip
#: Columns with the names that a catalogue gives to its stars, in order of preference, in small letters.
_NAMES = "source_id", "source", "star", "name", "id"
#: How the tables of the CDS call the parts of sexagesimal positions, in small letters.
_PARTS = ("rah", "ram", "ras", "ded", "dem", "des", "de-")
#: Columns of errors that are not called NAME_error.
_ERRORS = {"x": "x_err", "y": "y_err", "vx": "vx_err", "vy": "vy_err"}
_UNITS = dict.fromkeys(("ra", "dec"), u.deg) | dict.fromkeys(("pmra", "pmdec"), u.mas / u.yr)
_UNITS |= dict.fromkeys(("vx", "vy"), u.pix / u.yr) | {"parallax": u.mas}
_HOURS = 24  # of a day
#: mas a year, below which all motions of a catalogue are those of another unit: no star's is known so well.
_SMALLEST_MOTION = 1e-3
_MAS = np.radians(1 / 3.6e6)
#: Error of what is taken as exact: mas, and mas a year.
EXACT = 1e-3
#: In place of an error: it is to be found.
FOUND = "found"
#: Years between catalogue and exposures within which a star without proper motion still serves.
_SAME_TIME = 0.01


@dataclass(frozen=True, eq=False)
class Reference:
    """Positions to be tied to; one row a star.

    Attributes
    ----------
    label : str
        How messages call it.
    star : ndarray, shape (n,), or None
        Which star of the matches each is, if that is known.
    flux : ndarray, shape (n,), or None
        On any scale.
    sky : ndarray, shape (n, 2), or None
        ICRS right ascension and declination, degrees.
    xy : ndarray, shape (n, 2), or None
        Instead: positions in the reference plane, pixels.
    covariance : ndarray, shape (n, 2 + k, 2 + k)
        Of ra, dec along east and north and of `motion`, mas and years; or of x, y and `motion`, pixels and years.
    motion : ndarray, shape (n, k), or None
        Proper motions to the east and north, mas a year, or along x and y, pixels a year; perhaps parallaxes, mas.
    epoch : ndarray, shape (n,), or None
        Years of the positions; NaN for those not known, of which none has a motion.
    finds_errors : bool
        Whether the errors are known up to a common factor only, which is to be found.
    maps : ndarray, shape (n, 2, m), or None
        Errors that all its positions have in common, as displacements in the units of these: their sum times normal
        deviates.
    unknown : ndarray, shape (n, 2, k), or None
        Displacements that may be in its positions by any amount.
    degree : int or None
        Of a map that belongs to it alone and may be any, shift, rotation and scale aside; None for none.
    names : ndarray of str, shape (n,), or None
        What the catalogue calls its stars, or "row 0" and so on.
    """

    label: str
    star: np.ndarray | None
    flux: np.ndarray | None
    sky: np.ndarray | None
    xy: np.ndarray | None
    covariance: np.ndarray
    motion: np.ndarray | None = None
    epoch: np.ndarray | None = None
    finds_errors: bool = False
    maps: np.ndarray | None = None
    unknown: np.ndarray | None = None
    degree: int | None = None
    names: np.ndarray | None = None

    def __len__(self):
        return len(self.covariance)

    def __repr__(self):
        kind = "sky" if self.xy is None else "reference-plane"
        motion = ", with proper motions" if self.motion is not None else ""
        parallax = " and parallaxes" if self.motion is not None and self.motion.shape[1] > 2 else ""
        return f"<Reference: {len(self)} stars, {kind} positions{motion}{parallax}>"

    def subset(self, rows):
        """The same with some of its stars."""
        arrays = {key: value[rows] for key, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **arrays)

    def at(self, epoch, *, moving=False):
        """The reference with its stars where they were at an epoch, in years (straight motion, no parallax).

        Without proper motions they are taken to stay; where stars are known to be `moving`, those of another epoch are
        left out.

        Raises
        ------
        InputError
            If there are proper motions and `epoch` is None, or no star has one; if no star is left.
        """
        if self.motion is None:
            near = moving and self.epoch is not None and np.abs(epoch - self.epoch) < _SAME_TIME
            if near is False:
                return self
            if not near.any():
                own = np.nanmedian(self.epoch)
                raise InputError(
                    f"{self.label} has no proper motions, and its positions are those of {own:.2f}, "
                    f"where stars that move are sought at {epoch:.2f}: give motion_epoch={own:.2f} "
                    "(--motion-epoch), or the proper motions"
                )
            return self.subset(near)
        if epoch is None:
            raise InputError(
                f"{self.label} has proper motions, but the epoch of the exposures is not known (no MJD-OBS or DATE-OBS "
                "in their headers): give epoch= (--epoch), a decimal year or an astropy Time"
            )
        years = epoch - self.epoch
        known = np.isfinite(self.motion[:, :2]).all(axis=1) & np.isfinite(self.covariance[:, :4, :4]).all(axis=(1, 2))
        still = ~known & (np.abs(years) < _SAME_TIME)
        if not (known | still).any():
            raise InputError(
                f"no star of {self.label} has a proper motion with errors, and its epoch is not that of the exposures "
                f"({epoch:.2f}): leave the columns out to take the positions as they are"
            )
        motion = np.where(known[:, None], self.motion[:, :2], 0) * years[:, None]
        size = self.covariance.shape[1]
        step = np.tile(np.eye(size), (len(self), 1, 1))
        step[:, 0, 2] = step[:, 1, 3] = years
        lost = np.isnan(self.covariance)
        covariance = step @ np.where(lost, 0, self.covariance) @ step.transpose(0, 2, 1)
        covariance[lost] = np.nan
        covariance[~known, 2:, 2:] = np.nan
        moved = replace(self, covariance=covariance, epoch=np.full(len(self), float(epoch)))
        if self.xy is not None:
            return replace(moved, xy=self.xy + motion).subset(known | still)
        place, east, north = _axes(self.sky)
        place = place + _MAS * (motion[:, :1] * east + motion[:, 1:] * north)
        return replace(moved, sky=_degrees(place)).subset(known | still)

    def on_plane(self, plane):
        """The reference with positions, motions and covariances in pixels of a tangent plane.

        NaN far off its tangent point. Parallaxes are in pixels too.
        """
        if self.xy is not None:
            return self
        place, east, north = _axes(self.sky)
        middle = directions(*np.radians([plane.lon, plane.lat]))
        far = place @ middle < 0.5  # beyond 60 degrees; the projection ends at 90
        step = 1e-6
        near = (SkyCoord(*_degrees(place + step * shift).T * u.deg, frame="icrs") for shift in (0 * east, east, north))
        xy, x_east, x_north = map(plane.from_sky, near)
        slope = np.stack([x_east - xy, x_north - xy], axis=-1) * _MAS / step
        xy[far] = np.nan
        size = self.covariance.shape[1]
        turn = np.tile(np.eye(size) / (1000 * plane.pixel_scale), (len(self), 1, 1))
        for first in range(0, size - 1, 2):
            turn[:, first : first + 2, first : first + 2] = slope
        lost = np.isnan(self.covariance)
        covariance = turn @ np.where(lost, 0, self.covariance) @ turn.transpose(0, 2, 1)
        covariance[lost] = np.nan
        maps, unknown = (None if each is None else slope @ each for each in (self.maps, self.unknown))
        motion = None
        if self.motion is not None:
            moved = np.einsum("jab,jb->ja", turn[:, 2:, 2:], np.nan_to_num(self.motion))
            motion = np.where(np.isnan(self.motion), np.nan, moved)
        found = {"motion": motion, "covariance": covariance, "maps": maps, "unknown": unknown}
        return replace(self, sky=None, xy=xy, **found)


def _axes(sky):
    """Unit vectors (n, 3) to positions (n, 2) in degrees, and those to the east and to the north there."""
    lon, lat = np.radians(sky).T
    return directions(lon, lat), *compass(lon, lat)


def _degrees(place):
    lon, lat = np.degrees(angles(place))
    return np.stack([lon % 360, lat], axis=1)


def read_reference(reference, error=None, degree=None):
    """The `Reference` in a table or file.

    Parameters
    ----------
    reference : `~astropy.table.Table`, `~astropy.coordinates.SkyCoord`, str, path or Reference
        Of a table the column that holds a `~astropy.coordinates.SkyCoord`, if there is one, gives positions, motions
        and epoch. A `~astropy.coordinates.SkyCoord` alone is taken as exact.
    error : float, `~astropy.units.Quantity` or "found", optional
        Of positions for which it states none, per axis: mas on the sky, else pixels. Found: stated errors count only
        relative to one another, all others are equal, and their size follows from how the stars agree.
    degree : int, optional
        See `Reference`.

    Raises
    ------
    InputError
        For columns that are missing or hold no numbers, and for a table without a usable row.

    Warns
    -----
    AssumptionWarning
        For a `~astropy.coordinates.SkyCoord` alone, which has no errors.
    """
    if isinstance(reference, Reference):
        return reference
    check_stated(error, degree)
    if isinstance(reference, (str, Path)):
        label, table = f"the reference {reference}", read_table(reference)
        if "exposure" in table.colnames and table["exposure"].info.description == column_contract.OF_FILE:
            table.remove_column("exposure")  # of what is read as a list of positions
    elif isinstance(reference, Table):
        label, table = "the reference", Table(reference)  # Quantities become columns with a unit
    elif isinstance(reference, SkyCoord):
        label, table = "the reference", _exact(reference) if error is None else Table({"sky": reference})
    else:
        raise InputError(f"reference must be a table, the path of one, or a SkyCoord, got {type(reference).__name__}")
    table = _named(of_scamp(_with_coordinates(table, label)))
    celestial = {"ra", "dec"} <= set(table.colnames)
    if not celestial and not {"x", "y"} <= set(table.colnames):
        raise InputError(
            f"{label} has neither ra, dec nor x, y; it has {', '.join(table.colnames)}: rename its columns"
        )
    try:
        table = _with_errors(table, ("ra", "dec") if celestial else ("x", "y"), error)
        made = (_celestial if celestial else _planar)(table, label)
    except InputError as error:
        raise InputError(f"{label}: {error}" if label not in str(error) else str(error)) from None
    positions = made.sky if celestial else made.xy
    good = np.isfinite(positions).all(axis=1) & np.isfinite(made.covariance[:, :2, :2]).all(axis=(1, 2))
    if made.motion is not None and (n := np.count_nonzero(good & np.isnan(made.epoch))):
        log.info("%s: %d of %d stars are left out, whose motions have no epoch (ref_epoch)", label, n, len(good))
        good &= np.isfinite(made.epoch)
    if not good.any():
        raise InputError(f"{label} has no row with finite positions and errors ({len(good)} rows)")
    if made.star is not None and len(np.unique(made.star[good])) < np.count_nonzero(good):
        names, count = np.unique(made.star[good], return_counts=True)
        raise InputError(f"{label} names star {names[count > 1][0]} more than once")
    made = replace(made, names=_names(table), finds_errors=is_found(error), degree=degree)
    return made.subset(good)


def is_found(error):
    """Whether an error is one to be found."""
    return isinstance(error, str) and error == FOUND


def check_stated(error, degree):
    """Raise `InputError` for what is no error of positions, and no degree of a map."""
    if degree is not None:
        basis.check_degree(degree, "reference_degree")
    if error is None or is_found(error):
        return
    value = error.value if isinstance(error, u.Quantity) else error
    if not (isinstance(value, (Real, np.ndarray)) and np.ndim(value) == 0 and 0 < value < np.inf):
        raise InputError(
            f"reference_error must be a positive number, a Quantity, or {FOUND!r}, got {error!r}: the error per axis "
            "of positions for which the reference states none, mas on the sky, else pixels"
        )


def _with_errors(table, places, error):
    """The table with errors of positions where it states none."""
    if error is None:
        return table
    unit = u.mas if places[0] == "ra" else u.pix
    if is_found(error):
        size = 1.0
    else:
        try:
            size = float(u.Quantity(error, unit).value) if isinstance(error, u.Quantity) else float(error)
        except u.UnitsError:
            raise InputError(f"reference_error must be in {unit} for its positions, got {error}") from None
    out = table.copy()
    for name in (_ERRORS.get(place, f"{place}_error") for place in places):
        stated = column_contract.values(table, name, unit) if name in table.colnames else np.full(len(table), np.nan)
        out[name] = np.where(np.isfinite(stated), stated, size)
    return out


def _exact(coordinates):
    """A table of coordinates, and of their motions, with errors too small to matter."""
    if coordinates.isscalar or coordinates.ndim != 1:
        raise InputError(f"the SkyCoord of a reference must be a list of places, got shape {coordinates.shape}")
    warn(
        "a SkyCoord has no errors: its positions are taken as exact; give a table with this column and ra_error, "
        "dec_error (and pmra_error, pmdec_error) for others",
        AssumptionWarning,
    )
    table = Table({"sky": coordinates})
    for name in ("ra_error", "dec_error", "pmra_error", "pmdec_error"):
        table[name] = np.full(len(table), EXACT)
    return table


def _with_coordinates(table, label):
    """The table with the columns of Gaia where it has a SkyCoord."""
    found = [name for name in table.colnames if isinstance(table[name], SkyCoord)]
    if len(found) > 1 and "sky" not in found:
        raise InputError(f"{label} has several columns of coordinates, {', '.join(found)}: name one sky, or leave one")
    if not found:
        return table
    name = "sky" if "sky" in found else found[0]
    coordinates, table = table[name], table[[other for other in table.colnames if other not in found]]
    icrs = coordinates.icrs
    table["ra"], table["dec"] = icrs.ra.deg, icrs.dec.deg
    if "s" in icrs.data.differentials:
        table["pmra"] = icrs.pm_ra_cosdec.to_value(u.mas / u.yr)
        table["pmdec"] = icrs.pm_dec.to_value(u.mas / u.yr)
        if coordinates.obstime is None and "ref_epoch" not in table.colnames:
            raise InputError(
                f"{label} has proper motions but its SkyCoord has no obstime, the time of its positions: add it"
            )
    if coordinates.obstime is not None and "ref_epoch" not in table.colnames:
        table["ref_epoch"] = np.broadcast_to(coordinates.obstime.jyear, len(table)).copy()
    return table


def _named(table):
    """The table with the names of Gaia where it has those of VizieR or capitals."""
    table = table.copy(copy_data=False)
    for name in table.colnames:
        small = name.lower()
        wanted = VIZIER.get(small, small)
        if wanted != name and wanted not in table.colnames:
            table.rename_column(name, wanted)
    if set(_PARTS) <= set(table.colnames) and not {"ra", "dec"} & set(table.colnames):
        h, m, s, deg, arcmin, arcsec = (column_contract.values(table, name) for name in _PARTS[:-1])
        south = [word.strip().startswith(("-", "\u2212")) for word in text(np.asarray(table["de-"]).astype(str))]
        table["ra"] = 15 * (h + m / 60 + s / 3600)
        table["dec"] = np.where(south, -1, 1) * (deg + arcmin / 60 + arcsec / 3600)
    for name in [name for name in table.colnames if name.endswith("_abs")]:  # a table of stars of a solution
        table[name.removesuffix("_abs")] = table[name]
    return table


def _planar(table, label):
    xy = np.column_stack([column_contract.values(table, name, u.pix) for name in ("x", "y")])
    motion, epoch, covariance = _moving(table, ("x", "y"), ("vx", "vy"), u.pix, label)
    return Reference(label, _star(table), _flux(table), None, xy, covariance, motion, epoch)


def _moving(table, places, motions, unit, label):
    """Motions (n, k) and epochs (n,) of a table, None if it has none, and covariances with those of its places."""
    moving = [name in table.colnames for name in motions]
    if not any(moving):
        dated = "ref_epoch" in table.colnames or not {"ref_epoch", "epoch"}.isdisjoint(table.meta)
        epoch = _epochs(table, label, moving=False) if dated else None
        return None, epoch, _covariance(table, _errors(table, places, unit, label), places)
    if not all(moving):
        raise InputError(f"one of {motions[0]}, {motions[1]} is missing")
    if places[0] == "ra" and {"parallax", "parallax_error"} <= set(table.colnames):
        motions = (*motions, "parallax")
    motion = np.column_stack([column_contract.values(table, name, _UNITS[name]) for name in motions])
    _doubt_units(table, motions[:2], motion[:, :2], label)
    epoch = _epochs(table, label, moving=True)
    parts = ((places, unit), (motions[:2], unit / u.yr), (motions[2:], unit))
    errors = np.hstack([_errors(table, names, of, label) for names, of in parts if names])
    return motion, epoch, _covariance(table, errors, (*places, *motions))


def _doubt_units(table, names, motion, label):
    """Warn of motions without a unit that are smaller than any that are measured."""
    bare = names[0] == "pmra" and all(getattr(table[name], "unit", None) is None for name in names)
    largest = np.nanmax(np.abs(motion), initial=0.0)
    if bare and 0 < largest < _SMALLEST_MOTION:
        warn(
            f"{label}: no motion is larger than {largest:.2g} mas/yr, the unit of motions without one; if theirs is "
            "another (rad/yr, deg/yr, arcsec/yr), state it as the unit of the columns",
            AssumptionWarning,
        )


def _celestial(table, label):
    sky = np.column_stack([_degrees_of(table, name, unit) for name, unit in (("ra", u.hourangle), ("dec", u.deg))])
    if np.any(np.abs(sky[:, 1]) > 90):
        row = int(np.nanargmax(np.abs(sky[:, 1])))
        raise InputError(f"dec must lie in -90 ... 90 degrees, got {sky[row, 1]:g} in row {row}")
    motion, epoch, covariance = _moving(table, ("ra", "dec"), ("pmra", "pmdec"), u.mas, label)
    return Reference(label, _star(table), _flux(table), sky, None, covariance, motion, epoch)


def _degrees_of(table, name, usual):
    """A column of right ascensions or declinations in degrees; sexagesimal ones are in the unit that is `usual`.

    The unit of a column, or letters (5h35m12s, -5d24m), go before.
    """
    column = table[name]
    if name == "ra" and not is_text(column) and getattr(column, "unit", None) == u.hour:
        table = Table({name: Column(column, unit=u.hourangle)})
    found, is_none = numbers(column) if is_text(column) else (np.zeros(len(table)), np.zeros(len(table), dtype=bool))
    is_number = np.isfinite(found)
    if np.count_nonzero(is_none) <= np.count_nonzero(is_number):  # a column of numbers, but for some
        return column_contract.values(table, name, u.deg)
    stated = str(getattr(column, "unit", None) or "").strip("\"' ").lower()
    unit = {"h": u.hourangle, "d": u.deg}.get(stated[:1], usual)
    words, out = text(column), np.full(len(table), np.nan)
    for row in np.flatnonzero(is_none | is_number):
        try:
            if is_number[row]:
                raise ValueError("a number among sexagesimal values")
            with warnings.catch_warnings(action="ignore"):  # 60 s, of rounding
                out[row] = Angle(str(words[row]).strip().replace("\u2212", "-"), unit).deg
        except (ValueError, u.UnitsError) as error:
            raise InputError(
                f"column {name!r} has {str(words[row])!r} in row {row}, which is not sexagesimal in "
                f"{'hours' if unit is u.hourangle else 'degrees'} ({checks.first_line(error)}): correct it or leave "
                "the row out; or give all in degrees as numbers, or the column its unit, deg or hourangle"
            ) from None
    if usual is u.hourangle and stated.startswith("deg") and not np.nanmax(out, initial=0.0) >= _HOURS:
        first = str(words[np.argmax(np.isfinite(out))])
        if not re.search("[a-z]", first):
            raise InputError(
                f"column {name!r} has the unit {stated}, but sexagesimal values below {_HOURS}, {first!r} the first, "
                "which may be hours: give it the unit hourangle, or letters (5h35m12s, 83d48m), or degrees as numbers"
            )
    return out


def _errors(table, values, unit, label):
    """Errors (n, k) of columns called `values`."""
    names = [_ERRORS.get(name, f"{name}_error") for name in values]
    missing = [name for name in names if name not in table.colnames]
    if missing:
        of, else_ = "motions", "add them, or leave the motions out"
        if values[0] in ("x", "ra"):
            of, else_ = "positions", "state one for all (reference_error=, --reference-error)"
        raise InputError(
            f"{label} lacks {' and '.join(missing)}, errors of its {of} ({unit}, standard deviations); it has "
            f"{', '.join(table.colnames)}: rename the columns that are these, or {else_}"
        )
    out = np.column_stack([column_contract.values(table, name, unit) for name in names])
    bad = ~(out > 0) & np.isfinite(out)
    if bad.any():
        row, k = np.argwhere(bad)[0]
        raise InputError(
            f"{names[k]} must be positive, got {out[row, k]:g} in row {row}; one not known is NaN, or empty"
        )
    return out


def _covariance(table, errors, names):
    """Covariances (n, k, k) of columns from their errors (n, k) and the correlations that there are."""
    out = np.zeros((*errors.shape, errors.shape[1]))
    diagonal = np.arange(errors.shape[1])
    out[:, diagonal, diagonal] = errors**2
    for first, second in combinations(names, 2):
        if (name := column_contract.correlation(first, second)) in table.colnames:
            corr = np.nan_to_num(column_contract.values(table, name))
            if np.any(np.abs(corr) > 1):
                row = int(np.argmax(np.abs(corr)))
                raise InputError(f"{name} must lie in -1 ... 1, got {corr[row]:g} in row {row}")
            i, k = names.index(first), names.index(second)
            out[:, i, k] = out[:, k, i] = corr * errors[:, i] * errors[:, k]
    return out


def _epochs(table, label, moving):
    """Years (n,) of the positions of a table, NaN for those that are not known; None if none is, unless they move."""
    if "ref_epoch" not in table.colnames and "epoch" in table.meta:  # a table of stars of a solution
        return np.full(len(table), year(table.meta["epoch"]))
    if "ref_epoch" not in table.colnames and "ref_epoch" not in table.meta:
        raise InputError(
            f"{label} has proper motions but no column ref_epoch, the year of its positions (2016.0 for Gaia DR3): "
            "add it"
        )
    if "ref_epoch" not in table.colnames:
        return np.full(len(table), year(table.meta["ref_epoch"]))
    column = table["ref_epoch"]
    out = column.jyear if isinstance(column, Time) else column_contract.values(table, "ref_epoch", u.yr)
    known = np.array([_is_year(value) for value in out.tolist()], dtype=bool)
    if moving and not known.any():
        row = int(np.argmax(np.nan_to_num(np.abs(out))))
        raise InputError(
            f"ref_epoch must be the years of its positions, which have proper motions (2016.0 for Gaia DR3), got "
            f"{out[row]:g} in row {row}, and no year in any"
        )
    return np.where(known, out, np.nan) if known.any() else None


def _is_year(value):
    """Whether a number is the year of something: unknown ones are NaN, or 0 as SCAMP has them, or its means with 0."""
    try:
        year(value)
    except InputError:
        return False
    return True


def _names(table):
    """What a catalogue calls its stars, shape (n,), for messages; else the numbers of its rows, from 0."""
    for name in _NAMES:
        if name in table.colnames:
            column = table[name]
            return np.array([str(each).strip() for each in (text(column) if is_text(column) else column)], dtype=str)
    return np.array([f"row {row}" for row in range(len(table))], dtype=str)


def _star(table):
    return column_contract.labels(table, "star") if "star" in table.colnames else None


def _flux(table):
    if "flux" in table.colnames:
        return np.nan_to_num(column_contract.values(table, "flux"), nan=0.0)
    for name in ("phot_g_mean_mag", "mag"):
        if name in table.colnames:
            return np.nan_to_num(column_contract.flux_of(column_contract.values(table, name)), nan=0.0)
    return None
