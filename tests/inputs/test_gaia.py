"""Gaia by name, against a stand-in for its archive: a server on this machine that speaks TAP."""

import gc
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from urllib.parse import parse_qs

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import Table
from astropy.tests.helper import assert_quantity_allclose

import legdistort as ld
from legdistort.exceptions import InputError
from legdistort.geometry.tangent_plane import TangentPlane

pytest.importorskip("pyvo", reason="pyvo is an extra (gaia)")

SCALE = 0.05  # arcsec
JOB = """<?xml version="1.0"?><uws:job xmlns:uws="http://www.ivoa.net/xml/UWS/v1.0"
 xmlns:xlink="http://www.w3.org/1999/xlink" version="1.1"><uws:jobId>1</uws:jobId><uws:phase>{phase}</uws:phase>
<uws:executionDuration>60</uws:executionDuration><uws:parameters/>
<uws:results><uws:result id="result" xlink:href="{url}/results/result"/></uws:results></uws:job>"""


class Archive(ThreadingHTTPServer):
    """What answers for a catalogue: the stars inside the circle of a query, each column that it names."""

    daemon_threads = True

    def __init__(self, stars):
        super().__init__(("127.0.0.1", 0), Answers)
        self.stars, self.queries, self.phase = stars, [], "PENDING"
        self.url = f"http://127.0.0.1:{self.server_address[1]}/tap"

    def __enter__(self):
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self.shutdown()
        self.server_close()

    def answer(self):
        query = self.queries[-1]
        ra, dec, size = map(float, re.search(r"CIRCLE\('ICRS', ([-\d.]+), ([-\d.]+), ([-\d.]+)\)", query).groups())
        near = SkyCoord(self.stars["ra"], self.stars["dec"], unit="deg").separation(SkyCoord(ra, dec, unit="deg"))
        asked = re.search(r"SELECT (.*) FROM gaiadr3\.gaia_source", query)[1].split(", ")
        out = BytesIO()
        self.stars[asked][near.deg < size].write(out, format="votable")
        return out.getvalue()


class Answers(BaseHTTPRequestHandler):
    def log_message(self, *_):
        pass

    def _send(self, code, body=b"", **headers):
        self.send_response(code)
        for name, value in ({"Content-Length": len(body)} | headers).items():
            self.send_header(name.replace("_", "-"), str(value))
        self.end_headers()
        self.wfile.write(body)

    def do_POST(self):
        words = parse_qs(self.rfile.read(int(self.headers.get("Content-Length", 0))).decode())
        if self.path.endswith("/async"):
            self.server.queries += words["QUERY"]
            self.server.phase = "PENDING"
        elif self.path.endswith("/phase"):
            self.server.phase = "COMPLETED"
        self._send(303, Location=f"{self.server.url}/async/1")

    def do_GET(self):
        if self.path.endswith("/results/result"):
            self._send(200, self.server.answer(), Content_Type="application/x-votable+xml")
        elif self.path.endswith("/phase"):
            self._send(200, self.server.phase.encode(), Content_Type="text/plain")
        else:
            job = JOB.format(phase=self.server.phase, url=f"{self.server.url}/async/1")
            self._send(200, job.encode(), Content_Type="text/xml")

    def do_DELETE(self):
        self._send(200)


@pytest.fixture(scope="module")
def field():
    """Matches with a sky, and a catalogue of their true places with the columns of Gaia and more stars around."""
    sky = TangentPlane(83.2, -5.4, SCALE / 3600 * np.array([[-1.0, 0, 1024], [0, 1.0, -1024]]))
    drawn = ld.simulate_matches(n_stars=40, n_exposures=5, sigma=0.02, degree=2, dither=100.0, sky=sky, seed=4)
    rng = np.random.default_rng(1)
    places = sky.to_sky(np.vstack([drawn.truth.positions, rng.uniform(-4000, 6000, (300, 2))]))
    n, stars = len(places), Table()
    stars["source_id"] = np.arange(n) + 10**18
    stars["ra"], stars["dec"] = places.ra.deg, places.dec.deg
    stars["ref_epoch"] = np.full(n, 2016.0)
    for name in ("ra", "dec", "parallax", "pmra", "pmdec"):
        stars[f"{name}_error"] = np.full(n, 0.2)
    for name in ("parallax", "pmra", "pmdec"):
        stars[name] = np.zeros(n)
    for pair in ("ra_dec", "ra_parallax", "ra_pmra", "ra_pmdec", "dec_parallax", "dec_pmra", "dec_pmdec"):
        stars[f"{pair}_corr"] = np.zeros(n)
    for pair in ("parallax_pmra", "parallax_pmdec", "pmra_pmdec"):
        stars[f"{pair}_corr"] = np.zeros(n)
    stars["phot_g_mean_mag"], stars["ruwe"] = rng.uniform(12, 20, n), np.ones(n)
    return drawn.matches, stars


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    return tmp_path


def solved(matches, reference):
    return ld.solve(matches, degree=2, reference=reference, epoch=2016.0)


def test_gaia_by_name_is_its_table_by_hand_and_is_asked_once(field, home, monkeypatch, caplog):
    matches, stars = field
    expected = solved(matches, stars)
    with Archive(stars) as archive:
        monkeypatch.setenv("LEGDISTORT_GAIA_TAP", archive.url)
        caplog.set_level("INFO", logger="legdistort")
        found = solved(matches, "gaia")
        assert len(archive.queries) == 1
    gc.collect()  # of a connection that stays open there is a warning now, and that an error
    assert "from http://127.0.0.1" in caplog.text
    assert_quantity_allclose(found.stars["ra"], expected.stars["ra"], rtol=0, atol=1e-5 * u.mas)
    assert_quantity_allclose(found.stars["ra_error"], expected.stars["ra_error"], rtol=1e-3)
    (kept,) = home.rglob("gaiadr3_*.ecsv")
    asked = Table.read(kept)
    # a cone round the field, not all that the archive has
    assert 40 <= len(asked) < 0.7 * len(stars)
    # the server is gone: what was asked for serves again, for a part of the field too
    again = solved(matches, "Gaia")
    assert "of an earlier request" in caplog.text
    assert_quantity_allclose(again.stars["ra"], found.stars["ra"], rtol=0, atol=1e-9 * u.mas)
    part = matches.without({matches.names[-1]: "a smaller field"})
    assert "gaiadr3" in str(solved(part, "gaia").diagnostics.reference)


def test_no_archive_and_nothing_kept_is_said(field, home, monkeypatch):
    matches, stars = field
    with Archive(stars) as archive:
        monkeypatch.setenv("LEGDISTORT_GAIA_TAP", archive.url)
    with pytest.raises(
        InputError, match=r"archive of Gaia \(http://127.0.0.1:\d+/tap\) gives no stars: .*give a table"
    ):
        solved(matches, "gaia")
    assert not list(home.rglob("gaiadr3_*"))


def test_a_field_without_stars_or_without_a_sky_is_said(field, home, monkeypatch):
    matches, stars = field
    with Archive(stars[:0]) as archive:
        monkeypatch.setenv("LEGDISTORT_GAIA_TAP", archive.url)
        with pytest.raises(InputError, match=r"Gaia DR3 has no star within .* of ra 83\.2.*, dec -5\.4"):
            solved(matches, "gaia")
    plain = ld.simulate_matches(n_stars=30, n_exposures=4, degree=1, seed=1).matches
    with pytest.raises(InputError, match="needs to know where the field lies"):
        solved(plain, "gaia")


def test_a_file_of_that_name_is_a_file(field, home, monkeypatch, tmp_path):
    matches, stars = field
    monkeypatch.chdir(tmp_path)
    stars.write("gaia", format="ascii.ecsv")
    assert solved(matches, "gaia").diagnostics.reference is not None


@pytest.mark.slow
def test_the_command_takes_the_word(field, home, monkeypatch, tmp_path):
    from legdistort.cli import main

    _, stars = field
    night = ld.simulate_exposures(small=True, n_exposures=4, seed=1)
    night.write(tmp_path / "night")
    truth = night.truth.table()
    known = stars[:1][np.zeros(len(truth), dtype=int)]
    known["ra"], known["dec"] = truth["ra"].to_value("deg"), truth["dec"].to_value("deg")
    with Archive(known) as archive:
        monkeypatch.setenv("LEGDISTORT_GAIA_TAP", archive.url)
        words = ["run", str(tmp_path / "night" / "*.fits"), "--psf", "moffat", "--degree", "2", "--epoch", "2016"]
        assert main([*words, "--reference", "gaia", "--out", str(tmp_path / "results")]) == 0
    assert "tied to" in str(ld.Solution.read(tmp_path / "results").gauge)
