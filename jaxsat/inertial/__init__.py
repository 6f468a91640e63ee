"""What physics says: rotations, strapdown integration, error model and smoother."""
