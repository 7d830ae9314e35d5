"""What the LiDAR already proves about a scene, without learning."""
