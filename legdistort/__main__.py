"""``python -m legdistort``: the command."""

import sys

from .cli import command

sys.exit(command())
