"""Nights of a camera, added to one."""
