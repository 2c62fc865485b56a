"""What a run measures, until its results are there: nothing of it is lost if the run fails, or is killed.

Every image lands in ``OUT.measured/images`` beside the folder of the results as soon as it is measured. A run that goes
on from there measures the others. One that fails once all is measured leaves a table, as results have it. A process
that measures locks the folder as long as it lives.
"""

import json
import logging
import os
import re
from itertools import count
from pathlib import Path
from shlex import quote
from zipfile import BadZipFile

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..exceptions import InputError, LegdistortError
from ..runtime import locks, outputs, provenance
from .detections import MeasuredExposure
from .earlier import BEGUN, DETECTIONS, PSFS, begun_in, described, is_described, write_detections
from .effective.frame_psf import Verdict
from .effective.model import EffectivePSF
from .positions import write_psfs

log = logging.getLogger(__name__)

_IMAGES = "images"


class Unfinished:
    """A context that keeps what is measured in it, and says how to go on from there, unless it ends well.

    Parameters
    ----------
    out : Path
        Folder of the results, that are not made yet.
    options : dict
        What the summary has of the command, if there is one.
    again : str or None
        The command that goes on, but for the folder that it goes on from.
    """

    def __init__(self, out, options, again):
        self.out, self.options, self.again = out, options, again
        self.exposures, self.how, self.stuck = (), {}, False
        self.folder = self.begun = self.lock = self.found = None

    def __enter__(self):
        return self

    def __exit__(self, kind, error, traceback):
        if error is not None:
            told = self._keep() if self.found else self._count()
            if told and isinstance(error, LegdistortError) and len(error.args) == 1:
                error.args = (f"{error}; {told}",)
            elif told:
                log.warning("%s", told)
        elif self._has_no_others():
            self._remove()
        self._release()

    def begin(self, exposures, earlier, how):
        """Begin to measure exposures, or go on from an `EarlierRun` that is not whole; `how` as of `described`.

        Raises
        ------
        InputError
            If another process goes on from there, or as `EarlierRun.check` does.
        """
        self.exposures, self.how = exposures, how
        if earlier is not None:
            earlier.check(exposures)
            self.folder, self.begun = earlier.folder, earlier.table.meta
            self.lock = locks.lock(self.folder)
            if self.lock is None:
                raise InputError(f"another process measures what is kept in {self.folder}: wait until it has ended")
            log.info("%d of %d images are measured already in %s", self._measured(), self._all(), self.folder)
            return
        self._tell_of_others()
        if is_described(exposures, how["measuring"]):
            self.folder = next(place for place in _places(self.out) if not os.path.lexists(place))
            self.begun = described(exposures, self.folder, **how)

    def get(self, exposure):
        """The `MeasuredExposure` of an exposure that is measured already; None of others, and where it is damaged."""
        path = self.lock and self.folder / _IMAGES / f"{exposure.name}.npz"
        if not path or not path.is_file():
            return None
        try:
            return _read(path)
        except (OSError, EOFError, ValueError, KeyError, TypeError, BadZipFile, InputError) as error:
            log.info("%s is measured again: %s", exposure.name, error)
            return None

    def keep(self, exposure, measured):
        """Have a `MeasuredExposure` on the disk."""
        if self.folder is None or self.stuck:
            return
        try:
            if self.lock is None:
                self.folder.mkdir()
                self.lock = locks.lock(self.folder)
                outputs.write_summary(self.folder / provenance.SUMMARY, self.options | {BEGUN: self.begun})
            _write(measured, self.folder / _IMAGES / exposure.name)
        except (OSError, LegdistortError) as error:
            log.info("images are not kept as they are measured: %s", error)
            self.stuck = True

    def complete(self, table, psfs):
        """Take what was found in all exposures together."""
        self.found = (table, psfs) if len(table) and all(each.path is not None for each in self.exposures) else None
        if not len(table):
            self._remove()

    def _all(self):
        return len(self.begun["shapes"])

    def _measured(self):
        return len(_names(self.folder))

    def _has_no_others(self):
        """Whether no image is in the folder but those that are measured here: it may go."""
        return bool(self.lock) and set(_names(self.folder)) <= {each.name for each in self.exposures}

    def _remove(self):
        if self.lock:
            locks.remove(self.folder)
            self._release()

    def _release(self):
        if self.lock:
            self.lock.release()
        self.lock = None

    def _count(self):
        """How many images are on the disk, and how to go on from there; None for none."""
        if not self.lock:
            return None
        if not (n := self._measured()):
            self._remove()
            return None
        told = f"{n} of {self._all()} images are measured and kept in {self.folder}"
        return f"{told}, to go on from there: {self._call(self.folder)}"

    def _keep(self):
        """Leave all that was measured, whole or not at all; how to go on from it, or None."""
        own = self.folder if self._has_no_others() else None
        place = next(p for p in _places(self.out) if p == own or not os.path.lexists(p) or _is_of_failed(p))
        patterns = (DETECTIONS, f"{PSFS}/*.fits", provenance.SUMMARY, f"{_IMAGES}/*", locks.LOCK)
        try:
            with outputs.replacing_folder(place, results=patterns) as target:
                write_psfs(self.found[1], target / PSFS)
                write_detections(target / DETECTIONS, self.found[0], self.exposures, place, **self.how)
                outputs.write_summary(target / provenance.SUMMARY, self.options | outputs.listed_files(target))
        except (LegdistortError, OSError) as error:
            log.warning("what was measured could not be kept: %s", error)
            return self._count()
        if own not in (None, place):
            self._remove()
        return f"what was measured is kept in {place}, to go on from without measuring: {self._call(place)}"

    def _call(self, place):
        if self.again:
            return f"{self.again} --from {quote(str(place))}"
        return f"run(earlier={str(place)!r}, out={str(self.out)!r}, ...)"

    def _tell_of_others(self):
        """Name the images that a run on the same folder has left that was killed."""
        for place in _stopped(self.out):
            log.warning(
                "%s has %d of %d images that a run measured which was stopped: to go on from there, stop this one and "
                "call %s; else remove it",
                place, len(_names(place)), len(begun_in(place)["shapes"]), self._call(place),
            )  # fmt: skip


def _places(out):
    """``OUT.measured``, and with numbers behind it."""
    whole = out if out.name not in ("", "..") else Path(os.path.abspath(out))
    return (whole.with_name(f"{whole.name}.measured{f'-{n}' if n > 1 else ''}") for n in count(1))


def _stopped(out):
    """Folders that have some images of runs on a folder of results, and no process that measures the others."""
    first = next(_places(out))
    pattern = re.compile(rf"{re.escape(first.name)}(-\d+)?")
    names = sorted(os.listdir(first.parent)) if first.parent.is_dir() else []
    found = [first.with_name(name) for name in names if pattern.fullmatch(name)]
    return [place for place in found if locks.is_own_folder(place) and _names(place) and _is_free(place)]


def _is_free(place):
    if begun_in(place) is None or (held := locks.lock(place)) is None:
        return False
    held.release()
    return True


def _is_of_failed(place):
    """Whether a folder has nothing but all that a run measured that failed: it gives way to another such run."""
    files = provenance.files_of_run(place)
    own = {provenance.SUMMARY, DETECTIONS, PSFS}
    return files is not None and DETECTIONS in files and {path.name for path in place.iterdir()} <= own


def _names(folder):
    """Names of the images that are measured in a folder."""
    return [path.stem for path in (folder / _IMAGES).glob("*.npz")]


def _write(measured, path):
    """Write a `MeasuredExposure`: the PSF, ``NAME.fits``, and then the rest, ``NAME.npz``."""
    if measured.psf is not None:
        measured.psf.write(f"{path}.fits", overwrite=True)
    columns = {key: measured.table[key] for key in measured.table.colnames}
    facts = measured._replace(table=None, psf=measured.psf is not None, verdict=list(measured.verdict))._asdict()
    facts["shape"] = None if measured.shape is None else np.asarray(measured.shape).tolist()
    facts["units"] = {key: each.unit.to_string() for key, each in columns.items() if each.unit is not None}
    values = {f"column {key}": np.asarray(getattr(each, "value", each)) for key, each in columns.items()}
    with outputs.replacing(f"{path}.npz", overwrite=True) as file:
        np.savez(file, facts=np.array(json.dumps(facts, default=lambda number: number.item())), **values)


def _read(path):
    """The `MeasuredExposure` that `_write` has written."""
    with np.load(path, allow_pickle=False) as file:
        facts = json.loads(str(file["facts"]))
        columns = {key.removeprefix("column "): file[key] for key in file.files if key != "facts"}
    units = facts.pop("units")
    facts["table"] = QTable({key: each * u.Unit(units[key]) if key in units else each for key, each in columns.items()})
    facts["verdict"] = Verdict(*facts["verdict"])
    facts["psf"] = EffectivePSF.read(path.with_suffix(".fits")) if facts["psf"] else None
    facts["shape"] = None if facts["shape"] is None else np.array(facts["shape"])
    return MeasuredExposure(**facts)
