"""The options of ``legdistort predict``, as in `legdistort.cli.options`."""

from pathlib import Path

from ..runtime import words
from .arguments import Option, length, sized_terms, spectrum
from .options import KNOWN_STATIC, PICTURE_ENDINGS

#: Arguments of `legdistort.predict`.
PREDICTING = {
    "n_exposures": Option("how many", type=int, required=True),
    "n_stars": Option("so many, drawn evenly over the field", type=int, one_of="stars", required=True),
    "density": Option("the same, as stars a detector", type=float, one_of="stars", required=True),
    "stars": Option(
        "x, y in the reference plane, maybe x_err, y_err, mag; or a luminosity function: mag, density (1/mag/arcmin2)",
        metavar="TABLE",
        path="read",
        one_of="stars",
        required=True,
    ),
    "sigma": Option("error of one measured position, pixels (default: x_err, y_err)", type=length, metavar="LENGTH"),
    "degree": Option("total degree to be fitted (default 3)", type=int),
    "dithers": Option("rms length of the shifts, pixels (default 0)", "--dither", type=length, metavar="LENGTH"),
    **KNOWN_STATIC,
    "dynamic": Option("rms of a coefficient from exposure to exposure, pixels", type=length, metavar="LENGTH"),
    "spectrum": Option("the same by degree, beyond the fit too", type=spectrum, metavar="DEGREE=RMS,..."),
    "epochs": Option("years of the exposures: motions are fitted too", type=float, nargs="+", metavar="YEAR"),
    "pixel_scale": Option(
        "the errors in mas; lengths may then be angles: --sigma 0.4mas", type=float, metavar="ARCSEC"
    ),
    "terms": Option(
        f"what displaces stars and will be found too, and its size: {', '.join(words.SIZED_TERMS)}=SIZE:LENGTH"
        "[:SMOOTHNESS[:RATIO:ANGLE]]",
        "--term",
        type=sized_terms(words.SIZED_TERMS),
        action="extend",
        metavar="NAME=SIZE,...",
    ),
    "tan_z": Option("of the zenith distances of the exposures", type=float, nargs="+", metavar="TAN"),
    "parallactic_angle": Option("of the exposures, degrees", type=float, nargs="+", metavar="DEG"),
    "seed": Option("of stars and shifts that are drawn (default 0)", type=int),
}
#: Of `legdistort.Instrument.named`, and of `legdistort.Instrument`.
INSTRUMENT = {
    "name": Option(
        "errors from the magnitudes of --stars: GSAOI, MAVIS, MICADO, NIRC2, NIRCam-LW, NIRCam-SW, or a TOML file",
        "--instrument",
        metavar="NAME",
    ),
    "filter": Option("of the instrument", metavar="NAME"),
    "psf": Option("FITS of stpsf, TIPTOP or MAVISIM, or what measure takes", metavar="FILE", path="read"),
    "exposure_time": Option("of one integration, seconds", type=float, metavar="SECONDS"),
}
EXPOSURES = {
    "n_coadds": Option("integrations added up to an exposure (default 1)", "--coadds", type=int, metavar="N"),
    "sky_brightness": Option("magnitudes a square arcsec (default: of the instrument)", type=float, metavar="MAG"),
    "zero_point": Option("magnitude of 1 electron a second (default: of the instrument)", type=float, metavar="MAG"),
    "read_noise": Option("of an integration (default: of the instrument)", type=float, metavar="ELECTRONS"),
    "full_well": Option("a fuller pixel saturates (default: of the instrument)", type=float, metavar="ELECTRONS"),
    "min_snr": Option("signal to noise of the faintest stars (default 5)", type=float),
    "error_floor": Option("added in quadrature to the errors, pixels", type=float, metavar="PIXELS"),
    "psf_scale": Option("of a sample of the PSF, where its file does not state it", type=float, metavar="ARCSEC"),
}
PICTURE_OF_ERRORS = {
    "plot_errors": Option(
        "picture of errors against magnitude", type=Path, metavar="FILE.png", path="file", endings=PICTURE_ENDINGS
    )
}
