"""Charts as SVG, for the report and for the figures of an evaluation."""
