"""Error metrics of rendered scans and images, and the protocols they are measured by."""
