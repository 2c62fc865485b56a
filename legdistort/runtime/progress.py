"""Progress bars, and where what is said of every image goes."""

import sys

from tqdm import tqdm

#: Name of the logger of what is said of every image, one by one.
EACH_IMAGE = "legdistort.each_image"


class Bar(tqdm):
    """A bar of tqdm without the thread that would watch it: processes can be copied beside it, see `map_items`."""

    monitor_interval = 0

    def __init__(self, *args, miniters=1, **options):
        if sys.stderr is None:  # a process without a terminal, or anything in its place
            options["disable"] = True
        super().__init__(*args, miniters=miniters, **options)  # what the thread is for: slow steps after fast ones
