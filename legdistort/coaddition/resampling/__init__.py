"""Pieces of one exposure on the output grid."""
