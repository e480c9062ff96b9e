"""Recorded results that belong to the shipped weights: motion and unseen modalities."""

from dataclasses import asdict
from typing import Any

import pandas as pd

from zerobev.evaluation.metrics import Counts
from zerobev.evaluation.motion import evaluate_motion, moving_pairs
from zerobev.evaluation.unseen import VIEWS, evaluate_unseen
from zerobev.experiments.records import cached
from zerobev.experiments.workspace import Workspace
from zerobev.inference.shipped_weights import shipped_runs
from zerobev.scenes.homes import ensure_homes


def recorded_motion(workspace: Workspace, count: int = 32) -> pd.DataFrame:
    """Errors of `count` pairs of a workspace's generated test homes: read where they are recorded, else computed.

    The record `motion.json` of the report names the weights that it is of; those of other weights are computed again.
    """
    homes = list(workspace.split.test)

    def compute() -> dict[str, list]:
        ensure_homes(homes, workspace.scale.scenes.seed, 1)
        return evaluate_motion(moving_pairs(homes, count, seed=0)).to_dict(orient="list")

    identity = {"weights": shipped_runs(), "pairs": count, "scenes": asdict(workspace.scale.scenes)}
    return pd.DataFrame(cached(workspace.reports / "motion.json", identity, compute))


def recorded_unseen(workspace: Workspace) -> dict[str, Counts]:
    """`evaluate_unseen` of a workspace's generated test homes: read where it is recorded, else computed.

    The record `unseen.json` of the report names the weights that it is of; those of other weights are computed again.
    """
    homes = list(workspace.split.test)

    def compute() -> dict[str, Any]:
        ensure_homes(homes, workspace.scale.scenes.seed, 1)
        return {row: counts.to_json() for row, counts in evaluate_unseen(homes).items()}

    identity = {"weights": shipped_runs(), "views": VIEWS, "scenes": asdict(workspace.scale.scenes)}
    found = cached(workspace.reports / "unseen.json", identity, compute)
    return {row: Counts.from_json(counts) for row, counts in found.items()}
