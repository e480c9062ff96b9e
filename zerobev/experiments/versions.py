"""Versions, raised by hand when code changes its results; results of older versions are computed again."""

DATA = 2  #: homes, views, textures
RECIPE = 4  #: training and evaluation of a run
DEPTH = 1  #: training of the depth estimator
MIXED_DEPTH = 4  #: depth of any quality in training
BENCHMARK = 6  #: measurements of the benchmark
