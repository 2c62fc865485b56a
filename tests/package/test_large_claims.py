"""Files that claim or unpack to more than anybody has are refused by what they say, before the memory is filled."""

import bz2
import gzip
import io
import lzma
import resource
import subprocess
import sys
import zipfile

import asdf
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
from legdistort.runtime.guards import memory

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
    with pytest.raises(InputError, match="HDU 0 PRIMARY claims 100000000000 bytes, there are 2880 in the file"):
        ld.read_exposures(path)
    with pytest.raises(InputError, match="claims 100000000000 bytes"):
        ld.open_exposures([path], left_out={})


@pytest.mark.parametrize(
    ("card", "words"),
    [("NAXIS1", "a header has NAXIS1 twice, 50 and"), ("NAXIS", r"NAXIS = \d+ in a header; FITS has")],
)
def test_sizes_that_are_stated_twice(tmp_path, card, words):
    path = tmp_path / "twice.fits"
    second = f"{card:8s}= {2**40:20d}".ljust(80)
    content = header({"SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": 50, "NAXIS2": 40, "BLANK": 1})
    path.write_bytes(content.replace(f"BLANK   = {1:20d}".ljust(80).encode(), second.encode()) + bytes(4 * 2880))
    for read in (read_frame, read_psf, read_table, attach):
        with pytest.raises(InputError, match=words):
            read(path)


def test_sizes_that_are_no_numbers(tmp_path):
    path = tmp_path / "text.fits"
    path.write_bytes(header({"SIMPLE": "T", "BITPIX": -32, "NAXIS": 2, "NAXIS1": 10**9, "NAXIS2": "'x'"}) + bytes(2880))
    for read in (read_frame, read_psf, read_table, attach):
        with pytest.raises(InputError, match="NAXIS2 = 'x' in a header is no number"):
            read(path)


@pytest.mark.parametrize(("key", "value"), [("GCOUNT", -1), ("PCOUNT", -9), ("NAXIS1", -8), ("NAXIS2", -(2**40))])
def test_sizes_below_zero(tmp_path, key, value):
    """They lead back to before the header, which then follows itself without end."""
    path = tmp_path / "negative.fits"
    image = {"XTENSION": "'IMAGE   '", "BITPIX": 16, "NAXIS": 2, "NAXIS1": 48, "NAXIS2": 40, "PCOUNT": 0, "GCOUNT": 1}
    path.write_bytes(header(EMPTY) + header(image | {key: value}) + bytes(2880 * 4))
    for read in (read_frame, read_psf, read_grid, read_table, ld.Prior.from_file, attach):
        with pytest.raises(InputError, match=f"{key} = {value} in a header; FITS has 0 or more"):
            read(path)


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
    monkeypatch.setattr(memory, "MAX_BYTES", 50_000)
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
from legdistort.runtime.guards import memory
readers = {"frames": ld.read_exposures, "table": read_table, "prior": ld.Prior.from_file, "solution": ld.Solution.read}
memory.ANY_BYTES >>= 2  # to save time
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
size = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (size + (300 << 20), size + (300 << 20)))
for each in sys.argv[1:]:
    name, _, path = each.partition("=")
    try:
        readers[name](path)
    except ld.exceptions.InputError as error:
        print(name, str(error))
        assert path in str(error), error
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300 << 10)
"""


def bombs(folder):
    """Small files that hold, or claim to hold, gigabytes."""
    start, nothing = header(IMAGE), bytes(4_000_000)
    (folder / "b.fits.gz").write_bytes(gzip.compress(start) + 20 * gzip.compress(nothing))
    (folder / "b.fits.bz2").write_bytes(bz2.compress(start) + 20 * bz2.compress(nothing))
    (folder / "b.ecsv.xz").write_bytes(20 * lzma.compress(nothing))
    (folder / "b.csv.gz").write_bytes(20 * gzip.compress(nothing.replace(b"\0", b"1")))
    (folder / "b.vot").write_bytes(
        b'<VOTABLE><RESOURCE><TABLE nrows="300000000"><FIELD name="x" datatype="int"/><DATA><TABLEDATA/></DATA></TABLE>'
        b"</RESOURCE></VOTABLE>"
    )
    for name, packing in (("z", "zlib"), ("b", "bzp2")):
        asdf.AsdfFile({"roman": {"data": np.zeros(10_000_000)}}).write_to(
            folder / f"{name}.asdf", all_array_compression=packing
        )
    tiles = fits.CompImageHDU(np.zeros((64, 64), "i2"), name="SCI")
    fits.HDUList([fits.PrimaryHDU(), tiles]).writeto(folder / "tiles.fits")
    content = (folder / "tiles.fits").read_bytes()
    for key in (b"ZNAXIS1", b"ZNAXIS2"):
        content = content.replace(b"%-8s= %20d" % (key, 64), b"%-8s= %20d" % (key, 20_000))
    (folder / "tiles.fits").write_bytes(content)
    (folder / "image.fits").write_bytes(header(IMAGE | {"NAXIS2": 100_000}) + bytes(2880))
    return sorted(folder.iterdir())


BOMBS = {
    "frames=b.fits.gz": "it unpacks to more than 67108864 bytes; if you trust it, unpack it first",
    "table=b.fits.bz2": "it unpacks to more than 67108864 bytes",
    "table=b.ecsv.xz": "it unpacks to more than 67108864 bytes",
    "table=b.csv.gz": "it unpacks to more than 67108864 bytes",
    "table=b.vot": "a table in it claims 4800000000 bytes",
    "solution=z.asdf": "its arrays take 80000000 bytes and more when unpacked. 67108864 bytes are allowed",
    "frames=z.asdf": "its arrays take 80000000 bytes and more",
    "frames=b.asdf": "its arrays take 80000000 bytes and more",
    "solution=b.asdf": "is packed with b'bzp2'",
    "frames=tiles.fits": "claims 800000000 bytes, of 8640 in the file at most 67108864 can come",
    "prior=image.fits": "claims 200000000000 bytes, there are 2880 in the file; it is cut off",
}


def test_bombs_are_refused_with_their_names_before_they_fill_the_memory(tmp_path):
    assert all(path.stat().st_size < 3_000_000 for path in bombs(tmp_path))
    asked = [each.replace("=", f"={tmp_path}/") for each in BOMBS]
    run = subprocess.run([sys.executable, "-c", BOMB, *asked], capture_output=True, text=True, check=False)
    *said, small = run.stdout.splitlines()
    assert small == "True", run.stdout + run.stderr
    assert len(said) == len(BOMBS), run.stdout
    for line, (each, words) in zip(said, BOMBS.items(), strict=True):
        assert words in line, (each, line)


LITTLE = """
import resource, sys
from legdistort.cli.parser import main
import legdistort.inputs.exposure_files
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
sys.exit(main(["measure", sys.argv[1], "--out", sys.argv[2], "--quiet"]))
"""


@pytest.mark.slow
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
