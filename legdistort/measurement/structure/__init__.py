"""What stands around bright stars and is no star: side lobes, structure of the pupil."""
