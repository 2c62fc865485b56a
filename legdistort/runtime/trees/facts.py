"""What a field of a dataclass holds, stated beside it: `codec` writes, reads and checks files by these facts.

``values: np.ndarray = field(metadata=array("n_stars", 2, unit="pix"))``. A dimension is a number, a name, or a sum of
products of them, ``"2 n_modes + n_drift"``. Names that begin with ``n_`` mean the same in all parts of a file, others
in one object.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from ..checks import LARGEST

if TYPE_CHECKING:
    from collections.abc import Mapping

    #: Metadata of a field.
    Metadata = Mapping[str, Any]

#: Key of the metadata of a field under which its facts stand.
KEY = "legdistort"


@dataclass(frozen=True)
class Facts:
    """What a field holds.

    Attributes
    ----------
    entry : str or None
        Its name in files, if that is another.
    stored : bool
        Whether files have it.
    holds : {"numbers", "integers", "booleans", "names"}
        Of an array; names are text or integers.
    shape, blocks : tuple or None
        Dimensions of an array, and others that it may have instead.
    length : str or None
        Dimension of a list.
    unit : str
    minimum, maximum : float
        Bounds of numbers, also of those in arrays, lists and dicts.
    nan, infinite : bool
        Whether NaN and +infinity have a meaning here.
    covariance, packed : bool
        Whether the last two axes are those of covariances, or the first of xx, yy, xy and the further rows of one.
    invertible : bool
        Whether it is an affine map ``[M | t]`` with an inverse.
    choices : tuple of str
        The texts that there are; empty for any.
    key : str
        Of a dict of dataclasses that is a list in files: the entry that takes the key.
    """

    entry: str | None = None
    stored: bool = True
    holds: str = "numbers"
    shape: tuple[int | str, ...] | None = None
    blocks: tuple[int | str, ...] | None = None
    length: str | None = None
    unit: str = ""
    minimum: float = -LARGEST
    maximum: float = LARGEST
    nan: bool = False
    infinite: bool = False
    covariance: bool = False
    packed: bool = False
    invertible: bool = False
    choices: tuple[str, ...] = ()
    key: str = ""

    def words(self) -> str:
        """What its numbers should be."""
        one = "a number" if self.shape is None else "numbers"
        return ("a covariance: " if self.covariance or self.packed else "") + (
            ("" if self.nan or self.infinite else "finite, ")
            + one
            + (f" from {self.minimum:g}" if self.minimum > -LARGEST else "")
            + (f" to {self.maximum:g}" if self.maximum < LARGEST else "")
            + (f" [{self.unit}]" if self.unit else "")
            + (", NaN where unknown" if self.nan else "")
        )


def _metadata(**facts):
    return MappingProxyType({KEY: Facts(**facts)})


def array(*shape: int | str, holds: str = "numbers", **facts: Any) -> Metadata:
    """Of an array of these dimensions, with whatever `Facts` there are of it."""
    return _metadata(shape=shape, holds=holds, **facts)


def number(**facts: Any) -> Metadata:
    """Of a number, or of those in a tuple or dict."""
    return _metadata(**facts)


def text(*choices: str, length: str | None = None) -> Metadata:
    """Of one of some texts, or of a tuple of them with that length."""
    return _metadata(choices=choices, length=length)


def keyed(entry: str) -> Metadata:
    """Of a dict of dataclasses, a list of them in files, in which `entry` is the key."""
    return _metadata(key=entry)


#: Of a field that files do not have.
NOT_STORED = _metadata(stored=False)
#: Of ``(ny, nx)``.
SIZE = _metadata(minimum=1, maximum=10_000_000, unit="pix")
#: Of Julian years, as tables may have them.
YEARS = _metadata(minimum=1800, maximum=2200, unit="yr")
