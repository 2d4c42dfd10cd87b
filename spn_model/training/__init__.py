"""Training of pose models: recipes, the training loop, optimisers, logs and checkpoints."""
