"""A row taken out of the statistics leaves the readout that never observed it."""

import numpy as np
import pytest

from scroll_tactile.readouts.leave_one_out import leave_one_out_scores
from scroll_tactile.readouts.readout import fit_readout
from scroll_tactile.readouts.shrinkage import task_of
from scroll_tactile.statistics.moments import within_scatter
from scroll_tactile.statistics.statistics import Statistics

SCALE = 9


def statistics_of(rows, materials):
    statistics = Statistics(rows.shape[1], [SCALE])
    for at, (row, material) in enumerate(zip(rows, materials, strict=True)):
        statistics.add(material, at % 3, {SCALE: row[None]})
    return statistics


@pytest.mark.parametrize("penalty", [0.01, 1.0])
def test_it_is_as_if_the_row_had_never_been_observed(penalty):
    rng = np.random.default_rng(0)
    materials = [name for name in "abc" for _ in range(4)] + ["d", "d"]
    shifts = {name: rng.normal(0, 3e5, 8) for name in "abcd"}
    rows = np.rint([rng.normal(0, 2e5, 8) + shifts[name] for name in materials]).astype(np.int32)
    statistics = statistics_of(rows, materials)
    readout = fit_readout(task_of(statistics, SCALE), penalty)
    places = ["abcd".index(name) for name in materials]
    found = leave_one_out_scores(statistics, SCALE, readout, rows.astype(np.float64), places)
    for out, row in enumerate(rows):
        left = statistics_of(np.delete(rows, out, axis=0), materials[:out] + materials[out + 1 :])
        counts, sums = left.totals(SCALE)
        system = within_scatter(left.total_second(SCALE), counts, sums)
        system = np.triu(system) + np.triu(system, 1).T + np.diag(readout.penalties)
        means = sums / counts[:, None] - readout.center
        solved = np.linalg.solve(system, means.T) * len(rows)
        scores = (row - readout.center) @ solved - np.einsum("cd,dc->c", means, solved) / 2
        np.testing.assert_allclose(found[out], scores, rtol=1e-9, atol=1e-9)
