"""Settings that all tests share."""

import os

import hypothesis

import zerobev  # noqa: F401  # before a test loads torch: it tells OpenMP's threads not to spin

os.environ.setdefault("MPLBACKEND", "agg")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

# The same examples on every machine, and no limit on the time of one.
hypothesis.settings.register_profile("zerobev", derandomize=True, deadline=None)
hypothesis.settings.load_profile("zerobev")
