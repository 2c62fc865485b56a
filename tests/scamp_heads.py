"""Headers ``.head`` as SCAMP 2.10 writes them, and what they mean, by numpy alone."""

import numpy as np

#: Powers of xi and eta of PV1_k; of PV2_k those of eta and xi. PV_3 is of the radius, which SCAMP does not use.
POWERS = {0: (0, 0), 1: (1, 0), 2: (0, 1), 4: (2, 0), 5: (1, 1), 6: (0, 2), 7: (3, 0), 8: (2, 1), 9: (1, 2), 10: (0, 3)}
#: A solution of degree 3 of a detector of 1024 pixels of 0.035 arcsec.
CUBIC = (
    {0: 3.07e-6, 1: 0.99616, 2: 1.35e-4, 4: -0.273, 5: -0.128, 6: -0.189, 7: 134.3, 8: -13.2, 9: 124.5, 10: 12.8},
    {0: -7.3e-7, 1: 0.99741, 2: 4.43e-4, 4: -0.242, 5: -0.145, 6: 0.115, 7: 131.8, 8: 2.54, 9: 114.6, 10: -13.9},
)
_LETTERS = "COMMENT   (c) 2010-2018 Sorbonne Université/Université de Bordeaux/CNRS"


def barrel(strength):
    """Terms of a radial distortion, which rotations leave as it is; strength per square degree."""
    return ({1: 1.0, 7: strength, 9: strength},) * 2


def matrix(angle=0.7, scale=0.035 / 3600, flipped=True):
    """CD of a detector with its y axis at a position angle, degrees."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    return scale * np.array([[-c if flipped else c, s], [s if flipped else -s, c]])


def write_head(path, terms=CUBIC, *, cd=None, sky=(266.41, -28.95), crpix=(512.5, 512.5), encoding="utf-8", blocks=1):
    """A file ``.head``; returns its path."""
    numbers = {"CRVAL1": sky[0], "CRVAL2": sky[1], "CRPIX1": crpix[0], "CRPIX2": crpix[1]}
    cd = matrix() if cd is None else cd
    numbers |= {f"CD{i + 1}_{j + 1}": cd[i, j] for i in (0, 1) for j in (0, 1)}
    numbers |= {f"PV{i}_{k}": value for i, own in enumerate(terms, 1) for k, value in own.items()}
    lines = ["HISTORY   Astrometric solution by SCAMP version 2.10.0 (2020-12-01)", _LETTERS, "COMMENT   "]
    lines += ["EQUINOX =        2000.00000000 / Mean equinox", "RADESYS = 'ICRS    '           / Astrometric system"]
    lines += ["CTYPE1  = 'RA---TAN'           / WCS projection type for this axis"]
    lines += ["CTYPE2  = 'DEC--TAN'           / WCS projection type for this axis"]
    lines += ["CUNIT1  = 'deg     '           / Axis unit", "CUNIT2  = 'deg     '           / Axis unit"]
    lines += [f"{key:8s}= {value:20.12E} / Projection distortion parameter" for key, value in numbers.items()]
    lines += ["FLXSCALE=   3.333383171060E-02 / SCAMP relative flux scale", "END     "]
    path.write_bytes("".join(f"{line:80s}\n" for line in lines * blocks).encode(encoding))
    return path


def to_plane(x, y, terms=CUBIC, *, cd=None, crpix=(512.5, 512.5)):
    """Pixels, counted from 0, on the plane that touches the sky at CRVAL, degrees."""
    xi, eta = np.einsum("ij,j...->i...", matrix() if cd is None else cd, np.array([x + 1 - crpix[0], y + 1 - crpix[1]]))
    return [
        sum(value * a ** POWERS[k][0] * b ** POWERS[k][1] for k, value in own.items())
        for own, a, b in zip(terms, (xi, eta), (eta, xi), strict=True)
    ]


def to_sky(plane, sky=(266.41, -28.95)):
    """Right ascension and declination of a place on that plane, all in degrees."""
    xi, eta = np.radians(plane)
    ra, dec = np.radians(sky)
    ahead = np.cos(dec) - eta * np.sin(dec)
    lon = np.arctan2(xi, ahead)
    lat = np.arctan2(np.sin(dec) + eta * np.cos(dec), np.hypot(xi, ahead))
    return np.degrees([ra + lon, lat])
