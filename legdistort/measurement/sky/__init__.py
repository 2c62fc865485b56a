"""The sky of a frame: levels of amplifiers, its smooth part and its noise, and the light around stars."""
