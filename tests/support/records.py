"""Records whose numbers are known by hand."""

import numpy as np

from zerobev.evaluation.metrics import Counts
from zerobev.experiments.records import Record


def record(row: str, percent: list[list[float]], seed: int = 0, cells: int = 1000) -> Record:
    """A run with the given IoU of each test scene and class, in percent."""
    union = np.full(np.shape(percent), cells, np.int64)
    counts = Counts((np.array(percent) / 100 * cells).round().astype(np.int64), union)
    scenes = [f"scene{i}" for i in range(len(percent))]
    return Record(f"{row}-{seed}", row, seed, {}, {}, {}, scenes, counts, {})
