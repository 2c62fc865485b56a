"""Star lists and catalogues in the dialects of many programs, with damage: read rightly, or refused by file and row.

    python tests/list_dialects.py --lists 500

writes lists of stars that numpy made, by plain string formatting (FITS and VOTable by astropy), does some damage to a
row or to the file as a whole, and reads them as ``legdistort match`` does. A fault is an error that is not a
`LegdistortError`, a refusal that does not name the file and, of a text, the row that was damaged, and a wrong number in
a list that was read. Seeds are numbers, so that a fault can be made again: ``python tests/list_dialects.py --seed 17``.
"""

import argparse
import gzip
import io
import re
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

from legdistort.exceptions import AssumptionWarning, LegdistortError
from legdistort.inputs import column_contract
from legdistort.inputs.references.catalogue import read_reference
from legdistort.inputs.table_files import read_table

N = 25
ERROR = {"error": 0.05}


def stars(rng, *, full):
    """``x, y, mag`` as printed, with three decimals; `full` ones need all characters that DAOPHOT has for them."""
    x, y = np.round(rng.uniform(10000, 20000, (2, N)) if full else rng.uniform(1, 900, (2, N)), 3)
    return x, y, np.round(rng.uniform(-12, 18, N), 3)


# --- dialects: lines above the rows, the rows, and how they are read ------------------------------------------------


def als(x, y, m, full):
    head = [" NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD",
            "  1 20480 20480    79.9 30000.0   32.07    3.00    2.20    2.86    2.18", ""]  # fmt: skip
    first, sky = (1_000_000, 54321.123) if full else (1, 141.334)
    return head, [
        f"{first + k:7d}{a:9.3f}{b:9.3f}{c:9.3f}{0.015:9.4f}{sky:9.3f}{4:8d}.{0.547:9.3f}{-0.02:9.3f}"
        for k, (a, b, c) in enumerate(zip(x, y, m, strict=True))
    ]


def coo(x, y, m, full):
    first = 1_000_000 if full else 1
    return als(x, y, m, full)[0], [
        f"{first + k:7d}{a:9.3f}{b:9.3f}{c:9.3f}{0.553:9.3f}{-0.048:9.3f}{-0.053:9.3f}"
        for k, (a, b, c) in enumerate(zip(x, y, m, strict=True))
    ]


def iraf(x, y, m, full):
    head = ["#K IRAF       = NOAO/IRAFV2.10EXPORT version    %-23s",
            "#N ID    XCENTER   YCENTER   MAG         MERR          MSKY           NITER    ",
            "#U ##    pixels    pixels    magnitudes  magnitudes    counts         ##       ",
            "#F %-9d  %-12.3f   %-12.3f   %-12.3f     %-14.3f       %-15.7g        %-6d     ", "#"]  # fmt: skip
    return head, [
        f"{k + 1:<9d}{a:<12.3f}{b:<12.3f}{c:<12.3f}{0.003:<14.3f}{34.85955:<15.7g}{4:<6d}"
        for k, (a, b, c) in enumerate(zip(x, y, m, strict=True))
    ]


def txdump(x, y, m, full):
    return [], [f"{k + 1:<6d}  {a:<11.3f}{b:<11.3f}{c:<8.3f}{0.01:<6.3f}" for k, (a, b, c) in rows(x, y, m)]


def sextractor(x, y, m, full):
    head = ["#   1 NUMBER                 Running object number",
            "#   2 XWIN_IMAGE             Windowed position estimate along x              [pixel]",
            "#   3 YWIN_IMAGE             Windowed position estimate along y              [pixel]",
            "#   4 ERRX2WIN_IMAGE         Variance of windowed pos along x                [pixel**2]",
            "#   5 ERRY2WIN_IMAGE         Variance of windowed pos along y                [pixel**2]",
            "#   6 ERRXYWIN_IMAGE         Covariance of windowed pos between x and y      [pixel**2]",
            "#   7 MAG_AUTO               Kron-like elliptical aperture magnitude         [mag]",
            "#   8 FLAGS                  Extraction flags"]  # fmt: skip
    return head, [
        f"{k + 1:6d} {a:11.3f} {b:11.3f} 1.6e-05 1.7e-05 1.4e-07 {c:8.3f} 0" for k, (a, b, c) in rows(x, y, m)
    ]


def keck(x, y, m, full):
    return ["# name m t x y xe ye snr corr N_frames flux"], [
        f"ir{k + 100:<6d} {c:7.3f} 2014.944 {a:9.3f} {b:9.3f} 0.103 0.148 5.424 0.74 4 3213962"
        for k, (a, b, c) in rows(x, y, m)
    ]


def separated(separator):
    def write(x, y, m, full):
        cells = (("e1", f"s{k}", f"{a:.3f}", f"{b:.3f}", "0.02", "0.03", f"{c:.3f}") for k, (a, b, c) in rows(x, y, m))
        return [separator.join(("exposure", "name", "x", "y", "x_err", "y_err", "mag"))], list(
            map(separator.join, cells)
        )

    return write


def ecsv(x, y, m, full):
    names = ("x", "y", "x_err", "y_err", "mag")
    head = ["# %ECSV 1.0", "# ---", "# datatype:", *(f"# - {{name: {name}, datatype: float64}}" for name in names)]
    return [*head, " ".join(names)], [f"{a:.3f} {b:.3f} 0.02 0.03 {c:.3f}" for _, (a, b, c) in rows(x, y, m)]


def ipac(x, y, m, full):
    head = ["\\comment of IPAC", *(f"|{a:>22s}|{b:>22s}|{c:>22s}|" for a, b, c in (("x", "y", "mag"), ("double",) * 3))]
    return head, [f" {a:22.3f} {b:22.3f} {c:22.3f} " for _, (a, b, c) in rows(x, y, m)]


def hst1pass(x, y, m, full):
    head = ["# ARGUMENTS", "#  ARG0010: OUT=xymq", "#     rDAT:       2020.19905472", "#",
            "#.....x..... .....y..... ...m... ..q.."]  # fmt: skip
    return head, [f" {a:11.3f} {b:11.3f} {c:7.3f} 0.033" for _, (a, b, c) in rows(x, y, m)]


def dolphot(x, y, m, full):
    return [], [f"0 1 {a:10.3f} {b:10.3f} {0.98:6.2f} {12.5:8.1f} {c:7.3f} 1" for _, (a, b, c) in rows(x, y, m)]


def gaia(x, y, m, full):
    head = "solution_id,source_id,ref_epoch,ra,ra_error,dec,dec_error,pmra,pmra_error,pmdec,pmdec_error,phot_g_mean_mag"
    return [head], [
        f"1636148068921376768,{4295806720 + k},2016.0,{a / 60:.9f},0.1012,{b / 250:.9f},0.1001,11.94,0.13,-7.5,0.12,{c}"
        for k, (a, b, c) in rows(x, y, m)
    ]


def sexagesimal(x, y, m, full):
    return ["name,ra,dec,ra_error,dec_error,mag"], [
        f"s{k},{words(a / 900, 6)},+{words(b / 250, 5)},0.1,0.1,{c:.3f}" for k, (a, b, c) in rows(x, y, m)
    ]


def words(value, decimals):
    """Three sexagesimal parts of a positive number."""
    unit = 10**decimals
    parts = round(value * 3600 * unit)
    seconds = f"{parts % (60 * unit) / unit:0{decimals + 3}.{decimals}f}"
    return f"{parts // (3600 * unit):02d}:{parts // (60 * unit) % 60:02d}:{seconds}"


def rows(x, y, m):
    return enumerate(zip(x, y, m, strict=True))


def fits_table(x, y, m, full):
    file = io.BytesIO()
    table = Table({"name": [f"\u03b1 {k}".encode() for k in range(N)], "x": x, "y": y, "x_err": np.full(N, 0.02)})
    table["y_err"], table["mag"] = 0.03, m
    table.write(file, format="fits")
    return file.getvalue()


def ldac(x, y, m, full):
    header = fits.Header([("SIMPLE", True), ("BITPIX", -32), ("NAXIS", 2), ("NAXIS1", 20480), ("NAXIS2", 20480)])
    card = header.tostring(endcard=True, padding=False)
    cards = np.array([[card[k : k + 80] for k in range(0, len(card), 80)]], dtype="S80")
    image = fits.Column("Field Header Card", f"{len(card)}A", array=cards, dim=f"(80, {len(card) // 80})")
    columns = {"XWIN_IMAGE": x, "YWIN_IMAGE": y, "MAG_AUTO": m, "ERRAWIN_IMAGE": np.full(N, 0.02)}
    columns |= {"ERRBWIN_IMAGE": np.full(N, 0.01), "ERRTHETAWIN_IMAGE": np.full(N, 10.0)}
    objects = [fits.Column(name, "D", array=column) for name, column in columns.items()]
    file = io.BytesIO()
    head, body = (
        fits.BinTableHDU.from_columns(c, name=n) for c, n in (([image], "LDAC_IMHEAD"), (objects, "LDAC_OBJECTS"))
    )
    fits.HDUList([fits.PrimaryHDU(), head, body]).writeto(file)
    return file.getvalue()


def votable(x, y, m, full):
    file = io.BytesIO()
    Table({"x": x, "y": y, "mag": m}).write(file, format="votable")
    lines = file.getvalue().decode().splitlines()
    starts = [k for k, line in enumerate(lines) if line.strip() == "<TR>"]
    end = starts[-1] + 5
    joined = ["".join(line.strip() for line in lines[k : k + 5]) for k in starts]
    return lines[: starts[0]], joined, lines[end:]


#: Name -> (ending, writer, options of the reader, origin of the pixels).
DIALECTS = {
    "ALLSTAR": ("als", als, ERROR, 1),
    "FIND": ("coo", coo, ERROR, 1),
    "IRAF": ("als.1", iraf, ERROR, 1),
    "txdump": ("txt", txdump, ERROR | {"columns": {"x": "col2", "y": "col3", "mag": "col4"}}, 0),
    "SExtractor": ("cat", sextractor, {}, 1),
    "LDAC": ("ldac", ldac, {}, 1),
    "FlyStar": ("lis", keck, {}, 0),
    "comma": ("csv", separated(","), {}, 0),
    "semicolon": ("csv", separated(";"), {}, 0),
    "tab": ("tsv", separated("\t"), {}, 0),
    "ECSV": ("ecsv", ecsv, {}, 0),
    "VOTable": ("vot", votable, ERROR, 0),
    "IPAC": ("tbl", ipac, ERROR, 0),
    "FITS": ("fits", fits_table, {}, 0),
    "hst1pass": ("xymq", hst1pass, ERROR, 1),
    "DOLPHOT": ("phot", dolphot, ERROR | {"columns": {"x": "col3", "y": "col4", "mag": "col7"}}, 0),
    "Gaia": ("csv", gaia, None, 0),
    "sexagesimal": ("csv", sexagesimal, None, 0),
}
#: Dialects whose full columns leave no blank.
FULL = ("ALLSTAR", "FIND")


# --- damage to a row ------------------------------------------------------------------------------------------------

#: Numbers that stand alone in a row.
CELL = re.compile(r"(?<![^\s,;>])[-+]?\d+\.\d+(?![^\s,;<])")


def _some(line, rng):
    found = list(CELL.finditer(line))
    return found[rng.integers(len(found))] if found else None


def _cell(change):
    def damage(line, rng):
        found = _some(line, rng)
        if found is None:
            return line
        before, word = line[: found.start()], change(found[0], rng)
        while len(before) + len(word) > found.end() and before.endswith("  "):  # as wide as before, if there is room
            before = before[:-1]
        return before + word + line[found.end() :]

    return damage


def _fortran(word, rng):
    """The same number with Fortran's D."""
    return f"{float(word):.12E}".replace("E", "D")


def _insert(what):
    def damage(line, rng):
        k = int(rng.integers(len(line) + 1))
        return line[:k] + what + line[k:]

    return damage


def _merge(line, rng):
    found = list(re.finditer(r"(?<=\d)[ ,;\t]+(?=[-\d])", line))
    if not found:
        return line
    gap = found[rng.integers(len(found))]
    return line[: gap.start()] + line[gap.end() :]


WRONG = ["abc", "1.2.3", "--5", "12:30:15x", "0x1F", "1_0.5", "\u0661"]
#: Name -> change of a row. After those that state no wrong number, the row must be right or without a value.
ROWS = {
    "cut": lambda line, rng: line[: int(rng.integers(1, max(2, len(line))))],
    "wrong word": _cell(
        lambda word, rng: ["abc", "1.2.3", "--5", "12:30:15x", "0x1F", "1_0.5", "\u0661"][rng.integers(7)]
    ),
    "dropped": _cell(lambda word, rng: ""),
    "merged": _merge,
    "zero byte": _insert("\0"),
    "odd byte": _insert("\udce9"),
    "one more": lambda line, rng: line + f" {rng.random():.3f}",
    "Fortran": _cell(_fortran),
    "asterisks": _cell(lambda word, rng: "*" * len(word)),
    "INDEF": _cell(lambda word, rng: "INDEF"),
    "empty line": lambda line, rng: "\n" + line,
    "none": lambda line, rng: line,
}
#: Damage that can put another number into the row.
MISLEADING = ("cut", "wrong word", "odd byte", "dropped")
#: Damage that is none: it must be read.
HARMLESS = ("none", "empty line", "Fortran")

#: Forms of a whole file.
FILES = {
    "plain": lambda content: content,
    "mark": lambda content: b"\xef\xbb\xbf" + content,
    "UTF-16": lambda content: content.decode("utf-8", "replace").encode("utf-16"),
    "CRLF": lambda content: content.replace(b"\n", b"\r\n"),
    "CR": lambda content: content.replace(b"\n", b"\r"),
    "packed": lambda content: gzip.compress(content, 1),
}


def make(seed, kind=None):
    """A damaged list: ``(name of the file, bytes, kind, damage, damaged row or None, truth)``."""
    rng = np.random.default_rng(seed)
    kind = list(DIALECTS)[rng.integers(len(DIALECTS))] if kind is None else kind
    ending, write, _, _ = DIALECTS[kind]
    full = kind in FULL and rng.random() < 0.5
    truth = stars(rng, full=full)
    written = write(*truth, full)
    name = f"list{seed}.{ending}"
    if isinstance(written, bytes):
        damage = ["none", "bytes"][rng.integers(2)]
        if damage == "bytes":
            content = bytearray(written)
            for k in rng.integers(len(content), size=3):
                content[k] = rng.integers(256)
            written = bytes(content[: rng.integers(1, len(content))]) if rng.random() < 0.3 else bytes(content)
        return name, written, kind, damage, None, truth
    head, lines, *tail = written
    damage = list(ROWS)[rng.integers(len(ROWS))]
    row = int(rng.integers(N))
    before, lines = lines[row], list(lines)
    lines[row] = ROWS[damage](lines[row], rng)
    if lines[row] == before or (full and damage == "Fortran"):  # a field of nine characters has no room for it
        lines[row] = before
        damage = "none"
    form = list(FILES)[rng.integers(len(FILES))] if damage in HARMLESS and kind != "VOTable" else "plain"
    content = "\n".join([*head, *lines, *(tail[0] if tail else [])]) + "\n"
    content = FILES[form](content.encode("utf-8", "surrogateescape"))
    return name + ".gz" * (form == "packed"), content, kind, damage, row, truth


def read_list(path, kind):
    """Positions and magnitudes (n, 3) as printed in the file, by the reader."""
    _, _, options, origin = DIALECTS[kind]
    if options is None:
        found = read_reference(path)
        return np.column_stack([found.sky[:, 0] * 60, found.sky[:, 1] * 250, -2.5 * np.log10(found.flux)])
    table = column_contract.check(read_table(path, **options), column_contract.DETECTED, str(path))
    return np.column_stack([table["x"].value + origin, table["y"].value + origin, np.asarray(table["mag"])])


def fault_of(seed, folder, kind=None):
    """``(kind, damage, outcome, fault or None, traceback)`` of one list."""
    name, content, kind, damage, row, truth = make(seed, kind)
    path = Path(folder) / name
    path.write_bytes(content)
    try:
        with warnings.catch_warnings(action="error"), np.errstate(all="ignore"):
            warnings.simplefilter("ignore", AssumptionWarning)
            found = read_list(path, kind)
    except LegdistortError as error:
        return kind, damage, "refused", _fault_of_refusal(str(error), name, kind, damage, row), None
    except Exception as error:  # a fault
        return kind, damage, "error", f"{type(error).__name__}: {str(error).splitlines()[:1]}", traceback.format_exc()
    finally:
        path.unlink()
    return kind, damage, "read", _fault_of_numbers(found, np.column_stack(truth), kind, damage, row), None


def _fault_of_refusal(message, name, kind, damage, row):
    if name not in message:
        return f"the file is not named: {message}"
    if row is None:
        return None
    if damage in HARMLESS:
        return f"nothing is wrong with it: {message}"
    number = r"\d+" if kind == "VOTable" else row  # XML shows where it no longer fits
    if not re.search(rf"\brow {number}\b", message):
        return f"row {row} is not named: {message}"
    return None


def _fault_of_numbers(found, truth, kind, damage, row):
    if damage == "bytes":
        return None
    others = np.delete(truth, row, axis=0) if row is not None else truth
    if len(found) == len(truth):
        mine, own = (np.delete(found, row, axis=0), found[row]) if row is not None else (found, None)
    elif len(found) == len(others) and damage not in HARMLESS:
        mine, own = found, None
    else:
        return f"{len(found)} rows of {len(truth)}"
    tolerance = 2e-6 * np.maximum(np.abs(others), 1)
    if not np.all(np.abs(mine - others) < tolerance):
        return f"wrong numbers in other rows, up to {np.nanmax(np.abs(mine - others)):g}"
    if own is not None and damage not in MISLEADING:
        right = np.abs(own - truth[row]) < 2e-6 * np.maximum(np.abs(truth[row]), 1)
        allowed = right if damage in HARMLESS else right | ~np.isfinite(own)
        if not allowed.all():
            return f"row {row} is {own}, truth {truth[row]}"
    return None


def fuzz(seeds, *, verbose=True):
    """``(outcomes by kind, faults by seed)``."""
    counts, faults = Counter(), {}
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            kind, damage, outcome, fault, told = fault_of(seed, folder)
            counts[kind, outcome] += 1
            if fault is not None:
                faults[seed] = (kind, damage, fault)
                if verbose:
                    print(f"seed {seed}: {kind}, {damage}: {fault}", flush=True)
                    if told and len(seeds) == 1:
                        print(told)
    return counts, faults


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lists", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="seed of the first list")
    parser.add_argument("--seed", type=int, help="one list, with the traceback")
    given = parser.parse_args()
    number, wrong = fuzz([given.seed] if given.seed is not None else range(given.first, given.first + given.lists))
    print("dialect        lists  read  refused  faults")
    for each in DIALECTS:
        read, refused, broken = (number[each, outcome] for outcome in ("read", "refused", "error"))
        bad = sum(kind == each for kind, _, _ in wrong.values())
        print(f"{each:12s} {read + refused + broken:7d} {read:5d} {refused:8d} {bad:7d}")
    print(f"{'all':12s} {number.total():7d}  {len(wrong)} faults")
    sys.exit(bool(wrong))
