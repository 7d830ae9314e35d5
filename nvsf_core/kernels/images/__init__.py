"""Kernels of images: points and depth maps carried into them, and their colours looked up."""
