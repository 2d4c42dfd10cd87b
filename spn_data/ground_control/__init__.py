"""Ground control: surveyed points, their coordinate system, and their marks in images."""
