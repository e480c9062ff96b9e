"""Jobs over scenes, spread over processes or a cluster by joblib, with progress."""

import warnings
from collections.abc import Iterable, Iterator
from typing import Any

import joblib

from zerobev.progress import progress

# After large homes joblib takes a worker's memory for a leak and replaces it between two jobs: nothing is lost, and
# nothing to be told. A worker that dies is another matter, an exception.
warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)


def run_jobs(jobs: Iterable[Any], workers: int, what: str, total: int) -> Iterator[Any]:
    """Results of `total` `joblib.delayed` calls, in their order, in `workers` processes.

    Under `joblib.parallel_config` with another back end, that one decides. `what` names the progress bar.
    """
    outcomes = joblib.Parallel(n_jobs=workers, return_as="generator")(jobs)
    yield from progress(outcomes, what, "scene", total)
