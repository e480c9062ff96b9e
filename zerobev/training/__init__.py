"""Training: losses, batches, learning rate, history."""
