"""Pose models: each kind of network with its training examples, loss and decoding, and checkpoints."""
