"""Registration of evaluation frames in a frozen map: poses, covariances, and rejection of wrong poses."""
