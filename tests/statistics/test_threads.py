"""BLAS is held to one thread while the readouts are solved, whoever else holds it."""

import os
import subprocess
import sys


def test_it_stays_on_one_thread_until_the_last_that_needs_it_has_left_and_has_as_many_as_before_then():
    code = (
        "from scroll_tactile.statistics.moments import one_thread\n"
        "from threadpoolctl import threadpool_info, threadpool_limits\n"
        "threads = lambda: {pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas'}\n"
        "with one_thread(): pass\n"
        "threadpool_limits(2, user_api='blas')\n"
        "ours, theirs = one_thread(), one_thread()\n"
        "ours.__enter__(); theirs.__enter__(); ours.__exit__(None, None, None)\n"
        "within = threads()\n"
        "theirs.__exit__(None, None, None)\n"
        "assert (within, threads()) == ({1}, {2}), (within, threads())"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_it_stays_on_one_thread_in_whichever_thread_asks():
    """threadpoolctl 3.8 heeds the first thread that ever set a limit, and no other."""
    code = (
        "import threading\n"
        "from scroll_tactile.statistics.moments import one_thread\n"
        "from threadpoolctl import threadpool_info\n"
        "threads = lambda: {pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas'}\n"
        "before, within = threads(), []\n"
        "def solve():\n"
        "    with one_thread(): within.append(threads())\n"
        "solve()\n"
        "thread = threading.Thread(target=solve)\n"
        "thread.start(); thread.join()\n"
        "assert within == [{1}, {1}], within\n"
        "assert threads() == before"
    )
    variables = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60, env=variables)
