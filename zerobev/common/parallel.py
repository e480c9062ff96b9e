"""Jobs over scenes in several processes or on a cluster, with progress."""

import contextlib
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Any

import joblib

from zerobev.common.errors import InputError
from zerobev.common.progress import progress

# joblib suspects a leak after large homes and replaces the worker between two jobs; no result is lost. A worker that
# dies still raises an exception.
warnings.filterwarnings("ignore", "A worker stopped while some jobs were given", UserWarning)


def run_jobs(jobs: Iterable[Any], workers: int, title: str, total: int) -> Iterator[Any]:
    """Results of `total` `joblib.delayed` calls, in order, computed in `workers` processes.

    The back end of a surrounding `joblib.parallel_config` takes precedence. `title` is that of the progress bar.
    """
    outcomes = joblib.Parallel(n_jobs=workers, return_as="generator")(jobs)
    yield from progress(outcomes, title, "scene", total)


@contextlib.contextmanager
def cluster(address: str | None) -> Iterator[None]:
    """Run `run_jobs` on the dask cluster of the scheduler at `address`; None: in local processes.

    If a worker dies, another repeats its job. If a job kills as many workers as the scheduler allows, `run_jobs` raises
    dask's `KilledWorker`. Raises `InputError` if no scheduler answers.
    """
    if address is None:
        yield
        return
    # slow to import, and needed only with a cluster
    from dask.distributed import Client
    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):
        """joblib's back end; on its own it waits forever for a job that dask gives up."""

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
