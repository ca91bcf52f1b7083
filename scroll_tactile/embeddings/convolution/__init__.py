"""What the default embedding counts: banks of random kernels, their responses to an image, and the counts of these."""
