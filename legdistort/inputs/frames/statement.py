"""What a frame states of itself, each value with the words that it comes from."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...geometry import epochs
from .cards import Card, Stated, positive
from .integrations import integrations
from .value_units import ValueUnit, pixel_area, value_unit

if TYPE_CHECKING:
    from astropy.io.fits import Header

#: Header keywords in order of preference. EGAIN comes first: cameras that write it use GAIN for a setting without unit.
KEYWORDS = {
    "saturation": ("SATURATE", "SATLEVEL", "CELL.SATURATION"),
    "gain": (
        "EGAIN", "GAIN", "CCDGAIN", "ESO DET OUT1 CONAD", "CONAD", "ATODGAIN", "ADCGAIN", "GAINEFF",
        "CELL.GAIN",
    ),
    "read_noise": ("RDNOISE", "READNOIS", "READNSE", "RON", "ESO DET OUT1 RON", "ENOISE", "RONOISE", "CELL.READNOISE"),
}  # fmt: skip
#: Keywords of single amplifiers of one image, which count where none of all does: DECam; ACS, WFC3 and STIS of HST.
AMPLIFIERS = {
    "gain": (("GAINA", "GAINB"), ("ATODGNA", "ATODGNB", "ATODGNC", "ATODGND")),
    "read_noise": (("RDNOISEA", "RDNOISEB"), ("READNSEA", "READNSEB", "READNSEC", "READNSED")),
    "saturation": (("SATURATA", "SATURATB"),),
}
_DIFFER = 0.05  # of their mean, by which gains of amplifiers may differ unsaid
_COUNTS, _ELECTRONS = r"\b(adu|dn|du|counts?|cts?|data unit)s?", r"(e-|e\b|el|photo-?el|ph)"
_PER = r"['\]) ]*(/|per)['\[( ]*"
_SETTING = r"setting|unit-?less|\bdb\b|\biso\b|no unit"


@dataclass(frozen=True)
class FrameStatement:
    """What a frame states: a value, or None, and its source, for each quantity.

    Attributes
    ----------
    unit : Stated of ValueUnit
        Of a pixel value.
    gain : Stated of float
        Electrons per unit of the data.
    read_noise : Stated of float
        Electrons, of all integrations.
    saturation : Stated of float
        In units of the data.
    exposure_time : Stated of float
        Seconds, of all integrations.
    value_time : Stated of float
        Seconds of light that a pixel value stands for; None for a rate and for calibrated units.
    epoch : Stated of float
        A Julian year.
    wcs, mask : Stated of str
        In words.
    doubts : tuple of str
        What contradicts itself, or cannot be.
    """

    unit: Stated
    gain: Stated
    read_noise: Stated
    saturation: Stated
    exposure_time: Stated
    value_time: Stated
    epoch: Stated
    wcs: Stated
    mask: Stated
    doubts: tuple[str, ...]

    @property
    def known(self) -> dict[str, Any]:
        """The arguments of `Exposure` that it determines, itself included."""
        names = ("saturation", "gain", "read_noise", "exposure_time")
        return {name: getattr(self, name).value for name in names} | {"stated": self}

    def with_doubt(self, doubt: str) -> FrameStatement:
        """The same with one doubt more, if it is not there yet."""
        return self if doubt in self.doubts else replace(self, doubts=(*self.doubts, doubt))

    def __str__(self) -> str:
        rows = [("quantity", "value", "source"), *self.rows()]
        widths = [max(len(row[k]) for row in rows) for k in (0, 1)]
        lines = [f"{row[0]:{widths[0]}s}  {row[1]:{widths[1]}s}  {row[2]}".rstrip() for row in rows]
        return "\n".join([*lines, *(f"doubtful: {doubt}" for doubt in self.doubts)])

    def to_dict(self) -> dict[str, Any]:
        """Rows and doubts as JSON holds them."""
        rows = [dict(zip(("quantity", "value", "source"), row, strict=True)) for row in self.rows()]
        return {"stated": rows, "doubts": list(self.doubts)}

    def rows(self) -> list[tuple[str, str, str]]:
        """Quantity, value and source of each, in words."""
        quantities = {
            "unit of a value": (self.unit, "{}"),
            "electrons per unit": (self.gain, "{:.6g}"),
            "read noise": (self.read_noise, "{:.6g} e-"),
            "saturation": (self.saturation, "{:.6g}"),
            "exposure time": (self.exposure_time, "{:.6g} s"),
            "time of a value": (self.value_time, "{:.6g} s"),
            "epoch": (self.epoch, "{:.4f}"),
            "WCS": (self.wcs, "{}"),
            "bad pixels": (self.mask, "{}"),
        }
        return [
            (name, "none" if each.value is None else form.format(each.value), each.source)
            for name, (each, form) in quantities.items()
        ]


def read_statement(header: Header, data, *, integer, own=None, wcs=None, seen=None, mask=None) -> FrameStatement:
    """What a frame states.

    Parameters
    ----------
    header : Header
        Of the image, with that of the file.
    data : ndarray, shape (ny, nx)
        A saturation that is not stated may show in `integer` data.
    integer : bool
    own : Header, optional
        Of the image alone, if it is in an extension.
    wcs : WCS, optional
        A believable one.
    seen, mask : Stated, optional
        The WCS, and the bad pixels, in words.
    """
    unit, taken = value_unit(header), integrations(header)
    told = _Sources(header, own)
    time, averaged = taken.time, taken.averaged
    gain = _electrons(header, unit, time.value, averaged, wcs, data.shape)
    noise = _read_noise(header, unit, taken.number)
    saturation = _saturation(header, unit, gain.value, data)
    if saturation.value is None and integer:
        saturation = Stated(piled_up(data), "the highest value, where pixels pile up")
    of_value = Stated(None, "calibrated" if unit.kind == "calibrated" else "a rate")
    if unit.has_time:
        of_value = Stated(None)
    if unit.has_time and time.value is not None:
        share = f" / {averaged}, of the mean" if averaged > 1 else ""
        of_value = Stated(time.value / averaged, time.source + share)
    year, keyword = epochs.stated_epoch(header)
    doubts = (*_of_unit(unit, time.value), *taken.doubts, *epochs.unreadable_dates(header))
    if gain.source.startswith("mean of"):
        doubts += _of_amplifiers(header)
    return FrameStatement(
        unit=Stated(unit, told.of("BUNIT") if unit.text else "no BUNIT: taken as counts"),
        gain=told.where(gain),
        read_noise=told.where(noise),
        saturation=told.where(saturation),
        exposure_time=told.where(time),
        value_time=told.where(of_value),
        epoch=Stated(None) if year is None else Stated(year, told.of(keyword)),
        wcs=seen or Stated(None),
        mask=mask or Stated(None),
        doubts=doubts,
    )


def stated_rows(exposures):
    """What exposures state, those that state the same together, in the order of the quantities.

    Parameters
    ----------
    exposures : iterable of Exposure or ExposureFile

    Returns
    -------
    list of dict
        ``quantity``, ``value``, ``source``, and the names of the ``exposures``; none for what was not read from a file.
    """
    found = {}
    for exposure in exposures:
        for row in exposure.stated.rows() if exposure.stated else ():
            found.setdefault(row[0], {}).setdefault(row[1:], []).append(exposure.name)
    return [
        {"quantity": quantity, "value": value, "source": source, "exposures": names}
        for quantity, alike in found.items()
        for (value, source), names in alike.items()
    ]


class _Sources:
    """The words for the header that a keyword stands in."""

    def __init__(self, header, own):
        self.header, self.own = header, own

    def of(self, keyword):
        if self.own is None or keyword not in self.header:
            return keyword
        return f"{keyword} of the {'image' if keyword in self.own else 'primary header'}"

    def where(self, stated):
        """The same with the header in which the keyword stands that its source begins with."""
        key = re.split(r" x | / |,", stated.source)[0]
        return stated if key not in self.header else Stated(stated.value, self.of(key) + stated.source[len(key) :])


def _electrons(header, unit: ValueUnit, time, averaged, wcs, shape):
    """Electrons in one unit of the data, as far as header and unit state them."""
    if unit.kind not in ("counts", "electrons"):
        return Stated(None, f"not stated by {unit.text}")
    card = _gain_card(header) if unit.kind == "counts" else Card(f"BUNIT {unit.text!r}", 1.0, "")
    if card is None:
        return Stated(None)
    value, source = card.value, card.key
    if unit.kind == "counts" and card.says(_COUNTS + _PER + _ELECTRONS):
        value, source = 1 / value, f"{source}, counts per electron"
    factors = {"time": time if unit.per_time else 1.0, "area": pixel_area(wcs, shape) if unit.per_area else 1.0}
    if None in factors.values():
        missing = "the exposure time" if factors["time"] is None else "the area of a pixel"
        return Stated(None, f"{missing} is not known")
    value = value * unit.size * factors["time"] * factors["area"]
    source += " x exposure time" * unit.per_time + " x area of a pixel" * unit.per_area
    if averaged > 1 and not unit.per_time:
        return Stated(value * averaged, f"{source} x {averaged}, of the mean")
    return Stated(value, source)


def _gain_card(header):
    """The card with the electrons per count, or the counts per electron; none that is a setting of the camera."""
    for key in KEYWORDS["gain"]:
        card = positive(header, [key])
        if card is not None and (card.says(_ELECTRONS + _PER + _COUNTS) or not card.says(_SETTING)):
            return card
    return _of_all(header, "gain", np.mean, "mean")


def _of_all(header, quantity, combine, words):
    """One card for the cards of single amplifiers, None without any."""
    for keys in AMPLIFIERS[quantity]:
        cards = [card for card in (positive(header, [key]) for key in keys) if card is not None]
        if cards:
            key = f"{words} of {' and '.join(card.key for card in cards)}" if len(cards) > 1 else cards[0].key
            return Card(key, float(combine([card.value for card in cards])), cards[0].words)
    return None


def _of_amplifiers(header):
    """What is to be said of gains of amplifiers that differ."""
    keys = next((keys for keys in AMPLIFIERS["gain"] if any(key in header for key in keys)), ())
    cards = [card for card in (positive(header, [key]) for key in keys) if card is not None]
    gains = [card.value for card in cards]
    if len(gains) < 2 or np.ptp(gains) <= _DIFFER * np.mean(gains):
        return ()
    named = " and ".join(f"{card.key} = {card.value:g}" for card in cards)
    return (f"{named} differ by {np.ptp(gains) / np.mean(gains):.0%}; their mean is taken for all pixels",)


def _read_noise(header, unit, number):
    card = positive(header, KEYWORDS["read_noise"]) or _of_all(header, "read_noise", _rms, "rms")
    if card is None:
        return Stated(None)
    value, source = card.value, card.key
    if card.says(rf"^\W*{_COUNTS}|\[{_COUNTS[2:]}\]") and not card.says(_ELECTRONS + r"\W") and unit.kind == "counts":
        if (gain := _gain_card(header)) is None:
            return Stated(None)
        value, source = value * gain.value, f"{source} x {gain.key}"
    if number > 1:
        value, source = value * np.sqrt(number), f"{source} x sqrt({number})"
    return Stated(value, source)


def _rms(values):
    return np.sqrt(np.mean(np.square(values)))


def _saturation(header, unit, gain, data):
    """The level at which pixels are saturated: in units of the data, if its comment states no other."""
    card = positive(header, KEYWORDS["saturation"]) or _of_all(header, "saturation", min, "lowest")
    if card is None:
        return Stated(None)
    if unit.kind == "counts" and not unit.per_time and not unit.per_area:
        electrons = card.says(r"^\W*e(-|l|\b)|\[e(-|l\w*)?\]|electrons") and not card.says(_COUNTS)
        value = card.value / gain if electrons and gain else card.value
        return Stated(value, card.key)
    if unit.kind == "electrons" and not unit.per_time and not unit.per_area and not card.says(_COUNTS):
        return Stated(card.value, card.key)
    # levels of a detector stay in the headers of what is no reading of it any more
    reached = np.count_nonzero(np.asarray(data) >= card.value) > 0
    return Stated(card.value, card.key) if reached else Stated(None, f"{card.key}, which no pixel reaches")


def _of_unit(unit, time):
    """What is to be said of a unit."""
    if not unit.understood:
        yield f"BUNIT = {unit.text!r} is no unit that is known: values are taken as counts"
    if unit.kind == "magnitudes":
        yield f"BUNIT = {unit.text!r}: the values are magnitudes, not light; positions and mosaics need light"
    if unit.per_time and unit.kind != "calibrated" and time is None:
        yield f"BUNIT = {unit.text!r} is a rate, but no exposure time is stated: the noise of its light is not known"


def piled_up(data):
    """Saturation level: a maximum more frequent than all of the 5 % below it together, in pixels side by side."""
    top = np.nanmax(data) if np.isfinite(data).any() else np.nan
    if not top > 0:
        return None
    flat = data == top
    at_top, below = np.count_nonzero(flat), np.count_nonzero((data > 0.95 * top) & (data < top))
    beside = max(np.count_nonzero(flat[1:] & flat[:-1]), np.count_nonzero(flat[:, 1:] & flat[:, :-1]))
    return float(top) if max(5, below + 1) <= at_top < min(0.1 * data.size, 8 * beside + 1) else None
