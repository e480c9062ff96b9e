"""Zero-BEV: zero-shot projection of any first-person modality to a bird's-eye-view map."""

__version__ = "0.1.0"
