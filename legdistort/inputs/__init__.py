"""What comes in, checked once: images, tables, matches, catalogues."""
