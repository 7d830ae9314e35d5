"""The training of the paper's family (paper, Sec. III)."""
