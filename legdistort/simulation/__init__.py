"""Synthetic truth, and predictions before any data exist."""
