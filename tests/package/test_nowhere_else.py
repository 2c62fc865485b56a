"""No file makes the package go elsewhere: every format with references, in every reader, with a server that listens."""

import base64
import bz2
import gzip
import http.server
import io
import json
import pickle
import socket
import threading
import tracemalloc
import warnings

import asdf
import fuzz
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import CIRS, EarthLocation
from astropy.io import fits
from astropy.modeling import models
from astropy.table import Table
from astropy.time import Time
from astropy.utils.data import conf
from gwcs import coordinate_frames as cf
from gwcs.wcs import WCS as GWCS

import legdistort as ld
from legdistort.coaddition.grids import read_grid
from legdistort.exceptions import InputError, LegdistortError
from legdistort.inputs.references.catalogue import read_reference
from legdistort.inputs.sky_wcs import believable_wcs
from legdistort.inputs.table_files import read_table
from legdistort.measurement.effective.sources import read_psf
from legdistort.measurement.noise_curves import NoiseCurves
from legdistort.runtime.fits_bytes import locate, read_bytes
from legdistort.runtime.guards.offline import offline

SECRET = b"TOPSECRET"
#: A time for which the rotation of the Earth is in no table that is installed.
FAR = Time(61771.0, format="mjd", scale="ut1")


@pytest.fixture(scope="module")
def server():
    """``(address, paths that were asked for)`` of a server that answers everything with a secret."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(SECRET * 8)

        do_HEAD = do_POST = do_GET

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as listening:
        thread = threading.Thread(target=listening.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{listening.server_port}", asked
        listening.shutdown()
        thread.join()


@pytest.fixture
def alone(server, monkeypatch):
    """Whatever connects, or looks a name up, is noted and fails; to be checked at the end."""
    tried = []

    def refuse(*arguments, **_):
        tried.append(arguments)
        raise OSError("a test connects to nobody")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket.socket, "connect_ex", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    yield server[0]
    assert tried == []
    assert server[1] == []


READERS = {
    "frames": ld.read_exposures,
    "opened": lambda path: [exposure.read() for exposure in ld.open_exposures(path)],
    "table": lambda path: read_table(path, error=0.1),
    "reference": read_reference,
    "solution": ld.Solution.read,
    "wcs": ld.read_wcs,
    "prior": ld.Prior.from_file,
    "camera": ld.Camera.read,
    "psf": read_psf,
    "grid": read_grid,
    "noise": NoiseCurves.read,
    "attach": lambda path: locate(read_bytes(path)[0], path),
}


def words(found):
    """All that a result holds, as bytes."""
    try:
        return pickle.dumps(found)
    except Exception:  # some objects of astropy are not to be pickled
        return repr(found).encode()


def read_everywhere(path):
    """What every reader says of a file; none may bring the secret."""
    said = {}
    for name, read in READERS.items():
        with warnings.catch_warnings(action="ignore"):
            try:
                found = words(read(path))
                said[name] = None
            except LegdistortError as error:
                found = said[name] = str(error)
                assert path.name in found or "table" in found, (name, found)
                found = found.encode()
        for form in (SECRET, SECRET.decode().encode("utf-16-le"), SECRET.decode().encode("utf-32-le")):
            assert form not in found, name
    return said


# --- VOTable -----------------------------------------------------------------------------------------------------


def votable(inside, before="", fields=""):
    fields = fields or '<FIELD name="x" datatype="double"/><FIELD name="s" datatype="char" arraysize="8"/>'
    return (
        f'<?xml version="1.0"?>{before}<VOTABLE version="1.3"><RESOURCE><TABLE>{fields}<DATA>{inside}</DATA></TABLE>'
        "</RESOURCE></VOTABLE>"
    ).encode()


STREAMS = {
    "binary": '<BINARY><STREAM href="{}"/></BINARY>',
    "binary2": '<BINARY2><STREAM href="{}" encoding="gzip"/></BINARY2>',
    "fits": '<FITS extnum="1"><STREAM href="{}"/></FITS>',
    "parquet": '<PARQUET type="VOTable-remote-file"><STREAM href="{}"/></PARQUET>',
    "prefix": '<v:BINARY xmlns:v="v"><v:STREAM href="{}"/></v:BINARY>',
    "include": '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="{}"/>',
}
PACKED = {
    "": bytes,
    "gz": gzip.compress,
    "bz2": bz2.compress,
    "twice": lambda content: gzip.compress(gzip.compress(content)),
    "utf-16": lambda content: content.decode().replace('"1.0"?', '"1.0" encoding="utf-16"?').encode("utf-16"),
}


@pytest.mark.parametrize("kind", STREAMS)
@pytest.mark.parametrize("packing", PACKED)
def test_votables_fetch_nothing(alone, tmp_path, kind, packing):
    (tmp_path / "secret.bin").write_bytes(SECRET * 8)
    for place in (f"{alone}/beacon", f"file://{tmp_path}/secret.bin", "file:secret.bin"):
        path = tmp_path / "table.vot"
        path.write_bytes(PACKED[packing](votable(STREAMS[kind].format(place))))
        with pytest.raises(InputError, match=r"table\.vot") as caught:
            read_table(path)
        if packing != "twice":
            assert f"href='{place}'" in str(caught.value)
            assert "no other file or address is opened" in str(caught.value)
    if packing == "":
        read_everywhere(path)


def test_entities_of_votables(alone, tmp_path):
    (tmp_path / "secret.bin").write_bytes(SECRET)
    rows = "<TABLEDATA><TR><TD>1</TD><TD>&e;</TD></TR></TABLEDATA>"
    laughs = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 12))
    for before in (
        f'<!DOCTYPE V [<!ENTITY e SYSTEM "file://{tmp_path}/secret.bin">]>',
        f'<!DOCTYPE V [<!ENTITY e SYSTEM "{alone}/e">]>',
        f'<!DOCTYPE V [<!ENTITY % p SYSTEM "{alone}/p"> %p;]>',
        f'<!DOCTYPE V [<!ENTITY e0 "ha">{laughs}<!ENTITY e "&e11;">]>',
    ):
        path = tmp_path / "table.vot"
        path.write_bytes(votable(rows, before))
        with pytest.raises(InputError, match=r"table.vot: is refused: it defines words of its own"):
            read_table(path)
    plain = votable(
        "<TABLEDATA><TR><TD>1</TD><TD>a</TD></TR></TABLEDATA>", f'<!DOCTYPE VOTABLE SYSTEM "{alone}/v.dtd">'
    )
    path.write_bytes(plain)  # as tables of long ago have it; nobody fetches it
    assert read_table(path)["s"].tolist() == ["a"]


@pytest.mark.parametrize(
    ("fields", "rows"),
    [
        ('<FIELD name="x" datatype="double" arraysize="1000000x1000000"/>', "<TR><TD>1</TD></TR>"),
        ('<FIELD name="x" datatype="char" arraysize="100000*"/>', 3000 * "<TR><TD>1</TD></TR>"),
    ],
)
def test_votables_claim_no_more_than_they_can_hold(tmp_path, fields, rows):
    path = tmp_path / "table.vot"
    path.write_bytes(votable(f"<TABLEDATA>{rows}</TABLEDATA>", fields=fields))
    tracemalloc.start()
    with pytest.raises(
        InputError, match=r"a table in it claims \d+ bytes, where its text lets expect 268435456 at most"
    ):
        read_table(path)
    assert tracemalloc.get_traced_memory()[1] < 50_000_000
    tracemalloc.stop()
    path.write_bytes(votable("<TABLEDATA/>").replace(b"<TABLE>", b'<TABLE nrows="1000000000000">'))
    with pytest.raises(InputError, match="claims"):
        read_table(path)


# --- other texts -------------------------------------------------------------------------------------------------


def ecsv(meta, columns="# - {name: x, datatype: float64}", rows="x\n1.0\n"):
    return f"# %ECSV 1.0\n# ---\n# datatype:\n{columns}\n{meta}# schema: astropy-2.0\n{rows}".encode()


def far_times():
    """A column of times that need a table of the Earth's rotation which nobody has yet."""
    file = io.StringIO()
    Table({"time": Time([FAR]), "x": [1.0]}).write(file, format="ascii.ecsv")
    return file.getvalue().encode()


def laughing(levels=30):
    """A header of YAML that takes all memory when its aliases are written out."""
    lists = [f"#   a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, levels)]
    return "\n".join(["# meta:", "#   a0: &a0 [1]", *lists]) + "\n"


TEXTS = {
    "python.ecsv": lambda p: ecsv(f"# meta: {{a: !!python/object/apply:os.system [touch {p}/made]}}\n"),
    "new.ecsv": lambda p: ecsv(f"# meta: {{a: !!python/object/new:pathlib.Path [{p}/made]}}\n"),
    "laughs.ecsv": lambda p: ecsv(laughing()),
    "deep.ecsv": lambda p: ecsv(f"# meta: {'[' * 100_000}\n"),
    "class.ecsv": lambda p: ecsv(
        "# meta: !!omap\n# - __serialized_columns__:\n#     s: {__class__: os.system, command: touch made}\n"
    ),
    "array.ecsv": lambda p: ecsv(
        "# meta: {a: !numpy.ndarray {buffer: !!binary AAAA, dtype: object, order: C, shape: !!python/tuple [1]}}\n"
    ),
    "huge.ecsv": lambda p: ecsv(
        "# meta: {a: !numpy.ndarray {buffer: !!binary AAAA, dtype: int8, order: C, shape: !!python/tuple [99999999]}}\n"
    ),
    "times.ecsv": lambda p: far_times(),
    "page.html": lambda p: b'<html><img src="URL/i"><table><tr><th>x<th>y</tr><tr><td>1<td>2</tr></table></html>',
    "line.csv": lambda p: b"URL/table.csv",
    "line.ecsv": lambda p: b"URL/table.ecsv",
    "lines.ecsv": lambda p: b"URL/table.ecsv\n1\n",
    "lines.cat": lambda p: b"#   1 NUMBER\nURL/table.ecsv\n1\n",
    "file.csv": lambda p: f"file://{p}/secret.bin\n".encode(),
    "path.txt": lambda p: f"{p}/secret.bin".encode(),
    "list.txt": lambda p: f"@{p}/secret.bin\nx y\n1 2\n".encode(),
    "summary.json": lambda p: json.dumps({"files": {"URL/x": "0"}, "$ref": f"file://{p}/secret.bin"}).encode(),
    "cards.head": lambda p: b"SIMPLE  = 'URL/h'\nCTYPE1  = 'RA---TAN'\nCTYPE2  = 'DEC--TAN'\nEND\n",
    "drizzle.coeffs": lambda p: f"file://{p}/secret.bin\n".encode(),
    "values.npy": lambda p: np.lib.format.magic(1, 0) + b"v\0{'descr': '|O', 'shape': (1,), }\n" + Evil(p).pickled(),
    "values.pickle": lambda p: Evil(p).pickled(),
    "table.hdf5": lambda p: b"\x89HDF\r\n\x1a\n" + b"URL/x" * 50,
    "table.parquet": lambda p: b"PAR1" + b"URL/x" * 50 + b"PAR1",
    "table.feather": lambda p: b"ARROW1\0\0" + b"URL/x" * 50,
}


class Evil:
    """What makes a file when it is unpickled."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return open, (f"{self.folder}/made", "w")

    def pickled(self):
        return pickle.dumps(self)


@pytest.mark.parametrize("name", TEXTS)
def test_texts_and_other_containers(alone, tmp_path, name):
    (tmp_path / "secret.bin").write_bytes(b"x y " + SECRET + b"\n1 2 3\n")
    path = tmp_path / name
    path.write_bytes(TEXTS[name](tmp_path).replace(b"URL", alone.encode()))
    said = read_everywhere(path)
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted(["secret.bin", name])
    if name in ("python.ecsv", "new.ecsv"):
        assert "has no business in such a file" in said["table"]
    if name == "laughs.ecsv":
        assert "more than 1000000 nodes" in said["table"]


# --- FITS --------------------------------------------------------------------------------------------------------


def sky_cards(kind="RA---TAN", **more):
    lat = {"RA--": "DEC-", "TLON": "TLAT", "GLON": "GLAT"}[kind[:4]]
    return fits.Header({
        "CTYPE1": kind, "CTYPE2": lat + kind[4:], "CRPIX1": 5.0, "CRPIX2": 5.0, "CRVAL1": 10.0, "CRVAL2": 20.0,
        "CDELT1": -1e-5, "CDELT2": 1e-5, "EXPTIME": 30.0,
    } | more)  # fmt: skip


def with_image(*others, **cards):
    rng = np.random.default_rng(1)
    hdus = fits.HDUList([fits.PrimaryHDU(rng.normal(100, 5, (10, 12)), sky_cards(**cards)), *others])
    file = io.BytesIO()
    hdus.writeto(file)
    return file.getvalue()


def grouping(url):
    """A table of members in other files, as the FITS convention of groups has it."""
    row = {"MEMBER_LOCATION": [f"{url}/member.fits"], "MEMBER_URI_TYPE": ["URL"], "MEMBER_POSITION": [2]}
    hdu = fits.BinTableHDU(Table(row), name="GROUPING")
    hdu.header["GRPNAME"] = "members"
    return hdu


def serialized(yaml):
    """A table whose header has YAML of astropy in its comments."""
    hdu = fits.BinTableHDU(Table({"x": [1.0, 2.0], "y": [1.0, 2.0]}))
    for line in ("--BEGIN-ASTROPY-SERIALIZED-COLUMNS--", *yaml.splitlines(), "--END-ASTROPY-SERIALIZED-COLUMNS--"):
        hdu.header["COMMENT"] = line
    return hdu


def ut1_table():
    file = io.BytesIO()
    Table({"epoch": Time([FAR, FAR]), "x": [1.0, 2.0]}).write(file, format="fits")
    return fits.BinTableHDU.readfrom(io.BytesIO(file.getvalue()[2880:]))


FITS = {
    "group": lambda url, p: with_image(grouping(url)),
    "file group": lambda url, p: with_image(grouping(f"file://{p}")),
    "url cards": lambda url, p: with_image(
        NPOLFILE=f"{url}/n.fits", D2IMFILE=f"{url}/d.fits", IDCTAB=f"{url}/i.fits", DATAREF=f"file://{p}/secret.bin",
        FILENAME=f"{url}/f.fits", PARENT=f"{p}/secret.bin",
    ),
    "earth": lambda url, p: with_image(kind="TLON-TAN", **{"DATE-OBS": "2028-01-01T00:00:00", "MJD-OBS": 61771.0}),
    "ut1": lambda url, p: with_image(TIMESYS="UT1", **{"DATE-OBS": "2028-01-01T00:00:00"}),
    "ut1 column": lambda url, p: with_image(ut1_table()),
    "python": lambda url, p: with_image(serialized(f"x: !!python/object/apply:os.system ['touch {p}/made']")),
    "laughs": lambda url, p: with_image(serialized("\n".join(line[2:] for line in laughing().splitlines()))),
    "nothing": lambda url, p: f"{url}/x.fits".encode(),
}  # fmt: skip


@pytest.mark.parametrize("kind", FITS)
def test_fits(alone, tmp_path, kind):
    (tmp_path / "secret.bin").write_bytes(SECRET)
    path = tmp_path / "frame.fits"
    path.write_bytes(FITS[kind](alone, tmp_path))
    said = read_everywhere(path)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["frame.fits", "secret.bin"]
    if kind == "ut1":
        assert said["frames"] is None


@pytest.mark.parametrize(
    "name", ["URL/x.fits", "s3://bucket/x.fits", "ftp://127.0.0.1/x.fits", "file://FOLDER/frame.fits",
             "FOLDER/frame.fits[0]", "FOLDER/frame.fits[1:2,1:2]", "mem://x", "M31", "-", "|cat"]
)  # fmt: skip
def test_names_are_those_of_files(alone, tmp_path, name):
    (tmp_path / "frame.fits").write_bytes(with_image())
    name = name.replace("URL", alone).replace("FOLDER", str(tmp_path))
    for read in READERS.values():
        with pytest.raises(LegdistortError, match=r"no such file|no file|does not exist|could be read"):
            read(name)


# --- ASDF --------------------------------------------------------------------------------------------------------

TREES = {
    "reference": "{$ref: 'URL/other.asdf#/a'}",
    "file reference": "{$ref: 'file://FOLDER/other.asdf#/a'}",
    "beside": "{$ref: 'other.asdf#/a'}",
    "array": "!core/ndarray-1.0.0 {source: 'URL/o.asdf', datatype: float64, byteorder: little, shape: [8]}",
    "file array": "!core/ndarray-1.0.0 {source: 'other.asdf', datatype: uint8, byteorder: little, shape: [8]}",
    "external": "!core/externalarray-1.0.0 {fileuri: 'FOLDER/secret.bin', target: 0, datatype: uint8, shape: [8]}",
    "fits": "!core/ndarray-1.0.0 {source: 'fits:URL,1', datatype: uint8, byteorder: little, shape: [8]}",
    "python": "!!python/object/apply:os.system ['touch FOLDER/made']",
    "laughs": "[&a [1], "
    + ", ".join(f"&{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 30)}]" for k in range(20))
    + "]",
    "integer": "!core/integer-1.0.0 {sign: '+', string: '1', words: {$ref: 'URL/x'}}",
}


def asdf_text(entry, root):
    head = "#ASDF 1.0.0\n#ASDF_STANDARD 1.5.0\n%YAML 1.1\n%TAG ! tag:stsci.edu:asdf/\n--- !core/asdf-1.1.0\n"
    return f"{head}{root}\n  entry: {entry}\n...\n".encode()


@pytest.mark.parametrize("kind", TREES)
@pytest.mark.parametrize("root", ["legdistort:", "legdistort_prior:", "legdistort_camera:", "wcs:", "roman:"])
def test_asdf(alone, tmp_path, kind, root):
    asdf.AsdfFile({"a": np.frombuffer(SECRET, np.uint8)}).write_to(tmp_path / "other.asdf")
    (tmp_path / "secret.bin").write_bytes(SECRET)
    path = tmp_path / "tree.asdf"
    path.write_bytes(asdf_text(TREES[kind].replace("URL", alone).replace("FOLDER", str(tmp_path)), root))
    said = read_everywhere(path)
    assert None not in said.values()
    assert sorted(item.name for item in tmp_path.iterdir()) == ["other.asdf", "secret.bin", "tree.asdf"]
    frames, solution = said["frames"], said["solution"]
    for text in (frames, solution):
        if "reference" in kind or kind in ("beside", "integer"):
            assert "refers to another file, which is not followed" in text
        elif "array" in kind or kind == "fits":
            assert "lies in another file" in text
        elif kind == "python":
            assert "has no business in such a file" in text


@pytest.mark.slow
def test_images_of_roman_go_nowhere(alone, tmp_path):
    path = tmp_path / "r001_cal.asdf"
    image = {"data": np.ones((8, 9), np.float32), "meta": {"exposure": {"exposure_time": 1.0, "start_time": FAR}}}
    asdf.AsdfFile({"roman": image}).write_to(path)
    (exposure,) = ld.read_exposures(path)
    assert exposure.shape == (8, 9)


@pytest.mark.slow
def test_a_wcs_of_the_turning_earth(alone, tmp_path):
    """Frames of the Earth need its rotation, which nobody knows for years to come: no table is fetched."""
    place = CIRS(obstime=FAR, location=EarthLocation.from_geodetic(0, 0))
    sky = cf.CelestialFrame(reference_frame=place, unit=(u.deg, u.deg), name="sky")
    detector = cf.Frame2D(name="detector", unit=(u.pix, u.pix))
    scale = models.Scale(1e-5) & models.Scale(1e-5) | models.Pix2Sky_TAN() | models.RotateNative2Celestial(10, 20, 180)
    wcs = GWCS([(detector, scale), (sky, None)])
    with warnings.catch_warnings(action="ignore"):
        believable_wcs(wcs, (20, 20))
    tree = io.BytesIO()
    asdf.AsdfFile({"wcs": wcs}).write_to(tree)
    (tmp_path / "w.asdf").write_bytes(tree.getvalue())
    read_everywhere(tmp_path / "w.asdf")


def test_threads_leave_the_setting_of_astropy_as_it_was():
    before, order = conf.allow_internet, threading.Barrier(2, timeout=10)

    def work(first):
        with offline():
            order.wait()
            assert conf.allow_internet is False
            if first:
                order.wait()
        if not first:
            order.wait()

    threads = [threading.Thread(target=work, args=(first,)) for first in (True, False)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert conf.allow_internet == before


def test_every_reader_is_here():
    """The fuzzer knows the entry points; each of them has its place in this list."""
    assert {"frames", "solution", "wcs", "prior", "camera", "psf", "grid", "reference", "noise", "attach"} <= {*READERS}
    assert len(fuzz.READERS) <= len(READERS)
    assert base64.b64encode(SECRET).decode() == "VE9QU0VDUkVU"
