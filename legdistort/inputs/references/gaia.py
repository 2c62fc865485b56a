"""Gaia by name: the stars around a field from the archive, kept in a folder of the user's for the next time."""

import logging
import os
import re
from contextlib import ExitStack, closing
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord, UnitSphericalRepresentation

from ...exceptions import InputError
from ...geometry.detector_modes import detector_corners
from ...geometry.similarity import apply_inverses
from ...runtime.checks import first_line
from ..table_files import write_table

log = logging.getLogger(__name__)

#: The word for it, in place of a file.
GAIA = "gaia"
#: The archive (https://www.cosmos.esa.int/gaia); by the environment variable another that speaks TAP, as the Virtual
#: Observatory has it, and has the same table.
ARCHIVE, VARIABLE = "https://gea.esac.esa.int/tap-server/tap", "LEGDISTORT_GAIA_TAP"
_TABLE = "gaiadr3"
_ASTROMETRY = "ra", "dec", "parallax", "pmra", "pmdec"
_COLUMNS = (
    "source_id", "ref_epoch", *_ASTROMETRY, *(f"{name}_error" for name in _ASTROMETRY),
    "ra_dec_corr", "ra_parallax_corr", "ra_pmra_corr", "ra_pmdec_corr", "dec_parallax_corr", "dec_pmra_corr",
    "dec_pmdec_corr", "parallax_pmra_corr", "parallax_pmdec_corr", "pmra_pmdec_corr", "phot_g_mean_mag", "ruwe",
)  # fmt: skip
#: Farther than the field reaches, as a part of that, for other exposures of it, and beside it: headers point some
#: arcsec off, and stars move.
_WIDER, _BESIDE = 1.1, 15 * u.arcsec
_INSTEAD = "give a table of its stars (reference=, --reference FILE), or try again later"


def is_gaia(reference):
    """Whether a reference is the word for Gaia, and no file of that name."""
    return isinstance(reference, str) and reference.lower() == GAIA and not Path(reference).exists()


def check_gaia():
    """Raise `InputError` if what speaks to the archive is not installed."""
    try:
        import pyvo  # noqa: F401
    except ImportError:
        raise InputError(
            "reference='gaia' (--reference gaia) asks the archive by pyvo, which is not installed: pip install "
            "'legdistort[gaia]'; or give a table of its stars"
        ) from None


def gaia_around(matches):
    """The file of the stars of Gaia DR3 around the field of some matches, from the archive unless it is there already.

    Parameters
    ----------
    matches : Matches
        With a sky.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        If the matches have no sky, pyvo is not installed, the archive does not answer, or has no star there.
    """
    if matches.sky is None:
        raise InputError(
            "reference='gaia' (--reference gaia) needs to know where the field lies, and no header has a WCS on the "
            "sky: give one, or a table of the stars with x, y"
        )
    places, folder = _corners(matches), _folder()
    if (kept := _kept(folder, places)) is not None:
        log.info("Gaia DR3: the stars in %s, of an earlier request", kept)
        return kept
    check_gaia()
    middle = SkyCoord(places.cartesian.mean().represent_as(UnitSphericalRepresentation))
    ra, dec, size = middle.ra.deg, middle.dec.deg, _WIDER * _reach(middle, places)
    table = _asked(
        f"SELECT {', '.join(_COLUMNS)} FROM {_TABLE}.gaia_source "
        f"WHERE 1 = CONTAINS(POINT('ICRS', ra, dec), CIRCLE('ICRS', {ra:.7f}, {dec:.7f}, {size:.7f}))"
    )
    if not len(table):
        raise InputError(f"Gaia DR3 has no star within {60 * size:.2f} arcmin of ra {ra:.5f}, dec {dec:.5f} deg")
    path = folder / f"{_TABLE}_{ra:.7f}_{dec:+.7f}_{size:.7f}.ecsv"
    write_table(table, path, overwrite=True)
    log.info("Gaia DR3: %d stars from %s, kept in %s", len(table), _archive(), path)
    return path


def _corners(matches):
    """The corners of all exposures on the sky."""
    corners = detector_corners([matches.shapes[name] for name in matches.names])
    poses = np.stack([matches.poses[name] for name in matches.names])
    return matches.sky.to_sky(apply_inverses(poses, corners).reshape(-1, 2))


def _reach(middle, places):
    """Radius [deg] of a cone that holds places, wherever their headers point within `_BESIDE`."""
    return (middle.separation(places).max() + _BESIDE).to_value(u.deg)


def _archive():
    return os.environ.get(VARIABLE) or ARCHIVE


def _folder():
    """Where requests are kept: of astropy's kind, ``~/.legdistort/cache`` unless XDG_CACHE_HOME says another."""
    from astropy.config import get_cache_dir

    folder = Path(get_cache_dir("legdistort")) / "gaia"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}, where stars of Gaia are kept, cannot be made: {error}") from None
    return folder


def _kept(folder, places):
    """The smallest of the cones kept in a folder that holds places on the sky; None if none does."""
    found = []
    for path in folder.glob(f"{_TABLE}_*.ecsv"):
        if numbers := re.fullmatch(rf"{_TABLE}_([\d.]+)_([-+][\d.]+)_([\d.]+)\.ecsv", path.name):
            ra, dec, size = map(float, numbers.groups())
            if _reach(SkyCoord(ra, dec, unit="deg"), places) <= size:
                found.append((size, path))
    return min(found)[1] if found else None


def _asked(query):
    """The table that an archive answers with."""
    import pyvo
    from pyvo.utils.http import create_session

    try:
        with ExitStack() as opened:  # pyvo leaves connections open where it does not read an answer to its end
            session = opened.enter_context(closing(create_session()))

            def close_later(response, *_, **__):
                opened.callback(response.close)

            session.hooks["response"].append(close_later)
            return pyvo.dal.TAPService(_archive(), session=session).run_async(query).to_table()
    except Exception as error:  # requests, pyvo and the server raise what they like
        raise InputError(
            f"the archive of Gaia ({_archive()}) gives no stars: {first_line(error)}; {_INSTEAD}"
        ) from None
