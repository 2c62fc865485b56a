"""How long a frame was exposed, and what a pixel value is of it: the sum of its integrations, their mean, or a rate."""

from dataclasses import dataclass

from .cards import Stated, positive
from .value_units import value_unit

#: Where headers have the time of a frame, in order of preference ...
WHOLE = (
    "EXPTIME", "EXPOSURE", "XPOSURE", "ITIME", "EFFEXPTM", "INTTIME", "EXP_TIME", "ELAPTIME", "ESO DET DIT", "DIT",
)  # fmt: skip
#: ... and that of one of its integrations: NIRC2, Gemini after preparation, NEWFIRM, IRCS, ESO.
SINGLE = ("ITIME", "COADDEXP", "EXPCOADD", "EXP1TIME", "ESO DET DIT", "DIT")
#: Their number: detectors that add them up, and those that hand on the mean (ESO).
SUMMED = ("COADDS", "NCOADDS", "NCOADD", "CO_ADDS", "COADD")
AVERAGED = ("ESO DET NDIT", "NDIT")
_SAME = 0.1  # overheads and rounding


@dataclass(frozen=True)
class Integrations:
    """The integrations of a frame.

    Attributes
    ----------
    time : Stated
        Seconds of all of them, or None.
    number : int
    mean : bool
        Whether a pixel value is the mean of them, and not their sum.
    doubts : tuple of str
    """

    time: Stated
    number: int = 1
    mean: bool = False
    doubts: tuple[str, ...] = ()

    @property
    def averaged(self):
        """Integrations of which a pixel value is the mean; 1 for a sum."""
        return self.number if self.mean else 1


def value_time(exposure):
    """Seconds of light that a pixel value of an exposure stands for, None if its exposure time is not known."""
    if not exposure.exposure_time:
        return None
    return exposure.exposure_time / integrations(exposure.header).averaged


def integrations(header):
    """The `Integrations` of a header."""
    time = _seconds(header, WHOLE)
    n = positive(header, SUMMED + AVERAGED)
    if n is None or n.value < 2:
        zero = next((key for key in WHOLE if key in header and header[key] == 0), None) if time is None else None
        doubts = (f"{zero} = 0 is no exposure time",) if zero else ()
        return Integrations(Stated(*time) if time else Stated(None), doubts=doubts)
    number = int(n.value)
    mean = n.key in AVERAGED
    if n.says("averag|mean") or n.says(r"\bsum"):
        mean = not n.says(r"\bsum")
    mean = mean or value_unit(header).mean
    single = _seconds(header, SINGLE)
    if single is not None:
        total = Stated(number * single.value, f"{single.source} x {n.key}")
        return Integrations(total, number, mean, _contradictions(header, single.value, number, n.key))
    if time is None:
        return Integrations(Stated(None), number, mean)
    if _says_total(header, time.source):
        return Integrations(Stated(*time), number, mean)
    total = Stated(number * time.value, f"{time.source} x {n.key}")
    each = f"{time.source} = {time.value:g} s is taken for the time of one of {n.key} = {number} integrations"
    return Integrations(total, number, mean, () if _says_single(header, time.source) else (each,))


def _seconds(header, keywords):
    """The first time under some keywords, in seconds, as `Stated`; None without one."""
    card = positive(header, keywords)
    if card is None:
        return None
    unit = 1e-3 if card.says(r"\bm(illi)?-?sec|\[ms\]|^ms\b|\(ms\)") else 60.0 if card.says(r"\[min|^min\b") else 1.0
    return Stated(card.value * unit, card.key)


def _says_total(header, key):
    return positive(header, [key]).says(r"total|\bsum|all co-?add|effective")


def _says_single(header, key):
    return positive(header, [key]).says(r"\b(each|per|single|one|individual)\b")


def _contradictions(header, single, number, counted):
    """What is said where the time of the whole is neither that of one integration nor of all."""
    whole = _seconds(header, [key for key in WHOLE if key not in SINGLE])
    if whole is None or any(abs(whole.value / time - 1) < _SAME for time in (single, single * number)):
        return ()
    return (
        f"{whole.source} = {whole.value:g} s is the time neither of one integration, {single:g} s, nor of all "
        f"{counted} = {number}; {single * number:g} s are taken",
    )
