"""Losses, training, evaluation and metrics."""
