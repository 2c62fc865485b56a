"""Effective point-spread functions: made from the stars of an exposure or given, and fitted to all stars."""
