"""What is published about one image on board: a fix that may be flown, or why there is none."""
