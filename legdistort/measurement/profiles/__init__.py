"""Moffat profiles fitted to all stars of a frame."""
