"""Inputs wrong in their meaning, where `fuzz.py` damages bytes: read, or refused by an error of the package.

    python tests/fuzz_kinds.py fits --inputs 3000

Kinds: ``fits``, cards, descriptors, tiles and packing of FITS files; ``trees``, ASDF files that pass the first check,
with one wrong value; ``cells``, star lists with one wrong cell; ``words``, command lines; ``folders``, folders of
results of which files were exchanged, linked, planted or forged. A fault is an error that is not a `LegdistortError`, a
traceback, half a minute of work, a request to a server, and any change outside the one folder that a command may write.
Seeds are numbers, so that a fault can be made again: ``--seed 17``.
"""

import argparse
import bz2
import gzip
import hashlib
import io
import json
import logging
import lzma
import os
import re
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
import warnings
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path

import asdf
import fuzz
import list_dialects
import numpy as np
from astropy.io import fits
from astropy.table import Table

import legdistort as ld
from legdistort.cli.arguments import flagged
from legdistort.cli.parser import main
from legdistort.cli.usage import COMMANDS
from legdistort.exceptions import LegdistortError
from legdistort.inputs.table_files import read_table
from legdistort.runtime import locks

#: What takes the place of a value in a card, a tree or a cell.
NUMBERS = [
    0, -1, 1, 2, 7, 255, 999, 1000, 65536, 2**31 - 1, 2**31, 2**53, 2**63 - 1, 2**63, 10**30, -(2**31), 0.0, -0.0, 0.5,
    1e-320, 1e30, 1e308, -1e308, float("nan"), float("inf"), -float("inf"),
]  # fmt: skip
TEXTS = [
    "", " ", "x", "T", "nan", "1e400", "1,5", "0x10", "1_000", "--", "*****", "9" * 400, "\N{GREEK SMALL LETTER ALPHA}",
    "\N{ARABIC-INDIC DIGIT ONE}", "a b", "'", '"', "<td>", "&amp;", "!!python/object:x", "{}", "[1, 2]", "%s", "\\x00",
    "../../x", "/etc/passwd", "~root", "http://127.0.0.1:9/x", "file:///etc/passwd", "-1 2", "None", "1;2",
]  # fmt: skip


def pick(rng, values):
    """One of some values."""
    return values[rng.integers(len(values))]


# --- FITS ---------------------------------------------------------------------------------------------------------


def _saved(hdus):
    file = io.BytesIO()
    hdus.writeto(file)
    return file.getvalue()


@cache
def fits_sources():
    """FITS files of many kinds, by name."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:40, :48]
    image = rng.normal(100, 5, (40, 48))
    for place in ((10, 12), (30, 20), (22, 33)):
        image += 3000 * np.exp(-((x - place[1]) ** 2 + (y - place[0]) ** 2) / 5)
    found = {name: (fuzz.CORPUS / name).read_bytes() for name in (
        "frame.fits", "frame_dq.fits", "frame_rice.fits", "frame_sip.fits", "psf.fits", "matched.fits")}  # fmt: skip
    for kind in ("GZIP_1", "GZIP_2", "PLIO_1", "HCOMPRESS_1", "NOCOMPRESS"):
        packed = fits.CompImageHDU(image.astype("i2"), name="SCI", compression_type=kind, tile_shape=(20, 16))
        found[f"{kind}.fits"] = _saved(fits.HDUList([fits.PrimaryHDU(), packed]))
    floats = fits.CompImageHDU(image.astype("f4"), name="SCI", quantize_level=8.0)
    found["quantized.fits"] = _saved(fits.HDUList([fits.PrimaryHDU(), floats]))
    scaled = fits.ImageHDU(image.astype("i2"), name="SCI")
    scaled.header["BZERO"], scaled.header["BSCALE"], scaled.header["BLANK"] = 32768, 1, -1
    found["scaled.fits"] = _saved(fits.HDUList([fits.PrimaryHDU(), scaled, fits.ImageHDU(image, name="ERR")]))
    columns = [
        fits.Column("x", "D", array=rng.uniform(1, 40, 9)), fits.Column("y", "D", array=rng.uniform(1, 40, 9)),
        fits.Column("x_err", "E", array=np.full(9, 0.1)), fits.Column("y_err", "E", array=np.full(9, 0.1)),
        fits.Column("name", "5A", array=np.array(list("abcdefghi"))), fits.Column("flag", "L", array=np.ones(9, bool)),
        fits.Column("list", "PJ()", array=np.array([np.arange(k) for k in range(9)], dtype=object)),
        fits.Column("pair", "4E", dim="(2,2)", array=np.zeros((9, 2, 2))),
        fits.Column("bits", "3X", array=np.ones((9, 3), bool)),
        fits.Column("unsigned", "I", bzero=32768, array=np.arange(9, dtype="u2")),
    ]  # fmt: skip
    found["table.fits"] = _saved(fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]))
    text = fits.TableHDU.from_columns(
        [fits.Column("x", "F10.4", array=rng.uniform(1, 40, 9)), fits.Column("y", "F10.4", array=rng.uniform(1, 40, 9))]
    )
    found["text.fits"] = _saved(fits.HDUList([fits.PrimaryHDU(), text]))
    return found


_CARD = re.compile(rb"[A-Z][A-Z0-9_-]{0,7} *= ")
#: Cards that say how the rest is to be understood are hit more often.
_STRUCTURE = re.compile(
    rb"(BITPIX|Z?NAXIS|[PG]COUNT|T(FORM|DIM|SCAL|ZERO|NULL|TYPE|DISP)|TFIELDS|THEAP|BSCALE|BZERO|BLANK|XTENSION|"
    rb"Z(TILE|CMPTYPE|BITPIX|NAME|VAL|QUANTIZ|SCALE|ZERO|BLANK|MASKCMP)|EXT(NAME|VER))"
)


def _cards(content):
    """``(offset, card)`` of all cards with a value, in all headers."""
    return [
        (k, content[k : k + 80])
        for k in range(0, len(content) - 79, 80)
        if _CARD.match(content, k) and content[k + 8 : k + 10] == b"= "
    ]


def _value_of_card(rng, card):
    now = card[10:].split(b"/")[0].strip()
    if now.startswith(b"'") and rng.random() < 0.8:
        words = [
            "1D", "1PJ(2000000000)", "1QD", "999999999E", "0D", "-1D", "8A", "1X", "(1,1)", "(-1,5)", "(99999,99999)",
            "RICE_1", "GZIP_2", "HCOMPRESS_1", "PLIO_1", "RICE_ONE", "NONE", "IMAGE", "BINTABLE", "TABLE", "x", "SCI",
            "RA---TAN", "RA---TPV", "RA---ZPN", "DEC--SIP", "TLON-TAN", "2031-13-45", "2031-01-01T00:00:00", "E8.3",
            *TEXTS,
        ]  # fmt: skip
        return f"'{pick(rng, words)!s:8s}'".encode("ascii", "replace")[:70]
    if rng.random() < 0.15:
        return pick(rng, [b"T", b"F", b"'x'", b"", b"1 2", b"1D5", b"NaN", b"-", b"(1.0, 2.0)"])
    return f"{pick(rng, NUMBERS)!r:>20s}".encode()


def damaged_fits(rng):
    """A name and the bytes of a FITS file in which cards, descriptors or the order of parts are wrong."""
    name = pick(rng, sorted(fits_sources()))
    content = bytearray(fits_sources()[name])
    for _ in range(rng.integers(1, 4)):
        cards = _cards(bytes(content))
        if not cards:
            break
        structure = [each for each in cards if _STRUCTURE.match(each[1])]
        where, card = pick(rng, structure if structure and rng.random() < 0.6 else cards)
        what = rng.integers(8)
        if what <= 3:
            content[where : where + 80] = (card[:10] + _value_of_card(rng, card)).ljust(80)[:80]
        elif what == 4:  # no card
            content[where : where + 80] = b"COMMENT".ljust(80)
        elif what == 5:  # twice, with another value
            other = pick(rng, cards)[0]
            content[other : other + 80] = (card[:10] + _value_of_card(rng, card)).ljust(80)[:80]
        elif what == 6:  # words of the data: descriptors of heaps and tiles, ends of blocks
            place = int(rng.integers(2880, max(len(content) - 8, 2881)))
            content[place : place + 8] = int(pick(rng, [0, 1, 2**31 - 1, 2**40, 2**63 - 1])).to_bytes(8, "big")
        else:  # whole blocks gone, twice, or exchanged
            blocks = [content[k : k + 2880] for k in range(0, len(content), 2880)]
            k = int(rng.integers(len(blocks)))
            blocks[k : k + 1] = pick(rng, [[], [blocks[k], blocks[k]], [bytes(2880)], [pick(rng, blocks)]])
            content = bytearray(b"".join(blocks)) or bytearray(b" ")
    content, packing = bytes(content), rng.random()
    if packing < 0.15:
        pack = pick(rng, [gzip.compress, bz2.compress, lzma.compress])
        content = pack(content)
    return name, content


def use_fits(rng, folder):
    """Every reader of FITS in turn gets a damaged file."""
    name, content = damaged_fits(rng)
    path = folder / name
    path.write_bytes(content)
    uses = [fuzz.use_frame, fuzz.use_table, fuzz.use_psf, fuzz.use_grid, fuzz.use_prior, fuzz.use_bytes, use_frames]
    for use in uses:
        with suppress(LegdistortError):
            use(path)
    assert path.read_bytes() == content, "the input was changed"


def use_frames(path):
    """Images are measured as well."""
    for exposure in ld.open_exposures(path):
        ld.measure([exposure.read()])


# --- trees of ASDF ------------------------------------------------------------------------------------------------


@cache
def trees():
    """Reader and tree, with arrays of numpy, of every kind of file in ASDF."""
    found = {}
    for name, (use, _) in {key: fuzz.READERS[key] for key in ("solution", "prior", "camera")}.items():
        with asdf.open(fuzz.source(f"{name}.asdf"), memmap=False, lazy_load=False) as opened:
            tree = {k: v for k, v in opened.tree.items() if k.startswith("legdistort")}
            plain = asdf.treeutil.walk_and_modify(
                tree, lambda node: np.array(node) if isinstance(node, asdf.tags.core.NDArrayType) else node
            )
        found[name] = use, plain
    return found


def _leaves(node, path=()):
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _leaves(value, (*path, key))
    elif isinstance(node, list):
        for k, value in enumerate(node):
            yield from _leaves(value, (*path, k))
    elif path:
        yield path


def _with(node, path, value):
    """A copy of a tree with another value at a place; what is beside it is shared."""
    if not path:
        return value
    copy = node.copy()
    copy[path[0]] = _with(node[path[0]], path[1:], value)
    return copy


def _wrong(rng, value):
    """A value of the same type as another, and wrong; seldom of another type, which the first check sees."""
    if rng.random() < 0.1:
        return pick(rng, [None, True, "x", 3, 0.5, [], {}, np.zeros(2), np.array(["a"]), [1, "a", None]])
    if isinstance(value, np.ndarray) and value.size:
        value = value.copy()
        if value.dtype.kind in "US":
            value.flat[rng.integers(value.size)] = pick(rng, TEXTS)
        elif value.dtype.kind == "b":
            value.flat[rng.integers(value.size)] ^= True
        elif rng.random() < 0.2:
            change = [value[..., :0], value[:1], value.T, value[..., None], np.concatenate([value, value]), value * 0,
                      value * 1e200, -value, value[::-1]]  # fmt: skip
            with np.errstate(all="ignore"):
                value = np.ascontiguousarray(pick(rng, change) if value.ndim else value)
        else:
            with np.errstate(all="ignore"), suppress(OverflowError, ValueError):
                value.flat[rng.integers(value.size)] = pick(rng, NUMBERS)
        return value
    if isinstance(value, str):
        return pick(rng, TEXTS)
    number = pick(rng, NUMBERS)
    if isinstance(value, int) and not isinstance(value, bool):
        return int(number) if abs(number) < 2**52 else 2**40
    return number


def use_tree(rng, folder):
    """A tree with one wrong value is written, read, and what was read is used."""
    name = pick(rng, sorted(trees()) + ["solution"] * 4)
    use, tree = trees()[name]
    path = pick(rng, list(_leaves(tree)))
    value = tree
    for key in path:
        value = value[key]
    tree = _with(tree, path, _wrong(rng, value))
    where = folder / f"{name}.asdf"
    try:
        asdf.AsdfFile(tree, version="1.5.0").write_to(where)
    except Exception:  # what asdf does not write is no input
        return
    with suppress(LegdistortError):
        use(where)
        if name == "solution":
            use_all_of(ld.Solution.read(where), folder)


def use_all_of(solution, folder):
    """What people do with a solution."""
    view = solution[solution.names[0]]
    for function in (
        lambda: str(solution), lambda: repr(solution.residuals), lambda: solution.check(), lambda: view.header(),
        lambda: view.errors, lambda: solution.write(folder / "again.asdf", overwrite=True),
        lambda: solution.stars_at(2030.0), lambda: view.distort(np.array([[5.0, 5.0]])), lambda: view.relative_errors,
        lambda: view.model, lambda: view.covariance, lambda: view.sigma_map(n=5),
    ):  # fmt: skip
        with suppress(LegdistortError, AttributeError):
            function()
    (folder / "again.asdf").unlink(missing_ok=True)


# --- star lists ---------------------------------------------------------------------------------------------------


def use_cell(rng, folder):
    """A list in a dialect with one wrong cell, read, and matched with a good one."""
    name = pick(rng, [key for key, (_, _, options, _) in list_dialects.DIALECTS.items() if options is not None])
    ending, write, options, _ = list_dialects.DIALECTS[name]
    x, y, mag = list_dialects.stars(rng, full=False)
    made = write(x, y, mag, False)
    path = folder / f"list.{ending}"
    if isinstance(made, bytes):
        path.write_bytes(_wrong_cell_of_bytes(rng, made))
    else:
        lines = [line for part in made for line in part]
        text = "\n".join(lines) + "\n"
        path.write_bytes(_wrong_cell(rng, text).encode("utf-8", "surrogateescape"))
    good = Table(
        {"x": x + 0.5, "y": y - 0.25, "x_err": np.full(len(x), 0.05), "y_err": np.full(len(x), 0.05), "mag": mag}
    )
    good["exposure"] = "good"
    with suppress(LegdistortError):
        table = read_table(path, **options)
        tables = [table, good]
        ld.match(tables, shape=(1000, 1000), min_exposures=2)


def _wrong_cell(rng, text):
    cells = list(re.finditer(r"(?<![^\s,;>|])[^\s,;<>|]+(?![^\s,;<|])", text))
    cell = pick(rng, cells)
    new = pick(
        rng,
        [*TEXTS, *map(repr, NUMBERS), "\0", "\n", "\r", "\ufeff", "\x1a", "#", "|", ",,", "\t", "\udcff", cell[0] * 2],
    )
    return text[: cell.start()] + new + text[cell.end() :]


def _wrong_cell_of_bytes(rng, content):
    if content.startswith(b"SIMPLE"):
        content = bytearray(content)
        for _ in range(8):
            content[int(rng.integers(2880, len(content)))] = int(rng.integers(256))
        return bytes(content)
    return _wrong_cell(rng, content.decode()).encode("utf-8", "surrogateescape")


# --- command lines ------------------------------------------------------------------------------------------------


@cache
def small_run():
    """A folder with frames and the results of a run, made once for this process."""
    folder = Path(tempfile.mkdtemp(prefix="legdistort-fuzz-"))
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()), warnings.catch_warnings(action="ignore"):
        assert main(["demo", "--small", "--out", str(folder / "demo")]) == 0
    return folder / "demo"


def run_words(words, folder):
    """Status and what was said by a command line in a folder; a fault is an `AssertionError`."""
    said, printed = io.StringIO(), io.StringIO()
    before = os.getcwd()
    os.chdir(folder)
    try:
        with redirect_stdout(printed), redirect_stderr(said), warnings.catch_warnings(action="ignore"):
            try:
                status = main(words)
            except SystemExit as stopped:
                status = stopped.code
    finally:
        os.chdir(before)
    assert status in (0, 1, 2, 3), f"status {status}"
    assert "Traceback" not in said.getvalue(), said.getvalue()[-500:]
    if status in (1, 2):
        last = said.getvalue().splitlines()[-1:]
        assert last, "nothing was said"
        assert last[0].startswith("legdistort"), f"status {status}, said {said.getvalue()[-300:]!r}"
    return status, said.getvalue()


def use_words(rng, folder):
    """A command with some of its options, right and wrong values, and sometimes words of another command."""
    demo = small_run()
    for name in ("solution.asdf", "matched.ecsv", "detections.ecsv"):
        os.link(demo / name, folder / name)
    frames = sorted((demo / "frames").glob("*.fits"))[:2]
    for frame in frames:
        os.link(frame, folder / frame.name)
    command = pick(rng, sorted(set(COMMANDS) - {"demo"}))
    groups = COMMANDS[pick(rng, sorted(COMMANDS)) if rng.random() < 0.1 else command].groups
    options = list(flagged(groups))
    words = [command]
    paths = [
        *(frame.name for frame in frames),
        "solution.asdf",
        "matched.ecsv",
        "detections.ecsv",
        "nowhere",
        "out",
        ".",
    ]
    for _ in range(rng.integers(0, 5)):
        _, flag, _, option = pick(rng, options)
        if flag.startswith("-") and flag != "--debug":
            words.append(flag)
        if option.settings.get("action") != "store_true":
            count = option.settings.get("nargs")
            count = count if isinstance(count, int) else int(rng.integers(1, 3)) if count else 1
            words += [
                pick(rng, [*TEXTS, *map(str, NUMBERS), *paths, *option.settings.get("choices", [])])
                for _ in range(count)
            ]
    likely = {name: ["solution.asdf"] for name in ("show", "report", "stars")}
    likely |= {"measure": [frames[0].name], "solve": ["matched.ecsv"], "match": ["detections.ecsv"]}
    likely |= {"attach": ["solution.asdf", frames[0].name], "correct": ["solution.asdf", "detections.ecsv"]}
    words[1:1] = likely.get(command, [pick(rng, paths)])
    if rng.random() < 0.7:
        words += ["--out", pick(rng, ["out", "out.ecsv", "out.asdf", "out.fits", "out.html"])]
    kept = {name: (folder / name).read_bytes() for name in paths if (folder / name).is_file()}
    run_words([str(word) for word in words], folder)
    assert kept == {name: (folder / name).read_bytes() for name in kept}, f"an input was changed by {words}"


# --- folders of results -------------------------------------------------------------------------------------------

#: Commands for a folder of results, ``R``, with two frames of the run, ``F``, copies of them in ``I``, and the matched
#: table of the run, ``M``. They may write into ``O``, and where they are asked to into ``R`` or ``I``.
ON_FOLDERS = [
    ["show", "R"], ["show", "R/solution.asdf"], ["report", "R", "--out", "O/r.html"],
    ["stars", "R", "--out", "O/s.ecsv"], ["solve", "M", "--degree", "1", "--out", "R", "--overwrite"],
    ["solve", "M", "--degree", "1", "--out", "R", "--overwrite", "--keep"],
    ["correct", "R", "R/detections.ecsv", "--out", "O/c.ecsv"], ["attach", "R", "F", "--out", "O/a"],
    ["attach", "R", "I", "--in-place"], ["coadd", "F", "--solution", "R", "--out", "O/m.fits"],
    ["solve", "R/matched.ecsv", "--out", "O/n"], ["run", "--from", "R", "--degree", "1", "--out", "O/n"],
    ["match", "R/detections.ecsv", "--out", "O/m.ecsv"],
    ["predict", "--n-exposures", "8", "--n-stars", "50", "--sigma", "0.1", "--degree", "1",
     "--prior", "R/solution.asdf", "--plot", "O/p.png"],
]  # fmt: skip
WORD = "0123456789abcdef" * 2


def hostile(rng, results, outside):
    """Do something to a folder of results, with an eye on files outside it."""
    names = sorted(item.relative_to(results).as_posix() for item in results.rglob("*") if item.is_file())
    name = pick(rng, names)
    path, what = results / name, int(rng.integers(12))
    victim = pick(rng, ["../outside/thesis.txt", str(outside / "thesis.txt"), "../../outside", "/etc/passwd"])
    if what == 0:
        path.unlink()
    elif what == 1:
        path.unlink()
        path.mkdir()
        (path / "a").write_text("x")
    elif what == 2:
        path.unlink()
        path.symlink_to(victim)
    elif what == 3:
        path.write_bytes(fuzz.damaged(path.read_bytes(), rng))
    elif what == 4:
        path.write_bytes((results / pick(rng, names)).read_bytes())
    elif what == 5:
        path.write_bytes(b"")
    elif what == 6:
        summary = json.loads((results / "summary.json").read_text())
        key = pick(rng, sorted(summary))
        summary[key] = pick(rng, [None, [], {}, victim, {victim: "0" * 64}, 10**30, "x", [summary], summary[key]])
        if rng.random() < 0.5:
            summary["files"] = {victim: "0" * 64, name: "1"}
        (results / "summary.json").write_text(json.dumps(summary))
    elif what in (7, 8):  # hidden folders that somebody planted, as dead processes leave them
        plant(rng, pick(rng, [results, results.parent, results / "wcs", results.parent / "I"]), results, victim)
    elif what == 9:  # and one that shall be taken for the results, which were set aside
        results.rename(results.with_name(f"{results.name}{locks.OLD}{WORD}"))
    elif what == 10:
        (results / "wcs").exists() and shutil.rmtree(results / "wcs")
        (results / "wcs").symlink_to(outside)
    else:
        path.chmod(0)


def plant(rng, place, results, victim):
    """A hidden folder with links, a plan, and a lock of whatever kind."""
    word = pick(rng, [WORD, "abc", *(hashlib.sha256(name).hexdigest()[:32] for name in (b"", results.name.encode()))])
    hidden = place / pick(
        rng, [f".partial-{word}", f".replaced-{word}", f".commit-{word}", f"{results.name}.old-{word}"]
    )
    link = pick(rng, [hidden, hidden / locks.LOCK, hidden / "new", hidden / "solution.asdf", hidden / "exp00.fits"])
    if link != hidden:
        hidden.mkdir()
        (hidden / "summary.json").write_text(json.dumps({"remove": [victim], "files": {victim: "0" * 64}}))
        (hidden / locks.LOCK).touch()
    link.unlink(missing_ok=True)
    link.symlink_to(victim)


def use_folder(rng, folder):
    """A command on a folder of results that somebody changed."""
    demo = small_run()
    results, out = folder / "R", folder / "O"
    out.mkdir()
    shutil.copytree(demo, results, ignore=shutil.ignore_patterns("frames"))
    frames = [str(path) for path in sorted((demo / "frames").glob("*.fits"))]
    (folder / "I").mkdir()
    copies = [shutil.copy(path, folder / "I") for path in frames[:2]]
    outside = folder / "outside"
    outside.mkdir()
    (outside / "thesis.txt").write_text("years of work")
    (results / "frames").symlink_to(demo / "frames")  # where the table says that they are
    for _ in range(rng.integers(1, 3)):
        with suppress(OSError, ValueError, KeyError):
            hostile(rng, results, outside)
    before = snapshot(outside), snapshot(demo)
    given = {"F": frames[:2], "I": copies, "M": [str(demo / "matched.ecsv")]}
    words = [part for word in pick(rng, ON_FOLDERS) for part in given.get(word, [word])]
    mine = None if "--overwrite" in words else snapshot(results)
    run_words(words, folder)
    assert before == (snapshot(outside), snapshot(demo)), f"{words} changed what lies outside"
    assert mine is None or mine == snapshot(results), f"{words} changed what it read"


def snapshot(folder):
    """Names, links, contents of all that is below a folder; locks, which writers leave, aside."""
    found = {}
    for item in sorted(folder.rglob("*")):
        if item.name == ".legdistort.lock":
            continue
        if item.is_symlink():
            found[item.relative_to(folder)] = os.readlink(item)
        elif item.is_file():
            found[item.relative_to(folder)] = item.read_bytes() if os.access(item, os.R_OK) else b""
        else:
            found[item.relative_to(folder)] = None
    return found


# --- all kinds ----------------------------------------------------------------------------------------------------

KINDS = {"fits": use_fits, "trees": use_tree, "cells": use_cell, "words": use_words, "folders": use_folder}


def _refuse_connection(*arguments, **_):
    raise AssertionError(f"a request to {arguments}")


def attempt(kind, seed):
    """The fault, or None, and its traceback, of one input."""
    rng = np.random.default_rng([sorted(KINDS).index(kind), seed])
    fault = told = None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        top = Path(name)
        place = top / "place"
        place.mkdir()
        (top / "beside.txt").write_text("beside")
        signal.setitimer(signal.ITIMER_PROF, fuzz.TIME)
        try:
            with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
                KINDS[kind](rng, place)
        except LegdistortError:
            pass
        except fuzz.Slow:
            fault = f"more than {fuzz.TIME} s"
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            fault, told = f"{type(error).__name__}: {str(error)[:300]!r}", traceback.format_exc()
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        if (
            snapshot(top).keys() - {Path("beside.txt")} != {path for path in snapshot(top) if path.parts[0] == "place"}
            or (top / "beside.txt").read_text() != "beside"
        ):
            fault = "something outside the folder was changed"
    return fault, told


def fuzz_kind(kind, seeds, *, verbose=True):
    """The faults by seed."""
    signal.signal(signal.SIGPROF, fuzz._ring)
    if kind in ("words", "folders"):
        small_run()  # before there is a limit of time
    connect, socket.socket.connect = socket.socket.connect, _refuse_connection
    logging.disable(logging.CRITICAL)
    faults = {}
    try:
        for seed in seeds:
            fault, told = attempt(kind, seed)
            if fault is not None:
                faults[seed] = fault
                if verbose:
                    print(f"{kind} {seed}: {fault}", flush=True)
                    if told and len(seeds) == 1:
                        print(told)
    finally:
        logging.disable(logging.NOTSET)
        socket.socket.connect = connect
    return faults


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kinds", nargs="*", default=sorted(KINDS), choices=sorted(KINDS))
    parser.add_argument("--inputs", type=int, default=500)
    parser.add_argument("--first", type=int, default=0, help="seed of the first input")
    parser.add_argument("--seed", type=int, help="one input, with the traceback")
    given = parser.parse_args()
    wrong = 0
    for each in given.kinds:
        begin = time.perf_counter()
        seeds = [given.seed] if given.seed is not None else range(given.first, given.first + given.inputs)
        found = fuzz_kind(each, seeds)
        wrong += len(found)
        print(
            f"{each:8s} {len(seeds):6d} inputs {len(found):4d} faults   in {time.perf_counter() - begin:.0f} s",
            flush=True,
        )
    sys.exit(bool(wrong))
