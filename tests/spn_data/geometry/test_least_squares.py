"""Tests of robust weights for least squares over images."""

from __future__ import annotations

import numpy as np

from spn_data.geometry.least_squares import cauchy_weights


def test_the_scale_of_the_cauchy_loss_is_the_residual_of_half_weight() -> None:
    """With a scale of 5 px, residuals of 0, 5 and 10 px have weights 1, 1/2 and 1/5."""
    residuals = np.array([[0.0, 0.0], [3.0, -4.0], [8.0, 6.0]])
    np.testing.assert_allclose(cauchy_weights(residuals, 5.0), [1.0, 0.5, 0.2], rtol=1e-15)
