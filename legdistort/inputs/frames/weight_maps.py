"""Weight maps, which stand in a file of their own beside a frame, as SWarp and SExtractor have them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...exceptions import InputError

#: What the values of a map are, in the words of SWarp's ``WEIGHT_TYPE``.
KINDS = ("MAP_WEIGHT", "MAP_VARIANCE", "MAP_RMS")
#: SWarp's ``WEIGHT_SUFFIX``.
SUFFIX = ".weight.fits"
#: What pixels are called that a map alone says are bad.
NO_WEIGHT = "without weight"
_ENDINGS = (".fits", ".fit", ".fts", ".fits.fz", ".fits.gz")
_HUGE = 1e30  # variances from which SWarp and SExtractor take a pixel for one without weight
_ALIKE = 0.01  # by which the noise of good pixels may differ in a map that only tells good from bad ones
_BLOCK = 32  # side of the blocks whose scatter is the noise of the sky, px
_MAD = 1.4826
#: Times by which pixels may scatter more, or less, than a MAP_RMS: crowded fields, noise shared by resampled pixels.
_BELIEVED = 5.0


@dataclass(frozen=True)
class WeightMaps:
    """Which files beside frames are weight maps, and what their values are.

    Attributes
    ----------
    kind : {"MAP_WEIGHT", "MAP_VARIANCE", "MAP_RMS"} or None
        Inverse variance, relative; variance, relative; standard deviation of the sky, in the unit of the data. None:
        no maps are read.
    suffix : str
        What the name of a map has in the place of the ending of its frame.
    asked : bool
        Whether every frame must have one.
    """

    kind: str | None = KINDS[0]
    suffix: str = SUFFIX
    asked: bool = False

    @classmethod
    def parse(cls, text):
        """Those that a text names, ``KIND``, ``KIND,SUFFIX`` or ``none``; for None ``X.weight.fits`` if there is one.

        Raises
        ------
        InputError
            For other words.
        """
        if text is None:
            return cls()
        kind, _, suffix = text.partition(",") if isinstance(text, str) else (None, None, None)
        if kind is not None and kind.strip().lower() == "none" and not suffix:
            return cls(None)
        if kind is None or kind.strip().upper() not in KINDS or "/" in suffix:
            raise InputError(
                f"weight_maps (--weight-maps) must be one of {', '.join(KINDS)}, perhaps with how names of maps "
                f"end, MAP_RMS,.rms.fits, or none, got {text!r}"
            )
        return cls(kind.strip().upper(), suffix.strip() or SUFFIX, asked=True)

    def beside(self, path):
        """Path of the map of a frame; None where it has none.

        Raises
        ------
        InputError
            Where it must have one.
        """
        path = Path(path)
        stem, ending = _parted(path)
        if self.kind is None or ending is None:
            return None
        begin, last = _parted(Path(self.suffix))
        endings = dict.fromkeys((last, ending, *_ENDINGS)) if last else [""]
        found = [path.parent / f"{stem}{begin}{end}" for end in endings]
        for each in found:
            if _exists(each):
                return each
        if self.asked:
            raise InputError(f"{path} has no weight map: there is no {found[0]}; weight_maps='none' reads none")
        return None

    def frames_of(self, paths):
        """Paths without those that are the maps of others."""
        anywhere = WeightMaps(self.kind, self.suffix)
        maps = {anywhere.beside(path) for path in paths if isinstance(path, str | Path)}
        return [path for path in paths if not (isinstance(path, str | Path) and Path(path) in maps)]


class WeightPlane(NamedTuple):
    """The plane of a map that belongs to an image: its file, what its values are, and the number of its extension.

    `checksum` (SHA-256) and `identity` (`legdistort.runtime.provenance.identity`) are those of the file as it was read.
    """

    path: Path
    kind: str
    number: int
    checksum: str
    identity: tuple[Any, ...]


def _parted(path):
    """Name of a file without its ending, and that; None for the ending of no FITS file."""
    for ending in sorted(_ENDINGS, key=len, reverse=True):
        if path.name.lower().endswith(ending):
            return path.name[: -len(ending)], path.name[-len(ending) :]
    return path.name, None


def _exists(path):
    try:
        return path.is_file()
    except OSError:  # a name so much longer may be one that no file can have
        return False


def bad_and_sky_errors(weights, kind, data, mask):
    """What a weight map says of pixels.

    Parameters
    ----------
    weights : ndarray, shape (ny, nx)
    kind : str
        One of `KINDS`.
    data : ndarray, shape (ny, nx)
        Its scatter is the size of noise that a map states relatively.
    mask : ndarray of bool, shape (ny, nx)
        Pixels known to be bad.

    Returns
    -------
    bad : ndarray of bool, shape (ny, nx)
        Pixels without weight.
    errors : ndarray, shape (ny, nx), or None
        Standard deviation of the sky, in the unit of the data. None if the map only tells good from bad pixels.
    """
    weights = np.asarray(weights, dtype=float)
    bad = ~((weights > 0) & (weights < _HUGE))
    good = ~bad & ~mask
    if not good.any():
        return bad, None
    power = {"MAP_WEIGHT": -0.5, "MAP_VARIANCE": 0.5, "MAP_RMS": 1.0}[kind]
    errors = np.where(bad, np.nan, np.where(bad, 1.0, weights) ** power)
    if kind == "MAP_RMS":
        return bad, errors
    errors /= np.median(errors[good])
    if np.ptp(errors[good]) <= _ALIKE:
        return bad, None
    scatter = _scatter(np.where(good, data, np.nan), errors)
    return bad, errors * scatter if scatter > 0 else None


def doubt_of_rms(data, errors, mask):
    """Why errors (ny, nx) that a map states may be none, by the scatter of the pixels; empty if they agree."""
    ratio = _scatter(np.where(mask, np.nan, data), errors)
    if 1 / _BELIEVED < ratio < _BELIEVED:
        return ""
    size = f"more than {_BELIEVED:g} times" if ratio > 1 else f"less than 1/{_BELIEVED:g} of"
    return (
        f"the pixels scatter by {size} what the weight map states as MAP_RMS: is it of another kind (--weight-maps "
        "MAP_WEIGHT, MAP_VARIANCE), or in another unit than the frame"
    )


def _scatter(data, errors):
    """Scatter of the sky in relative errors: the median of those in blocks, whose stars and slopes matter little."""
    (ny, nx), side = data.shape, min(_BLOCK, *data.shape)
    cut = np.s_[: ny // side * side, : nx // side * side]
    blocks, of_errors = (
        each[cut].reshape(ny // side, side, nx // side, side).swapaxes(1, 2).reshape(-1, side * side)
        for each in (data, errors)
    )
    n_good = np.isfinite(blocks).sum(axis=1)
    used = n_good >= min(side * side // 4, n_good.max())
    blocks, of_errors = blocks[used], of_errors[used]
    off = np.abs(blocks - np.nanmedian(blocks, axis=1)[:, None]) / of_errors
    return _MAD * float(np.median(np.nanmedian(off, axis=1)))
