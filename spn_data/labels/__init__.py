"""Labels of frames in a frozen map, their observations, and the points and hash of the map."""
