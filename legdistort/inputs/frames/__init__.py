"""What a frame states: numbers of its header with their source, the unit of its pixels, its WCS, its flags."""
