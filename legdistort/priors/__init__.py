"""A static distortion that is known beforehand, from anything."""
