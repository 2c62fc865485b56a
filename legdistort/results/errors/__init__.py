"""Errors of a solution: of stars, coefficients, common maps, cameras, what a catalogue ties."""
