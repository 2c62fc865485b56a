"""Output grids from files: the same from an image and from the text of its header, and clear words on anything else."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from stacks import scene

from legdistort.coaddition.grids import given_grid, read_grid
from legdistort.exceptions import InputError

SHAPE = (280, 300)


@pytest.fixture
def header():
    angle, scale = np.radians(30), 1e-4
    cards = {"SIMPLE": True, "BITPIX": -32, "NAXIS": 2, "NAXIS1": SHAPE[1], "NAXIS2": SHAPE[0]}
    cards |= {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 150.5, "CRPIX2": 140.5, "CRVAL1": 84.9}
    cards |= {"CRVAL2": -69.7, "CD1_1": -scale * np.cos(angle), "CD1_2": scale * np.sin(angle)}
    return fits.Header(cards | {"CD2_1": scale * np.sin(angle), "CD2_2": scale * np.cos(angle)})


def _image(path, header):
    fits.PrimaryHDU(np.zeros(SHAPE, "f4"), header).writeto(path)


def _third(path, header):
    """Compressed, behind an image without sky and a cube with another sky."""
    cube = header.copy()
    cube["CRVAL1"] = 10.0
    image = fits.CompImageHDU(np.zeros(SHAPE, "f4"), header)
    fits.HDUList([fits.PrimaryHDU(np.zeros((5, 5))), fits.ImageHDU(np.zeros((2, 5, 5)), cube), image]).writeto(path)


def _text(path, header):
    header.totextfile(path, endcard=True)


def _swarp(path, header):
    """Short lines, without the first cards; letters that FITS does not know; a second header."""
    lines = [line.rstrip() for line in repr(header).splitlines()][2:]
    path.write_text("\n".join([*lines, "COMMENT Astromatique à Paris", "END", lines[0], "END", ""]), encoding="latin-1")


FORMS = [("a.fits", _image), ("a.fits.gz", _image), ("b.fits", _third), ("a.txt", _text), ("a.head", _swarp)]


@pytest.mark.parametrize(("name", "write"), FORMS)
def test_all_forms_give_the_same_grid(tmp_path, header, name, write):
    write(tmp_path / name, header)
    grid, wanted = read_grid(tmp_path / name), WCS(header)
    assert grid.array_shape == SHAPE
    corners = np.array([[0, 0], [299, 0], [0, 279], [299, 279]])
    np.testing.assert_array_equal(grid.wcs_pix2world(corners, 0), wanted.wcs_pix2world(corners, 0))


def test_what_is_left_to_coadd(tmp_path, header):
    """No shape, no sky, three axes: told by what is returned, and refused there."""
    bare = header.copy()
    del bare["NAXIS*"]
    _text(tmp_path / "bare.head", bare)
    assert read_grid(tmp_path / "bare.head").array_shape is None
    fits.PrimaryHDU(np.zeros(SHAPE)).writeto(tmp_path / "blank.fits")
    assert not read_grid(tmp_path / "blank.fits").has_celestial
    fits.PrimaryHDU(np.zeros((2, *SHAPE)), header).writeto(tmp_path / "cube.fits")
    assert read_grid(tmp_path / "cube.fits").naxis == 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"CTYPE1": "RA---XXX", "CTYPE2": "DEC--XXX"}, "no grid can be read from it .*XXX"),
        ({"CRVAL2": 900.0}, "no grid can be read from it"),
        ({"NAXIS1": 0}, r"NAXIS1 and NAXIS2 must be positive whole numbers, got \(0, 280\)"),
        ({"NAXIS2": -3}, "positive whole numbers, got"),
        ({"NAXIS2": "many"}, "positive whole numbers, got"),
        ({"CD1_1": 1e-4, "CD1_2": 1e-4, "CD2_1": 1e-4, "CD2_2": 1e-4}, "pixels have no area"),
    ],
)
def test_headers_without_sense(tmp_path, header, changes, words):
    for key, value in changes.items():
        header[key] = value
    _text(tmp_path / "bad.head", header)
    with pytest.raises(InputError, match=rf"bad\.head: .*{words}"):
        read_grid(tmp_path / "bad.head")
    solution, *_ = scene(1)
    words = words.replace("no grid can be read from it", "no WCS can be read from the header")
    with pytest.raises(InputError, match=f"grid: .*{words}"):
        given_grid(header, solution.sky)


def test_a_reference_pixel_that_is_no_number(header):
    """A header cannot tell it, a text (1E400) and a WCS can."""
    wcs = WCS(header)
    wcs.wcs.crpix = [np.inf, 140.5]
    with pytest.raises(InputError, match=r"grid: CRPIX and CRVAL of its WCS must be finite, got \[ *inf 140.5\] and"):
        given_grid(wcs, None)


@pytest.mark.parametrize(
    "content", [b"", b"some words\nand more\n", b"\x89PNG\r\n\0\0", b"SIMPLE  = nonsense", b"\x1f\x8b"]
)
def test_files_that_are_something_else(tmp_path, content):
    (tmp_path / "bad").write_bytes(content)
    with pytest.raises(InputError, match=r"bad: (no grid can be read from it|neither a FITS file nor)"):
        read_grid(tmp_path / "bad")


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match=r"absent: no such file"):
        read_grid(tmp_path / "absent")
    with pytest.raises(InputError, match="is not a file"):
        read_grid(tmp_path)
