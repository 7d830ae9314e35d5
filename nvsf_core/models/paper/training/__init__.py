"""What the paper's family learns from, and its steps (paper, Sec. III)."""
