"""Parametric designs. A design takes a random generator and returns a `Piece`."""
