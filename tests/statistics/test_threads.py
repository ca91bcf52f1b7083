"""BLAS is held to one thread while the readouts are solved, whoever else holds it."""

import os
import subprocess
import sys

CODE = """
import threading
from scroll_tactile.statistics.moments import one_thread
from threadpoolctl import threadpool_info, threadpool_limits

threads = lambda: {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}
before, within = threads(), []
def solve():
    with one_thread():
        within.append(threads())
solve()
thread = threading.Thread(target=solve)  # threadpoolctl 3.8 heeds the first thread that ever set a limit, and no other
thread.start()
thread.join()
assert within == [{1}, {1}] and threads() == before, (within, threads())
threadpool_limits(2, user_api="blas")
ours, theirs = one_thread(), one_thread()
ours.__enter__(); theirs.__enter__(); ours.__exit__(None, None, None)
assert threads() == {1}, threads()
theirs.__exit__(None, None, None)
assert threads() == {2}, threads()
"""


def test_it_stays_on_one_thread_in_any_thread_until_the_last_that_needs_it_has_left():
    subprocess.run(
        [sys.executable, "-c", CODE], check=True, timeout=60, env={**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    )
