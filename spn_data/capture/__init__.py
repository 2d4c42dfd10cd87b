"""Videos and photos: discovery, decoding, measurement and selection of frames."""
