"""Types that the annotations of public functions have in common."""

from collections.abc import Sequence
from os import PathLike
from typing import Any

#: What names a file.
StrPath = str | PathLike[str]
#: Rows and columns of an image.
Shape = tuple[int, int] | Sequence[int]
#: Extension of a FITS file: its number, its name, or its name and version.
Extension = int | str | tuple[str, int]
#: What frames are read from: paths with wildcards, HDULists, NDData, or a sequence of these.
Images = Any
