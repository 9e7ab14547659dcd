"""Benchmarks. What they measure is built, though it may lie on disk from an earlier run."""

import os

os.environ["TORCHCOVER_CACHE_GB"] = "0"
