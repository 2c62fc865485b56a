"""FITS_LDAC tables as SExtractor writes them."""

import numpy as np
from astropy.io import fits


def write_ldac(path, *tables, size=(700, 600), images=None):
    """FITS_LDAC as SExtractor writes it: the header of the image as text before every table, with cards of `images`."""
    hdus = [fits.PrimaryHDU()]
    for table, image in zip(tables, images or [{}] * len(tables), strict=True):
        header = fits.Header(
            [("SIMPLE", True), ("BITPIX", -32), ("NAXIS", 2), ("NAXIS1", size[0]), ("NAXIS2", size[1])]
        )
        header.extend(image.items())
        text = header.tostring(endcard=True, padding=False)
        cards = np.array([[text[k : k + 80] for k in range(0, len(text), 80)]], dtype="S80")
        card = fits.Column("Field Header Card", f"{len(text)}A", array=cards, dim=f"(80, {len(text) // 80})")
        hdus += [
            fits.BinTableHDU.from_columns([card], name="LDAC_IMHEAD"),
            fits.BinTableHDU(table, name="LDAC_OBJECTS"),
        ]
    fits.HDUList(hdus).writeto(path)
    return path
