"""From densities to ranges, intensities, hits and colours; the training-free renderers."""
