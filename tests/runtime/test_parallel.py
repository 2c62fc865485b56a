"""Work on many cores: the same results, bit for bit, in bounded memory, and nothing left when it fails."""

import _thread
import gc
import io
import json
import logging
import mmap
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData
from caller_warnings import warns_here
from night_sets import SIZE, field
from rolled_night import night as rolled_night
from stacks import SHAPE, expose, scene
from threadpoolctl import threadpool_info, threadpool_limits

import legdistort as ld
from legdistort.coaddition import block_stack, preparation
from legdistort.coaddition.resampling import engines
from legdistort.exceptions import AssumptionWarning, DiskFullError, InputError, LegdistortError
from legdistort.inputs.exposure_files import ExposureFile, file_checksums
from legdistort.runtime import parallel, scratch
from legdistort.runtime.parallel import map_items, one_blas_thread
from legdistort.runtime.provenance import checksums

COMPILED = pytest.mark.parametrize("compiled_from", [0, 1 << 62], ids=["compiled", "plain"])
WORK = {"serial": {"workers": 1}, "threads": {"workers": 2, "threads": True}, "processes": {"workers": 2}}


def blas_threads():
    """Threads of every linear algebra library in this process."""
    return [each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"]


def test_frames_have_one_thread_of_linear_algebra_each():
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        assert set(before) == {2}
        with one_blas_thread():
            assert set(blas_threads()) == {1}
        assert list(map_items(lambda _: blas_threads(), range(2))) == [[1] * len(before)] * 2
        assert blas_threads() == before
        steps = threading.Barrier(2)  # two threads whose times with one thread of linear algebra overlap

        def overlap(i):
            steps.wait()
            time.sleep(0.1 * i)
            return blas_threads()

        assert list(map_items(overlap, range(2), workers=2, threads=True)) == [[1] * len(before)] * 2
        assert blas_threads() == before


def work(i):
    """What other processes import from this file."""
    if i == 3:
        warnings.warn("three is assumed", AssumptionWarning, stacklevel=1)
    logging.getLogger("legdistort.test").warning("item %d", i)
    if i == 99:
        raise InputError("99 is not a number to work on")
    return i * i


def die(i):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture(scope="module")
def cluster():
    """Two processes. Port 0 is any free one: the usual one may belong to another cluster of this machine."""
    distributed = pytest.importorskip("distributed")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Creating scratch directories is taking")  # on a busy disk
        cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0")
    with cluster:
        yield cluster


@pytest.fixture
def client(cluster):
    """The cluster as the current client, for one test."""
    with cluster.get_client() as client:
        yield client


@pytest.fixture
def interruptible():
    """Ctrl-C as in a terminal: what a shell starts in the background ignores it.

    And no search for garbage, during which functions that others have registered would swallow it.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.disable()
    yield
    gc.enable()
    signal.signal(signal.SIGINT, before)


class TestEach:
    @pytest.mark.parametrize("how", WORK)
    def test_results_warnings_log_and_errors_come_as_from_a_loop(self, how, caplog):
        with warns_here(AssumptionWarning, match="three is assumed"):
            assert list(map_items(work, range(10), **WORK[how])) == [i * i for i in range(10)]
        assert sorted(r.getMessage() for r in caplog.records) == [f"item {i}" for i in range(10)]
        with pytest.raises(InputError) as caught:
            list(map_items(work, [1, 99, 2], **WORK[how]))
        assert str(caught.value) == "99 is not a number to work on"  # no traceback of a worker in it

    def test_a_cluster_that_goes_away_is_told(self):
        distributed = pytest.importorskip("distributed")
        cluster = distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=None)
        with cluster, cluster.get_client() as client:
            results = map_items(time.sleep, [0, 0.1, 0.5])
            assert next(results) is None
            client.close()
            with pytest.raises(
                LegdistortError, match=r"the cluster is gone \(\w+\): .* connect a new Client, .* workers="
            ):
                list(results)

    @pytest.mark.slow
    def test_a_worker_of_another_version_is_told(self, client, monkeypatch):
        monkeypatch.setattr(parallel, "version", lambda name: "0.0.1")
        with pytest.raises(LegdistortError, match=r"have legdistort [\d.]+, here it is 0\.0\.1: install the same"):
            list(map_items(abs, [1]))

    @pytest.mark.slow
    def test_errors_of_the_work_come_as_they_are_from_a_cluster(self, client):
        with pytest.raises(FileNotFoundError, match="nowhere"):
            list(map_items(open, ["/nowhere"]))

    @pytest.mark.slow
    def test_the_client_of_the_caller_is_used(self, client):
        assert set(map_items(_process, range(8))) == set(client.run(os.getpid).values())
        assert set(map_items(_process, range(8), workers=1)) == {os.getpid()}
        with pytest.raises(InputError, match=r"^99 is not a number to work on$"):
            list(map_items(work, [99]))

    def test_few_items_are_in_flight(self):
        drawn, most = 0, 0

        def items():
            nonlocal drawn
            for i in range(60):
                drawn += 1
                yield i

        for done, _ in enumerate(map_items(abs, items(), workers=2, threads=True)):
            most = max(most, drawn - done)
        assert most <= 8

    def test_a_process_that_dies_is_explained(self):
        with pytest.raises(LegdistortError, match="a worker process died: it ran out of memory, or this is a script"):
            list(map_items(die, [1], workers=2))

    @pytest.mark.parametrize("how", ["threads", "processes"])
    @pytest.mark.usefixtures("interruptible")
    def test_an_interrupt_ends_it(self, how):
        before = set(multiprocessing.active_children())
        timer = threading.Timer(1, _thread.interrupt_main)
        timer.start()
        begin = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            list(map_items(time.sleep, [0.3] * 300, **WORK[how]))
        assert time.monotonic() - begin < 30
        assert set(multiprocessing.active_children()) <= before

    @pytest.mark.parametrize("workers", [0, -1, 1.5, True, "two", np.nan])
    def test_bad_numbers_of_workers(self, workers):
        with pytest.raises(InputError, match="workers must be a positive integer, got"):
            list(map_items(abs, [1], workers=workers))


def in_a_new_process(script, *arguments):
    """What a script prints that runs in a process of its own, without the threads of this one."""
    done = subprocess.run([sys.executable, "-c", script, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux")
class TestCopies:
    def test_where_no_other_thread_runs_workers_are_copies(self):
        """They know what was never imported or pickled; a function of a script without a guard, say."""
        script = """if True:
            import os, threading, time
            from legdistort.runtime.parallel import map_items
            secret = [1]
            def work(i):
                time.sleep(0.05)
                return os.getpid(), secret[0] + i
            secret[0] = 5
            found = list(map_items(work, range(6), workers=2))
            assert [value for _, value in found] == [5, 6, 7, 8, 9, 10]
            assert len({process for process, _ in found} - {os.getpid()}) == 2
            threading.Thread(target=time.sleep, args=[3], daemon=True).start()
            from legdistort.runtime.parallel import _may_fork
            print(_may_fork())
        """
        assert in_a_new_process(script) == "False\n"

    @pytest.mark.slow
    def test_a_function_beside_a_block(self, tmp_path):
        """It is at work while the block runs, its files stay, what it warns of and raises arrives."""
        script = """if True:
            import os, sys, time, warnings
            from pathlib import Path
            from legdistort.exceptions import AssumptionWarning, InputError, LegdistortError
            from legdistort.runtime.parallel import beside
            out = Path(sys.argv[1])
            def work():
                warnings.warn("three is assumed", AssumptionWarning)
                (out / "process").write_text(str(os.getpid()))
                return 7
            def refuse():
                raise InputError("no such thing")
            with warnings.catch_warnings(record=True, action="always") as caught:
                with beside(work, workers=2) as finish:
                    while not (out / "process").exists():
                        time.sleep(0.01)
                    assert finish() == 7
            assert [str(w.message) for w in caught] == ["three is assumed"]
            assert int((out / "process").read_text() or 0) != os.getpid()
            for function, error, words in (
                (refuse, InputError, "no such thing"),
                (lambda: os.kill(os.getpid(), 9), LegdistortError, "a worker process died"),
            ):
                try:
                    with beside(function, workers=2) as finish:
                        finish()
                except error as raised:
                    assert words in str(raised)
                else:
                    raise AssertionError(words)
            begin = time.monotonic()
            for error in (InputError, EOFError):
                try:
                    with beside(lambda: time.sleep(60), workers=2):
                        raise error("of the block")
                except error as raised:
                    assert str(raised) == "of the block"
            assert time.monotonic() - begin < 20
            def no_memory():
                raise OSError(12, "Cannot allocate memory")
            for workers in (1, 2):
                with beside(work, workers=workers) as finish:
                    assert (out / "process").read_text() != str(os.getpid())
                    assert finish() == 7
                assert (out / "process").read_text() == str(os.getpid())
                (out / "process").write_text("")
                os.fork = no_memory
        """
        in_a_new_process(script, tmp_path)

    @pytest.mark.parametrize("threads", [0, 1])
    def test_workers_end_with_their_master(self, threads, tmp_path):
        """Copied or not: nobody is left who would keep a folder locked."""
        (tmp_path / "script.py").write_text(
            "import os, sys, threading, time\n"
            "from pathlib import Path\n"
            "from legdistort.runtime.parallel import map_items\n"
            "def work(i):\n"
            "    Path(sys.path[0], f'pid{i}').write_text(str(os.getpid()))\n"
            "    time.sleep(60)\n"
            "if __name__ == '__main__':\n"
            f"    for _ in range({threads}): threading.Thread(target=time.sleep, args=[60], daemon=True).start()\n"
            "    list(map_items(work, range(2), workers=2))\n"
        )
        pids = [tmp_path / f"pid{i}" for i in range(2)]
        with subprocess.Popen([sys.executable, tmp_path / "script.py"]) as master:
            _until(lambda: all(path.exists() and path.read_text() for path in pids))
            master.kill()
        _until(lambda: not any(_runs(int(path.read_text())) for path in pids))


def _until(condition, seconds=60):
    """Wait until something is so."""
    for _ in range(20 * seconds):
        if condition():
            return
        time.sleep(0.05)
    pytest.fail(f"not within {seconds} s")


def _runs(pid):
    """Whether a process runs, and is not one that has ended and that nobody has asked after."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _process(i):
    time.sleep(0.05)
    return os.getpid()


# --- exposures that stay in their files ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Three frames of a few stars: plain, gzipped with companions, tile-compressed."""
    folder, rng = tmp_path_factory.mktemp("frames"), np.random.default_rng(7)
    y, x = np.mgrid[:120, :150]
    xy = rng.uniform(15, 105, (12, 2))
    stars = sum(4e3 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / 5) for px, py in xy)
    header = fits.Header({"GAIN": 2.0, "EXPTIME": 30.0, "RDNOISE": 5.0})
    for i, name in enumerate(["a.fits", "b.fits.gz", "c.fits"]):
        image = np.clip(rng.normal(100 + stars, 8), 0, 65535)
        image = image.astype(np.uint16 if i == 0 else np.float32)
        hdus = [fits.PrimaryHDU(image, header)]
        if i == 1:
            mask = fits.ImageHDU((rng.random(image.shape) < 0.01).astype(np.uint8), name="MASK")
            hdus += [mask, fits.ImageHDU(np.full(image.shape, 8.0, dtype=np.float32), name="ERR")]
        if i == 2:
            hdus = [fits.PrimaryHDU(), fits.CompImageHDU(image, header, quantize_level=0, compression_type="GZIP_2")]
        fits.HDUList(hdus).writeto(folder / name)
    return [folder / name for name in ("a.fits", "b.fits.gz", "c.fits")]


class TestExposureFiles:
    def test_they_are_what_read_exposures_gives(self, frames):
        for handle, exposure in zip(ld.open_exposures(frames), ld.read_exposures(frames), strict=True):
            assert isinstance(handle, ExposureFile)
            for thing in (handle, pickle.loads(pickle.dumps(handle))):
                read = thing.read()
                for name in ("name", "shape", "saturation", "gain", "read_noise", "exposure_time", "path"):
                    assert getattr(thing, name) == getattr(exposure, name) == getattr(read, name)
                assert thing.header.tostring() == exposure.header.tostring()
                for name in ("data", "mask", "uncertainty"):
                    np.testing.assert_array_equal(getattr(read, name), getattr(exposure, name))
            assert exposure.read() is exposure
            assert repr(handle) == f"<ExposureFile {handle.name!r}: 150 x 120 px in {handle.path}>"

    def test_what_is_small_is_worked_out_once(self, frames, monkeypatch):
        handles = ld.open_exposures([*frames[:2], CCDData(np.ones((5, 5)), unit="adu")])
        assert file_checksums(handles) == checksums(*frames[:2])
        for name in ("header_wcs", "read_statement"):
            monkeypatch.setattr(f"legdistort.inputs.fits_images.{name}", lambda *_, **__: pytest.fail("once more"))
        for handle in handles[:2]:
            read = handle.read()
            assert read.header is handle.header
            assert read.wcs is handle.wcs

    def test_an_extension_is_remembered(self, frames):
        (handle,) = ld.open_exposures(frames[1], ext="ERR")
        assert handle.name == "b_ERR"
        np.testing.assert_array_equal(handle.read().data, 8)

    def test_what_is_in_memory_stays_there(self, frames):
        with fits.open(frames[0]) as hdulist:
            (from_list,) = ld.open_exposures([hdulist])
        (from_ccd,) = ld.open_exposures(CCDData(np.ones((5, 5)), unit="adu"))
        assert isinstance(from_list, ld.Exposure)
        assert isinstance(from_ccd, ld.Exposure)

    def test_files_that_change_or_go_are_named(self, frames, tmp_path):
        path = tmp_path / "x.fits"
        fits.writeto(path, np.ones((9, 8)))
        (handle,) = ld.open_exposures(path)
        fits.writeto(path, np.ones((9, 7)), overwrite=True)
        with pytest.raises(InputError, match=r"x.fits has changed since it was first read: its SHA-256 is another"):
            handle.read()
        path.unlink()
        with pytest.raises(InputError, match=r"x.fits: no such file"):
            handle.read()
        with pytest.raises(InputError, match="two exposures are named 'a'"):
            ld.open_exposures([frames[0], frames[0]])

    @pytest.mark.slow
    def test_measuring_is_the_same_for_files_and_processes(self, frames, client):
        plain = ld.measure(ld.read_exposures(frames), workers=1)
        assert len(set(plain["exposure"])) == 3
        handles = ld.open_exposures(frames)
        for table in (ld.measure(handles, workers=1), ld.measure(handles, workers=2), ld.measure(handles)):
            assert table.colnames == plain.colnames
            for name in plain.colnames:
                np.testing.assert_array_equal(table[name], plain[name])


def reduced(folder, out):
    """A night as a task of a cluster."""
    return ld.run(sorted(folder.glob("*.fits")), out=out, degree=3, psf="moffat")


@pytest.mark.slow
def test_nights_side_by_side_give_the_same_bits(client, tmp_path):
    nights = [tmp_path / name for name in ("first", "second")]
    for seed, folder in enumerate(nights):
        ld.simulate_exposures(small=True, seed=seed).write(folder)
    empty = tmp_path / "empty"
    empty.mkdir()
    futures = client.map(reduced, [*nights, empty], [folder / "shared" for folder in [*nights, empty]], pure=False)
    assert isinstance(futures[2].exception(), InputError)
    assert not (empty / "shared").exists()
    for folder, future in zip(nights, futures, strict=False):
        mine, there = reduced(folder, folder / "here"), future.result()
        np.testing.assert_array_equal(there.solution.estimate.positions, mine.solution.estimate.positions)
        np.testing.assert_array_equal(there.solution.stars["x_err_abs"], mine.solution.stars["x_err_abs"])
        for plane in ("data", "variance", "weight"):
            np.testing.assert_array_equal(getattr(there.mosaic, plane), getattr(mine.mosaic, plane))
        assert json.dumps(there.summary["checks"]) == json.dumps(mine.summary["checks"])
        assert sorted(os.listdir(folder / "shared")) == sorted(os.listdir(folder / "here"))
    assert len({future.result().solution.chi2 for future in futures[:2]}) == 2


@pytest.mark.parametrize(
    "after", [pytest.param(0.0, marks=pytest.mark.sets), pytest.param(1.5, marks=pytest.mark.slow)]
)
def test_nights_are_added_alike_by_a_cluster_that_loses_a_worker(tmp_path, after):
    """Whether it is killed before or while it works on them: what nights say is added, and is the same to rounding."""
    distributed, paths = pytest.importorskip("distributed"), []
    static = field(np.random.default_rng(5), 1.5)
    for i in range(5):
        table = rolled_night(
            i, static + field(np.random.default_rng(10 + i), 0.02), n_stars=70, exposures=6, year=2015 + i
        )
        paths.append(tmp_path / f"{i}.asdf")
        ld.solve(ld.Matches.from_table(table, shape=(SIZE, SIZE))).write(paths[-1])
    alone = ld.combine_nights(paths, workers=1)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
        cluster.get_client() as client,
    ):
        killed = next(iter(client.run(os.getpid).values()))
        timer = threading.Timer(after, os.kill, (killed, signal.SIGKILL))
        timer.start()
        shared = ld.combine_nights(paths)
        timer.join()
    for one, other in zip(alone.static(), shared.static(), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-12)


# --- planes on disk -----------------------------------------------------------------------------------------------


def _resident():
    """Bytes of this process in memory."""
    statistics = Path("/proc/self/statm")
    if not statistics.exists():
        pytest.skip("the system does not say how much memory a process has")
    return int(statistics.read_text().split()[1]) * mmap.PAGESIZE


class TestScratch:
    def test_planes_come_back_by_pieces(self, tmp_path):
        plane = np.arange(30.0).reshape(5, 6)
        with scratch.scratch_folder(tmp_path, 1) as folder:
            stored = scratch.store(folder, {"data": plane, "bad": None})
            piece = stored.piece("data", (slice(1, 3), slice(2, 6)))
            np.testing.assert_array_equal(piece, plane[1:3, 2:6])
            assert type(piece) is np.ndarray  # and not what keeps the file mapped
            assert stored.piece("bad", (slice(0, 1), slice(0, 1))) is None
        assert not any(tmp_path.iterdir())

    @pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, OSError(28, "No space left on device")])
    def test_nothing_is_left(self, tmp_path, error):
        def fail():
            with scratch.scratch_folder(tmp_path, 1) as folder:
                scratch.store(folder, {"data": np.ones(3)})
                raise error

        with pytest.raises((KeyboardInterrupt, ValueError, DiskFullError)):
            fail()
        assert not any(tmp_path.iterdir())

    def test_spilled_arrays_may_be_forgotten(self, tmp_path):
        array = scratch.spill((3, 700, 1000), np.nan, np.float32, tmp_path)
        assert np.isnan(array).all()
        array[1, 5:9] = 7
        resident = _resident()
        scratch.forget(array[0])  # any part of it stands for all
        if hasattr(mmap, "MADV_DONTNEED"):
            assert _resident() < resident - 6e6
        assert (array[1, 5:9] == 7).all()
        assert np.isnan(array).sum() == array.size - 4000
        assert not any(tmp_path.iterdir())

    def test_other_memory_is_not_forgotten(self, tmp_path):
        np.save(tmp_path / "a.npy", np.zeros(5000))
        for own in (np.zeros(5000), np.load(tmp_path / "a.npy", mmap_mode="c")):  # changes of the latter are in no file
            own[:] = 3
            scratch.forget(own)
            assert (own == 3).all()

    def test_a_disk_that_fills_up_is_told_when_an_array_is_made(self, monkeypatch, tmp_path):
        class Full(io.BytesIO):
            def write(self, data):
                raise OSError(28, "No space left on device")

        monkeypatch.setattr(tempfile, "TemporaryFile", lambda dir: Full())
        with (
            pytest.raises(DiskFullError, match=r"No space left on the disk of .* give another folder as scratch="),
            scratch.scratch_folder(tmp_path, 1) as folder,
        ):
            scratch.spill((10, 10), 0, np.float32, folder)

    def test_a_disk_too_small_is_told_before(self, tmp_path):
        with (
            pytest.raises(DiskFullError, match=r"the pixels take 1,073,741,824.00 GB on disk .* give another folder"),
            scratch.scratch_folder(tmp_path, 2**60),
        ):
            pass
        with pytest.raises(InputError, match="no scratch folder can be made in"), scratch.scratch_folder("/none", 1):
            pass


# --- mosaics ------------------------------------------------------------------------------------------------------

PLANES = ("data", "variance", "weight", "footprint", "flags", "context")


def night(n=4, seed=3, **planes):
    """Noisy exposures of a few stars with bad pixels, and the truth about their distortions."""
    solution, stars, flux = scene(n, rolls=range(n), spread=5, peak=5)
    rng = np.random.default_rng(seed)
    exposures = []
    for e in expose(solution, stars, flux):
        mask = rng.random(e.shape) < 0.002
        data = (e.data + rng.normal(100, 8, e.shape)).astype(np.float32)
        exposures.append(ld.Exposure(e.name, np.where(mask, 6e4, data), mask=mask, **planes))
    return solution, exposures


def assert_same(one, other):
    for name in PLANES:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


class TestMosaicInBlocks:
    @pytest.mark.parametrize(
        "settings",
        [
            {"order": 3, "method": "clipped"},
            {"order": 1},
            pytest.param({"order": 5, "method": "median"}, marks=pytest.mark.slow),
            pytest.param({"algorithm": "adaptive"}, marks=pytest.mark.slow),
            {"algorithm": "drizzle"},
            pytest.param({"algorithm": "exact"}, marks=pytest.mark.sets),
        ],
        ids=lambda s: " ".join(map(str, s.values())),
    )
    def test_they_fit_together(self, monkeypatch, settings):
        solution, exposures = night(3 if settings.get("method") else 1)
        monkeypatch.setattr(block_stack, "_SAMPLES", 1 << 21)
        monkeypatch.setattr(block_stack, "_SIDES", (64, 512))
        whole = ld.coadd(exposures, solution, **settings)
        assert max(whole.shape) < block_stack.side(len(exposures))  # one block
        monkeypatch.setattr(block_stack, "_SAMPLES", 1)
        pieces = ld.coadd(exposures, solution, **settings)
        assert block_stack.side(len(exposures)) == 64
        for name in ("weight", "footprint", "flags", "context"):
            np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name), err_msg=name)
        # the exact algorithm puts every block on a small piece of a sphere, which is not quite flat
        close = 2e-4 if settings.get("algorithm") == "exact" else 1e-6
        np.testing.assert_allclose(pieces.data, whole.data, rtol=close, atol=1e-6 * np.nanmax(whole.data))
        # found in a table of 256 fractions of a pixel, so rounding may take its neighbour
        np.testing.assert_allclose(pieces.variance, whole.variance, rtol=0.02)

    @pytest.mark.slow
    @COMPILED
    def test_any_number_of_workers_gives_the_same_bits(self, client, monkeypatch, tmp_path, compiled_from):
        solution, exposures = night(uncertainty=np.full(SHAPE, 8.0))
        monkeypatch.setattr(engines, "COMPILED_FROM", compiled_from)
        monkeypatch.setattr(block_stack, "_SAMPLES", 1 << 16)
        settings = {"method": "clipped", "scratch": tmp_path}
        one = ld.coadd(exposures, solution, workers=1, **settings)
        for workers in (2, 3, None):  # None: the processes of the cluster
            assert_same(ld.coadd(exposures, solution, workers=workers, **settings), one)
        assert not any(tmp_path.iterdir())

    @pytest.mark.parametrize(
        "method", [pytest.param("mean", marks=pytest.mark.sets), pytest.param("clipped", marks=pytest.mark.slow)]
    )
    def test_drizzle_in_processes_gives_the_same_bits(self, monkeypatch, method):
        pytest.importorskip("drizzle")
        solution, exposures = night(uncertainty=np.full(SHAPE, 8.0))
        monkeypatch.setattr(block_stack, "_SAMPLES", 1 << 16)
        settings = {"method": method, "algorithm": "drizzle"}
        one = ld.coadd(exposures, solution, workers=1, **settings)
        assert_same(ld.coadd(exposures, solution, workers=2, **settings), one)

    @pytest.mark.parametrize("n", [pytest.param(12, marks=pytest.mark.slow), pytest.param(60, marks=pytest.mark.sets)])
    @COMPILED
    def test_sixty_times_the_same(self, monkeypatch, compiled_from, n):
        solution, exposures = night(2)
        monkeypatch.setattr(engines, "COMPILED_FROM", compiled_from)
        monkeypatch.setattr(block_stack, "_SAMPLES", 1 << 15)
        one = ld.coadd(exposures, solution, workers=1)
        for _ in range(n):
            assert_same(ld.coadd(exposures, solution, workers=2), one)

    def test_files_give_the_same_as_memory(self, tmp_path):
        solution, exposures = night()
        for e in exposures:
            fits.HDUList([fits.PrimaryHDU(e.data), fits.ImageHDU(e.mask.astype(np.uint8), name="MASK")]).writeto(
                tmp_path / f"{e.name}.fits"
            )
        assert_same(ld.coadd(ld.open_exposures(str(tmp_path / "*")), solution), ld.coadd(exposures, solution))

    def test_nothing_is_between_exposures_far_apart(self):
        solution, exposures = night(2)
        solution.poses["frame1"] = solution.poses["frame1"] - np.array([[0, 0, 900], [0, 0, 700]])
        mosaic = ld.coadd(exposures, solution, order=1, match_background=False)
        empty = mosaic.footprint == 0
        assert min(mosaic.shape) > 900
        assert 0.7 < empty.mean() < 0.9
        for plane in (mosaic.data, mosaic.variance):
            np.testing.assert_array_equal(np.isnan(plane), empty)
        for plane in (mosaic.weight, mosaic.flags, *mosaic.context):
            assert not plane[empty].any()

    @pytest.mark.slow
    def test_the_context_says_who_contributes(self, tmp_path):
        solution, exposures = night(34)
        mosaic = ld.coadd(exposures, solution, order=1, planes="all")
        assert mosaic.context.shape == (2, *mosaic.shape)
        bits = np.bitwise_count(mosaic.context).sum(axis=0)
        np.testing.assert_array_equal(bits, mosaic.footprint)
        for name in ("frame1", "frame33"):
            alone = ld.coadd([e for e in exposures if e.name == name], solution, order=1)
            ox, oy = np.array(alone.offset) - mosaic.offset
            nx = alone.shape[1]
            y, x = np.nonzero(np.pad(alone.footprint, ((oy, 0), (ox, 0))))
            there = np.zeros(mosaic.shape, dtype=bool)
            there[y, x] = True
            for px, py in [(0, 0), (150, 200), (nx // 2, 3), (x.min(), y[x.argmin()]), (x.max(), y[x.argmax()])]:
                assert (name in mosaic.contributors(px, py)) == there[py, px]
        hdulist = mosaic.to_hdulist()
        assert hdulist["CONTEXT"].data.dtype == np.int32
        np.testing.assert_array_equal(hdulist["CONTEXT"].data.view(np.uint32), mosaic.context)
        written = fits.getdata(mosaic.write(tmp_path / "m.fits"), "CONTEXT")
        np.testing.assert_array_equal(written.astype(np.int32).view(np.uint32), mosaic.context)
        with pytest.raises(InputError, match=r"pixel \(-1, 0\) is not one of the \d+ x \d+ of the mosaic"):
            mosaic.contributors(-1, 0)

    @pytest.mark.usefixtures("interruptible")
    def test_an_error_or_interrupt_leaves_nothing(self, monkeypatch, tmp_path):
        solution, exposures = night(2)

        def fail(*args, **kwargs):
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as patch:
            patch.setattr(preparation, "store", fail)
            with pytest.raises(DiskFullError, match=r"No space left on the disk of .* give another folder as scratch="):
                ld.coadd(exposures, solution, scratch=tmp_path)
        assert not any(tmp_path.iterdir())
        measure = preparation.measure_background
        monkeypatch.setattr(preparation, "measure_background", lambda *a, **k: time.sleep(0.5) or measure(*a, **k))
        threading.Timer(1, _thread.interrupt_main).start()
        with pytest.raises(KeyboardInterrupt):
            [ld.coadd(exposures, solution, workers=2, scratch=tmp_path) for _ in range(20)]
        assert not any(tmp_path.iterdir())

    @pytest.mark.parametrize("first", [True, False])
    def test_a_full_disk_loses_nothing(self, monkeypatch, tmp_path, first):
        solution, exposures = night(1)
        mosaic, path = ld.coadd(exposures, solution, order=0), tmp_path / "m.fits"
        if not first:
            mosaic.write(path)
        before = [(p.name, p.read_bytes()) for p in tmp_path.iterdir()]

        def forget(written):
            raise OSError("Not enough space on disk: requested 9, available 6")

        monkeypatch.setattr("legdistort.coaddition.mosaic.forget", forget)
        monkeypatch.setattr("legdistort.runtime.disk_errors.free_bytes", lambda folder: 100)
        with pytest.raises(DiskFullError, match=r"No space left on the disk for .*m.fits, which was left as it was"):
            mosaic.write(path, overwrite=True)
        assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == before

    def test_masked_exposures_are_left_out(self):
        solution, exposures = night(2)
        empty = SimpleNamespace(name="frame1", shape=SHAPE, header=fits.Header(), exposure_time=None)
        empty.data, empty.mask, empty.uncertainty = np.ones(SHAPE), np.ones(SHAPE, dtype=bool), None
        empty.read = lambda: empty
        with warns_here(AssumptionWarning, match="left out of the mosaic: frame1: every pixel is masked"):
            mosaic = ld.coadd([exposures[0], empty], solution)
        assert (mosaic.exposures, mosaic.left_out) == (("frame0",), {"frame1": "every pixel is masked"})
        with (
            warns_here(AssumptionWarning, match="every pixel is masked"),
            pytest.raises(InputError, match="no exposure meets the output grid: frame1: every pixel is masked"),
        ):
            ld.coadd([empty], solution)


MEMORY = """
import resource, sys
sys.path.insert(0, {tests!r})
import stacks
stacks.SHAPE = (2048, 2048)
import legdistort as ld

if __name__ == "__main__":
    solution, *_ = stacks.scene({n}, rolls=[0.01 * i for i in range({n})], sky=None)
    exposures = ld.open_exposures({folder!r} + "/*.fits")
    mosaic = ld.coadd(exposures, solution, method="clipped", workers=2, scratch={folder!r})
    mosaic.write({folder!r} + "/mosaic.fits")
    assert mosaic.footprint.max() == {n}
    print(sum(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 2**20)
"""


@pytest.mark.parametrize(
    ("n", "limit"), [pytest.param(16, 1.3, marks=pytest.mark.slow), pytest.param(40, 2.0, marks=pytest.mark.sets)]
)
def test_many_frames_stay_under_two_gigabytes(tmp_path, n, limit):
    """As numbers of double precision the pixels of 40 alone would be 1.3 GB, and with variances and weights 4."""
    image = np.random.default_rng(1).normal(1000, 20, (2048, 2048)).astype(np.float32)
    fits.writeto(tmp_path / "frame0.fits", image)
    for i in range(1, n):
        (tmp_path / f"frame{i}.fits").symlink_to(tmp_path / "frame0.fits")
    script = tmp_path / "script.py"
    script.write_text(MEMORY.format(tests=str(Path(__file__).parents[1]), folder=str(tmp_path), n=n))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < limit
