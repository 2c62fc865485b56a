"""The refined WCS goes into the data models of pipelines, and nothing else of them changes."""

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.wcs import WCS
from astropy.wcs.utils import fit_wcs_from_points
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.runtime.fits_bytes import locate
from legdistort.simulation.example_files import write_examples
from legdistort.wcs.attachment import attach


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Level-2 files with a gwcs through v2v3, and what solves them."""
    folder = tmp_path_factory.mktemp("night")
    write_examples("gwcs", folder, seed=2)
    paths = sorted(folder.glob("*.asdf"))
    exposures = ld.read_exposures(paths)
    solution = ld.solve(ld.match(ld.measure(exposures, psf="moffat"), exposures=exposures), degree=2)
    return paths, solution


def model_of(path):
    """A tree with more than the WCS: repeated parts, arrays, a table with a tag of its own."""
    with asdf.open(path, lazy_load=False, memmap=False) as opened:
        tree = dict(opened.tree["roman"])
        twice = {"names": ["a", "b"], "size": 3}
        others = {"first": twice, "second": twice, "catalogue": Table({"xcentroid": [1.5, 2.5], "flux": [3.0, 4.0]})}
        meta = others | dict(tree["meta"]) | {"zlast": np.arange(40.0)}
        return tree | {"meta": meta}


def places(wcs, shape):
    x, y = np.meshgrid(np.linspace(0, shape[1] - 1, 5), np.linspace(0, shape[0] - 1, 5))
    return np.stack(wcs(x, y))


def without_wcs(text):
    """The lines of a YAML text but those of the WCS: from its key to the next one that is not deeper."""
    out, depth = [], None
    for line in text.splitlines():
        indent = len(line) - len(line.lstrip())
        if depth is not None and (indent > depth or line[indent : indent + 1] == "-"):
            continue
        depth = indent if line.strip().startswith("wcs:") else None
        out += [] if depth is not None else [line]
    return out


def yaml_of(content):
    return content[: content.index(b"\n...") + 5].decode()


@pytest.mark.slow
def test_the_footprint_beside_the_wcs_is_renewed(night, tmp_path):
    """Pipelines keep the corners on the sky as text: of the former WCS, if nobody writes it anew."""
    paths, solution = night
    path, tree = tmp_path / paths[0].name, model_of(paths[0])
    ny, nx = tree["data"].shape
    corners = np.array([[-0.5, -0.5], [nx - 0.5, -0.5], [nx - 0.5, ny - 0.5], [-0.5, ny - 0.5]])
    sky = np.stack(tree["meta"]["wcs"](*corners.T, with_bounding_box=False), axis=1)
    region = "POLYGON ICRS  " + " ".join(f"{each:.9f}" for each in sky.ravel()) + " "
    others = {"s_region": region, "vparity": -1, "text": "s_region: POLYGON ICRS 1 2"}
    asdf.AsdfFile({"roman": tree | {"meta": {"wcsinfo": others} | tree["meta"]}}).write_to(path)
    (done,) = attach(solution, path, out=tmp_path / "out", kind="sip")
    with asdf.open(done.path) as new:
        meta = new["roman"]["meta"]
        assert meta["wcsinfo"] | {"s_region": region} == others
        found = np.array(meta["wcsinfo"]["s_region"].split()[2:], dtype=float).reshape(-1, 2)
        by_wcs = np.stack(meta["wcs"](*corners.T, with_bounding_box=False), axis=1)
        assert_array_equal(new["roman"]["data"], tree["data"])
        assert_allclose(meta["zlast"], np.arange(40.0))
    assert_allclose(found, by_wcs, rtol=0, atol=1e-9)
    assert np.abs(found - sky).max() > 1e-8


@pytest.mark.slow
def test_asdf_files_of_roman(night, tmp_path):
    paths, solution = night
    path, name = tmp_path / paths[0].name, solution.names[0]
    asdf.AsdfFile({"roman": model_of(paths[0])}).write_to(path)
    (done,) = attach(solution, path, out=tmp_path / "out", kind="sip")
    assert done.header is None
    assert repr(done) == f"<Attachment: {name} in {done.path}: ASDF>"
    before, after = path.read_bytes(), done.path.read_bytes()
    assert without_wcs(yaml_of(after)) == without_wcs(yaml_of(before))
    blocks = [each[each.index(b"\xd3BLK") : each.rindex(b"#ASDF BLOCK INDEX")] for each in (before, after)]
    assert blocks[0] == blocks[1]
    with asdf.open(path) as old, asdf.open(done.path) as new:
        wcs, shape = new["roman"]["meta"]["wcs"], new["roman"]["data"].shape
        assert wcs.available_frames == old["roman"]["meta"]["wcs"].available_frames
        refined = ld.refine(old["roman"]["meta"]["wcs"], solution[name])
        assert_allclose(places(wcs, shape), places(refined, shape), rtol=0, atol=1e-12)
        assert np.abs(places(wcs, shape) - places(old["roman"]["meta"]["wcs"], shape)).max() > 1e-7
        for key in ("data", "err", "dq"):
            assert_array_equal(new["roman"][key], old["roman"][key])
        assert_array_equal(new["roman"]["meta"]["zlast"], np.arange(40.0))
        assert new["roman"]["meta"]["first"] is new["roman"]["meta"]["second"]
    (read,) = ld.read_exposures(done.path)
    assert_allclose(read.wcs(3.0, 4.0), solution[name].wcs(3.0, 4.0), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_data_models_of_jwst(night, tmp_path):
    asdf_in_fits = pytest.importorskip("stdatamodels.asdf_in_fits")
    paths, solution = night
    path, name = tmp_path / f"{solution.names[0]}.fits", solution.names[0]
    tree = model_of(paths[0])
    image, error, meta = (tree.pop(key) for key in ("data", "err", "meta"))
    hdus = [fits.PrimaryHDU(header=fits.Header({"TELESCOP": "JWST"})), fits.ImageHDU(np.array(image), name="SCI")]
    hdus += [fits.ImageHDU(np.array(error), name="ERR")]
    asdf_in_fits.write(tmp_path / "plain.fits", {"meta": meta}, fits.HDUList(hdus))
    with fits.open(tmp_path / "plain.fits") as hdulist:
        hdulist.writeto(path, checksum=True)
    before = path.read_bytes()
    attach(solution, path, in_place=True, kind=None)
    after = path.read_bytes()
    old, new = locate(before, path), locate(after, path)
    assert len(old) == len(new) == 4
    assert after[: new[3].start] == before[: old[3].start]
    with fits.open(path, checksum=True) as hdulist:  # a wrong checksum is a warning, and that an error
        assert hdulist["ASDF"].data["ASDF_METADATA"].nbytes == new[3].header["NAXIS1"]
    contents = [data[span.data :] for data, span in ((before, old[3]), (after, new[3]))]
    assert without_wcs(yaml_of(contents[1])) == without_wcs(yaml_of(contents[0]))
    with asdf_in_fits.open(path) as opened:
        wcs = opened["meta"]["wcs"]
        assert wcs.available_frames == ["detector", "v2v3", "world"]
        refined = ld.refine(meta["wcs"], solution[name])
        assert_allclose(places(wcs, image.shape), places(refined, image.shape), rtol=0, atol=1e-12)
        assert opened["meta"]["catalogue"]["flux"].tolist() == [3.0, 4.0]
    again = after
    attach(solution, path, in_place=True, kind=None)
    assert len(path.read_bytes()) == len(again)


@pytest.mark.slow
def test_copies_of_cards_in_data_models_follow(night, tmp_path):
    """Saved next by the pipeline's own package, they would be written over those of the header."""
    datamodels = pytest.importorskip("stdatamodels.jwst.datamodels")
    paths, solution = night
    path, tree = tmp_path / f"{solution.names[0]}.fits", model_of(paths[0])
    pixels = np.random.default_rng(1).uniform(20, 200, (2, 50))
    with datamodels.ImageModel(np.array(tree["data"], dtype="f4")) as model:
        model.meta.wcs = tree["meta"]["wcs"]
        former = fit_wcs_from_points(pixels, SkyCoord(*tree["meta"]["wcs"](*pixels), unit="deg")).to_header()
        copies = {key.lower(): former[key] for key in former if key[:5] in ("CRPIX", "CRVAL", "CTYPE", "CDELT")}
        copies |= {f"pc{i}_{j}": former.get(f"PC{i}_{j}", float(i == j)) for i in (1, 2) for j in (1, 2)}
        for key, value in (copies | {"v2_ref": 120.5, "vparity": -1}).items():
            setattr(model.meta.wcsinfo, key, value)
        model.save(path)
    (done,) = attach(solution, path, out=tmp_path / "out", kind="sip")
    with datamodels.ImageModel(done.path) as model:
        assert (model.meta.wcsinfo.v2_ref, model.meta.wcsinfo.vparity) == (120.5, -1)
        model.save(tmp_path / "again.fits")
    for each in (done.path, tmp_path / "again.fits"):
        found = WCS(fits.getheader(each, "SCI")).all_pix2world(*pixels, 0)
        off = np.abs(np.subtract(found, solution[solution.names[0]].wcs(*pixels))).max()
        assert off * 3600e3 < 1, f"{off * 3600e3} mas"


@pytest.mark.slow
def test_a_file_of_the_archive_after_tweakreg(shared_data, tmp_path, caplog):
    path = tmp_path / "jw.fits"
    content = (shared_data / "jwst_nrcalong" / "jw01227_nrcalong_f444w_cutout.fits").read_bytes()
    start = locate(content, path)[-1].start  # the gwcs is of the full frame, the image a part of that
    path.write_bytes(content[:start] + content[start:].replace(b"2047.5", b"99.500"))
    (exposure,) = ld.read_exposures(path)
    rng = np.random.default_rng(3)
    xy = rng.uniform(2, 97, (60, 2))
    bent = xy + 0.3 * (xy[:, ::-1] / 50 - 1) ** 2  # what its gwcs does not know
    ra, dec = exposure.wcs(*bent.T)
    stars = Table({"ra": ra, "dec": dec, "ra_error": np.full(60, 0.1), "dec_error": np.full(60, 0.1)})
    seen = QTable({"exposure": ["jw"] * 60, "x": xy[:, 0] * u.pix, "y": xy[:, 1] * u.pix})
    seen["x_err"] = seen["y_err"] = np.full(60, 0.01) * u.pix
    prior = ld.Prior.from_headers([exposure])
    solution = ld.solve(ld.match(seen, exposures=[exposure]), degree=2, prior=prior, reference=stars)
    before = path.read_bytes()
    with (
        caplog.at_level("INFO", "legdistort"),
        pytest.warns(AssumptionWarning, match="another field"),  # its header is of the part
    ):
        attach(solution, path, in_place=True, kind=None)
    assert "; their headers, which --asdf-only leaves as they were, are off by as much" in caplog.text
    after = path.read_bytes()
    old, new = locate(before, path)[-1], locate(after, path)[-1]
    assert after[: new.start] == before[: old.start]
    assert without_wcs(yaml_of(after[new.data :])) == without_wcs(yaml_of(before[old.data :]))
    (read,) = ld.read_exposures(path)
    assert read.wcs.available_frames == ["detector", "v2v3", "v2v3vacorr", "v2v3corr", "world"]
    off = read.wcs.invert(ra, dec, with_bounding_box=False) - xy.T
    assert np.abs(off).max() < 0.02


@pytest.mark.slow
def test_by_how_much_corners_move_is_said_once(night, tmp_path, caplog):
    paths, solution = night
    with caplog.at_level("INFO", "legdistort"):
        attach(solution, paths, out=tmp_path / "out")
    (said,) = [record.getMessage() for record in caplog.records if "corners" in record.getMessage()]
    old, new = (ld.read_exposures(each) for each in (paths, [tmp_path / "out" / path.name for path in paths]))
    far = {}
    for a, b in zip(old, new, strict=True):
        x, y = np.array(
            [[-0.5, -0.5], [-0.5, a.shape[0] - 0.5], [a.shape[1] - 0.5, -0.5], np.array(a.shape[::-1]) - 0.5]
        ).T
        there = [SkyCoord(*each.wcs(x, y, with_bounding_box=False), unit="deg") for each in (a, b)]
        far[a.name] = there[0].separation(there[1]).arcsec.max()
    worst = max(far, key=far.get)
    assert said == f"corners of {len(paths)} images move by up to {far[worst]:.3g} arcsec ({worst})"


def test_a_model_that_cannot_be_refined_is_named(night, tmp_path):
    paths, solution = night
    path = tmp_path / paths[0].name
    tree = model_of(paths[0])
    tree["meta"].pop("wcs")
    asdf.AsdfFile({"roman": tree}).write_to(path)
    with pytest.raises(InputError, match=rf"{path.name} has no gwcs at meta\.wcs or roman\.meta\.wcs"):
        attach(solution, path, out=tmp_path / "out")
    with pytest.raises(InputError, match="is no FITS file: SWarp and SCAMP do not read it"):
        attach(solution, paths[0], out=tmp_path / "out", kind="head")
    other = tmp_path / "unknown.asdf"
    other.write_bytes(paths[0].read_bytes())
    with pytest.raises(InputError, match="no exposure 'unknown' in the solution"):
        attach(solution, other, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_catalogues_with_the_wcs_of_their_images(night, tmp_path, capsys):
    """Lists as the JWST pipeline writes them beside its images: sky, shape and time are those of the images."""
    from legdistort.cli import main

    paths, solution = night
    measured = ld.measure(ld.read_exposures(paths), psf="moffat")
    for path in paths:
        mine = measured[measured["exposure"] == path.stem]
        found = Table({"label": np.arange(len(mine)), "xcentroid": mine["x"].value, "ycentroid": mine["y"].value})
        found["aper_total_flux"] = mine["flux"]
        found.write(tmp_path / f"{path.stem}_cat.ecsv")
    lists = [str(tmp_path / f"{path.stem}_cat.ecsv") for path in paths]
    words = ["--error", "0.02", "--wcs", *map(str, paths), "--out", str(tmp_path / "matched.ecsv")]
    assert main(["match", *lists, *words]) == 0
    told = "columns of the JWST pipeline: x = xcentroid, y = ycentroid, flux = aper_total_flux"
    assert capsys.readouterr().err.count(told) == 1  # of six lists
    assert main(["solve", str(tmp_path / "matched.ecsv"), "--degree", "2", "--out", str(tmp_path / "solved")]) == 0
    found = ld.Solution.read(tmp_path / "solved")
    assert found.names == solution.names
    for name in found.names:
        here, there = (each[name].wcs.pixel_to_world(200.0, 300.0) for each in (found, solution))
        assert here.separation(there) < solution.sky.pixel_scale * u.arcsec  # directions are unknown, noise decides
    assert main(["attach", str(tmp_path / "solved"), str(paths[0]), "--out", str(tmp_path / "out")]) == 0
    other = tmp_path / "exp000_cal_cat.ecsv"
    other.write_bytes((tmp_path / "exp00_cal_cat.ecsv").read_bytes())
    capsys.readouterr()
    assert main(["match", str(other), *lists[1:], *words[:-1], str(tmp_path / "b.ecsv")]) == 1
    assert "exposure exp000_cal_cat is none of the frames (exp00_cal, exp01_cal" in capsys.readouterr().err
