"""Moving objects: found among the returns, tracked from scan to scan, each in a frame of its own."""
