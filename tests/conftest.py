"""Settings that all tests share."""

import os

import hypothesis

import zerobev  # noqa: F401  # before a test loads torch: it tells OpenMP's threads not to spin

os.environ.setdefault("MPLBACKEND", "agg")
# Networks in tests are too small for more threads, and `make test` runs two parts at a time.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

# The same examples on every machine, and no limit on the time of one.
hypothesis.settings.register_profile("zerobev", derandomize=True, deadline=None)
hypothesis.settings.load_profile("zerobev")
