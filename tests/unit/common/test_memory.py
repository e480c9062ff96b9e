"""Memory that a process frees and allocates again."""

import platform
import subprocess
import sys

import pytest

from support.paths import ROOT

ROUNDS, BLOCK = 10, 30 * 2**20
PAGES = 3 * BLOCK // 4096  # per round
CHURN = f"""
import resource
import numpy as np
from zerobev.common.memory import keep_freed_memory

def churn():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range({ROUNDS}):
        blocks = [np.ones({BLOCK}, np.uint8) for _ in range(3)]
        del blocks
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

churn()
print(churn())
keep_freed_memory()
churn()
print(churn())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the allocator is glibc's")
def test_reused_blocks_cause_no_page_faults():
    # with huge pages, NumPy would cause fewer page faults
    env = {"NUMPY_MADVISE_HUGEPAGE": "0", "PYTHONPATH": str(ROOT)}
    ended = subprocess.run([sys.executable, "-c", CHURN], env=env, capture_output=True, text=True, check=True)
    default, keeping = map(int, ended.stdout.split())
    assert default > PAGES * ROUNDS / 2
    assert keeping < PAGES / 10
