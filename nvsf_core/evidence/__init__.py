"""What the training scans prove about a scene, before anything is learned."""
