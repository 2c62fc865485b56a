"""Damaged and nonsensical inputs for every reader: each is read, or refused by an error of the package.

    python tests/fuzz.py --inputs 10000

draws inputs from the small files of ``tests/corpus`` and ``tests/written`` (``python tests/fuzz.py --corpus`` makes the
former), does some damage, and hands them to the reader. A fault is any error that is not a `LegdistortError`, an input
that was changed, a file that was left behind, or half a minute of work; ten minutes in compiled code end the command.
What was read is used as well: a table is matched or solved, a solution printed and evaluated. Seeds are numbers, so
that a fault can be made again: ``python tests/fuzz.py --seed 1234``.
"""

import argparse
import gzip
import inspect
import io
import os
import re
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from contextlib import redirect_stdout, suppress
from functools import partial
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

import legdistort as ld
from legdistort.coaddition.grids import read_grid
from legdistort.exceptions import LegdistortError
from legdistort.inputs.references.catalogue import read_reference
from legdistort.inputs.table_files import read_table
from legdistort.measurement.effective.sources import read_psf
from legdistort.measurement.noise_curves import NoiseCurves
from legdistort.runtime.fits_bytes import locate, read_bytes
from legdistort.wcs.storage import read_wcs

HERE = Path(__file__).parent
CORPUS = HERE / "corpus"
TIME = 30  # s of the processor for one input
#: What takes the place of a number in a text.
NUMBERS = [
    "nan", "inf", "-inf", "-1", "0", "1", "-0.0", "1e308", "-1e308", "1e-320", "1e400", "9" * 25, "-" + "9" * 25,
    "4294967296", "9223372036854775808", "0.5", "1e18", "'x'", "", "T", "null", "[]", "1 2",
]  # fmt: skip


# --- damage -------------------------------------------------------------------------------------------------------


def damaged(content, rng):
    """Bytes with one to four faults."""
    content = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        content = bytearray(DAMAGES[rng.integers(len(DAMAGES))](content, rng)) or bytearray(b"x")
    return bytes(content)


def _place(content, rng):
    end = len(content) if rng.random() < 0.5 else min(len(content), 6000)  # headers and trees stand in front
    return int(rng.integers(end))


def _bits(content, rng):
    for _ in range(rng.integers(1, 9)):
        content[_place(content, rng)] ^= 1 << int(rng.integers(8))
    return content


def _bytes(content, rng):
    where, n = _place(content, rng), int(rng.integers(1, 64))
    content[where : where + n] = [bytes(n), b"\xff" * n, rng.bytes(n)][rng.integers(3)]
    return content


def _cut(content, rng):
    return content[: _place(content, rng)]


def _drop(content, rng):
    where = _place(content, rng)
    del content[where : where + int(rng.integers(1, 3000))]
    return content


def _repeat(content, rng):
    where, n = _place(content, rng), int(rng.integers(1, 3000))
    content[where:where] = content[where : where + n]
    return content


def _number(content, rng):
    """Another number in a text, or in a card of a header, of which the length stays."""
    found = list(re.finditer(rb"(?<=[\s,=\[:])[-+]?\d+\.?\d*(e[-+]?\d+)?(?=[\s,\]}])", bytes(content[:20_000])))
    if not found:
        return content
    match = found[rng.integers(len(found))]
    new = NUMBERS[rng.integers(len(NUMBERS))].encode()
    if bytes(content[:6]) == b"SIMPLE":  # cards have 80 characters
        new = new.rjust(match.end() - match.start())[: 80 - match.start() % 80]
        content[match.end() - len(new) : match.end()] = new
    else:
        content[match.start() : match.end()] = new
    return content


def _word(content, rng):
    found = list(re.finditer(rb"[A-Za-z_]{2,}", bytes(content[:20_000])))
    if not found:
        return content
    match, other = found[rng.integers(len(found))], found[rng.integers(len(found))]
    new = other[0].ljust(len(match[0]))[: len(match[0])] if rng.random() < 0.5 else other[0]
    content[match.start() : match.end()] = new
    return content


DAMAGES = (_bits, _bytes, _cut, _drop, _repeat, _number, _number, _number, _word)


# --- readers ------------------------------------------------------------------------------------------------------


def use_frame(path):
    (frame,) = ld.read_exposures(path)
    repr(frame)
    ld.open_exposures(path)


def use_table(path):
    table = read_table(path, error=0.1)
    if "star" in table.colnames:
        matches = ld.Matches.from_table(table, shape=table.meta.get("shapes") or (100, 100))
        with suppress(LegdistortError):
            ld.solve(matches, degree=1)
    elif len(table) < 500:
        ld.match(table, shape=table.meta.get("shapes") or (100, 100), min_exposures=2)


def use_solution(path):
    solution = ld.Solution.read(path)
    str(solution)
    for name in solution.names[:1]:
        with suppress(LegdistortError):
            solution[name].wcs(10.0, 10.0)
            solution[name].correct(np.array([[5.0, 5.0]]), errors=np.array([[0.1, 0.1]]))
            solution[name].sigma_map()
    repr(solution.stars)


def use_wcs(path):
    wcs = read_wcs(path)
    wcs.invert(*wcs(10.0, 20.0))


def use_prior(path):
    given = {} if path.suffix == ".asdf" else {"direction": "detector_to_reference"}
    repr(ld.Prior.from_file(path, **given))


def use_camera(path):
    repr(ld.Camera.read(path))


def use_psf(path):
    repr(read_psf(path))


def use_grid(path):
    repr(read_grid(path))


def use_reference(path):
    repr(read_reference(path))


def use_noise(path):
    repr(NoiseCurves.read(path))


def use_bytes(path):
    locate(read_bytes(path)[0], path)


#: Entry point -> function, and the files it is given.
READERS = {
    "frames": (use_frame, ["frame.fits", "frame_dq.fits", "frame.fits.gz", "frame_rice.fits", "frame_sip.fits"]),
    "tables": (use_table, ["matched.ecsv", "detected.ecsv", "matched.fits", "list.txt", "sextractor.cat", "table.csv",
                           "table.vot", "matched.ecsv.gz", "daophot.als"]),
    "solution": (use_solution, ["solution.asdf"]),
    "wcs": (use_wcs, ["wcs.asdf"]),
    "prior": (use_prior, ["prior.asdf", "frame_sip.fits", "sip.head", "solution.asdf"]),
    "camera": (use_camera, ["camera.asdf"]),
    "psf": (use_psf, ["psf.fits"]),
    "grid": (use_grid, ["frame_sip.fits", "sip.head"]),
    "reference": (use_reference, ["gaia.csv", "gaia.vot"]),
    "noise": (use_noise, ["noise.ecsv"]),
    "attach": (use_bytes, ["frame_dq.fits", "frame.fits.gz", "frame_rice.fits"]),
}  # fmt: skip


def source(name):
    (written,) = (path for path in sorted((HERE / "written").iterdir())[-1:])
    return CORPUS / name if (CORPUS / name).exists() else written / name


class Slow(BaseException):
    """An input that takes too long."""


def _ring(*_):
    raise Slow


def _give_up(seed):
    print(f"seed {seed}: no answer in {20 * TIME} s, in compiled code, which no signal reaches", flush=True)
    os._exit(1)


def attempt(seed, folder):
    """The entry point, the fault or None, and the traceback, for one input."""
    watch = threading.Timer(20 * TIME, _give_up, [seed])
    watch.daemon = True
    watch.start()
    try:
        return _attempt(seed, folder)
    finally:
        watch.cancel()


def _attempt(seed, folder):
    rng = np.random.default_rng(seed)
    entry = list(READERS)[rng.integers(len(READERS))]
    use, names = READERS[entry]
    name = names[rng.integers(len(names))]
    content = source(name).read_bytes()
    if name.endswith(".gz") and rng.random() < 0.7:  # what is inside is damaged, not the packing
        content = gzip.compress(damaged(gzip.decompress(content), rng), 1)
    else:
        content = damaged(content, rng)
    path = folder / name
    path.write_bytes(content)
    fault = told = None
    signal.setitimer(signal.ITIMER_PROF, TIME)
    try:
        with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
            use(path)
    except LegdistortError as error:
        text = str(error)
        if not text or "Traceback" in text:
            fault = f"says nothing: {text!r}"
    except Slow:
        fault = f"more than {TIME} s"
    except Exception as error:
        fault, told = f"{type(error).__name__}: {str(error).splitlines()[:1]}", traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    if path.read_bytes() != content:
        fault = "the input was changed"
    if strays := [item.name for item in folder.iterdir() if item != path]:
        fault = f"left behind: {strays}"
    path.unlink()
    return entry, fault, told


def fuzz(seeds, *, verbose=True):
    """``(inputs by entry point, faults by seed)``."""
    signal.signal(signal.SIGPROF, _ring)
    counts, faults = Counter(), {}
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            entry, fault, told = attempt(seed, Path(folder))
            counts[entry] += 1
            if fault is not None:
                faults[seed] = (entry, fault)
                if verbose:
                    print(f"seed {seed}: {entry}: {fault}", flush=True)
                    if told and len(seeds) == 1:
                        print(told)
    return counts, faults


# --- arguments and values -----------------------------------------------------------------------------------------

#: What somebody might give for any argument.
VALUES = [
    None, True, False, 0, 1, -1, 3, 10**30, 0.0, 0.5, -2.5, 1e300, float("nan"), float("inf"), "", "x", "auto", b"x",
    [], [1, 2], (3.0, 4.0), {}, {"a": 1}, {1: "a"}, np.zeros(2), np.zeros((2, 3)), np.array(["a"]), np.float32(2.0),
    np.int64(2), 1j, object(), len, Path("none"), range(3), {1, 2},
]  # fmt: skip
#: Arguments that only say how much is shown, or that need other machinery.
_LEFT_OUT = {"progress", "workers", "scratch"}


def small_set():
    """Matches and a table of detections of a small simulation."""
    from legdistort.simulation.observations import simulate_matches

    matches = simulate_matches(n_stars=12, n_exposures=4, degree=1, shape=(100, 100), dither=5.0, seed=1).matches
    detections = matches.table.copy()
    detections.remove_column("star")
    return matches, detections


def argument_calls():
    """Functions of one value: every argument of `match`, `solve`, `Matches.from_table` and of the frozen options."""
    from legdistort.coaddition.options import CoaddOptions
    from legdistort.matching.options import MatchOptions
    from legdistort.measurement.options import MeasureOptions

    matches, detections = small_set()
    shape = {"shape": (100, 100)}
    functions = {
        "match": (ld.match, partial(ld.match, detections, **shape)),
        "solve": (ld.solve, partial(ld.solve, matches, degree=1)),
        "from_table": (ld.Matches.from_table, partial(ld.Matches.from_table, matches.table, **shape)),
        "Prior": (ld.Prior, partial(ld.Prior, np.zeros((2, 3)))),
        "MatchOptions": (MatchOptions, MatchOptions),
        "MeasureOptions": (MeasureOptions, MeasureOptions),
        "CoaddOptions": (CoaddOptions, CoaddOptions),
    }
    for name, (function, call) in functions.items():
        for parameter in inspect.signature(function).parameters.values():
            an_option = parameter.kind is parameter.KEYWORD_ONLY or "Options" in name
            if an_option and parameter.name not in _LEFT_OUT:
                yield f"{name}({parameter.name}=...)", lambda v, c=call, p=parameter.name: c(**{p: v})
    yield "match(...)", lambda v: ld.match(v, **shape)
    yield "solve(...)", ld.solve
    yield "from_table(...)", lambda v: ld.Matches.from_table(v, **shape)


def value_calls():
    """Functions of one value, which stands in one row or in all rows of a column of a table, matched and solved."""
    matches, detections = small_set()
    for name in matches.table.colnames:
        for rows in (0, slice(None)):
            for kind, table in (("solve", matches.table), ("match", detections)):
                if name in table.colnames:
                    yield f"{kind}, column {name}, {'a row' if rows == 0 else 'all'}", partial(_with, table, name, rows)


def _with(table, name, rows, value):
    table = table.copy()
    unit = getattr(table[name], "unit", None)
    column = np.array(getattr(table[name], "value", table[name]), dtype=object)
    column[rows] = value
    plain = all(isinstance(v, (int, float, np.number)) and abs(v) < 2**63 for v in column)
    table[name] = column.astype(float) if plain and unit is not None else column
    if unit is not None and plain:
        table[name].unit = unit
    if "star" in table.colnames:
        ld.solve(ld.Matches.from_table(table, shape=(100, 100)), degree=1)
    else:
        ld.match(table, shape=(100, 100))


def nonsense(calls, values):
    """Number of calls, and the faults: errors that are not the package's, in a list of sentences."""
    signal.signal(signal.SIGPROF, _ring)
    n, faults = 0, []
    for name, call in calls:
        for value in values:
            n += 1
            signal.setitimer(signal.ITIMER_PROF, TIME)
            try:
                with warnings.catch_warnings(action="ignore"), redirect_stdout(io.StringIO()):
                    call(value)
            except LegdistortError:
                pass
            except (Exception, Slow) as error:
                faults.append(f"{name} with {value!r}: {type(error).__name__}: {str(error)[:90]!r}")
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
    return n, faults


#: Numbers that stand in tables.
EXTREME = [0.0, -1.0, 1e-320, 1e-30, 1e30, 1e300, -1e300, float("nan"), float("inf"), 10**30, 5]


# --- corpus -------------------------------------------------------------------------------------------------------


def make_corpus():
    """Small files of every kind that is read."""
    from legdistort.simulation.observations import simulate_exposures, simulate_matches

    CORPUS.mkdir(exist_ok=True)
    rng = np.random.default_rng(1)
    image = rng.normal(100, 5, (24, 30)).astype("f4")
    sip = fits.Header({"CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRPIX1": 15.0, "CRPIX2": 12.0,
                       "CRVAL1": 10.0, "CRVAL2": 20.0, "CD1_1": -1e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 1e-5,
                       "A_ORDER": 2, "B_ORDER": 2, "A_2_0": 1e-4, "B_0_2": -2e-4, "EXPTIME": 30.0})  # fmt: skip
    write = partial(fits.HDUList.writeto, overwrite=True)
    write(fits.HDUList([fits.PrimaryHDU(image)]), CORPUS / "frame.fits")
    write(fits.HDUList([fits.PrimaryHDU(image)]), CORPUS / "frame.fits.gz")
    planes = [fits.ImageHDU(image, name="SCI"), fits.ImageHDU(np.ones_like(image), name="ERR"),
              fits.ImageHDU(np.zeros(image.shape, "i2"), name="DQ")]  # fmt: skip
    write(fits.HDUList([fits.PrimaryHDU(), *planes]), CORPUS / "frame_dq.fits")
    rice = fits.CompImageHDU(image.astype("i2"), name="SCI")
    write(fits.HDUList([fits.PrimaryHDU(), rice]), CORPUS / "frame_rice.fits")
    whole = fits.PrimaryHDU(image, sip)
    write(fits.HDUList([whole]), CORPUS / "frame_sip.fits")
    (CORPUS / "sip.head").write_text(whole.header.tostring(sep="\n") + "\n")
    sim = simulate_matches(n_stars=12, n_exposures=4, degree=1, shape=(100, 100), dither=5.0, seed=1)
    matched = sim.matches.table.copy()
    matched.write(CORPUS / "matched.ecsv", overwrite=True)
    matched.write(CORPUS / "matched.fits", overwrite=True)
    (CORPUS / "matched.ecsv.gz").write_bytes(gzip.compress((CORPUS / "matched.ecsv").read_bytes(), mtime=0))
    detected = matched.copy()
    detected.remove_column("star")
    detected.write(CORPUS / "detected.ecsv", overwrite=True)
    plain = Table({"x": [1.5, 20.0, 33.0], "y": [4.0, 50.0, 61.0], "x_err": [0.1, 0.1, 0.2],
                   "y_err": [0.1, 0.1, 0.2], "flux": [10.0, 100.0, 1000.0], "ra": [10.0, 10.001, 10.002],
                   "dec": [20.0, 20.001, 20.002]})  # fmt: skip
    plain.write(CORPUS / "table.csv", overwrite=True)
    plain.write(CORPUS / "table.vot", format="votable", overwrite=True)
    plain.write(CORPUS / "list.txt", format="ascii.commented_header", overwrite=True)
    (CORPUS / "sextractor.cat").write_text(
        "#   1 X_IMAGE    Object position along x   [pixel]\n#   2 Y_IMAGE    Object position along y   [pixel]\n"
        "#   3 ERRX2_IMAGE Variance  [pixel**2]\n#   4 ERRY2_IMAGE Variance  [pixel**2]\n#   5 ERRXY_IMAGE Covariance "
        "[pixel**2]\n#   6 FLUX_AUTO  Flux  [count]\n#   7 FLAGS      Flags\n"
        + "".join(f"{10 * k + 1.5} {7 * k + 2.5} 0.01 0.01 0.0 {100 * k + 50} 0\n" for k in range(6))
    )
    (CORPUS / "daophot.als").write_text(
        " NL   NX   NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD\n"
        "  1   30   24   -50.0 60000.0   10.00    3.00    2.00    5.00    4.0\n\n"
        + "".join(f"{k:6d} {5 * k:8.3f} {4 * k:8.3f} 15.{k}00 0.0100 100.0 3. 1.0 0.1\n" for k in range(1, 5))
    )
    (CORPUS / "gaia.csv").write_text(
        "source_id,ra,ra_error,dec,dec_error,pmra,pmra_error,pmdec,pmdec_error,parallax,ref_epoch\n"
        + "".join(f"{k},{10 + k / 1e3},0.1,{20 + k / 1e3},0.1,1.0,0.1,-1.0,0.1,null,2016.0\n" for k in range(1, 6))
    )
    Table.read(CORPUS / "gaia.csv").write(CORPUS / "gaia.vot", format="votable", overwrite=True)
    y, x = np.mgrid[-20:21, -20:21] / 4
    psf = np.stack([np.exp(-(x**2 + y**2) / (2 * (1.0 + 0.1 * k))) / (2 * np.pi * (1.0 + 0.1 * k)) for k in range(4)])
    header = fits.Header({"NXPSFS": 2, "NYPSFS": 2, "IPSFX01": 1, "IPSFX02": 30, "JPSFY01": 1, "JPSFY02": 24})
    write(fits.HDUList([fits.PrimaryHDU(psf.astype("f4"), header)]), CORPUS / "psf.fits")
    night = simulate_exposures(small=True, seed=3)
    frame = next(iter(night.write(Path(tempfile.mkdtemp()))))
    ld.calibrate_noise(ld.read_exposures(frame), n_positions=20).write(CORPUS / "noise.ecsv", overwrite=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first input")
    parser.add_argument("--seed", type=int, help="one input, with the traceback")
    parser.add_argument("--corpus", action="store_true", help="make the corpus")
    given = parser.parse_args()
    if given.corpus:
        make_corpus()
        sys.exit()
    begin = time.perf_counter()
    seeds = [given.seed] if given.seed is not None else range(given.first, given.first + given.inputs)
    number, wrong = fuzz(seeds)
    print("entry point   inputs  faults")
    for entry in READERS:
        print(f"{entry:12s} {number[entry]:7d} {sum(e == entry for e, _ in wrong.values()):7d}")
    for label, calls, values in (("arguments", argument_calls, VALUES), ("values", value_calls, EXTREME)):
        if given.seed is None:
            n, bad = nonsense(list(calls()), values)
            print(*bad, f"{label:12s} {n:7d} {len(bad):7d}", sep="\n")
            number[label], wrong = n, wrong | {f"{label} {k}": (label, each) for k, each in enumerate(bad)}
    print(f"{'all':12s} {number.total():7d} {len(wrong):7d}   in {time.perf_counter() - begin:.0f} s")
    sys.exit(bool(wrong))
