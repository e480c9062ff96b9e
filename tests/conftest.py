"""What every test shares: no display, no window, no chance."""

import os

import hypothesis

os.environ.setdefault("MPLBACKEND", "agg")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

# The same examples on every machine, and no limit on the time of one.
hypothesis.settings.register_profile("zerobev", derandomize=True, deadline=None)
hypothesis.settings.load_profile("zerobev")
