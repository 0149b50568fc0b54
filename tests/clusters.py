"""Local Dask clusters of tests."""

import os
from pathlib import Path

#: What all have: a port that is free, and no lines on the screen.
QUIET = {"dashboard_address": "127.0.0.1:0", "silence_logs": 50}


def in_this_process(distributed, count=1, threads=1):
    """A cluster whose workers are threads of this process."""
    return distributed.LocalCluster(n_workers=count, threads_per_worker=threads, processes=False, **QUIET)


def of_processes(distributed, count):
    """A cluster whose workers are processes of one thread, with this checkout."""
    root = str(Path(__file__).parents[1])
    os.environ["PYTHONPATH"] = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])
    return distributed.LocalCluster(n_workers=count, threads_per_worker=1, memory_limit=0, **QUIET)
