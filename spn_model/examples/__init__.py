"""Training examples: data sets in memory, data augmentation, target surfaces and rendered novel views."""
