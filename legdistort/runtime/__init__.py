"""Work on this machine: outputs, disk, workers, file formats. Knows nothing of astronomy."""
