"""Theorem 3.1 of the paper in numbers: correspondence, the two-stream attention alone, and max-pooling."""
