"""The commands `spn-data` and `spn-model`."""
