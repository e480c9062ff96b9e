"""The worth of new looks (`zerobev.data.looks`), by a comparison that the paper does not have.

Depth and (c) of the scale `deploy` are trained twice, for fewer steps, with and without new looks, all else equal. They
are tested in homes of their own generator, and in those of the tables, which another generator makes.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from zerobev.evaluation.real_homes import evaluate_homes
from zerobev.experiments.records import recorded
from zerobev.experiments.registry import experiment
from zerobev.experiments.runs import Run
from zerobev.experiments.workspace import Workspace
from zerobev.inference.projector import load
from zerobev.scenes.homes import ensure_homes

STEPS = 1500
HOMES, VIEWS = 16, 12  #: of each generator; per home
_SHORT = [
    f"{part}.{name}"
    for part in ("depth", "train")
    for name in (f"steps={STEPS}", "decay_every=38", "validate_every=500")
]
#: Training -> settings of the scale.
TRAININGS = {"new looks": [], "looks of the homes": ["augment.looks=0"]}
#: Homes -> the scale with which they are made.
TESTS = {"same generator": "deploy", "other generator": "reduced"}


def recorded_looks() -> dict[str, dict[str, Any]]:
    """Training -> homes -> results, see `real_homes.Results.to_json`; recorded in `reports/deploy/looks.json`."""
    runs = {
        name: Run(experiment("c"), Workspace("deploy", settings=[*_SHORT, *more])) for name, more in TRAININGS.items()
    }
    homes = {name: Workspace(scale) for name, scale in TESTS.items()}

    def compute() -> dict[str, Any]:
        return {
            name: {test: _results(run, workspace) for test, workspace in homes.items()} for name, run in runs.items()
        }

    config = {"runs": {name: run.config for name, run in runs.items()}, "homes": HOMES, "views": VIEWS}
    config |= {"tests": {name: workspace.data_config for name, workspace in homes.items()}}
    return recorded(Workspace("deploy").reports / "looks.json", "looks", config, compute, device="cpu")


def _results(run: Run, workspace: Workspace) -> dict[str, Any]:
    folders = list(workspace.split.test[:HOMES])
    ensure_homes(folders, workspace.scale.scenes.seed, 1)
    projector = load(run.trained(), estimator=run.pretraining.estimator)
    with TemporaryDirectory() as folder:
        projector.save_pretrained(folder)
        return evaluate_homes(folders, VIEWS, report=lambda line: None, weights=Path(folder)).to_json()
