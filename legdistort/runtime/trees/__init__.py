"""Frozen objects as trees of plain arrays, numbers and text, as files hold them."""
