"""Catalogues of places that are known beforehand: files, tables, and Gaia by name."""
