"""Headers of FITS as texts, one card a line: ``.head`` and ``.ahead`` of SCAMP and SWarp, ``Header.totextfile``."""

import re

from astropy.io import fits

from ...exceptions import AssumptionWarning, some_of, warn
from ..exposure_names import exposure_name
from .statement import read_statement
from .wcs_cards import header_of_image

#: Endings of such files.
TEXTS = ".head", ".ahead"
_COMMENT = 47  # letters that fit beside a number in a card
_END = re.compile(r"^END *$", re.MULTILINE)
#: A card without which a text is no header that leads anywhere.
_FIRST = re.compile(r"^(CTYPE1|SIMPLE) *=", re.MULTILINE)


def read_text(path):
    """The text of a file in which letters that FITS does not know are question marks.

    SCAMP has such letters in its comments, in UTF-8 or Latin-1 as it was built; no card of a WCS has any.
    """
    return path.read_text(encoding="ascii", errors="replace").replace("\ufffd", "?")


def is_header(text):
    """Whether a text is that of a header."""
    return _FIRST.search(text) is not None


def headers_of(text):
    """The headers in a text, each up to its END, as a list of `~astropy.io.fits.Header`."""
    return [fits.Header.fromstring(block, sep="\n") for block in _END.split(text) if block.strip()]


def text_of(headers):
    """The text of several headers, in the order of the images of a file."""
    blocks = [[*each.tostring(sep="\n", endcard=False, padding=False).splitlines(), "END"] for each in headers]
    return "".join(f"{line.rstrip()}\n" for block in blocks for line in block)


def detector_cards(hdulist, number):
    """Gain and saturation of an image under the keywords that SWarp reads, where its header has others for these."""
    data, cards = hdulist[number].data, fits.Header()
    header = header_of_image(hdulist[0].header, hdulist[number].header)
    stated = read_statement(header, data, integer=False)
    for keyword, each in (("GAIN", stated.gain), ("SATURATE", stated.saturation)):
        if each.value is not None and header.get(keyword) != each.value:
            cards[keyword] = each.value, f"by {each.source}"[:_COMMENT]
    return cards


def beside(path):
    """Where SWarp looks for the headers of a file, instead of those that are in it."""
    return path.with_name(f"{exposure_name(path)}{TEXTS[0]}")


def warn_of_texts(paths):
    """Warn of texts beside files that get new headers, which are read in the place of these."""
    if there := [str(text) for text in map(beside, paths) if text.is_file()]:
        warn(
            f"beside {len(there)} of the files written stands a text .head ({some_of(there, 3)}), which SWarp reads in "
            "the place of the new header: remove it, or write it anew, kind='head' (--head)",
            AssumptionWarning,
        )
