"""Files that claim or unpack to more than anybody has are refused by what they say, before the memory is filled."""

import bz2
import gzip
import io
import lzma
import resource
import subprocess
import sys
import zipfile

import numpy as np
import pytest
from astropy.io import fits

import legdistort as ld
from legdistort.coaddition.grids import read_grid
from legdistort.exceptions import InputError
from legdistort.inputs.table_files import read_table
from legdistort.measurement.effective.sources import read_psf
from legdistort.runtime import fits_bytes
from legdistort.runtime.fits_bytes import read_bytes

HUGE = 100_000_000_000


def header(cards):
    """Bytes of a header without data."""
    text = "".join(f"{key:8s}= {value!s:>20s}".ljust(80) for key, value in cards.items()) + "END".ljust(80)
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


IMAGE = {"SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": 500_000, "NAXIS2": HUGE // 4 // 500_000}
EMPTY = {"SIMPLE": "T", "BITPIX": 8, "NAXIS": 0, "EXTEND": "T"}
TABLE = EMPTY, {"XTENSION": "'BINTABLE'", "BITPIX": 8, "NAXIS": 2, "NAXIS1": 8, "NAXIS2": HUGE // 8, "PCOUNT": 0,
                "GCOUNT": 1, "TFIELDS": 1, "TTYPE1": "'x       '", "TFORM1": "'1D      '"}  # fmt: skip


def read_frame(path):
    return ld.read_exposures(path)


def attach(path):
    return fits_bytes.locate(read_bytes(path)[0], path)


@pytest.mark.parametrize("read", [read_frame, read_grid, read_psf, read_table, ld.Prior.from_file, attach])
@pytest.mark.parametrize("cards", [(IMAGE,), TABLE], ids=["image", "table"])
def test_a_header_that_claims_100_gb_is_refused(tmp_path, read, cards):
    path = tmp_path / "claim.fits"
    path.write_bytes(b"".join(map(header, cards)) + bytes(2880 * 4))
    with pytest.raises(InputError, match=r"HDU \d [A-Z]*\s*claims 100000000000 bytes|the data of HDU \d .* incomplete"):
        read(path)


def test_what_is_refused_names_the_size_and_the_limit(tmp_path):
    path = tmp_path / "claim.fits"
    path.write_bytes(header(IMAGE) + bytes(2880))
    with pytest.raises(InputError, match=r"HDU 0 PRIMARY claims 100000000000 bytes, more than .* than 2147483648"):
        ld.read_exposures(path)
    with pytest.raises(InputError, match="claims 100000000000 bytes"):
        ld.open_exposures([path], left_out={})


def test_a_compressed_image_of_nothing(tmp_path):
    path = tmp_path / "packed.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(np.zeros((64, 64), "i2"), name="SCI")]).writeto(path)
    content = path.read_bytes()
    for key in ("ZNAXIS1", "ZNAXIS2"):
        before = f"{key:8s}= {64:20d}".encode()
        assert content.count(before) == 1
        content = content.replace(before, f"{key:8s}= {300_000:20d}".encode())
    path.write_bytes(content)
    with pytest.raises(InputError, match="HDU 1 SCI claims 180000000000 bytes"):
        ld.read_exposures(path)


def packed(kind, content):
    if kind == "zip":
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.fits", content)
        return file.getvalue()
    return {"gz": gzip, "bz2": bz2, "xz": lzma}[kind].compress(content)


@pytest.mark.parametrize("kind", ["gz", "bz2", "xz", "zip"])
def test_what_unpacks_beyond_the_limit_is_refused(tmp_path, monkeypatch, kind):
    plain, path = tmp_path / "plain.fits", tmp_path / f"frame.fits.{kind}"
    fits.writeto(plain, np.arange(40 * 50.0).reshape(40, 50))
    path.write_bytes(packed(kind, plain.read_bytes() + b"\0" * 100_000))
    (frame,) = ld.read_exposures(path)
    np.testing.assert_array_equal(frame.data, fits.getdata(plain))
    monkeypatch.setattr(fits_bytes, "MAX_BYTES", 50_000)
    readers = [read_frame, ld.Prior.from_file, read_grid, read_table, read_psf, attach]
    for read in readers if kind in ("gz", "bz2") else [read_frame]:
        with pytest.raises(InputError, match="is refused: it unpacks to more than 50000 bytes; if you trust"):
            read(path)
    path.write_bytes(packed(kind, plain.read_bytes())[:-40])
    with pytest.raises(InputError, match="damaged"):
        ld.read_exposures(path)


BOMB = """
import resource, sys
import legdistort as ld
from legdistort.inputs.table_files import read_table
ld.read_exposures, ld.Prior
resource.setrlimit(resource.RLIMIT_AS, (5 << 30, 5 << 30))
for read in (ld.read_exposures, read_table):
    try:
        read(sys.argv[1])
    except ld.exceptions.InputError as error:
        print(str(error))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 5 << 20)
"""


@pytest.mark.slow
def test_ten_megabytes_that_unpack_to_ten_gigabytes(tmp_path):
    path = tmp_path / "bomb.fits.gz"
    path.write_bytes(gzip.compress(header(IMAGE)) + 100 * gzip.compress(bytes(100_000_000)))
    assert path.stat().st_size < 11_000_000
    run = subprocess.run([sys.executable, "-c", BOMB, path], capture_output=True, text=True, check=False)
    assert run.stdout.count("unpacks to more than 2147483648 bytes") == 2, run.stdout + run.stderr
    assert run.stdout.endswith("True\n")


LITTLE = """
import resource, sys
from legdistort.cli.parser import main
import legdistort.inputs.exposure_files
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
sys.exit(main(["measure", sys.argv[1], "--out", sys.argv[2], "--quiet"]))
"""


def test_little_memory_is_told_in_one_line(tmp_path):
    """A header that claims what is allowed but not there, and a limit of the process."""
    path = tmp_path / "claim.fits"
    path.write_bytes(header(IMAGE | {"NAXIS2": 1000}) + bytes(2880))
    arguments = [sys.executable, "-c", LITTLE, path, tmp_path / "out.ecsv"]
    run = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert run.stderr.count("\n") == 1, run.stderr
    assert "memory" in run.stderr or "damaged" in run.stderr
    assert [item.name for item in tmp_path.iterdir()] == ["claim.fits"]
    assert resource.getrlimit(resource.RLIMIT_AS)[0] != 1 << 30
