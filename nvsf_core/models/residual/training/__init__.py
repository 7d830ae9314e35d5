"""What our family learns from, and its steps."""
