"""Which rays return, as the training scans tell."""
