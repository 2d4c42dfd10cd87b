"""Stage inputs: what the pipeline reads from flights, photos and earlier stages of an area."""
