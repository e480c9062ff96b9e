"""Parametric designs. A design takes a random generator and gives a `Piece`."""
