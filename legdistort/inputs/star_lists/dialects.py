"""Which program wrote a table of positions, by its columns, and what they are called here.

Another program is another `Dialect`. Those of SExtractor need arithmetic and have a module of their own.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from astropy.coordinates import SkyCoord

from ...exceptions import InputError
from ..column_contract import values
from . import sextractor

log = logging.getLogger(__name__)

#: Bits of `legdistort.measurement.flags.Flag`.
_SATURATED, _EDGE, _NOT_CONVERGED = 1, 2, 8
#: Rows of the lower chip of ACS/WFC and WFC3/UVIS in the pixels of hst1pass, which puts the other one above it.
_LOWER_CHIP = 2048


@dataclass(frozen=True)
class Dialect:
    """The columns of one program.

    Attributes
    ----------
    program : str
    columns : dict
        ``{contract name: names, the best first}``.
    marks : tuple of str
        Columns by which it is recognised where the file does not name it; none for one that the file names.
    origin : int
        Coordinate of the centre of the first pixel.
    flags : callable
        Our flags of a table, or None.
    """

    program: str
    columns: dict
    marks: tuple = ()
    origin: int = 0
    flags: Callable = field(default=lambda table: None)

    def speaks(self, table):
        """Whether a table is of this kind."""
        stated = table.meta.get("program")
        return stated == self.program if stated else bool(self.marks) and set(self.marks) <= set(table.colnames)


def _positive(name, bit):
    """Our flag where a column is above zero."""
    return lambda table: np.where(values(table, name) > 0, bit, 0) if name in table.colnames else None


def _iraf_flags(table):
    """Stars of which IRAF has an error of the fit (PIER), or of the centre (CIER)."""
    stated = [name for name in ("PIER", "CIER") if name in table.colnames]
    return np.where(sum(values(table, name) > 0 for name in stated), _NOT_CONVERGED, 0) if stated else None


def _photutils_flags(table):
    """Those of ``PSFPhotometry``: 1 = masked pixels, higher bits = no positive flux, not converged, no errors."""
    if "flags" not in table.colnames:
        return None
    theirs = np.nan_to_num(values(table, "flags")).astype(int)
    return np.where(theirs & 1, _EDGE, 0) | np.where(theirs & ~1, _NOT_CONVERGED, 0)


#: FlyStar and StarFinder; hst1pass (Anderson 2022, WFC3 ISR 2022-05), whose X, Y are x, y after the correction for
#: charge transfer, u, v and U, V those without distortion; DAOPHOT of Stetson and of IRAF; photutils;
#: the step source_catalog of the JWST pipeline, whose total flux is that of stars, its magnitudes where it has none.
DIALECTS = (
    Dialect(
        "StarFinder, FlyStar",
        {"x_err": ("xe",), "y_err": ("ye",), "mag": ("m",), "epoch": ("t",)},
        ("x", "y", "xe", "ye"),
    ),
    Dialect("StarFinder", {"mag": ("m",), "epoch": ("t",)}, ("x", "y", "m", "t", "snr", "corr", "N_frames", "flux")),
    Dialect(
        "hst1pass",
        {"x": ("X", "x"), "y": ("Y", "y"), "mag": ("M", "m", "w", "W"), "epoch": ("t",)},
        origin=1,
        flags=_positive("n", _SATURATED),
    ),
    Dialect("DAOPHOT", {"x": ("X",), "y": ("Y",), "mag": ("MAG",)}, origin=1),
    Dialect(
        "DAOPHOT of IRAF",
        {"x": ("XCENTER",), "y": ("YCENTER",), "x_err": ("XERR",), "y_err": ("YERR",), "mag": ("MAG", "MAG1")},
        ("XCENTER", "YCENTER"),
        origin=1,
        flags=_iraf_flags,
    ),
    Dialect(
        "PSFPhotometry of photutils",
        {"x": ("x_fit",), "y": ("y_fit",), "flux": ("flux_fit",), "flux_err": ("flux_err",)},
        ("x_fit", "y_fit"),
        flags=_photutils_flags,
    ),
    *(
        Dialect(
            "the JWST pipeline",
            {"x": ("xcentroid",), "y": ("ycentroid",), "flux": (flux,), "flux_err": (f"{flux}_err",)},
            ("xcentroid", "ycentroid", flux),
        )
        for flux in ("aper_total_flux", "isophotal_flux")
    ),
    *(
        Dialect(
            "the JWST pipeline",
            {"x": ("xcentroid",), "y": ("ycentroid",), "mag": (f"{kind}mag",)},
            ("xcentroid", "ycentroid", f"{kind}mag"),
        )
        for kind in ("aper_total_ab", "aper_total_vega", "isophotal_ab", "isophotal_vega")
    ),
    *(
        Dialect(
            "photutils",
            {"x": (x,), "y": (y,), "flux": ("segment_flux",), "flux_err": ("segment_flux_err", "segment_fluxerr")},
            (x, y),
        )
        for x, y in (("xcentroid", "ycentroid"), ("x_centroid", "y_centroid"))
    ),
)


#: Columns of the lists of StarFinder as the Galactic Center Group of UCLA writes them (``.lis``, Keck), which have no
#: names: with errors and without, as FlyStar reads them (flystar/starlists.py, StarList.from_lis_file).
_STARFINDER = (
    ("name", "m", "t", "x", "y", "xe", "ye", "snr", "corr", "N_frames", "flux"),
    ("name", "m", "t", "x", "y", "snr", "corr", "N_frames", "flux"),
)
_YEARS = 1980, 2100


def _named(table):
    """The table with the names of its columns, if it has none and is a list of StarFinder by what stands in them."""
    names = next((names for names in _STARFINDER if len(names) == len(table.columns)), None)
    if names is None or table.colnames != [f"col{j + 1}" for j in range(len(names))]:
        return table
    try:
        found = {name: values(table, col) for name, col in zip(names[1:], table.colnames[1:], strict=True)}
    except InputError:
        return table
    year, corr, frames = found["t"], found["corr"], found["N_frames"]
    dated = np.all((year > _YEARS[0]) & (year < _YEARS[1])) or np.all(year == 0)
    if not (dated and np.all((corr >= 0) & (corr <= 1.001))):
        return table
    if not np.all((frames >= 0) & (frames == np.round(frames))) or np.any(found.get("xe", np.ones(1)) < 0):
        return table
    table = table.copy(copy_data=False)
    table.rename_columns(table.colnames, names)
    return table


def understand(table, columns, *, without_errors=False):
    """What the columns of a table are in the words of the contract; what the caller states goes before.

    Parameters
    ----------
    table : `~astropy.table.Table`
    columns : dict
        The caller's ``{contract name: name in the table}``.
    without_errors : bool
        Whether positions may come without errors.

    Returns
    -------
    table : `~astropy.table.Table`
        The same, with columns added where they had to be worked out, without places on the sky by a header.
    columns : dict
        The caller's, with those that were understood.
    origin : int
        Coordinate of the centre of the first pixel.

    Raises
    ------
    InputError
        For positions that are not those of the detector, and for those of SExtractor without errors, unless
        `without_errors`.
    """
    if not any(str(theirs).startswith("col") for theirs in columns.values()):
        table = _named(table)
    table, source = sextractor.understand(table, columns, without_errors=without_errors)
    source = columns.get("x", source)
    if source is not None and sextractor.is_pixel(source):
        return table, columns, 1
    dialect = next((dialect for dialect in DIALECTS if dialect.speaks(table)), None)
    if dialect is None:
        return table, columns, 0
    table = _without_no_date(table, columns, dialect)
    present, found = set(table.colnames), {}
    for name, choices in dialect.columns.items():
        theirs = next((choice for choice in choices if choice in present), None)
        if theirs is not None and name not in columns and theirs not in columns.values():
            found[name] = theirs
    if dialect.program == "hst1pass":
        _check_pixels(found, columns, present)
    log.info("columns of %s: %s", dialect.program, ", ".join(f"{ours} = {theirs}" for ours, theirs in found.items()))
    sky = [name for name in table.colnames if isinstance(table[name], SkyCoord)]  # of objects, which files cannot hold
    if sky:
        table = table[[name for name in table.colnames if name not in sky]]
    flags = dialect.flags(table)
    if flags is not None and "flags" not in columns:
        table = table.copy(copy_data=False)
        table["flags"] = flags
        table = _without_lost(table, columns | found)
    return table, columns | found, dialect.origin


def _without_no_date(table, columns, dialect):
    """The table without dates that are all zero, as StarFinder writes them where it is not told any; says so."""
    if dialect.columns.get("epoch") != ("t",) or not {"t"} <= set(table.colnames) - set(columns.values()):
        return table
    if not len(table) or np.any(values(table, "t") != 0):
        return table
    log.info("the dates (t) are zero: when the stars were seen is not known")
    return table[[name for name in table.colnames if name != "t"]]


def _without_lost(table, columns):
    """The table without rows for which their program found no position, and says so."""
    places = [columns[name] for name in "xy" if columns.get(name) in table.colnames]
    lost = (table["flags"] & _NOT_CONVERGED) != 0
    for name in places:
        lost = lost & np.isnan(values(table, name))
    if not places or not lost.any():
        return table
    log.warning("%d of %d rows state no position, nor has their program found one: left out", lost.sum(), len(table))
    return table[~lost]


def _check_pixels(found, columns, present):
    missing = [name for name in "xy" if name not in found and name not in columns]
    if missing:
        raise InputError(
            f"hst1pass wrote no pixel positions, but {', '.join(sorted(present - {'epoch'}))}; u, v and U, V are "
            "corrected for distortion: let it write x, y or X, Y (OUT=XYMpqk), or take what is there with columns= "
            "(--columns x=u,y=v), if what is left of the distortion is wanted"
        )


def chips(table):
    """The tables of single chips, ``{number: table}``, of a table of hst1pass; one without a number of chips is one.

    Its pixels of the second chip of ACS/WFC and WFC3/UVIS lie above those of the first, 2048 rows up; here each chip
    counts its own.
    """
    if table.meta.get("program") != "hst1pass" or not {"k", "K"} & set(table.colnames):
        return {}
    if "k" in table.colnames:
        number = np.asarray(values(table, "k"), dtype=int)
    else:  # K1, K2
        number = np.array([int(str(word).lstrip("K")) for word in table["K"]])
    out = {int(chip): table[number == chip] for chip in np.unique(number)}
    for name in {"y", "Y"} & set(table.colnames):
        if 2 in out and np.nanmin(values(out[2], name)) > _LOWER_CHIP:
            out[2][name] = values(out[2], name) - _LOWER_CHIP
    return out
