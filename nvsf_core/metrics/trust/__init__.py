"""What can be said of a rendered view without its truth: how far it is from recorded scans and images."""
