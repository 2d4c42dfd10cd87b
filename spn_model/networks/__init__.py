"""Network architectures, their losses and pose targets, with one module for each published network."""
