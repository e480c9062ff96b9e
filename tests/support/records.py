"""Records whose numbers are known by hand."""

import numpy as np

from zerobev.evaluation.metrics import Counts
from zerobev.experiments.run_records import RunRecord


def run_record(key: str, counts: Counts, row: str = "c", seed: int = 0, **parts: dict) -> RunRecord:
    """A record of a run, scenes named after their number; `parts` are its config, origin, cost and history."""
    config = {**parts.get("config", {}), "experiment": {"row": row}, "seed": seed}
    scenes = [f"scene{i}" for i in range(len(counts.union))]
    result = {"scenes": scenes, "counts": counts.to_json(), "history": parts.get("history", {})}
    return RunRecord(key, config, parts.get("origin", {}), parts.get("cost", {}), result)


def record(row: str, percent: list[list[float]], seed: int = 0, cells: int = 1000) -> RunRecord:
    """A run with the given IoU of each test scene and class, in percent."""
    union = np.full(np.shape(percent), cells, np.int64)
    counts = Counts((np.array(percent) / 100 * cells).round().astype(np.int64), union)
    return run_record(f"{row}-{seed}", counts, row, seed)
