"""Split into training, validation and test frames with guard bands, and the audit for leakage."""
