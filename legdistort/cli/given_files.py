"""What is given on the command line: tables, cameras, matched positions of one field or several, sized terms."""

from fnmatch import fnmatchcase
from pathlib import Path

import legdistort

from ..exceptions import InputError, some_of
from ..inputs import column_contract
from ..inputs.table_files import read_table
from ..runtime.asdf_files import entry_of
from ..solving.checks.limits import ASKED


def refuse(given, reason):
    """Raise `InputError` for the first of ``{name: value}`` that was given: it would be ignored."""
    for name, value in given.items():
        if value not in (None, False):
            raise InputError(f"--{name.replace('_', '-')} {reason}: leave it out")


def sized_term(name, sizes):
    """A `legdistort.Term` of a forecast by its sizes, in order."""
    names = ("size", "length", "smoothness", "ratio", "angle") if name == "turbulence" else ("sigma",)
    if len(sizes) > len(names):
        raise InputError(f"--term {name} has {len(sizes)} sizes: it takes {', '.join(names)}")
    return legdistort.Term.named(name, **dict(zip(names, sizes, strict=False)))


def read_given(path, a, contract=None):
    """The table in a file; where it does not keep a contract, the message names the file."""
    table = read_table(path, columns=dict(a.columns), origin=a.origin, error=a.error)
    if contract is not None and len(table):
        column_contract.check(table, contract, str(path))
    return table


def given_camera(given):
    """The camera of ``--camera``: gsaoi, that of a file, or what a solution found, its file or folder; None without."""
    if not given or given == "gsaoi":
        return legdistort.Camera.gsaoi() if given else None
    solved = Path(given).is_dir() or entry_of(given, ["legdistort"]) is not None
    return legdistort.Solution.read(given).camera if solved else legdistort.Camera.read(given)


def read_matches(a):
    """The `Matches` in the tables of a command line, those of several fields joined, and their inputs."""
    paths = [Path(path) for path in a.tables]
    if len({path.resolve() for path in paths}) < len(paths):
        raise InputError("a table stands twice on the command line: every field has one of its own")
    read = {path: _read(path, a) for path in paths}
    inputs = {name: checksum for _, files in read.values() for name, checksum in files.items()}
    return _without(_joined(read), a.without), inputs


def _joined(read):
    """The matches of ``{path: (matches, inputs)}``, as fields if there are several."""
    if len(read) == 1:
        ((matches, _),) = read.values()
        return matches
    stems = [path.stem for path in read]
    labels = stems if len(set(stems)) == len(stems) else [path.resolve().parent.name for path in read]
    if len(set(labels)) < len(labels):
        raise InputError(f"tables of fields must differ in their names, or those of their folders: {', '.join(stems)}")
    fields = {label: matches for label, (matches, _) in zip(labels, read.values(), strict=True)}
    return legdistort.Matches.of_fields(fields)


def _without(matches, patterns):
    """The matches without the exposures, or nights, that were asked to be left out."""
    reasons = {}
    for pattern in patterns or ():
        found = _like(pattern, matches.names) or _like(pattern, matches.nights)
        if not found:
            nights = f", and none of the nights: {some_of(list(matches.nights), 6)}" * (len(matches.nights) > 1)
            raise InputError(f"--without {pattern} is none of the exposures: {some_of(list(matches.names), 6)}{nights}")
        reasons |= dict.fromkeys(found, ASKED)
    return matches.without(reasons) if reasons else matches


def _like(pattern, names):
    return [name for name in names if fnmatchcase(str(name), pattern)]


def known_file(path):
    """The camera, nights or prior in a file that holds one of these and no solution; else None."""
    kinds = {
        "legdistort_nights": legdistort.CombinedNights,
        "legdistort_camera": legdistort.Camera,
        "legdistort_prior": legdistort.Prior,
    }
    entry = entry_of(path, kinds)
    return None if entry is None else kinds[entry].read(path)


def _read(path, a):
    """The `Matches` in a table, and its inputs."""
    table = read_given(path, a, column_contract.MATCHED)
    known = legdistort.Matches.read_meta(table.meta)
    known |= {"shape": tuple(a.shape)} if a.shape else {}
    known |= {"camera": given_camera(a.camera)} if a.camera else {}
    if known["camera"]:
        refuse({"shape": a.shape}, "comes from the camera")
    else:
        refuse({"layout": a.layout}, "is for the detectors of a camera")
        if known["shape"] is None:
            raise InputError(f"{path} does not state the size of the detectors: give --shape NY NX")
    return legdistort.Matches.from_table(table, **known), table.meta["inputs"]
