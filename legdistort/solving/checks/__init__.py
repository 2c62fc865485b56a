"""Checks of a solution, made from its residuals."""
