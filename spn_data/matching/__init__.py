"""Image matching: features, pair selection, putative matches and guided matching."""
