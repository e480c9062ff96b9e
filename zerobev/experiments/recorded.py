"""Recorded results of the shipped weights: motion, unseen modalities, other cameras, other depth, walks.

The networks run on the CPU.
"""

from typing import Any

import pandas as pd

from zerobev.evaluation.home_scores import HomeScores
from zerobev.evaluation.metrics import Counts
from zerobev.evaluation.motion import evaluate_motion, moving_pairs
from zerobev.evaluation.other_cameras import CAMERAS, POSES, CameraCounts, evaluate_cameras
from zerobev.evaluation.real_homes import evaluate_homes
from zerobev.evaluation.unseen import VIEWS, evaluate_unseen
from zerobev.evaluation.walks import STAGES, Case, evaluate_walks
from zerobev.experiments.records import recorded
from zerobev.experiments.workspace import Workspace
from zerobev.inference.shipped_weights import shipped_runs
from zerobev.mapping import home_map
from zerobev.scenes.homes import ensure_homes

PAIRS = 32  #: of photographs, for motion
HOMES = 8  #: photographed by other cameras
DEPTH_VIEWS = 12  #: per home, with depth of each kind
WALKS = 4  #: homes to walk through


def recorded_motion(workspace: Workspace) -> pd.DataFrame:
    """`evaluate_motion` of `PAIRS` pairs in the generated test homes; recorded in `motion.json` of the report."""
    homes = list(workspace.split.test)

    def compute() -> dict[str, Any]:
        ensure_homes(homes, workspace.scale.scenes.seed, 1)
        return evaluate_motion(moving_pairs(homes, PAIRS, seed=0)).to_dict(orient="list")

    config = {"weights": shipped_runs(), "pairs": PAIRS, "scenes": workspace.scale.scenes}
    return pd.DataFrame(recorded(workspace.reports / "motion.json", "motion", config, compute, device="cpu"))


def recorded_unseen(workspace: Workspace) -> dict[str, Counts]:
    """`evaluate_unseen` in the generated test homes; recorded in `unseen.json` of the report."""
    homes = list(workspace.split.test)

    def compute() -> dict[str, Any]:
        ensure_homes(homes, workspace.scale.scenes.seed, 1)
        return {row: counts.to_json() for row, counts in evaluate_unseen(homes).items()}

    config = {"weights": shipped_runs(), "views": VIEWS, "scenes": workspace.scale.scenes}
    found = recorded(workspace.reports / "unseen.json", "unseen", config, compute, device="cpu")
    return {row: Counts.from_json(counts) for row, counts in found.items()}


def recorded_cameras(workspace: Workspace) -> CameraCounts:
    """`evaluate_cameras` in the first `HOMES` generated test homes; recorded in `cameras.json` of the report."""
    homes = list(workspace.split.test[:HOMES])

    def compute() -> dict[str, Any]:
        ensure_homes(homes, workspace.scale.scenes.seed, 1)
        found = evaluate_cameras(homes)
        return {
            f"{name} {value}": {row: one.to_json() for row, one in rows.items()}
            for (name, value), rows in found.items()
        }

    config = {"weights": shipped_runs(), "cameras": CAMERAS, "poses": POSES, "homes": HOMES}
    config |= {"scenes": workspace.scale.scenes}
    found = recorded(workspace.reports / "cameras.json", "cameras", config, compute, device="cpu")
    return {
        (name, value): {row: Counts.from_json(one) for row, one in found[f"{name} {value}"].items()}
        for name, values in CAMERAS.items()
        for value in values
    }


def recorded_homes(workspace: Workspace) -> dict[str, Any]:
    """`evaluate_homes` of the generated test homes, see `Results.to_json`; recorded in `homes.json` of the report."""
    homes = list(workspace.split.test)

    def compute() -> dict[str, Any]:
        ensure_homes(homes, workspace.scale.scenes.seed, 1)
        return evaluate_homes(homes, DEPTH_VIEWS, report=lambda line: None).to_json()

    config = {"weights": shipped_runs(), "views": DEPTH_VIEWS, "scenes": workspace.scale.scenes}
    return recorded(workspace.reports / "homes.json", "homes", config, compute, device="cpu")


def recorded_walks(workspace: Workspace) -> dict[Case, HomeScores]:
    """`evaluate_walks` in the first `WALKS` generated test homes; recorded in `walks.json` of the report."""
    homes = list(workspace.split.test[:WALKS])

    def compute() -> dict[str, Any]:
        ensure_homes(homes, workspace.scale.scenes.seed, 1)
        return {" ".join(map(str, case)): scores.to_json() for case, scores in evaluate_walks(homes, STAGES).items()}

    config = {
        "weights": shipped_runs(),
        "homes": len(homes),
        "stages": STAGES,
        "fusion": [home_map.PRIOR, home_map.LOWEST, home_map.HIGHEST, home_map.LIMIT],
        "scenes": workspace.scale.scenes,
    }
    found = recorded(workspace.reports / "walks.json", "walks", config, compute, device="cpu")
    return {Case.parse(case): HomeScores.from_json(counts) for case, counts in found.items()}
