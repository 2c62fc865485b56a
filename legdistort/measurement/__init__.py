"""From images to star positions and their errors."""
