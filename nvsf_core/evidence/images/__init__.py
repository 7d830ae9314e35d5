"""What images prove."""
