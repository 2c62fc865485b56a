"""Shared fixtures: where the real data are, and small synthetic sets."""

import gc
import os
import pickle
from pathlib import Path

# the matrices are small: on a busy machine, threads of the linear algebra library only wait for one another
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import pytest
from filelock import FileLock

matplotlib.use("Agg")
gc.set_threshold(200_000, 20, 50)  # a tenth less time: hundreds of thousands of objects of modules stay anyway


def pytest_collection_finish():
    """Modules and tests stay to the end: no search for garbage looks at them again."""
    gc.collect()
    gc.freeze()


def data_folder():
    """Folder of real data: ``LEGDISTORT_DATA``, or ``../shared/data`` beside the repository; None if absent."""
    candidates = [os.environ.get("LEGDISTORT_DATA"), Path(__file__).parents[2] / "shared" / "data"]
    return next((Path(c) for c in candidates if c and Path(c).is_dir()), None)


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real data, or skip."""
    folder = data_folder()
    if folder is None:
        pytest.skip("real data absent: set LEGDISTORT_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def common_folder(tmp_path_factory):
    """A folder of all processes that run these tests, for what takes long to make; a lock says who makes it."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "common"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def microobservatory(shared_data, common_folder):
    """Twelve real, undersampled frames, and the stars measured on them: once for all tests."""
    from caller_warnings import warns_here

    import legdistort as ld
    from legdistort.exceptions import AssumptionWarning

    exposures = ld.read_exposures(sorted((shared_data / "microobs_hatp32" / "frames").glob("*.fits.gz")))
    made = common_folder / "microobservatory.pickle"
    with FileLock(made.with_suffix(".lock")):
        if not made.exists():
            with warns_here(AssumptionWarning, match="no gain known"):
                detections = ld.measure(exposures)
            made.write_bytes(pickle.dumps(detections))
    return exposures, pickle.loads(made.read_bytes())


@pytest.fixture
def undrawn(monkeypatch):
    """Reports are written whole, but their pictures are not turned into SVG, which takes most of the time."""
    monkeypatch.setattr("legdistort.reporting.pictures.svg_of", lambda *_, **__: "")


@pytest.fixture(scope="session")
def geometry():
    """See `sky_chains.geometries`."""
    from sky_chains import geometries

    return geometries()
