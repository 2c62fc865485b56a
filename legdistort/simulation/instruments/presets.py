"""Instruments that are described in files: those that come along, and those of callers."""

import tomllib
from importlib import resources
from pathlib import Path

import numpy as np

from ...cameras.camera import Camera
from ...cameras.detector import Detector
from ...exceptions import InputError

_NUMBERS = "pixel_scale", "read_noise", "dark_current", "full_well", "zero_point", "sky_brightness"
_KEYS = {*_NUMBERS, "name", "camera", "filters", "detectors"}


def preset_names():
    """Names of the instruments that come along."""
    files = (each for each in _folder().iterdir() if each.name.endswith(".toml"))
    return sorted(tomllib.loads(each.read_text(encoding="utf-8"))["name"] for each in files)


def _folder():
    return resources.files("legdistort").joinpath("data/instruments")


def described(name, filter=None):
    """What a file states of an instrument, as keyword arguments of `Instrument`.

    Parameters
    ----------
    name : str or path
        Of a preset, in upper or lower case, or of a TOML file of the same form.
    filter : str, optional
        One of those in the file; needed if there are several.

    Raises
    ------
    InputError
        For a name that is neither, a file of another form, and a filter that is not in it.
    """
    path = Path(name)
    if path.suffix == ".toml":
        if not path.is_file():
            raise InputError(f"{path}: no such file of an instrument")
        text, where = path.read_text(encoding="utf-8"), str(path)
    else:
        known = {each.lower(): each for each in preset_names()}
        if str(name).lower() not in known:
            raise InputError(f"no instrument {name!r}: there are {', '.join(known.values())}, or a file NAME.toml")
        where = known[str(name).lower()]
        text = _folder().joinpath(f"{where.lower()}.toml").read_text(encoding="utf-8")
    try:
        stated = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: no TOML file that could be read ({error})") from None
    return _checked(stated, filter, where)


def _checked(stated, filter, where):
    if unknown := sorted(set(stated) - _KEYS):
        raise InputError(f"{where}: {unknown[0]} is nothing that is known of an instrument: {', '.join(sorted(_KEYS))}")
    filters = stated.pop("filters", {})
    if filter is None and len(filters) == 1:
        (filter,) = filters
    if filter is None and filters:
        raise InputError(f"{where} has several filters: give filter, one of {', '.join(filters)}")
    if filter is not None and filter not in filters:
        raise InputError(f"{where} has no filter {filter!r}: there are {', '.join(filters) or 'none'}")
    of_filter = filters.get(filter, {})
    numbers = {key: value for key, value in (stated | of_filter).items() if key in _NUMBERS}
    for key, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise InputError(f"{where}: {key} must be a number, got {value!r}")
    if "pixel_scale" not in numbers:
        raise InputError(f"{where}: pixel_scale [arcsec] is missing")
    name = str(stated.get("name", where))
    if stated.get("camera", "gsaoi") != "gsaoi" or ("camera" in stated) == ("detectors" in stated):
        raise InputError(f'{where}: there must be a table detectors, or camera = "gsaoi"')
    camera = Camera.gsaoi() if "camera" in stated else _camera(name, stated["detectors"], numbers["pixel_scale"], where)
    return numbers | {"name": name if filter is None else f"{name} {filter}", "camera": camera}


def _camera(name, stated, pixel_scale, where):
    """A `Camera` of detectors at places [arcsec] in the focal plane, none of them turned or mirrored."""
    stated, made = dict(stated), {}
    try:
        ny, nx = (int(n) for n in stated.pop("shape"))
        for key, each in stated.items():
            own = pixel_scale / float(each.get("pixel_scale", pixel_scale))
            centre = np.array([float(each["x"]), float(each["y"])]) / pixel_scale
            shift = np.array([nx - 1, ny - 1]) / 2 - own * centre
            made[key] = Detector((ny, nx), layout=np.column_stack([own * np.eye(2), shift]))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{where}: detectors must have shape = [ny, nx], and NAME = {{ x = ..., y = ... }} [arcsec] of every one "
            f"({error!r})"
        ) from None
    if not made:
        raise InputError(f"{where}: there is no detector")
    if len(made) == 1:
        return Camera(name, {key: Detector((ny, nx)) for key in made})
    return Camera(name, made)
