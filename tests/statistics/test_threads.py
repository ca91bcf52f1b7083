"""BLAS is held to one thread in small factorisations, whenever its libraries are loaded."""

import subprocess
import sys


def test_the_blas_that_scipy_brings_is_governed_though_it_is_loaded_late():
    code = (
        "from scroll_tactile.statistics.moments import one_thread\n"
        "from threadpoolctl import threadpool_info\n"
        "with one_thread():\n"
        "    print([pool['num_threads'] for pool in threadpool_info() if pool['user_api'] == 'blas'])\n"
        "import scipy.linalg\n"
        "print(len([pool for pool in threadpool_info() if pool['user_api'] == 'blas']))"
    )
    held, count = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    ).stdout.splitlines()
    assert held == str([1] * int(count))
