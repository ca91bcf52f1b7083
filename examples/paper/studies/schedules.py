"""The order of a pass: which touch is learned when, and where parts of the pass end."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scroll_tactile.errors import InputError

__all__ = ["SCHEDULES", "arrange", "part_ends", "si_blurry"]

SCHEDULES = ("class-by-class", "shuffled")


def arrange(schedule: str, materials: Sequence[str], seed: int) -> list[int]:
    """The order in which N touches are learned: a permutation of 0 … N − 1.

    materials: of each touch, N names. seed: 0 or more.
    "class-by-class": all touches of one material, then of the next, materials in a drawn order; "shuffled": at random.

    Raises InputError for another schedule.
    """
    if schedule not in SCHEDULES:
        raise InputError(f"expected a schedule, one of {', '.join(SCHEDULES)}; came {schedule!r}")
    random = np.random.default_rng(seed)
    names = sorted(set(materials))
    turn = {names[place]: i for i, place in enumerate(random.permutation(len(names)))}
    draw = random.permutation(len(materials))
    if schedule == "shuffled":
        return [int(i) for i in draw]
    return sorted(range(len(materials)), key=lambda i: turn[materials[i]])  # stable: of a material in order


def part_ends(schedule: str, materials: Sequence[str]) -> list[int]:
    """After how many touches each part of a pass ends; a pass has as many parts as materials.

    materials: of each touch, in the order in which they are learned. Where they come one by one a part is a
    material; else the parts are equally long: of twenty materials, twentieths.
    """
    total, kinds = len(materials), len(set(materials))
    if schedule == "class-by-class":
        return [i for i in range(1, total + 1) if i == total or materials[i] != materials[i - 1]]
    return [round(total * part / kinds) for part in range(1, kinds + 1)]


def si_blurry(
    materials: Sequence[str], seed: int, *, tasks: int = 5, disjoint: float = 0.5, moved: float = 0.1
) -> tuple[list[int], list[int]]:
    """A Si-Blurry stream (Moon et al. 2023, arXiv 2308.09303): the order of N touches, and after how many a task ends.

    A share of the materials, `disjoint`, belongs to one task each, and so at first do the others, the blurry ones; both
    are cut into tasks at drawn places, so that tasks differ in size. Of the blurry materials' touches a share, `moved`,
    is drawn, and dealt over the tasks in shares that are drawn too. Within a task the order is at random. Each touch
    comes once. A task that nothing falls into is left out.

    materials: of each touch, N names. Raises InputError for shares that are none, or fewer tasks than one.
    """
    if tasks < 1 or not 0 <= disjoint <= 1 or not 0 <= moved <= 1:
        raise InputError(f"expected tasks of 1 or more and shares from 0 to 1; came {tasks}, {disjoint} and {moved}")
    random = np.random.default_rng([seed, 6])
    names = random.permutation(sorted(set(materials))).tolist()
    first = round(disjoint * len(names))
    task_of: dict[str, int] = {}
    for group in (names[:first], names[first:]):
        cuts = np.sort(random.integers(0, len(group) + 1, tasks - 1))
        task_of |= {name: int(np.searchsorted(cuts, i, side="right")) for i, name in enumerate(group)}
    task = np.array([task_of[name] for name in materials], dtype=np.intp)
    blurry = np.flatnonzero([name in names[first:] for name in materials])
    travelling = random.permutation(blurry)[: round(moved * len(blurry))]
    task[travelling] = random.choice(tasks, size=len(travelling), p=random.dirichlet(np.ones(tasks)))
    order = sorted(random.permutation(len(materials)).tolist(), key=lambda i: task[i])  # stable: random within a task
    ends = np.cumsum(np.bincount(task, minlength=tasks)).tolist()
    return order, sorted({end for end in ends if end})
