"""Star lists as other programs write them; magnitudes, errors, rows that belong nowhere."""

import gzip

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import ascii as astropy_ascii
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal

import legdistort as ld
from legdistort.cli import parser
from legdistort.exceptions import AssumptionWarning, InputError
from legdistort.inputs import column_contract
from legdistort.inputs.plain_columns import plain_columns
from legdistort.inputs.references.catalogue import read_reference
from legdistort.inputs.table_files import read_table
from legdistort.matching.matches import Matches
from legdistort.measurement.flags import Flag
from legdistort.simulation.observations import simulate_matches

# From a file that hst1pass v1a (2022.07.05) wrote with OUT=uvwXYMpq (ie8j01xmq_flt.uvwXYMpq in
# github.com/jluastro/hst1pass; columns: Anderson 2022, WFC3 ISR 2022-05): of 157 lines of comments those with a table
# in them, and the last ones.
HST1PASS = """\
#
#--------------------------------------------
# ARGUMENTS
#--------------------------------------------
#  ARG0000: /g/lu/code/fortran/hst1pass/CODE/hst1pass/hst1pass
#  ARG0010: OUT=uvwXYMpq
#  ARG0012: ../00.DATA/ie8j01xmq_flt.fits
#
# FILENAME: ../00.DATA/ie8j01xmq_flt.fits
#   NAXIS1:  4096
#     rDAT:       2020.19905472
#    MAG   LFe    CUMe      LFe/s CUMe/s
#-------- -----  ------   ------- ------
# LF -18      1      1          0      0
#      CENTRAL PIXEL ARRAY
#                           0000    0682    1365    2048    2731    3413    4096
#               4096 08   0.1531  0.1594  0.1651  0.1662  0.1672  0.1688  0.1687
#
#  FILEOUT: ie8j01xmq_flt.uvwXYMpq                                                          
#---------------------------------------------------
# (01)  u -- u ref-frame           c002-c010    F001
# (02)  v -- v ref-frame           c012-c020    F002
# (03)  w -- dist-corr inst mag    c022-c028    F044
# (04)  X -- dist-cor x posn       c030-c038    F008
# (05)  Y -- dist-cor y posn       c040-c048    F009
# (06)  M -- instl mag (1000s)     c050-c056    F003
# (07)  p -- peak pixel value      c058-c068    F018
# (08)  q -- quality of fit        c070-c074    F019
#---------------------------------------------------
#
#  (01)      (02)     (03)     (04)      (05)     (06)      (07)     (08)   
#
#....u.... ....v.... ...w... ....X.... ....Y.... ...M... .....p..... ..q..  
#
  163.1255   86.7585 -12.673  158.7864    5.9838 -12.671    18284.76 0.033
  366.8454   99.3525  -9.288  363.9407    6.2220  -9.284      797.52 0.050
  902.9401  131.1858  -7.143  902.6855    5.6561  -7.135      101.92 0.165
"""  # noqa: W291

# The same program with OUT=xymnk: raw positions, saturated pixels, chips (the second lies 2048 rows up).
HST1PASS_CHIPS = """\
#....x.... ....y.... ...m... .n. k
  163.1255   86.7585 -12.673   0 1
  366.8454   99.3525 -14.288   7 1
  902.9401 2179.1858  -7.143   0 2
"""

# FlyStar's lists (github.com/MovingUniverseLab/flystar, flystar/tests/A.lis).
FLYSTAR = """\
# name m t x y xe ye snr corr N_frames flux
Pare1839 8.801 2014.944 577.926 395.633 0.204 0.148 11.594 0.92 4 3255625
ir1491 8.805 2014.944 647.255 242.165 0.103 0.422 5.424 0.74 4 3213962
"""

# ALLSTAR of Stetson: three lines of header, then ID X Y MAG MERR SKY NITER CHI SHARP (manual of DAOPHOT II).
ALLSTAR = """\
 NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD
  1  2040  2047    79.9 30000.0   32.07    3.00    2.20    2.86    2.18

     59  957.205   12.228   13.961   0.0151  141.334       4.    0.547   -0.020
     61  120.010   13.500   99.999   0.0200  141.334      10.    1.547    0.520
"""

# ALLSTAR of IRAF as the documentation of astropy.io.ascii.Daophot shows it (its INDEF in a magnitude).
IRAF = """\
#K MERGERAD   = INDEF                   scaleunit  %-23.7g  
#K IRAF = NOAO/IRAFV2.10EXPORT version %-23s
#
#N ID    XCENTER   YCENTER   MAG         MERR          MSKY           NITER    \\
#U ##    pixels    pixels    magnitudes  magnitudes    counts         ##       \\
#F %-9d  %-10.3f   %-10.3f   %-12.3f     %-14.3f       %-15.7g        %-6d     
#                                                                              
#N         SHARPNESS   CHI         PIER  PERROR                                \\
#U         ##          ##          ##    perrors                               \\
#F         %-23.3f     %-12.3f     %-6d  %-13s                                 
#                                                                              
14       138.538     256.405   15.461      0.003         34.85955       4        \\
            -0.032      0.802       0     No_error                             
18       18.114      280.170   INDEF       INDEF         30.12784       4        \\
            -2.544      1.104       4     No_convergence                       
"""  # noqa: W291


def read(tmp_path, name, text, **options):
    (tmp_path / name).write_text(text)
    return read_table(tmp_path / name, **options)


# --- programs ----------------------------------------------------------------------------------------------------


def test_hst1pass(tmp_path):
    out = read(tmp_path, "ie8j01xmq_flt.uvwXYMpq", HST1PASS, error=0.02)
    checked = column_contract.check(out, column_contract.DETECTED, "t")
    assert_allclose(out["x"].value, [157.7864, 362.9407, 901.6855])  # X, which counts from 1
    assert_allclose(out["y"].value, [4.9838, 5.2220, 4.6561])
    assert_allclose(checked["flux"], 10 ** (-0.4 * np.array([-12.671, -9.284, -7.135])))  # M, not w
    assert_allclose(out["epoch"], 2020.19905472)
    assert_array_equal(out["q"], [0.033, 0.050, 0.165])
    assert_array_equal(checked["x_err"].value, 0.02)
    assert set(out["exposure"]) == {"ie8j01xmq_flt"}
    assert_allclose(read(tmp_path, "a.x", HST1PASS, columns={"x": "u", "y": "v"})["x"].value[0], 162.1255)


def test_hst1pass_of_two_chips_is_two_exposures(tmp_path):
    out = read(tmp_path, "a.xymnk", HST1PASS_CHIPS)
    assert out["exposure"].tolist() == ["a_1", "a_1", "a_2"]
    assert_allclose(out["y"].value, [85.7585, 98.3525, 130.1858])  # each chip from 0
    assert out["flags"].tolist() == [0, Flag.SATURATED, 0]
    one = "\n".join(HST1PASS_CHIPS.splitlines()[:2]) + "\n"
    assert set(read(tmp_path, "b.xymnk", one)["exposure"]) == {"b_1"}


def test_hst1pass_without_pixels_is_refused(tmp_path):
    text = "#....u.... ....v.... ...w...\n  163.1  86.7 -12.6\n"
    with pytest.raises(
        InputError, match=r"a\.uvw: hst1pass wrote no pixel positions, but u, v, w; u, v and U, V are c"
    ):
        read(tmp_path, "a.uvw", text)


def test_single_letters_of_anybody_are_not_hst1pass(tmp_path):
    out = read(tmp_path, "a.txt", "# x y m\n 5 6 12.5\n")
    assert_array_equal(out["x"], 5)  # from 0


def test_flystar(tmp_path):
    out = column_contract.check(read(tmp_path, "A.lis", FLYSTAR), column_contract.DETECTED, "t")
    assert_array_equal(out["x"].value, [577.926, 647.255])
    assert_array_equal(out["y_err"].value, [0.148, 0.422])
    assert_array_equal(out["mag"], [8.801, 8.805])
    assert_array_equal(out["flux"], [3255625, 3213962])  # its own, not made from the magnitudes
    assert_array_equal(out["epoch"], 2014.944)


def _without_names(lines, *left_out):
    rows = [line.split() for line in lines.splitlines()[1:]]
    return "".join(" ".join(word for k, word in enumerate(row) if k not in left_out) + "\n" for row in rows)


def test_starfinder_without_a_header(tmp_path, caplog):
    """The same list by the same program, with errors (eleven columns) and without (nine)."""
    named = read(tmp_path, "A.lis", FLYSTAR)
    caplog.set_level("INFO", logger="legdistort")
    bare = read(tmp_path, "B.lis", _without_names(FLYSTAR))
    assert "columns of StarFinder, FlyStar: x_err = xe, y_err = ye, mag = m, epoch = t" in caplog.text
    for name in ("x", "y", "x_err", "y_err", "mag", "flux", "epoch"):
        assert_array_equal(bare[name], named[name])
    nine = read(tmp_path, "C.lis", _without_names(FLYSTAR, 5, 6), error=0.01)
    assert "columns of StarFinder: mag = m, epoch = t" in caplog.text
    for name in ("x", "y", "mag", "flux", "epoch"):
        assert_array_equal(nine[name], named[name])
    assert_array_equal(nine["x_err"], 0.01)
    mine = read(tmp_path, "D.lis", _without_names(FLYSTAR), columns={"x": "col5", "y": "col4"})
    assert_array_equal(mine["x"], named["y"])


@pytest.mark.parametrize("left_out", [(), (5, 6)], ids=["eleven columns", "nine"])
def test_starfinder_without_dates(tmp_path, caplog, left_out):
    """The third column is zero in all rows: no date. In some of them it is none of StarFinder's lists."""
    caplog.set_level("INFO", logger="legdistort")
    text = _without_names(FLYSTAR, *left_out)
    bare = read(tmp_path, "A.lis", text.replace("2014.944", "0.000"), error=0.01)
    dated = read(tmp_path, "B.lis", text, error=0.01)
    assert set(dated.colnames) - set(bare.colnames) == {"epoch"}
    assert "t" not in bare.colnames
    for name in ("x", "y", "x_err", "mag", "flux"):
        assert_array_equal(bare[name], dated[name])
    assert caplog.text.count("the dates (t) are zero: when the stars were seen is not known") == 1
    mixed = read(tmp_path, "C.lis", text.replace("2014.944", "0.000", 1))
    assert mixed.colnames[0] == "col1"
    named = read(tmp_path, "D.lis", FLYSTAR.replace("2014.944", "0.000"))
    assert not {"epoch", "t"} & set(named.colnames)


@pytest.mark.parametrize(
    "wrong", [{2: "57000.5"}, {8: "12.0"}, {9: "3.5"}, {3: "abc"}], ids=["MJD", "corr", "frames", "word"]
)
def test_eleven_columns_of_others_are_not_starfinder(tmp_path, wrong):
    rows = [line.split() for line in FLYSTAR.splitlines()[1:]]
    for k, word in wrong.items():
        rows[1][k] = word
    out = read(tmp_path, "a.txt", "".join(" ".join(row) + "\n" for row in rows))
    assert out.colnames[:3] == ["col1", "col2", "col3"]


def test_stetson(tmp_path):
    out = read(tmp_path, "obj1.als", ALLSTAR, error=0.05)
    assert out.meta["shapes"] == {"obj1": [2047, 2040]}
    assert_allclose(out["x"].value, [956.205, 119.010])
    flux = column_contract.check(out, column_contract.DETECTED, "t")["flux"]
    assert_allclose(flux[0], 10 ** (-0.4 * 13.961))
    assert np.isnan(flux[1])  # 99.999 is no magnitude
    with pytest.raises(InputError, match=r"b\.ap: a list of DAOPHOT whose rows are not the nine numbers of ALLSTAR"):
        read(tmp_path, "b.ap", "\n".join(ALLSTAR.splitlines()[:3]) + "\n 1 2.0 3.0 14.1\n 9.0 0.1\n")


def test_daophot_of_iraf(tmp_path):
    out = read(tmp_path, "obj1.als.1", IRAF, error=0.05)
    (tmp_path / "same").write_text(IRAF)
    theirs = astropy_ascii.read(tmp_path / "same", format="daophot")
    assert_allclose(out["x"].value, theirs["XCENTER"] - 1)
    assert_allclose(out["mag"][0], 15.461)
    assert out["flags"].tolist() == [0, Flag.NOT_CONVERGED]
    assert np.isnan(column_contract.check(out, column_contract.DETECTED, "t")["flux"][1])


def test_photutils(tmp_path):
    from photutils.detection import DAOStarFinder
    from photutils.psf import CircularGaussianPRF, PSFPhotometry

    rng = np.random.default_rng(3)
    y, x = np.mgrid[:60, :70]
    psf = CircularGaussianPRF(fwhm=3.0)
    image = sum(
        CircularGaussianPRF(flux=f, x_0=a, y_0=b, fwhm=3.0)(x, y) for f, a, b in ((900, 20.3, 30.7), (500, 50.1, 12.4))
    )
    image = image + rng.normal(0, 0.5, image.shape)
    found = DAOStarFinder(8.0, 3.0)(image)
    found.write(tmp_path / "found.ecsv")
    out = read_table(tmp_path / "found.ecsv", error=0.1)
    assert_allclose(np.sort(out["x"].value), [20.3, 50.1], atol=0.1)
    assert_allclose(out["flux"], found["flux"])
    listed = QTable({"xcentroid": [10.0], "ycentroid": [5.0], "segment_flux": [7.0], "segment_fluxerr": [0.5]})
    listed.write(tmp_path / "segments.ecsv")
    out = read_table(tmp_path / "segments.ecsv", error=0.1)
    assert (out["flux"][0], out["flux_err"][0]) == (7, 0.5)
    fitted = PSFPhotometry(psf, (7, 7), aperture_radius=4)(image, init_params=QTable({"x": [20, 50], "y": [31, 12]}))
    fitted["flags"][1] = 8
    fitted.write(tmp_path / "fitted.ecsv", serialize_method="data_mask")
    out = column_contract.check(read_table(tmp_path / "fitted.ecsv"), column_contract.DETECTED, "t")
    assert_allclose(out["x"].value, [20.3, 50.1], atol=0.05)
    assert_allclose(out["flux"], [900, 500], rtol=0.05)
    assert np.all((out["x_err"].value > 0.001) & (out["x_err"].value < 0.1))
    assert out["flags"].tolist() == [0, Flag.NOT_CONVERGED]


@pytest.mark.parametrize(("total", "isophotal"), [(True, True), (False, True), (True, False)])
def test_a_catalogue_of_the_jwst_pipeline(tmp_path, total, isophotal, recwarn):
    """Of source_catalog: the flux of a star is the total one, else the isophotal; old places are no result."""
    flux, xy = np.array([3e-6, 2e-7, 5e-8]), np.array([[10.0, 20.0, 30.0], [5.0, 6.0, 7.0]])
    listed = QTable({"label": [1, 2, 3], "xcentroid": xy[0], "ycentroid": xy[1]})
    listed["sky_centroid"] = SkyCoord([80.1, 80.2, 80.3], [-69.1, -69.2, -69.3], unit="deg")
    if total:
        listed["aper_total_flux"], listed["aper_total_flux_err"] = flux * u.Jy, 0.01 * flux * u.Jy
    if isophotal:
        listed["isophotal_flux"], listed["isophotal_flux_err"] = 0.9 * flux * u.Jy, 0.02 * flux * u.Jy
    listed["is_extended"] = [False, True, False]
    listed.write(tmp_path / "a_cat.ecsv")
    out = read_table(tmp_path / "a_cat.ecsv", error=0.02)
    assert "sky_centroid" not in out.colnames
    assert_allclose(out["x"].value, xy[0])
    assert_allclose(out["flux"], flux * (1 if total else 0.9))
    assert_allclose(out["flux_err"], flux * (0.01 if total else 0.02))
    plain_columns(column_contract.check(out, column_contract.DETECTED, "t"))
    assert not recwarn.list


@pytest.mark.parametrize("name", ["aper_total_abmag", "isophotal_vegamag"])
def test_a_catalogue_of_the_jwst_pipeline_without_fluxes_has_its_magnitudes(tmp_path, name):
    listed = Table({"label": [1, 2, 3], "xcentroid": [10.0, 20.0, 30.0], "ycentroid": [5.0, 6.0, 7.0]})
    listed[name] = [17.0, 19.5, np.nan]
    listed.write(tmp_path / "a_cat.ecsv")
    out = column_contract.check(read_table(tmp_path / "a_cat.ecsv", error=0.02), column_contract.DETECTED, "t")
    assert_allclose(out["mag"], [17.0, 19.5, np.nan])
    assert_allclose(out["flux"][:2], 10 ** (-0.4 * np.array([17.0, 19.5])))
    assert np.isnan(out["flux"][2])


def test_names_of_columns_between_other_comments(tmp_path):
    """As the xym2bar of J. Anderson writes them: names, numbers of the columns, dots (MATCHUP.XYMEEE)."""
    text = (
        "#.......... ........... ........... ........... ...........\n"
        "#    xbar        ybar        mbar        xsig        ysig\n"
        "#    (01)        (02)        (03)        (04)        (05)\n"
        "#.......... ........... ........... ........... ...........\n"
        "   157.6341     86.4263    -12.6758      0.0026      0.0052\n"
    )
    names = {"x": "xbar", "y": "ybar", "x_err": "xsig", "y_err": "ysig", "mag": "mbar"}
    out = column_contract.check(
        read(tmp_path, "MATCHUP.XYMEEE", text, columns=names, origin=1), column_contract.DETECTED, "t"
    )
    assert (out["x"][0].value, out["y_err"][0].value) == (156.6341, 0.0052)


def test_numbers_without_names(tmp_path):
    out = read(tmp_path, "a.xym", "  1.5 2.5 -9.0\n  3.5 4.5 -8.0\n", columns={"x": "col1", "y": "col2", "mag": "col3"})
    assert_array_equal(out["x"], [1.5, 3.5])
    with pytest.raises(InputError, match=r"lacks the columns x, y, x_err, y_err; it has col1, col2, col3 \(map"):
        column_contract.check(read(tmp_path, "b.xym", "1.5,2.5,-9.0\n"), column_contract.DETECTED, "the list")
    with pytest.raises(InputError, match=r"no column 'x' to use as 'x_err'; the table has col1, col2"):
        read(tmp_path, "c.xym", "1.5 2.5\n", columns={"x_err": "x"})


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.lis", "# name x y\ns1 1 2\ns2 1\n", r"a\.lis: cannot be read as a table"),
        ("a.txt", "# only comments\n", r"a\.txt: cannot be read as a table: it has no rows"),
        ("a.txt", "", r"a\.txt: the file is empty"),
        ("a.csv", "\n", r"a\.csv: the file is empty"),
        ("a.xymk", "#..x.. ..y.. ..m.. k\n 1.0 2.0 3.0 a\n", r"a\.xymk: column 'k' cannot be read as numbers"),
    ],
)
def test_bad_lists_are_named(tmp_path, name, text, message):
    with pytest.raises(InputError, match=message):
        read(tmp_path, name, text)


def test_a_damaged_archive_is_named(tmp_path):
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"x,y\n1,2\n")[:-6])
    with pytest.raises(InputError, match=r"a\.csv\.gz: cannot be read as a table: damaged"):
        read_table(tmp_path / "a.csv.gz")


# --- Gaia --------------------------------------------------------------------------------------------------------

# As the archive gives them (Gaia DR3): missing values are empty, or "null" in the bulk downloads.
GAIA = """\
solution_id,source_id,ref_epoch,ra,ra_error,dec,dec_error,pmra,pmra_error,pmdec,pmdec_error,phot_g_mean_mag
1636148068921376768,4295806720,2016.0,44.9961,0.1012,0.0056,0.1001,11.94,0.13,-7.5,0.12,17.64
1636148068921376768,34361129088,2016.0,45.0048,4.1801,0.0197,2.8503,{0},{0},{0},{0},21.14
"""


@pytest.mark.parametrize("missing", ["", "null"])
@pytest.mark.parametrize("kind", ["csv", "csv.gz", "ecsv in csv.gz", "vot.gz"])
def test_gaia(tmp_path, missing, kind):
    text = GAIA.format(missing)
    table = Table.read(GAIA.format(""), format="ascii.csv")
    path = tmp_path / f"gaia.{kind.split()[-1]}"
    if kind.startswith("ecsv"):
        header = "# %ECSV 1.0\n# ---\n# delimiter: ','\n# datatype:\n"
        header += "".join(f"# - {{name: {n}, datatype: {table[n].dtype.name}}}\n" for n in table.colnames)
        path.write_bytes(gzip.compress((header + text).encode()))
    elif kind == "vot.gz":
        table.write(tmp_path / "gaia.vot", format="votable", tabledata_format="binary2")
        path.write_bytes(gzip.compress((tmp_path / "gaia.vot").read_bytes()))
    else:
        path.write_bytes(gzip.compress(text.encode()) if kind.endswith("gz") else text.encode())
    found = read_reference(path)
    assert_allclose(found.sky[:, 0], [44.9961, 45.0048])
    assert_allclose(found.motion[0], [11.94, -7.5])
    assert np.isnan(found.motion[1]).all()
    assert_allclose(found.flux, 10 ** (-0.4 * np.array([17.64, 21.14])))


# --- errors ------------------------------------------------------------------------------------------------------


def test_one_error_for_what_has_none(tmp_path):
    text = "# x y xe ye\n1 2 0.1 0\n3 4 nan 0.2\n5 6 -1 0.3\n"
    out = column_contract.check(read(tmp_path, "a.txt", text, error=0.5), column_contract.DETECTED, "t")
    assert_array_equal(out["x_err"].value, [0.1, 0.5, 0.5])
    assert_array_equal(out["y_err"].value, [0.5, 0.2, 0.3])
    with pytest.raises(
        InputError, match=r"y_err is not a positive finite number .* or give them one \(--error PIXELS\)"
    ):
        column_contract.check(read(tmp_path, "b.txt", "# x y xe ye\n1 2 0.1 0\n"), column_contract.DETECTED, "t")
    with pytest.raises(InputError, match=r"lacks the columns x_err, y_err; .*--error PIXELS, and let solve find them"):
        column_contract.check(read(tmp_path, "c.txt", "# x y\n1 2\n"), column_contract.DETECTED, "t")
    for wrong in (0, -1, np.inf, "a"):
        with pytest.raises(InputError, match="error must be a positive number of pixels"):
            read(tmp_path, "d.txt", text, error=wrong)


def test_sextractor_without_errors(tmp_path):
    table = Table({"XWIN_IMAGE": [5.0], "YWIN_IMAGE": [6.0], "MAG_AUTO": [-9.0]})
    table.write(tmp_path / "t.fits")
    with pytest.raises(InputError, match=r"XWIN_IMAGE comes without errors.*give one error for all \(error=, --error"):
        read_table(tmp_path / "t.fits")
    out = column_contract.check(read_table(tmp_path / "t.fits", error=0.3), column_contract.DETECTED, "t")
    assert (out["x"][0].value, out["x_err"][0].value) == (4.0, 0.3)
    assert_allclose(out["flux"], 10**3.6)


# --- errors by brightness ----------------------------------------------------------------------------------------


def night(seed, *, start="same", n_exposures=8, n_stars=100):
    """Matches whose errors go as (3 / f)^2 + 0.2^2 / f + 0.005^2, times a factor by exposure, and those errors."""
    rng = np.random.default_rng(seed)
    simulated = simulate_matches(n_exposures=n_exposures, n_stars=n_stars, sigma=1e-6, dynamic=0.1, seed=seed)
    table = simulated.matches.table.copy()
    _, exposure = np.unique(table["exposure"], return_inverse=True)
    flux = (10 ** rng.uniform(2, 5, n_stars))[np.searchsorted(simulated.matches.stars, table["star"])]
    sigma = np.exp(rng.normal(0, 0.3, n_exposures))[exposure] * np.sqrt((3 / flux) ** 2 + 0.2**2 / flux + 0.005**2)
    for name in "xy":
        table[name] += rng.normal(0, sigma) * table[name].unit
        few = np.sqrt(rng.chisquare(2, len(table)) / 2) * sigma + 1e-3  # the scatter of three repeats
        table[f"{name}_err"] = (few if start == "few repeats" else np.full(len(table), 0.1)) * table[name].unit
    table["mag"] = -2.5 * np.log10(flux)
    matches = Matches.from_table(table, shape=simulated.matches.shapes, poses=simulated.matches.poses)
    return simulated, matches, sigma


@pytest.mark.parametrize("start", ["same", "few repeats"])
def test_errors_by_brightness(start, tmp_path):
    """Truth: a law that the fit does not start from. Faint, middle and bright stars get their errors within 10 %."""
    simulated, matches, sigma = night(2, start=start)
    solution = ld.solve(matches, prior=ld.Prior(simulated.truth.static), clip=None, errors="by-brightness")
    ratio = solution.residuals["x_err"].value / sigma
    faint_first = np.argsort(matches.table["flux"])
    for part in np.array_split(ratio[faint_first], 3):
        assert np.median(part) == pytest.approx(1, abs=0.1)
    assert np.std(np.log(ratio)) < 0.12
    assert solution.chi2 == pytest.approx(solution.dof, rel=1e-3)
    law = solution.diagnostics.error_law
    assert law.floor == pytest.approx(0.005, rel=0.25)
    assert "errors  by brightness, from the scatter of the stars: sqrt((" in str(solution)
    if start == "few repeats":  # the stated ones are useless as they are
        stated = ld.solve(matches, prior=ld.Prior(simulated.truth.static), clip=None)
        assert stated.chi2 > 1.5 * stated.dof
    back = ld.Solution.read(solution.write(tmp_path / "s.asdf"))
    assert back.diagnostics.error_law == law


def test_a_brightness_that_tells_nothing_gives_the_same_errors_to_all():
    """The model is wrong: magnitudes shuffled among the stars. The errors are right in the mean and alike."""
    simulated, matches, sigma = night(2)
    table = matches.table.copy()
    table.remove_column("flux")
    _, star = np.unique(table["star"], return_inverse=True)
    table["mag"] = np.random.default_rng(0).permutation(100)[star] / 10.0
    shuffled = Matches.from_table(table, shape=matches.shapes, poses=matches.poses)
    solution = ld.solve(shuffled, prior=ld.Prior(simulated.truth.static), clip=None, errors="by-brightness")
    assert solution.chi2 == pytest.approx(solution.dof, rel=1e-3)
    error = solution.residuals["x_err"].value
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.sqrt(np.mean(sigma**2)), rel=0.25)
    assert np.std(np.log(error)) < 0.5 * np.std(np.log(sigma))


def test_by_brightness_needs_brightness():
    matches = night(1)[1]
    table = matches.table.copy()
    table.remove_columns(["flux", "mag"])
    plain = Matches.from_table(table, shape=matches.shapes, poses=matches.poses)
    with pytest.raises(
        InputError, match=r"needs the brightness of the stars, and 0 of 800 positions have a positive fl"
    ):
        ld.solve(plain, errors="by-brightness")
    with pytest.raises(InputError, match="errors='by-brightness' finds the errors, their floor too: leave error_floor"):
        ld.solve(matches, errors="by-brightness", error_floor=0.1)


# --- rows that belong nowhere ------------------------------------------------------------------------------------


def test_stray_rows_are_left_out_by_name():
    matches = simulate_matches(n_exposures=4, n_stars=30, seed=1).matches
    table = matches.table.copy()
    clean = ld.solve(matches, degree=2)
    table.add_row(table[5])
    table["star"][-1], table["x"][-1] = 777, 5000 * table["x"].unit
    name = table["exposure"][5]
    with pytest.warns(
        AssumptionWarning,
        match=rf"1 positions lie outside their detector and are left out: star 777 of exposure {name} at",
    ):
        stray = Matches.from_table(table, shape=matches.shapes, poses=matches.poses)
    assert len(stray.table) == len(matches.table)
    assert_allclose(ld.solve(stray, degree=2).estimate.positions, clean.estimate.positions)


def test_many_stray_rows_are_a_wrong_shape():
    matches = simulate_matches(n_exposures=4, n_stars=30, seed=1).matches
    with pytest.raises(
        InputError, match=r"positions lie outside their detector, \d+ % of those of exposure .* correct the"
    ):
        Matches.from_table(matches.table, shape=(1024, 1024), poses=matches.poses)


# --- the shell ---------------------------------------------------------------------------------------------------


def test_lists_without_errors_in_the_shell(tmp_path, capsys):
    """Four lists of positions and magnitudes, as hst1pass writes them."""
    matches = night(3, n_exposures=4, n_stars=40)[1]
    for name in matches.names:
        rows = matches.table[matches.table["exposure"] == name]
        lines = [
            f"{a + 1:.5f} {b + 1:.5f} {m:.3f} 0.01"
            for a, b, m in zip(rows["x"].value, rows["y"].value, rows["mag"], strict=True)
        ]
        (tmp_path / f"{name}.XYMq").write_text("\n".join(["#...X... ...Y... ..M.. .q.", *lines]) + "\n")
    lists = [str(tmp_path / f"{name}.XYMq") for name in matches.names]
    matched = str(tmp_path / "m.ecsv")
    assert parser.main(["match", *lists, "--shape", "2048", "2048", "--out", matched]) == 1
    assert "lacks the columns x_err, y_err" in capsys.readouterr().err
    assert parser.main(["match", *lists, "--error", "0.05", "--shape", "2048", "2048", "--out", matched]) == 0
    matched = Table.read(matched, format="ascii.ecsv")
    assert_array_equal(matched["x_err"], 0.05)
    brightest = matched[matched["star"] == 0]["mag"]
    assert np.max(brightest) <= np.min(matched["mag"]) + 0.001  # stars are numbered by their magnitudes
