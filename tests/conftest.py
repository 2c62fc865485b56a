"""Shared fixtures: where the real data are, and small synthetic sets."""

import gc
import os
from pathlib import Path

# the matrices are small: on a busy machine, threads of the linear algebra library only wait for one another
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import pytest

matplotlib.use("Agg")
gc.set_threshold(200_000, 20, 50)  # a tenth less time: hundreds of thousands of objects of modules stay anyway


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


@pytest.fixture
def undrawn(monkeypatch):
    """Reports are written whole, but their pictures are not turned into SVG, which takes most of the time."""
    monkeypatch.setattr("legdistort.reporting.pictures.svg_of", lambda *_, **__: "")


@pytest.fixture(scope="session")
def geometry():
    """See `sky_chains.geometries`."""
    from sky_chains import geometries

    return geometries()
