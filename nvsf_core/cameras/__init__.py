"""Camera images as pinhole images: fisheyes undistorted, validity masks."""
