"""The unit of a pixel value (``BUNIT``): counts, electrons, a rate of them, or light in calibrated units."""

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from astropy import units as u

from ..sky_wcs import to_icrs

#: What programs write, in small letters, and what astropy calls it.
_NAMES = {
    name: unit
    for unit, names in {
        "adu": "adu adus",
        "DN": "dn dns du",
        "ct": "ct cts cnt cnts count counts",
        "electron": "e e_ el els elec electron electrons",
        "ph": "ph phot phots photon photons",
        "ct s**-1": "cps",
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millisecond milliseconds",
        "min": "min mins minute minutes",
        "h": "h hr hrs hour hours",
        "pix": "pix pixel pixels px spaxel spaxels",
        "arcsec": "arcsec arcsecs asec arcsecond arcseconds",
        "sr": "sr str ster sterad steradian steradians",
        "deg": "deg degree degrees",
        "Angstrom": "a aa å ang angs angstrom angstroms",
        "erg": "erg ergs",
        "W": "w watt watts",
        "um": "um µm μm micron microns micrometer",
        "nm": "nm nanometer",
        "cm": "cm",
        "m": "m meter meters",
        "Hz": "hz hertz",
        "Jy": "jy jansky janskys",
        "beam": "beam beams",
        "mag": "mag mags magnitude magnitudes abmag",
        "3.631e-6 Jy": "nmgy nanomaggy nanomaggies",
    }.items()
    for name in names.split()
}
#: Units of one of several co-added integrations, by which the mean of them is stated.
_MEAN = re.compile(r"(/|\bper\b|\b)\s*(co-?adds?|dit|integration|frame|read)\b(\s*\*\*\s*-1|\^?-1)?", re.IGNORECASE)
_ELECTRON = re.compile(r"(?<![A-Za-z0-9.])[eE]l?-(?=$|[\s/*.)\]])")
_WORD = re.compile(r"(?<![A-Za-zµμÅå0-9.])([A-Za-zµμÅå_]+)")
_LIGHT = (u.adu, u.DN, u.ct, u.electron, u.ph)
_FREE = ("", "none", "unitless", "dimensionless", "n/a", "unknown", "undefined", "relative", "arbitrary")


@dataclass(frozen=True)
class ValueUnit:
    """The unit of a pixel value.

    Attributes
    ----------
    text : str
        As the header has it.
    kind : {"counts", "electrons", "calibrated", "magnitudes"}
        Readings of the detector; electrons or photons; light by a calibration, of which no header states the electrons;
        no light at all. What is not stated, or not understood, counts as readings.
    unit : `~astropy.units.UnitBase` or None
        None if it is not stated or not understood.
    size : float
        Counts, or electrons, in one of the unit: of those per second and per steradian, if it is such a rate.
    per_time, per_area : bool
        Whether it is a rate; whether it is of an area on the sky, so that a sum over pixels is light only times their
        area. A rate of light in calibrated units has no time that a value stands for either.
    mean : bool
        Whether it is that of one of several integrations, the mean of which a value is.
    """

    text: str
    kind: str = "counts"
    unit: u.UnitBase | None = None
    size: float = 1.0
    per_time: bool = False
    per_area: bool = False
    mean: bool = False

    @property
    def understood(self):
        """Whether the header states a unit that is known, or none."""
        return self.unit is not None or self.text.lower() in _FREE

    @property
    def has_time(self):
        """Whether a value grows with the exposure time."""
        return not self.per_time and self.kind != "calibrated"

    def same_as(self, other):
        """Whether another one is this one in whatever spelling."""
        if self.unit is None or other.unit is None:
            return self.text == other.text
        return self.unit == other.unit and self.mean == other.mean

    def __str__(self):
        return self.text or "counts"


def value_unit(header):
    """The `ValueUnit` of a header."""
    return parse_unit(str(header.get("BUNIT", "")).strip())


@lru_cache(maxsize=256)
def parse_unit(text):
    """The `ValueUnit` of a text in any of the usual spellings: ``DN/s``, ``e- s**-1``, ``COUNTS/SEC``, ``MJy sr-1``."""
    mean = _MEAN.search(text) is not None
    unit = _unit(_MEAN.sub("", text) if mean else text)
    if unit is None:
        return ValueUnit(text, mean=mean)
    if isinstance(unit, u.FunctionUnitBase):
        return ValueUnit(text, "magnitudes", unit)
    parts = unit.decompose()
    powers = dict(zip(parts.bases, parts.powers, strict=True))
    powers.pop(u.pix, None)
    if u.mag in powers or u.dex in powers:
        return ValueUnit(text, "magnitudes", unit)
    light = [quantum for quantum in _LIGHT if powers.get(quantum) == 1]
    of_time, of_sky = powers.get(u.s, 0), powers.get(u.rad, 0)
    if powers in ({}, {u.s: -1}):  # so many, or so many a second
        return ValueUnit(text, "counts", unit, float(parts.scale), per_time=bool(powers), mean=mean)
    if len(light) == 1 and powers.keys() <= {light[0], u.s, u.rad} and of_time in (0, -1) and of_sky in (0, -2):
        kind = "electrons" if light[0] in (u.electron, u.ph) else "counts"
        known = {"per_time": of_time == -1, "per_area": of_sky == -2, "mean": mean}
        return ValueUnit(text, kind, unit, float(parts.scale), **known)
    per_area = of_sky < 0 or powers.get(u.beam, 0) < 0
    return ValueUnit(text, "calibrated", unit, 1.0, per_time=True, per_area=per_area)


def _unit(text):
    """The unit that a text means, None if it is not known."""
    text = re.sub(r"\bper\b", "/", text.strip(" []'\""), flags=re.IGNORECASE)
    text = _WORD.sub(_named, _ELECTRON.sub("e_", text)).rstrip(" .")
    if not text:
        return None
    # what stands between two slashes is below the line; astropy warns of more than one slash
    first, *below = re.split(r"/(?![^(]*\))", text)
    try:
        unit = u.Unit(first)
        for part in below:
            unit = unit / u.Unit(part.strip().removeprefix("(").removesuffix(")") if part.count("(") == 1 else part)
    except (ValueError, TypeError):
        return None
    return unit


def _named(found):
    word = found[1]
    small = word.lower()
    if small in _NAMES:
        return _NAMES[small]
    if jansky := re.fullmatch(r"([gkmunµμ])jy", small):
        prefix = "M" if word[0] == "M" else jansky[1].replace("g", "G")  # JY has no small letters, but there is mJy
        return f"{prefix.replace('µ', 'u').replace('μ', 'u')}Jy"
    return word


def pixel_area(wcs, shape):
    """Area [sr] of the pixel in the middle of a believable WCS, None without one."""
    if wcs is None:
        return None
    ny, nx = shape
    middle = np.array([(nx - 1) / 2, (ny - 1) / 2])
    lon, lat = np.radians(to_icrs(wcs, middle + [[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]]))
    place = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    return float(np.linalg.norm(np.cross(place[1] - place[2], place[3] - place[4])))
