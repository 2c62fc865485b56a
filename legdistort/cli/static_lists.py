"""Lists of positions that a solution corrects, or without one a camera, or another known static distortion."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import legdistort

from ..exceptions import InputError, some_of
from ..inputs import column_contract
from ..inputs.exposure_names import detector_name
from ..inputs.star_lists.formats import stack
from ..inputs.table_files import named_after, named_as_known, told_apart
from ..runtime.asdf_files import entry_of, read_tree
from .given_files import read_given, refuse, without_options_of_prior

#: What the table says of the correction, in its ``meta``.
_FIGURES = "static_error_px", "exposure_scatter_px"
_MOST_NAMED = 3  # lists in a message
_OURS = "legdistort_nights", "legdistort_camera", "legdistort_prior"


@dataclass(frozen=True, eq=False)
class GivenStatic:
    """A static distortion that was given in the place of a solution.

    Attributes
    ----------
    known : Camera or Prior
    what : str
        What it is, and of when.
    scatter : dict
        Further arguments of its `correct_table`.
    """

    known: object
    what: str
    scatter: dict = field(default_factory=dict)

    def corrected(self, a):
        """The lists of a command line, one below the other, corrected; in words by what and how well; the figures."""
        lists = told_apart([(Path(path), read_given(path, a)) for path in a.tables])
        camera = self.known if isinstance(self.known, legdistort.Camera) else None
        made = []
        for path, table in lists.items():
            named = with_detectors(table, path, camera, a.detector)
            try:
                made.append(self.known.correct_table(named, **self.scatter))
            except InputError as error:
                raise InputError(f"{path}: {error}") from None
        bare = [str(path) for path, table in lists.items() if "x_err" not in table.colnames]
        out = stack(made)
        out.meta |= {name: _joint([each.meta[name] for each in made], list(map(len, made))) for name in _FIGURES}
        words = self._described(out)
        if bare:
            words += f"; {some_of(bare, _MOST_NAMED)} without errors of the positions, which x_err leaves out: --error"
        return out, words, {name: out.meta[name] for name in _FIGURES}

    def _described(self, table):
        """What corrected the positions of a table, and how good it is there."""
        error, scatter = map(table.meta.get, _FIGURES)
        lost = sum(table["x_err_abs"].value != table["x_err_abs"].value)
        said = "states no error, and counts as exact" if error == 0 else f"is known to {error or 0:.2g} px rms per axis"
        if lost:
            rest = f", of the others to {error:.2g} px rms per axis" if error else ""
            said = f"is not known of {lost} of them (x_err_abs is nan){rest}"
        about = f"exposures scatter about it by {scatter or 0:.2g} px"
        about = about if scatter else "how far exposures scatter about it is not stated"
        return f", without the static distortion of {self.what}, which {said}; {about}"


def with_detectors(table, path, camera, detector=None, names=None):
    """The table of a file with the detector of every row, as `match` has it with frames: by name, image, or as given.

    Parameters
    ----------
    table : `~astropy.table.QTable`
    path : str or path
        Of its file, for messages.
    camera : Camera or None
    detector : str, optional
        Of all rows, which ``--detector`` gives.
    names : sequence of str, optional
        Of the exposures that are known. Without them any is: ``a03-CCD1`` and the images ``a03_1``, ``a03_2`` of an
        LDAC list are of ``a03``.

    Raises
    ------
    InputError
        For a detector where there are none, or where the table has its own; if what images are of cannot be told.
    """
    if detector is not None:
        if camera is None:
            raise InputError("--detector is for a camera: leave it out, this static distortion is of one detector")
        camera[detector]  # refuses an unknown one
        if "detector" in table.colnames:
            raise InputError(f"{path}: it has a column detector, which says it of every row: leave --detector out")
        if len(images := table.meta.get("images", {})) > 1:
            raise InputError(f"{path}: it has tables of {len(images)} images, each a detector: leave --detector out")
        table["detector"] = detector
        return table
    if (
        camera is None
        or not camera.has_focal_plane
        or "detector" in table.colnames
        or not {"exposure", "x", "y"} <= set(table.colnames)
    ):
        return table
    ids = list(camera.detectors)
    if names is None:
        ends = "|".join(re.escape(detector_name("", key)) for key in ids)
        ends = rf"(?:{ends}|_\d+)$" if table.meta.get("images") else rf"(?:{ends})$"
        names = {re.sub(ends, "", name) for name in np.unique(column_contract.labels(table, "exposure")).tolist()}
    parts = [
        SimpleNamespace(name=detector_name(name, key), exposure=name, detector=key) for name in names for key in ids
    ]
    table = named_after(table, parts, path)
    if "detector" not in table.colnames:
        raise InputError(
            f"{path}: the list has no column detector, which of {some_of(ids, 8)} of camera {camera.name} it is of: "
            f"add it, or call the list as {parts[0].name}; for lists of one of them, --detector {ids[0]}"
        )
    return table


def lists_of(solution, a):
    """The lists of a command line, one below the other, with the exposures and detectors of a solution."""
    of_camera = {} if solution.camera.has_focal_plane else {"detector": a.detector}
    refuse(of_camera | {"date": a.date, "value": a.value}, "is for the lists of a camera")
    lists = []
    for path in a.tables:
        table = named_as_known(read_given(path, a), path, solution.names)
        lists.append(with_detectors(table, path, solution.camera, a.detector, solution.names))
    return stack(lists)


def given_static(where, a):
    """The `GivenStatic` in a file, or by a name, as ``--prior`` takes it; None for a solution."""
    if Path(where).is_dir() or entry_of(where, ["legdistort"]) is not None:
        return None
    entry = entry_of(where, _OURS)
    if entry != "legdistort_nights":
        refuse({"date": a.date, "value": a.value}, "is for a camera of several nights, which legdistort nights writes")
    if entry is None or entry == "legdistort_prior":
        with without_options_of_prior(a):
            return GivenStatic(legdistort.Prior.from_file(where), f"{where}{_written(where, entry)}")
    camera = legdistort.Camera.read(where)
    if entry == "legdistort_camera":
        return GivenStatic(camera, f"camera {camera.name} ({where}){_written(where, entry)}")
    nights = legdistort.CombinedNights.read(where)
    dates = sorted({f"{date:.2f}" for date in (nights.dates.min(), nights.dates.max()) if date})
    count = sum(each.n_nights for each in nights.nights)
    what = f"camera {camera.name} ({where}) of {count} night{'s' * (count > 1)}{', ' * bool(dates)}{' to '.join(dates)}"
    if at := asked_for(nights, a):
        camera, what = nights.camera(a.date, a.value), f"{what}, that of {at}"
    known = {} if nights.has_focal_plane else {"sigma": nights.prior(a.date, a.value, one_exposure=True).sigma}
    return GivenStatic(camera, what, known)


def asked_for(nights, a):
    """The date and the number of the covariate that a command line asks a camera for, in words; none without them."""
    asked = {"date": a.date, nights.covariate: a.value}
    return ", ".join(f"{name} {number:g}" for name, number in asked.items() if number is not None)


def _written(where, entry):
    """When a file of ours was written; nothing of another one."""
    created = read_tree(where)[entry].get("provenance", {}).get("created") if entry else None
    return f", written {str(created)[:10]}" if created else ""


def _joint(sizes, count):
    """Root mean square of some that are known, of numbers of positions; None without any."""
    known = [(size, n) for size, n in zip(sizes, count, strict=True) if size is not None]
    return (sum(size**2 * n for size, n in known) / sum(n for _, n in known)) ** 0.5 if known else None
