"""Published weights: catalogue, download and loading into networks."""
