"""Positions that an earlier run measured, so that another one goes on from there."""

import json
import os
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from astropy.table import Table

from ..cameras.camera import Camera
from ..exceptions import AssumptionWarning, InputError, LegdistortError, some_of, warn
from ..inputs.exposure_files import ExposureFile, checksums_of_paths, file_checksums, open_exposures
from ..inputs.exposure_names import folder_mark, marked, whole_name
from ..inputs.table_files import read_table, write_table
from ..runtime import provenance
from ..runtime.checks import options_from
from ..runtime.locks import way_back
from .effective.model import EffectivePSF
from .options import MeasureOptions

#: Files of a run that have what it measured.
DETECTIONS, PSFS = "detections.ecsv", "psf"
#: What a summary calls how measuring began, as long as not all is measured.
BEGUN = "begun"


@dataclass(frozen=True, eq=False)
class EarlierRun:
    """What a run measured.

    Attributes
    ----------
    folder : Path
    table : Table
        Detections of all its exposures, as `legdistort.measure` gives them.
    psfs : dict of str to EffectivePSF
        Of the exposures that have one.
    is_whole : bool
        Whether all was measured. Else the table is empty, and has in its header how it was begun.
    """

    folder: Path
    table: Table
    psfs: dict = field(default_factory=dict)
    is_whole: bool = True

    @classmethod
    def read(cls, folder):
        """What the run that left this folder measured.

        All of it is read here: the folder may be replaced by the results of the next run.

        Raises
        ------
        InputError
            Where there is no such folder, no run has left its positions there, or it has files of several runs.
        """
        return provenance.of_one_run(folder, partial(cls._read, Path(folder)))

    @classmethod
    def _read(cls, folder):
        """The object, and the names of the files that it was read from."""
        if not (folder / DETECTIONS).is_file() and (begun := begun_in(folder)) is not None:
            return cls(folder, Table(meta=begun), is_whole=False), [provenance.SUMMARY]
        if not (folder / DETECTIONS).is_file():
            lost = way_back(folder / DETECTIONS) or ": give the folder of the results of a run"
            raise InputError(f"{folder} has no {DETECTIONS}{lost}")
        table = read_table(folder / DETECTIONS)
        if not {"exposure", "x", "y", "x_err", "y_err"} <= set(table.colnames) or "frames" not in table.meta:
            raise InputError(f"{folder / DETECTIONS} is not what a run has left: measure the frames again")
        paths = sorted((folder / PSFS).glob("*.fits"))
        psfs = {path.stem: EffectivePSF.read(path) for path in paths}
        return cls(folder, table, psfs), [DETECTIONS, *(f"{PSFS}/{path.name}" for path in paths)]

    @property
    def frames(self):
        """Paths of the frames that were measured, from the folder of the results."""
        return [Path(os.path.normpath(self.folder / path)) for path in self.table.meta["frames"]]

    @property
    def reading(self):
        """Arguments ``ext``, ``dq_good`` and ``weight_maps`` with which the frames were read."""
        reading = {name: self.table.meta.get(name) for name in ("ext", "dq_good", "weight_maps")}
        return reading | {"ext": tuple(reading["ext"]) if isinstance(reading["ext"], list) else reading["ext"]}

    @property
    def measuring(self):
        """The `MeasureOptions`, as far as they are numbers and words."""
        return options_from(MeasureOptions, self.table.meta.get("measuring"), f"{self.folder / DETECTIONS}: measuring")

    @property
    def camera(self):
        """The camera that was given; None if none was."""
        meta = self.table.meta.get("camera")
        return None if meta is None else Camera.from_meta(meta)

    def named(self, exposures):
        """Exposures called as that run called them: of files whose names repeated, a folder stands before their names.

        Parameters
        ----------
        exposures : list of ExposureFile
        """
        known = self.table.meta.get("shapes") or {}
        return [
            marked(each, folder_mark(each.name, each.path, known)) if isinstance(each, ExposureFile) else each
            for each in exposures
        ]

    def of(self, exposures):
        """Detections and effective PSFs of some exposures, which must be those that were measured.

        Parameters
        ----------
        exposures : list of ExposureFile
            As `named` calls them.

        Returns
        -------
        detections : Table
        psfs : dict of str to EffectivePSF

        Raises
        ------
        InputError
            As `check` does.
        """
        self.check(exposures)
        names = [whole_name(exposure) for exposure in exposures]
        table = self.table[np.isin(self.table["exposure"], names)]
        table.meta = {}
        return table, {exposure.name: self.psfs[exposure.name] for exposure in exposures if exposure.name in self.psfs}

    def check(self, exposures):
        """Raise `InputError` unless exposures, as `named` calls them, are some of those that were measured.

        Naming a frame that was not measured, that has changed, or that is in no file; or the detectors are called
        otherwise.
        """
        without = [exposure.name for exposure in exposures if not isinstance(exposure, ExposureFile)]
        if without:
            raise InputError(f"{without[0]} is not in a file: nothing proves that it is what was measured; give files")
        measured = self.table.meta["inputs"]
        for path, checksum in checksums_of_paths(exposures).items():
            file = folder_mark(path.name, path, measured) + path.name
            if file not in measured:
                raise InputError(
                    f"{file} was not measured in {self.folder}, whose frames are {some_of(list(measured), 3)}: give "
                    "frames of that run, or measure all of them together"
                )
            if measured[file] != checksum:
                raise InputError(f"{file} is not as it was measured in {self.folder}: measure the frames again")
        known = self.table.meta.get("shapes") or {}
        if strange := [each.name for each in exposures if known and each.name not in known]:
            raise InputError(
                f"{self.folder} has no positions of {strange[0]}: the camera does not name the detectors as they were "
                "measured; leave it out, or measure the frames again with it"
            )


def begun_in(folder):
    """How measuring began that a folder has some images of, the arguments of `described`; None if it is no such one."""
    try:
        begun = json.loads((Path(folder) / provenance.SUMMARY).read_text(encoding="utf-8"))[BEGUN]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return begun if isinstance(begun, dict) and isinstance(begun.get("frames"), list) else None


def _plain_options(measuring):
    """Those of `MeasureOptions` that are numbers or words, and no defaults."""
    usual = vars(MeasureOptions())
    kept = {name: value for name, value in vars(measuring).items() if isinstance(value, str | int | float)}
    return {name: value for name, value in kept.items() if value != usual[name]}


def is_described(exposures, measuring):
    """Whether what `described` states is all that measuring these exposures takes: not of PSFs or frames in memory."""
    return all(each.path is not None for each in exposures) and isinstance(measuring.psf, str)


def measured_frames(tables):
    """The frames of tables of positions, whose headers may know the sky.

    Parameters
    ----------
    tables : dict of Path to Table
        As `write_detections` wrote them, or others.

    Returns
    -------
    list of ExposureFile or None
        None if one of the tables names no frames, or if frames are not there any more as they were measured: then
        with a warning.
    """
    if not all("frames" in table.meta for table in tables.values()):
        return None
    exposures = []
    for path, table in tables.items():
        earlier = EarlierRun(path.parent, table)
        try:
            opened = earlier.named(open_exposures(earlier.frames, **earlier.reading))
            exposures += earlier.camera.of_detectors(opened) if earlier.camera else opened
            earlier.of(opened)
        except LegdistortError as error:
            warn(f"{path}: matched without the headers of its frames, so without their sky: {error}", AssumptionWarning)
            return None
    return exposures


def write_detections(
    path,
    detections,
    exposures,
    out,
    *,
    measuring,
    ext=None,
    dq_good=None,
    weight_maps=None,
    camera=None,
    overwrite=False,
):
    """Write what was measured, for `EarlierRun` and for the command ``match``.

    Parameters
    ----------
    path : Path
    detections : Table
    exposures : list of Exposure
        Those that are not in files cannot be gone on from.
    out : Path
        Where the file will be found: paths of frames are relative to it.
    measuring : MeasureOptions
        How it was measured.
    ext, dq_good, weight_maps, camera
        As given to `legdistort.run`.
    overwrite : bool
        Replace a file that exists.
    """
    table = detections.copy()
    how = {"ext": ext, "dq_good": dq_good, "weight_maps": weight_maps, "camera": camera}
    table.meta |= described(exposures, out, measuring=measuring, **how)
    write_table(table, path, overwrite=overwrite)


def described(exposures, out, *, measuring, ext=None, dq_good=None, weight_maps=None, camera=None):
    """What goes beside measured positions so that a run goes on from them; arguments as of `write_detections`."""
    files = list(dict.fromkeys(exposure.path for exposure in exposures if exposure.path is not None))
    return {
        "inputs": file_checksums(exposures),
        "frames": [os.path.relpath(file, out) for file in files],
        "shapes": {exposure.name: list(exposure.shape) for exposure in exposures},
        "ext": list(ext) if isinstance(ext, tuple) else ext,
        "dq_good": dq_good,
        "weight_maps": weight_maps,
        "camera": camera and camera.to_meta(),
        "measuring": _plain_options(measuring),
    }
