"""Theorem 3.1 of the paper in numbers: correspondence, two-stream attention without a network, max-pooling."""
