"""Versions that are raised by hand when code changes its results: results of an older version are computed again."""

DATA = 2  #: homes, sensors, textures
RECIPE = 4  #: training and evaluation of a run
DEPTH = 1  #: training of the depth estimator
BENCHMARK = 4  #: measurements of the benchmark
