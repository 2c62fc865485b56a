"""Warnings name the line of whoever called the package, not one inside it."""

from contextlib import contextmanager
from pathlib import Path

import pytest

from legdistort.exceptions import LegdistortWarning


@contextmanager
def warns_here(category, match):
    """As `pytest.warns`; the file named by every warning of the package is one of the tests."""
    with pytest.warns(category, match=match) as caught:
        yield caught
    named = [Path(w.filename) for w in caught if issubclass(w.category, LegdistortWarning)]
    assert named
    assert all(path.is_relative_to(Path(__file__).parent) for path in named)
