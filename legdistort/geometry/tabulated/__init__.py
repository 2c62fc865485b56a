"""Displacements on a regular grid of nodes, for what no polynomial describes."""
