"""What moves: found among the returns, followed from scan to scan, and kept in frames of its own."""
