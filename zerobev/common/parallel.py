"""Jobs over scenes, spread over processes or a cluster by joblib, with progress."""

import contextlib
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Any

import joblib

from zerobev.common.errors import InputError
from zerobev.common.progress import progress

# After large homes joblib takes a worker's memory for a leak and replaces it between two jobs: nothing is lost, and
# nothing to be told. A worker that dies is another matter, an exception.
warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)


def run_jobs(jobs: Iterable[Any], workers: int, what: str, total: int) -> Iterator[Any]:
    """Results of `total` `joblib.delayed` calls, in their order, in `workers` processes.

    Under `joblib.parallel_config` with another back end, that one decides. `what` names the progress bar.
    """
    outcomes = joblib.Parallel(n_jobs=workers, return_as="generator")(jobs)
    yield from progress(outcomes, what, "scene", total)


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[None]:
    """Let `run_jobs` work on the dask cluster with the scheduler at `address`, if there is one.

    The job of a worker that dies is done by another; where it ends as many workers as the scheduler allows, it is taken
    for the cause, and `run_jobs` raises dask's `KilledWorker`. Raises `InputError` where there is no scheduler.
    """
    if address is None:
        yield
        return
    # not needed, and slow to import, without a cluster
    from dask.distributed import Client
    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):
        """joblib's own, which does not hear of a job that dask gives up, and waits for it for ever."""

        def submit(self, func: Any, callback: Callable[[Any], None]) -> Future:
            job = super().submit(func, callback)
            job.add_done_callback(lambda done: callback(done.exception()) if done.exception() else None)
            return job

        def retrieve_result_callback(self, out: Any) -> Any:
            if isinstance(out, Exception):
                raise out
            return super().retrieve_result_callback(out)

    try:
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise InputError(f"--dask: expected the address of a scheduler, found {address!r}: {error}") from None
    with client, joblib.parallel_config(backend=Backend(client=client)):
        yield
