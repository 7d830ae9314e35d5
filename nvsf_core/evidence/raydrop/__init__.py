"""Which rays return, counted in the training scans."""
