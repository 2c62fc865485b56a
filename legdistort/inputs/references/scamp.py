"""Catalogues that SCAMP writes, and those that it reads as a reference: names, ellipses of errors, motions unknown."""

import numpy as np
from astropy import units as u

#: How SCAMP calls the columns of a reference, in small letters; ``X_WORLD`` and ``OBSDATE`` where it reads one.
NAMES = {
    "alpha_j2000": "ra", "delta_j2000": "dec", "x_world": "ra", "y_world": "dec", "pmalpha_j2000": "pmra",
    "pmdelta_j2000": "pmdec", "pmalphaerr_j2000": "pmra_error", "pmdeltaerr_j2000": "pmdec_error",
    "parallax_world": "parallax", "parallaxerr_world": "parallax_error", "obsdate": "ref_epoch", "epoch": "ref_epoch",
}  # fmt: skip
_ELLIPSE = "erra_world", "errb_world", "errtheta_world"
#: What SCAMP writes as 0 with an error of 0 where it did not fit it.
_UNFITTED = ("pmra", "pmdec"), ("parallax",)


def of_scamp(table):
    """The table with names, errors and motions as `read_reference` knows them, if it is one of SCAMP; else as it is.

    The ellipse of the errors (``ERRA_WORLD``, ``ERRB_WORLD``, ``ERRTHETA_WORLD`` from east to north) becomes errors and
    a correlation. Motions and parallaxes that are zero to zero are unknown.
    """
    own = {name.lower(): name for name in table.colnames}
    if not set(_ELLIPSE) <= own.keys() or "ra" in own:
        return table
    table = table.copy()
    for name, known in NAMES.items():
        if name in own and known not in table.colnames:
            table.rename_column(own[name], known)
    a, b, theta = (u.Quantity(table[own[name]], u.deg).to_value(u.mas if "theta" not in name else u.rad)
                   for name in _ELLIPSE)  # fmt: skip
    cos, sin = np.cos(theta), np.sin(theta)
    east, north = np.hypot(a * cos, b * sin), np.hypot(a * sin, b * cos)
    across = (a**2 - b**2) * sin * cos
    table["ra_error"], table["dec_error"] = east * u.mas, north * u.mas
    table["ra_dec_corr"] = np.divide(across, east * north, out=np.zeros(len(table)), where=east * north > 0)
    for names in _UNFITTED:
        errors = [f"{name}_error" for name in names]
        if not set(errors) <= set(table.colnames):
            continue
        fitted = np.all([np.asarray(table[error]) > 0 for error in errors], axis=0)
        if not fitted.any():
            table.remove_columns([*names, *errors])
            continue
        for name in (*names, *errors):
            table[name] = u.Quantity(np.where(fitted, np.asarray(table[name], dtype=float), np.nan), table[name].unit)
    return table
