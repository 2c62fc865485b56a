"""The command ``legdistort``."""

from .parser import main

__all__ = ["main"]
