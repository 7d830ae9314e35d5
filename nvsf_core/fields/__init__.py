"""Networks: scene fields of the LiDAR and the cameras, scene flow, and corrections of range images."""
