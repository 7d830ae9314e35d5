"""What `nvsf doctor` examines."""
