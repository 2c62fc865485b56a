"""Cameras whose detectors have files of their own: which files are of one exposure, and of which detector.

The headers name the detector. The files of one exposure have one name but for the detector
(``jw01234_nrca1_cal.fits``, ``jw01234_nrca2_cal.fits``), or were begun at the same time and have the beginning of their
names in common (``SUPA00123450.fits``, ``SUPA00123451.fits``).
"""

import logging
import re
from dataclasses import replace

import numpy as np

from ..exceptions import AssumptionWarning, InputError, some_of, warn
from ..geometry import epochs
from .exposure_names import alike, detector_name
from .file_images import KEYWORDS

log = logging.getLogger(__name__)

#: Keywords of the detector of a file, in order of preference; extensions of single files all have one ``EXTVER``.
_OF_FILES = ("CCDCHIP", "DETECTOR", "CHIP", "CCDNUM", "DET-ID")
#: Detectors as names of files have them: NIRCam, NIRSpec, Roman, and those that count chips.
_IN_NAME = re.compile(
    r"(?<![A-Za-z0-9])(nrc[ab](?:[1-4]|long)|nrs[12]|wfi\d\d|(?:chip|ccd|det|sca)\d{1,3})(?![A-Za-z0-9])", re.IGNORECASE
)
#: The number of a detector: the last one in its name.
_NUMBER = re.compile(r".*?0*(\d+)\D*")
#: Years between the beginnings of what counts as one exposure: 2 s by name, a minute by the time alone.
_APART, _SAME_TIME = 60 / 3.156e7, 2 / 3.156e7


def with_detectors(exposures):
    """Exposures with `exposure` and `detector`, if they are those of several detectors in files of their own.

    Else as they are. Every file must be of a detector that its header names, or its own name where it states nothing (a
    gwcs alone), no exposure have one twice, and one at least have several.

    Parameters
    ----------
    exposures : list of Exposure or ExposureFile
    """
    if any(exposure.detector is not None for exposure in exposures):
        return exposures
    for keyword in (*_OF_FILES, None):
        ids = [_stated(exposure, keyword) for exposure in exposures]
        if len(set(ids)) < 2 or "" in ids or not all(re.fullmatch(r"[\w.+-]+", key) for key in ids):
            continue
        for whole in (_by_name(exposures, ids), _by_time(exposures)):
            n_parts = len(set(zip(whole, ids, strict=True)))
            if None not in whole and len(set(whole)) < n_parts == len(exposures):
                log.info(
                    "files of the detectors %s are put together: %d exposure%s", ", ".join(sorted(set(ids))),
                    len(set(whole)), "s" * (len(set(whole)) > 1),
                )  # fmt: skip
                return [
                    replace(exposure, exposure=name, detector=key)
                    for exposure, name, key in zip(exposures, whole, ids, strict=True)
                ]
    return exposures


def _stated(exposure, keyword):
    """The detector by a keyword of the header; without one by the name of a file that has no header, such as a gwcs."""
    if keyword is not None:
        return str(exposure.header.get(keyword, "")).strip()
    found = None if set(exposure.header) - {"EXPTIME"} else _IN_NAME.search(exposure.name)
    return "" if found is None else found[1].upper()


def _by_name(exposures, ids):
    """The name of each file without its detector; None where it has not, or where times contradict it."""
    whole = [without_id(exposure.name, key) for exposure, key in zip(exposures, ids, strict=True)]
    times = {}
    for exposure, name in zip(exposures, whole, strict=True):
        times.setdefault(name, []).append(_time(exposure))
    wrong = {name for name, each in times.items() if None not in each and max(each) - min(each) > _APART}
    return [None if name in wrong else name for name in whole]


def _by_time(exposures):
    """What the names of files that were begun together have in common in the beginning; None where that is nothing."""
    times = [_time(exposure) for exposure in exposures]
    if None in times:
        return [None] * len(exposures)
    groups, last = [], -1.0
    for time, exposure in sorted(zip(times, exposures, strict=True), key=lambda each: each[0]):
        groups += [[]] if time - last > _SAME_TIME else []
        groups[-1].append(exposure.name)
        last = time
    named = {name: _beginning(group).rstrip("-_. ") for group in groups for name in group}
    distinct = len({named[group[0]] for group in groups}) == len(groups)
    return [(named[exposure.name] or None) if distinct else None for exposure in exposures]


def _beginning(names):
    """What names have in common, letter by letter."""
    low, high = min(names), max(names)
    n = next((i for i, (a, b) in enumerate(zip(low, high, strict=False)) if a != b), len(low))
    return low[:n]


def _time(exposure):
    return epochs.stated_epoch(exposure.header)[0]


def without_id(name, key):
    """Name of a file without the id of a detector in it; None where it does not have it, or nothing else."""
    whole = re.sub(rf"[-_.]?(?<![A-Za-z0-9]){re.escape(key)}(?![A-Za-z0-9])", "", name, flags=re.IGNORECASE)
    return None if whole in ("", name) else whole


def named_detectors(names):
    """Detectors that names of files have in them, and the names without these, of several of the same exposures.

    Parameters
    ----------
    names : list of str

    Returns
    -------
    keys, whole : list of str
        Sorted, each once; empty unless every name has one, and two at least are the same without it.
    """
    found = [_IN_NAME.search(name) for name in names]
    if not all(found):
        return [], []
    keys = {match[1].lower() for match in found}
    whole = {without_id(name, match[1]) for name, match in zip(names, found, strict=True)} - {None}
    return (sorted(keys), sorted(whole)) if len(keys) > 1 and len(whole) < len(names) else ([], [])


def warn_of_detectors(tables):
    """Warn where tables without detectors have exposures named after several detectors of the same, and no others."""
    names = [name for table in tables if "detector" not in table.colnames for name in dict.fromkeys(table["exposure"])]
    keys, whole = named_detectors(names)
    if keys:
        warn(
            f"by their names these are {len(keys)} detectors ({some_of(keys, 6)}) of {len(whole)} exposures, and they "
            f"are taken for {len(names)} exposures of one detector: give the frames that they were measured in, --wcs "
            "FRAMES, whose headers tell detectors apart",
            AssumptionWarning,
        )


def label_of(name, header, labels, *, exact):
    """Which of the labels ``EXPOSURE-ID`` a file has that is of one detector, by its name and header; None if none has.

    Parameters
    ----------
    name : str
        As `legdistort.inputs.exposure_names.exposure_name` gives it.
    header : Header
    labels : iterable of str
    exact : bool
        The label must have the whole name of the file but for the detector; else the beginning of it does. Where none
        has, one that differs from it by its last word is taken (`alike`).
    """
    found, products = [], [alike(name, labels)]
    for key in filter(None, _named_in(header)):
        whole, end = without_id(name, key), detector_name("", key)
        firsts = {each[: -len(end)]: each for each in labels if each.lower().endswith(end.lower())}
        for first, label in firsts.items():
            if first and (first == whole or (name.startswith(first) and not exact)):
                found.append((len(first), label))
        products.append(firsts.get(alike(whole or "", firsts)))
    return max(found)[1] if found else next(filter(None, products), None)


def of_files(exposures, ids):
    """Exposures with `exposure` and `detector`, also those whose detectors are in files of their own.

    The detector is that of `ids` which the header names, the exposure is the name of the file without it. Those that
    have a detector keep it, unless that is none of `ids` and another keyword names one, or the detectors of all have
    the numbers of `ids`, each once (``IM1`` to ``IM4`` for 1 to 4), which is logged.

    Parameters
    ----------
    exposures : list of Exposure
    ids : iterable of str

    Raises
    ------
    InputError
        For a header that names none of the detectors, or a file name that does not have it.
    """
    known, out = {key.lower(): key for key in ids}, []
    numbered = _by_number(exposures, known)
    for exposure in exposures:
        if exposure.detector in known.values():
            out.append(exposure)
            continue
        key = numbered.get(exposure.detector, _key_of(exposure.header, known))
        if exposure.detector is not None:
            parted = exposure.name == detector_name(exposure.exposure, exposure.detector)
            known_as = {} if key is None else {"detector": key}
            known_as |= {"name": detector_name(exposure.exposure, key)} if parted and key is not None else {}
            out.append(replace(exposure, **known_as))
            continue
        if key is None:
            raise InputError(
                f"the header of {exposure.name} names none of the detectors {', '.join(known.values())} "
                f"({', '.join(KEYWORDS)}): read all extensions of a file by their name (ext='SCI', --ext SCI), or "
                "correct the ids of the camera"
            )
        whole = without_id(exposure.name, key)
        if whole is None:
            raise InputError(
                f"{exposure.name} is of detector {key}, which its name does not contain: files of one exposure are "
                f"those with one name but for the detector, such as {exposure.name}_{key}; rename them"
            )
        out.append(replace(exposure, exposure=whole, detector=key))
    return out


def _key_of(header, known):
    """The detector of ``{lower case: id}`` that a header names; None for none."""
    return next((known[value.lower()] for value in _named_in(header) if value.lower() in known), None)


def _by_number(exposures, known):
    """``{detector of exposures: id}`` of those that have other names and the same numbers, all of them; else empty.

    Headers that name the detectors, each another one, go before.
    """
    called = {}
    for exposure in exposures:
        if exposure.detector is not None:
            called.setdefault(exposure.detector, set()).add(_key_of(exposure.header, known))
    named = {key for keys in called.values() for key in keys} - {None}
    if len(named) == len(called):
        return {}
    return paired_by_number(called, known.values())


def paired_by_number(theirs, ours):
    """``{id: id}`` of ids of detectors that have other names and the same numbers, each once, all of them; else empty.

    It is logged.
    """
    if not theirs or set(theirs) & set(ours):
        return {}
    numbers, of_camera = (
        {match[1]: key for key in keys if (match := _NUMBER.fullmatch(key))} for keys in (theirs, ours)
    )
    if numbers.keys() != of_camera.keys() or not len(theirs) == len(numbers) == len(ours):
        return {}
    pairs = {numbers[number]: of_camera[number] for number in sorted(numbers, key=int)}
    log.info(
        "detectors %s are taken for %s of the camera, by their numbers", ", ".join(pairs), ", ".join(pairs.values())
    )
    return pairs


def with_ids_of(table, ids):
    """A table with the ids of a camera in the column ``detector`` in place of others of the same numbers, if so."""
    if "detector" not in table.colnames:
        return table
    named = np.asarray(table["detector"]).astype(str)
    pairs = paired_by_number(np.unique(named).tolist(), list(ids))
    if pairs:
        table = table.copy()
        table["detector"] = [pairs[key] for key in named]
    return table


def stated_detector(header):
    """The detector that a header names by a keyword of files of single detectors; empty for none."""
    return next(filter(None, (str(header.get(keyword, "")).strip() for keyword in _OF_FILES)), "")


def _named_in(header):
    """What a header may call its detector."""
    return [str(header.get(keyword, "")).strip() for keyword in dict.fromkeys((*_OF_FILES, *KEYWORDS))]
