"""What the command line adds to Lightning's trainer: progress, estimates of duration, Weights & Biases."""
