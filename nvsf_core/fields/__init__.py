"""The neural scene field: residual density and its heads."""
