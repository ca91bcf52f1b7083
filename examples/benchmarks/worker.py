"""A process that times one checkout's learner, call by call; `before` starts one with each checkout's path.

It asks nothing of the checkout but `TactileLearner.open`, `observe` and `predict`. Argument: a file of touches (arrays
`readings` and `materials`) and a folder for the memory. Each line on the standard input is "observe" or "predict" and
the number of a touch; the answer is the seconds that it took by the clock on the wall and of the processor.
"""

import sys
import time
from pathlib import Path

import numpy as np

__all__: list[str] = []


def _main(touches: Path, folder: Path) -> None:
    from scroll_tactile import TactileLearner
    from scroll_tactile.sensors import BIOTAC

    with np.load(touches) as file:
        readings, materials = file["readings"], file["materials"].tolist()
    with TactileLearner.open(folder, sensor=BIOTAC) as learner:
        print("ready", flush=True)
        for line in sys.stdin:
            verb, number = line.split()
            stream = readings[int(number)]
            begun, spent = time.perf_counter(), time.process_time()
            if verb == "observe":
                learner.observe(materials[int(number)], stream)
            else:
                learner.predict(stream)
            print(time.perf_counter() - begun, time.process_time() - spent, flush=True)


if __name__ == "__main__":
    _main(Path(sys.argv[1]), Path(sys.argv[2]))
