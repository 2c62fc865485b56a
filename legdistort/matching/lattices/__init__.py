"""Holes of a mask: their periods, their places on the lattice, and which hole of one exposure is which of another."""
